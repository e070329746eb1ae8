"""A second, independent implementation of the sampled-data control loop, as a test oracle.

It steps the loop through time: events (planner sample, joint service, drive step) in order,
explicit queues for what is under way, and classical Runge-Kutta steps between the events.
It uses the full coordinates of all 12 joints, no symmetry, and no matrix exponential.

All quantities are deviations from an equilibrium, so the loop is linear. A column holds one
initial condition, and all columns are stepped together. The state is taken at time 0 of a
planner period, just before the sample of that period. Its rows are, in this order::

    p 6, pdot 6                   body pose and its rate
    theta 12, omega 12            motor angles and rates, joint side
    tau 12                        motor torques
    q_hat 12, v_hat 12            the drives' estimates of theta and omega
    W 12                          target in use by the drives
    f1 12, f2 12, e 12            the planner's filters
    F_I 1                         the planner's integral, a force, N
    r n, rdot n, c 12             each command still needed, oldest first; n = sum(S)
    W 12                          each target written but not yet in use, oldest first

How many commands and targets are under way follows from the delays, see `state_size`.
Units are SI (m, rad, s, N, N m) but for the bandwidths: those named _hz are in Hz, and the
encoder bandwidth is in rad/s.

Order of what falls on the same instant: planner sample, joint service, then drive step. A
target reaches the drives at the first drive step not earlier than its time of effect.

The Runge-Kutta step must be short against the fastest time constant: lag_s, the inverse of the
encoder bandwidth, and those of the drivetrain's oscillation and damping (I / b).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from shared.arrays import Array

N_POSE = 6
N_JOINTS = 12
PITCH = 4  # the row of p that is the pitch
UP = 2  # the row of the harness Jacobian that is vertical

INSTANT = 1e-9  # s; times closer than this are the same instant


@dataclass(frozen=True)
class Loop:
    """The constants of one loop."""

    M: Array  # (6, 6) mass matrix of the body
    K_geo: Array  # (6, 6) geometric stiffness of the body
    T: Array  # (12, 6) joint rates per body rate
    J: Array  # (6, 12) body rate per joint rates
    J_harness: Array  # (3, 12) harness point rate per joint rates; row 2 is vertical
    H: Array  # (12, 12) feedforward torque per joint reference, N m/rad
    S: Array  # (6,) 1 for each pose coordinate that is taken as measured
    D: Array  # (12,) joint stiffness gains
    D_B: Array  # (12,) joint damping gains
    C_q: Array  # (12, 12) coupling gains on the joint errors
    C_v: Array  # (12, 12) coupling gains on the joint rate errors
    bandwidth_hz: float  # corner of each of the two coupling filters
    lead_easing: float  # share of the hand's force that is eased
    easing_bandwidth_hz: float
    lifts: float  # above 0: an assist follows the hand within follow_s, and lifts, N/s per metre
    follow_s: float
    integral: Array  # (12,) body rate per joint rates, of what the planner integrates
    integral_gain: float  # growth of its force per error, N/(m s)
    k: float  # drivetrain stiffness
    b: float  # drivetrain damping
    I: float  # noqa: E741  (the paper's letter) motor inertia, joint side
    d_motor: float  # viscous friction at the motor
    d_joint: float  # viscous friction at the joint
    lag_s: float  # time constant of the motor torque, above 0
    encoder_bandwidth: float  # of the drive's estimator, rad/s
    hand: tuple[float, float, float, float]  # k_z, b_z, k_pitch, b_pitch
    joint_period: float  # divides the planner period
    planner_period: float
    delay: float  # least age of a command when the joint service uses it
    drive_step: float  # period of the drive law; divides the planner period
    write_delay: float  # from a joint cycle until the drives use its target


@dataclass(frozen=True)
class _Command:
    """What the planner sends: open pose coordinates, their rates, and coupling torques."""

    time: float  # of the sample, s
    r: Array
    rdot: Array
    c: Array


@dataclass(frozen=True)
class _Write:
    """A target on its way to the drives."""

    effect: float  # from when the drives may use it, s
    target: Array


class _Plant:
    """The continuous part: body, hand, drivetrains, motors and the drives' estimators.

    A state is (72, columns): p, pdot, theta, omega, tau, q_hat, v_hat.
    """

    P = slice(0, 6)
    P_DOT = slice(6, 12)
    THETA = slice(12, 24)
    OMEGA = slice(24, 36)
    TAU = slice(36, 48)
    Q_HAT = slice(48, 60)
    V_HAT = slice(60, 72)
    SIZE = 72

    def __init__(self, loop: Loop) -> None:
        self.loop = loop
        k_z, b_z, k_pitch, b_pitch = loop.hand
        n_z = loop.J_harness[UP] @ loop.T
        n_pitch = np.zeros(N_POSE)
        n_pitch[PITCH] = 1.0
        lift, pitch = np.outer(n_z, n_z), np.outer(n_pitch, n_pitch)
        self.stiffness = loop.K_geo + k_z * lift + k_pitch * pitch
        self.damping = b_z * lift + b_pitch * pitch + loop.d_joint * loop.T.T @ loop.T
        self.inverse_mass = np.linalg.inv(loop.M)

    def rates(self, x: Array, u: Array) -> Array:
        """The time derivative of the state at held drive torques u (12, columns)."""
        loop = self.loop
        p, p_dot = x[self.P], x[self.P_DOT]
        theta, omega, tau = x[self.THETA], x[self.OMEGA], x[self.TAU]
        q_hat, v_hat = x[self.Q_HAT], x[self.V_HAT]
        w = loop.encoder_bandwidth
        spring = loop.k * (theta - loop.T @ p) + loop.b * (omega - loop.T @ p_dot)
        force = loop.T.T @ spring - self.stiffness @ p - self.damping @ p_dot
        dx = np.empty_like(x)
        dx[self.P] = p_dot
        dx[self.P_DOT] = self.inverse_mass @ force
        dx[self.THETA] = omega
        dx[self.OMEGA] = (tau - spring - loop.d_motor * omega) / loop.I
        dx[self.TAU] = (u - tau) / loop.lag_s
        dx[self.Q_HAT] = v_hat + 2.0 * w * (theta - q_hat)
        dx[self.V_HAT] = w**2 * (theta - q_hat)
        return dx

    def advance(self, x: Array, u: Array, duration: float, micro_step: float) -> Array:
        """The state after a duration, in equal Runge-Kutta steps of at most micro_step."""
        steps = max(1, math.ceil(duration / micro_step - 1e-6))
        h = duration / steps
        for _ in range(steps):
            k1 = self.rates(x, u)
            k2 = self.rates(x + 0.5 * h * k1, u)
            k3 = self.rates(x + 0.5 * h * k2, u)
            k4 = self.rates(x + h * k3, u)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x


class _Planner:
    """The planner: makes one command from each sample, and keeps its filters."""

    def __init__(self, loop: Loop, f1: Array, f2: Array, e: Array, force: Array) -> None:
        self.loop = loop
        self.f1, self.f2, self.e, self.force = f1, f2, e, force
        self.open = np.asarray(loop.S).astype(bool)
        self.a = _filter_gain(loop.bandwidth_hz, loop.planner_period)
        self.a_e = _filter_gain(loop.easing_bandwidth_hz, loop.planner_period)

    def command(self, time: float, x: Array) -> _Command:
        """Take a sample of the plant, update the filters, and give the command."""
        loop = self.loop
        p, p_dot = x[_Plant.P], x[_Plant.P_DOT]
        q_hat, v_hat = x[_Plant.Q_HAT], x[_Plant.V_HAT]
        J_open, T_open = loop.J[self.open], loop.T[:, self.open]
        r, rdot = J_open @ q_hat, J_open @ v_hat
        error = T_open @ r - q_hat
        raw = loop.C_q @ error + loop.C_v @ (T_open @ rdot - v_hat)
        self.force = self.force + loop.planner_period * loop.integral_gain * (loop.integral @ error)
        raw = raw + np.outer(loop.integral, self.force)
        self.f1 = self.f1 + self.a * (raw - self.f1)
        self.f2 = self.f2 + self.a * (self.f1 - self.f2)
        if loop.lifts:
            self.e = self.e + loop.planner_period * self._assist_rate(p, p_dot)
        else:
            self.e = self.e + self.a_e * (self._felt(p, p_dot) - self.e)
        return _Command(time, r, rdot, self.f2 + self.e)

    def _assist_rate(self, p: Array, p_dot: Array) -> Array:
        """The rate of the joint torques of a parked robot's assist."""
        loop = self.loop
        k_z, b_z, _, _ = loop.hand
        z_dot = loop.J_harness[UP] @ loop.T @ p_dot
        weighs = k_z * (loop.J_harness[UP] @ loop.T @ p) + b_z * z_dot
        rises = weighs / loop.follow_s - loop.lifts * p[UP]
        return np.outer(loop.J_harness[UP], rises) - self.e / loop.follow_s

    def _felt(self, p: Array, p_dot: Array) -> Array:
        """The joint torques that ease the hand's force."""
        loop = self.loop
        k_z, b_z, k_pitch, b_pitch = loop.hand
        n_z = loop.J_harness[UP] @ loop.T
        lift = k_z * (n_z @ p) + b_z * (n_z @ p_dot)
        moment = k_pitch * p[PITCH] + b_pitch * p_dot[PITCH]
        torques = np.outer(loop.J_harness[UP], lift) + np.outer(loop.J[PITCH], moment)
        return np.asarray(-loop.lead_easing * torques)


