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
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_POSE = 6
N_JOINTS = 12
PITCH = 4  # the row of p that is the pitch
UP = 2  # the row of the harness Jacobian that is vertical

INSTANT = 1e-9  # s; times closer than this are the same instant


@dataclass(frozen=True)
class Loop:
    """The constants of one loop.

    Attributes:
        M: Mass matrix of the body, (6, 6).
        K_geo: Geometric stiffness of the body, (6, 6).
        T: Joint rates per body rate, (12, 6).
        J: Body rate per joint rates, (6, 12).
        J_harness: Harness point rate per joint rates, (3, 12); row 2 is vertical.
        H: Feedforward stiffness, joint torque per joint reference in N m/rad, (12, 12).
        S: 1 for each pose coordinate left open, to be taken as measured, else 0, (6,).
        D: Joint stiffness gains in N m/rad, (12,).
        D_B: Joint damping gains in N m s/rad, (12,).
        C_q: Coupling gains on the joint errors in N m/rad, (12, 12).
        C_v: Coupling gains on the joint rate errors in N m s/rad, (12, 12).
        bandwidth_hz: Corner of each of the two coupling filters in Hz.
        lead_easing: The share alpha of the hand's force that is eased, no unit.
        easing_bandwidth_hz: Corner of the easing filter in Hz.
        k: Drivetrain stiffness in N m/rad.
        b: Drivetrain damping in N m s/rad.
        I: Motor inertia, joint side, in kg m^2.
        d_motor: Viscous friction at the motor in N m s/rad.
        d_joint: Viscous friction at the joint in N m s/rad.
        lag_s: Time constant of the motor torque in s, above 0.
        encoder_bandwidth: Bandwidth w of the drive's estimator in rad/s.
        hand: (k_z in N/m, b_z in N s/m, k_pitch in N m/rad, b_pitch in N m s/rad).
        joint_period: Period of the joint service in s; divides the planner period.
        planner_period: Period of the planner in s.
        delay: Least age of a command when the joint service uses it, in s.
        drive_step: Period of the drive law in s; divides the planner period.
        write_delay: Time from a joint cycle until the drives use its target, in s.
    """

    M: Array
    K_geo: Array
    T: Array
    J: Array
    J_harness: Array
    H: Array
    S: Array
    D: Array
    D_B: Array
    C_q: Array
    C_v: Array
    bandwidth_hz: float
    lead_easing: float
    easing_bandwidth_hz: float
    k: float
    b: float
    I: float  # noqa: E741  (the paper's letter)
    d_motor: float
    d_joint: float
    lag_s: float
    encoder_bandwidth: float
    hand: tuple[float, float, float, float]
    joint_period: float
    planner_period: float
    delay: float
    drive_step: float
    write_delay: float


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

    def __init__(self, loop: Loop, f1: Array, f2: Array, e: Array) -> None:
        self.loop = loop
        self.f1, self.f2, self.e = f1, f2, e
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
        raw = loop.C_q @ (T_open @ r - q_hat) + loop.C_v @ (T_open @ rdot - v_hat)
        self.f1 = self.f1 + self.a * (raw - self.f1)
        self.f2 = self.f2 + self.a * (self.f1 - self.f2)
        self.e = self.e + self.a_e * (self._felt(p, p_dot) - self.e)
        return _Command(time, r, rdot, self.f2 + self.e)

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


def _whole(quotient: float, what: str) -> int:
    """The quotient of two periods, which must be a whole number."""
    count = round(quotient)
    if count < 1 or abs(quotient - count) > 1e-6 * count:
        raise ValueError(f"{what} must divide the planner period")
    return count


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
    return _Plant.SIZE + 4 * N_JOINTS + commands * command_size + writes * N_JOINTS


def _times(loop: Loop) -> list[tuple[float, bool, bool]]:
    """The events of one planner period in order: time in s, joint service or not, drive or not."""
    cycles = _whole(loop.planner_period / loop.joint_period, "joint_period")
    drives = _whole(loop.planner_period / loop.drive_step, "drive_step")
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
    loop: Loop,
    states: Array,
    coupling: float = 1.0,
    torque: float = 1.0,
    micro_step: float = 25e-6,
) -> Array:
    """Step discrete states through one planner period.

    Args:
        loop: The constants of the loop.
        states: One state per column, (state_size(loop), columns); rows as in the module's text.
        coupling: Factor on the coupling torques c, no unit.
        torque: Factor on the drives' torque, no unit; the feedforward is not scaled.
        micro_step: Longest Runge-Kutta step in s.

    Returns:
        The states one planner period later, same shape.

    Raises:
        ValueError: The states have a wrong number of rows, or the periods do not fit.
    """
    if states.shape[0] != state_size(loop):
        raise ValueError(f"states need {state_size(loop)} rows, not {states.shape[0]}")
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
    planner = _Planner(loop, take(N_JOINTS), take(N_JOINTS), take(N_JOINTS))
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

    parts = [x, target, planner.f1, planner.f2, planner.e]
    for command in commands:
        parts += [command.r, command.rdot, command.c]
    parts += [write.target for write in writes]
    return np.vstack(parts)


def monodromy(
    loop: Loop, coupling: float = 1.0, torque: float = 1.0, micro_step: float = 25e-6
) -> Array:
    """The matrix that takes the discrete state over one planner period.

    Args:
        loop: The constants of the loop.
        coupling: Factor on the coupling torques c, no unit.
        torque: Factor on the drives' torque, no unit; the feedforward is not scaled.
        micro_step: Longest Runge-Kutta step in s.

    Returns:
        A square matrix of state_size(loop) rows; rows as in the module's text, SI units.
    """
    return advance(loop, np.eye(state_size(loop)), coupling, torque, micro_step)


def growth(
    loop: Loop, coupling: float = 1.0, torque: float = 1.0, micro_step: float = 25e-6
) -> float:
    """The growth rate of the slowest motion of the loop in 1/s; below 0 the loop is stable.

    It is the logarithm of the largest eigenvalue modulus of `monodromy` over the planner period.
    The arguments are those of `monodromy`.
    """
    eigenvalues = np.linalg.eigvals(monodromy(loop, coupling, torque, micro_step))
    return float(np.log(np.max(np.abs(eigenvalues))) / loop.planner_period)