def _filter_gain(bandwidth_hz: float, period: float) -> float:
    """The gain of a first-order filter that is updated once per period."""
    return 1.0 - math.exp(-2.0 * math.pi * bandwidth_hz * period)


def _pair_means(gains: Array) -> Array:
    """Each consecutive pair of gains replaced by its mean, as a column (12, 1)."""
    means = [0.5 * (gains[i - i % 2] + gains[i - i % 2 + 1]) for i in range(N_JOINTS)]
    return np.array(means)[:, None]


def _under_way(loop: Loop) -> tuple[int, int]:
    """How many commands and how many writes are under way at the start of a planner period."""
    commands = 0
    while commands * loop.planner_period < loop.delay - INSTANT:
        commands += 1
    writes = 0
    while (writes + 1) * loop.joint_period <= loop.write_delay + INSTANT:
        writes += 1
    return commands, writes


def state_size(loop: Loop) -> int:
    """The number of rows of the discrete state of a loop."""
    commands, writes = _under_way(loop)
    n_open = int(np.count_nonzero(loop.S))
    command_size = 2 * n_open + N_JOINTS
    return _Plant.SIZE + 4 * N_JOINTS + 1 + commands * command_size + writes * N_JOINTS


def _times(loop: Loop) -> list[tuple[float, bool, bool]]:
    """The events of one planner period in order: time in s, joint service or not, drive or not."""
    cycles = round(loop.planner_period / loop.joint_period)
    drives = round(loop.planner_period / loop.drive_step)
    joint_times = [loop.planner_period * i / cycles for i in range(cycles)]
    drive_times = [loop.planner_period * i / drives for i in range(drives)]
    events: list[tuple[float, bool, bool]] = []
    while joint_times or drive_times:
        now = min(joint_times[:1] + drive_times[:1])
        joint = bool(joint_times) and joint_times[0] <= now + INSTANT
        drive = bool(drive_times) and drive_times[0] <= now + INSTANT
        if joint:
            joint_times.pop(0)
        if drive:
            drive_times.pop(0)
        events.append((now, joint, drive))
    return events


def _joint_target(
    loop: Loop, x: Array, command: _Command, now: float, coupling: float, torque: float
) -> Array:
    """The target W of one joint cycle, (12, columns)."""
    T_open = loop.T[:, np.asarray(loop.S).astype(bool)]
    q_hat, v_hat = x[_Plant.Q_HAT], x[_Plant.V_HAT]
    age = now - command.time
    q_ref = T_open @ (command.r + age * command.rdot)
    v_ref = T_open @ command.rdot
    tau_law = (
        loop.D[:, None] * (q_ref - q_hat)
        + loop.D_B[:, None] * (v_ref - v_hat)
        + loop.H @ q_ref / torque
        + coupling * command.c
    )
    return np.asarray(tau_law + _pair_means(loop.D) * q_hat + _pair_means(loop.D_B) * v_hat)


def advance(
    loop: Loop, states: Array, coupling: float = 1.0, torque: float = 1.0, micro_step: float = 25e-6
) -> Array:
    """Step discrete states, one per column, through one planner period.

    `coupling` and `torque` are factors on the coupling torques and on the drives' torque; the
    feedforward is not scaled. `micro_step` is the longest Runge-Kutta step, s.
    """
    n_commands, n_writes = _under_way(loop)
    n_open = int(np.count_nonzero(loop.S))
    plant = _Plant(loop)
    D_m, D_Bm = _pair_means(loop.D), _pair_means(loop.D_B)

    # Unpack the state.
    rest = states

    def take(rows: int) -> Array:
        nonlocal rest
        head, rest = rest[:rows], rest[rows:]
        return head.copy()

    x = take(_Plant.SIZE)
    target = take(N_JOINTS)
    filters = take(N_JOINTS), take(N_JOINTS), take(N_JOINTS)
    planner = _Planner(loop, *filters, take(1))
    commands: deque[_Command] = deque()
    for i in range(n_commands):
        sampled = -(n_commands - i) * loop.planner_period
        commands.append(_Command(sampled, take(n_open), take(n_open), take(N_JOINTS)))
    writes: deque[_Write] = deque()
    for i in range(n_writes):
        written = -(n_writes - i) * loop.joint_period
        writes.append(_Write(written + loop.write_delay, take(N_JOINTS)))

    # Step through the events; u is set by the drive step at time 0.
    u = np.zeros_like(target)
    events = _times(loop)
    ends = [time for time, _, _ in events[1:]] + [loop.planner_period]
    commands.append(planner.command(0.0, x))
    for (now, joint, drive), end in zip(events, ends, strict=True):
        if joint:
            newest = next(c for c in reversed(commands) if now - c.time >= loop.delay - INSTANT)
            computed = _joint_target(loop, x, newest, now, coupling, torque)
            writes.append(_Write(now + loop.write_delay, computed))
        if drive:
            while writes and writes[0].effect <= now + INSTANT:
                target = writes.popleft().target
            u = torque * (target - D_m * x[plant.Q_HAT] - D_Bm * x[plant.V_HAT])
        x = plant.advance(x, u, end - now, micro_step)

    # Targets that took effect before the end are in use. Older commands are never used again.
    while writes and writes[0].effect < loop.planner_period - INSTANT:
        target = writes.popleft().target
    while len(commands) > n_commands:
        commands.popleft()

    parts = [x, target, planner.f1, planner.f2, planner.e, planner.force]
    for command in commands:
        parts += [command.r, command.rdot, command.c]
    parts += [write.target for write in writes]
    return np.vstack(parts)


def monodromy(loop: Loop, coupling: float = 1.0, torque: float = 1.0) -> Array:
    """The matrix that takes the discrete state over one planner period; rows as in `advance`."""
    return advance(loop, np.eye(state_size(loop)), coupling, torque)
