"""Models the sampled-data loop around a pose: linear, with a flexible drivetrain. Offline and pure.

The dynamic certificate (docs/law.md) uses this model. Around a standing pose, in deviations
from it, with both feet in place:

    M p''     = T^T s - (K_geo + K_hand) p - (B_hand + d_joint T^T T) p'
    I theta'' = tau - s - d_motor theta',       s = k (theta - T p) + b (theta' - T p')
    lag tau'  = u - tau
    q^' = v^ + 2 w (theta - q^),  v^' = w^2 (theta - q^)        the drive's estimator

The controllers run on it, each at its own rate:

    drive          u = W - D_m q^ - D_Bm v^                     D_m: the module's mean
    joint service  W = tau + D_m q^ + D_Bm v^, tau the law of `services.joint.pd_law` on q^, v^
    planner        r = S J q^, q_ref = T r, tau_coupled filtered, used d after the sample;
                   tau_coupled includes F_I, with F_I' = K_p e_y / push_integral_s

One planner period is a linear map. The loop is stable if the map's spectral radius is below 1.

A standing pose is symmetric, left to right. The loop therefore splits into a sagittal half (x, z,
pitch) and a lateral half (y, roll, yaw): `halves`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.law.certificate import motor_mean
from services.planner.law.coupling import pole_gain
from services.planner.watch.park import FOLLOW_S
from shared.arrays import Array
from shared.extras import late
from shared.joints import N_JOINTS, N_LEG

linalg = late("scipy.linalg")


class DrivetrainModel(NamedTuple):
    """Flexible drivetrain between motor and joint."""

    stiffness: float
    """k, N m/rad."""
    damping: float
    """b, N m s/rad."""
    rotor_inertia: float
    """I, kg m^2 at the joint."""
    motor_damping: float = 0.3
    joint_damping: float = 0.2
    """N m s/rad"""
    lag_s: float = 1e-3
    """Lag of the drive's torque, s."""
    encoder_bandwidth: float = 1000.0
    """w, rad/s."""


class HandModel(NamedTuple):
    """Stiffness and damping of the hand at the harness, along z and pitch."""

    k_z: float
    b_z: float
    k_pitch: float
    b_pitch: float


MOVES_MIN: Final = 1e-9
"""An integral with a smaller gain is left out."""
ROUNDING: Final = 1e-12
"""Singular values below this fraction of the largest count as zero."""
NO_HAND: Final = HandModel(0.0, 0.0, 0.0, 0.0)


class LoopTiming(NamedTuple):
    """Periods and delays of the loop, s."""

    joint_period: float
    planner_period: float
    delay: float
    """From a state's sample to the first joint cycle that uses its command."""
    drive_step: float = 125e-6
    """Period of the drive's own loop."""
    write_delay: float = 1e-3
    """From a joint cycle to the drive's response; a multiple of `drive_step`."""


class Feedback(NamedTuple):
    """Feedback gains at one pose."""

    D: Array
    """(12,) N m/rad"""
    D_B: Array
    """(12,) N m s/rad"""
    C_q: Array
    """Coupled stiffness (12, 12): tau_coupled = C_q e_q + C_v e_v, N m/rad."""
    C_v: Array
    """Coupled damping (12, 12), N m s/rad."""
    bandwidth_hz: float
    """Bandwidth of the two poles of tau_coupled."""
    lead_easing: float = 0.0
    easing_bandwidth_hz: float = 40.0
    """Bandwidth of the pole on the hand's measured wrench."""
    integral: Array = np.zeros(N_JOINTS)
    """(12,): row of J whose error is integrated, or zeros."""
    integral_gain: float = 0.0
    """N/(m s)"""
    seen: Array = np.eye(N_JOINTS)
    """(12, 12): the local loops measure `seen` q; the identity unless an encoder is blind."""
    lifts: float = 0.0
    """Rate at which a parked robot's assist rises per metre below its height, N/(s m). Above 0 the
    assist also follows the hand's force, and nothing is eased (`services.planner.watch.park`)."""


class Gains(NamedTuple):
    """Factors on parts of the loop; a margin is the largest stable factor."""

    coupling: float = 1.0
    """On tau_coupled."""
    torque: float = 1.0
    """On every feedback torque."""


NOMINAL: Final = Gains()


class Growth(NamedTuple):
    """The motion that decays most slowly, or grows fastest."""

    rate: float
    """1/s; negative if it decays."""
    frequency_hz: float


class Stand(NamedTuple):
    """Linearised pose."""

    M: Array
    """(6, 6) inertia along p, without rotors."""
    K_geo: Array
    """(6, 6) stiffness of weight, load and feedforward."""
    T: Array
    """(12, 6)"""
    J: Array
    """(6, 12)"""
    J_harness: Array
    """(3, 12)"""
    H: Array
    """(12, 12): d tau_ff / d q_ref."""
    S: Array
    """(6,)"""


class Half(NamedTuple):
    """Part of the loop that is decoupled from the rest."""

    P: Array
    """(6, n) basis of p."""
    V: Array
    """(12, n_joint) basis of the joints."""


def halves() -> tuple[Half, Half]:
    """Return (sagittal, lateral); the mirror swaps the legs and inverts the sign of every phi."""
    mirror = np.array([-1.0, 1.0] * (N_LEG // 2))
    eye = np.eye(N_LEG) / math.sqrt(2.0)
    sagittal, lateral = np.vstack((eye, eye * mirror)), np.vstack((eye, -eye * mirror))
    p = np.eye(6)
    return Half(p[:, [0, 2, 4]], sagittal), Half(p[:, [1, 3, 5]], lateral)


def whole() -> Half:
    """Return the identity: the whole loop at once."""
    return Half(np.eye(6), np.eye(N_JOINTS))


class _Laws(NamedTuple):
    """Laws of services, planner and hand, in the coordinates of a half."""

    D: Array
    D_B: Array
    D_m: Array
    D_Bm: Array
    """Means over the motors of a module, as in the drives' law."""
    coupled: Array
    """(n, n_c) orthonormal basis of tau_coupled; filters and commands contain its coordinates."""
    C_q: Array
    C_v: Array
    """(n_c, n)"""
    H: Array
    J_open: Array
    T_open: Array
    """J and T of the coordinates in which the planner uses the measured values."""
    ease_p: Array
    ease_v: Array
    """(n_c, n_p): part of tau_coupled that eases the hand's force, or the assist that follows the
    force, per p and p'."""
    integral: Array
    """(1, n): the integrated row of J; (0, n) without one."""
    integrated: Array
    """(n_c, 1), or (n_c, 0): tau_coupled per F_I."""


class _State(NamedTuple):
    """Positions of plant and estimator in the state."""

    p: slice
    pd: slice
    theta: slice
    omega: slice
    tau: slice
    q: slice
    v: slice


class _Step(NamedTuple):
    """One step with constant inputs: x+ = F x + G u + G_f f, f a force on p."""

    F: Array
    G: Array
    G_f: Array

    def repeated(self, times: int) -> _Step:
        """Return the map of several steps."""
        total, by_u, by_f = np.eye(len(self.F)), np.zeros_like(self.G), np.zeros_like(self.G_f)
        for _ in range(times):
            total, by_u, by_f = (self.F @ total, self.F @ by_u + self.G, self.F @ by_f + self.G_f)
        return _Step(total, by_u, by_f)


class SampledLoop:
    """One half of the loop at one pose, with one drivetrain, hand and timing.

    Attributes:
        A: matrix of plant and estimator, x' = A x + B (u, f).
        n_z: (n_p,), rise of the harness point per unit of p.
        feedback: feedback of services and planner, before the projection to the half.
    """

    def __init__(
        self,
        stand: Stand,
        half: Half,
        feedback: Feedback,
        drivetrain: DrivetrainModel,
        timing: LoopTiming,
        hand: HandModel = NO_HAND,
    ) -> None:
        """Discretise the plant over one step of the drives."""
        self._timing, self.feedback = timing, feedback
        P, V = half.P, half.V
        self._n_p, self._n_q = n_p, n = P.shape[1], V.shape[1]
        at = np.cumsum([0, n_p, n_p, n, n, n, n, n])
        self._at = _State(*(slice(a, b) for a, b in pairwise(at)))
        self.n_z = n_z = P.T @ (stand.J_harness[2] @ stand.T)
        n_pitch = P.T @ np.eye(6)[4]
        self._laws = _laws(stand, half, feedback, hand, n_z, n_pitch)
        along_z, along_pitch = np.outer(n_z, n_z), np.outer(n_pitch, n_pitch)
        K = P.T @ stand.K_geo @ P + (hand.k_z * along_z + hand.k_pitch * along_pitch)
        B_hand = hand.b_z * along_z + hand.b_pitch * along_pitch
        T, M = V.T @ stand.T @ P, P.T @ stand.M @ P
        self.A, B = self._plant(T, M, K, B_hand, drivetrain)
        n_x = len(self.A)
        block = np.zeros((n_x + B.shape[1],) * 2)
        block[:n_x, :n_x], block[:n_x, n_x:] = self.A, B
        exact = linalg.expm(block * timing.drive_step)[:n_x]
        self._drive_step = _Step(exact[:, :n_x], exact[:, n_x : n_x + n], exact[:, n_x + n :])

    def _plant(
        self, T: Array, M: Array, K: Array, B_hand: Array, d: DrivetrainModel
    ) -> tuple[Array, Array]:
        """Return A and B of plant and estimator."""
        n_p, n = self._n_p, self._n_q
        n_x = 2 * n_p + 5 * n
        A, B = np.zeros((n_x, n_x)), np.zeros((n_x, n + n_p))
        p, pd, theta, omega, tau, q, v = self._at
        inverse, eye = np.linalg.inv(M), np.eye(n)
        k, b = d.stiffness, d.damping
        A[p, pd] = np.eye(n_p)
        A[pd, p] = -inverse @ (k * T.T @ T + K)
        A[pd, pd] = -inverse @ ((b + d.joint_damping) * T.T @ T + B_hand)
        A[pd, theta], A[pd, omega] = k * inverse @ T.T, b * inverse @ T.T
        A[theta, omega] = eye
        A[omega, theta] = -k / d.rotor_inertia * eye
        A[omega, omega] = -(b + d.motor_damping) / d.rotor_inertia * eye
        A[omega, p], A[omega, pd] = k / d.rotor_inertia * T, b / d.rotor_inertia * T
        A[omega, tau] = eye / d.rotor_inertia
        A[tau, tau], B[tau, :n] = -eye / d.lag_s, eye / d.lag_s
        w = d.encoder_bandwidth
        A[q, v], A[q, theta], A[q, q] = eye, 2.0 * w * eye, -2.0 * w * eye
        A[v, theta], A[v, q] = w * w * eye, -w * w * eye
        B[pd, n:] = inverse
        return A, B

    def period_map(self, gains: Gains = NOMINAL) -> tuple[Array, Array]:
        """Return (Phi, Gamma): X+ = Phi X + Gamma f over one planner period.

        X holds plant and estimator, the drives' targets, the filters, and the commands in transit.
        f is a force along p, constant over the period; `gains` scale parts of the loop.
        """
        t, n, laws, at = self._timing, self._n_q, self._laws, self._at
        cycles = round(t.planner_period / t.joint_period)
        steps = round(t.joint_period / t.drive_step)
        late = round(t.write_delay / t.drive_step)
        slots = max(0, math.ceil(t.delay / t.planner_period - 1e-9))
        n_c = laws.coupled.shape[1]
        command = 2 * len(laws.J_open) + n_c
        sizes = [len(self.A), n, n_c, n_c, n_c, len(laws.integral), *[command] * slots]
        ends = np.cumsum(sizes)
        width = int(ends[-1])
        X = np.eye(width, width + self._n_p)
        force = np.eye(width + self._n_p)[width:]
        x, W, f_1, f_2, eased, F_I, *queue = (part.copy() for part in np.split(X, ends[:-1]))
        f_1, f_2, eased, F_I, newest = self._tick(x, f_1, f_2, eased, F_I)
        queue.insert(0, newest)
        step, torque = self._drive_step, gains.torque
        closed = step.F.copy()
        closed[:, at.q] -= torque * step.G @ laws.D_m
        closed[:, at.v] -= torque * step.G @ laws.D_Bm
        driven = _Step(closed, torque * step.G, step.G_f)
        before, after = driven.repeated(late), driven.repeated(steps - late)
        for cycle in range(cycles):
            since = cycle * t.joint_period
            slot = max(0, math.ceil((t.delay - since) / t.planner_period - 1e-9))
            age = slot * t.planner_period + since
            old, W = W, self._target(x, queue[slot], age, gains)
            for (F, G, G_f), w in ((before, old), (after, W)):
                x = F @ x + G @ w + G_f @ force
        out = np.vstack((x, W, f_1, f_2, eased, F_I, *queue[:slots]))
        return out[:, :width], out[:, width:]

    def eigenvalues(self, gains: Gains = NOMINAL) -> NDArray[np.complex128]:
        """Return the eigenvalues of one planner period; stable if every magnitude is below 1."""
        return np.asarray(np.linalg.eigvals(self.period_map(gains)[0]), complex)

    def growth(self, gains: Gains = NOMINAL, above_hz: float = 0.0) -> Growth:
        """Return the motion that decays most slowly, ignoring motions slower than `above_hz`."""
        period = self._timing.planner_period
        values = self.eigenvalues(gains)
        if above_hz > 0.0:
            values = values[np.abs(np.angle(values)) >= 2.0 * math.pi * above_hz * period]
        worst = values[np.abs(values).argmax()]
        rate = math.log(max(abs(worst), 1e-12)) / period
        return Growth(rate, abs(np.angle(worst)) / (2.0 * math.pi * period))

    def impedance_z(self, w: float) -> complex:
        """Return force over velocity at the harness point, N s/m, for a hand that oscillates at w.

        w is in rad/s. Valid only for the half with z. The force acts along the world's z.
        """
        Phi, Gamma = self.period_map()
        z = np.exp(1j * w * self._timing.planner_period)
        X = np.linalg.solve(z * np.eye(len(Phi)) - Phi, Gamma @ self.n_z)
        return complex(1.0 / (self.n_z @ X[self._at.pd]))

    def _tick(
        self, x: Array, f_1: Array, f_2: Array, eased: Array, F_I: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Run the planner on the current samples; return its own states and its command."""
        laws, at, period = self._laws, self._at, self._timing.planner_period
        q, v = x[at.q], x[at.v]
        r, rate = laws.J_open @ q, laws.J_open @ v
        e_q, e_v = laws.T_open @ r - q, laws.T_open @ rate - v
        F_I = F_I + period * self.feedback.integral_gain * (laws.integral @ e_q)
        raw = laws.C_q @ e_q + laws.C_v @ e_v + laws.integrated @ F_I
        gain = pole_gain(self.feedback.bandwidth_hz, period)
        f_1 = f_1 + gain * (raw - f_1)
        f_2 = f_2 + gain * (f_1 - f_2)
        gain = pole_gain(self.feedback.easing_bandwidth_hz, period)
        if self.feedback.lifts > 0.0:
            gain = period / FOLLOW_S
        felt = laws.ease_p @ x[at.p] + laws.ease_v @ x[at.pd]
        eased = eased + gain * (felt - eased)
        return f_1, f_2, eased, F_I, np.vstack((r, rate, f_2 + eased))

    def _target(self, x: Array, entry: Array, age: float, gains: Gains) -> Array:
        """Run the joint service on the current samples; return W of the drives' law."""
        laws, n_open = self._laws, len(self._laws.J_open)
        q, v = x[self._at.q], x[self._at.v]
        r, rate, coupled = np.split(entry, (n_open, 2 * n_open))
        q_ref, v_ref = laws.T_open @ (r + age * rate), laws.T_open @ rate
        tau = laws.D @ (q_ref - q) + laws.D_B @ (v_ref - v)
        tau = tau + gains.coupling * laws.coupled @ coupled
        # a gain on all feedback does not scale the weight's feedforward
        tau = tau + laws.H @ q_ref / gains.torque
        return np.asarray(tau + laws.D_m @ q + laws.D_Bm @ v, float)


def _laws(
    stand: Stand, half: Half, feedback: Feedback, hand: HandModel, n_z: Array, n_pitch: Array
) -> _Laws:
    P, V = half.P, half.V
    opened = np.flatnonzero(P.T @ stand.S > 0.0)
    gains = [feedback.D, feedback.D_B, motor_mean(feedback.D), motor_mean(feedback.D_B)]
    D, D_B, D_m, D_Bm = (V.T @ (gain[:, np.newaxis] * feedback.seen) @ V for gain in gains)
    easing = np.outer(V.T @ stand.J_harness[2], n_z), np.outer(V.T @ stand.J[4], n_pitch)
    alpha = feedback.lead_easing
    integral = (feedback.integral @ V)[np.newaxis]
    if np.abs(integral).max() * feedback.integral_gain < MOVES_MIN:
        integral = integral[:0]  # it would stay constant, like a motion that does not decay
    C_q, C_v = V.T @ feedback.C_q @ V, V.T @ feedback.C_v @ V
    ease_p = -alpha * (hand.k_z * easing[0] + hand.k_pitch * easing[1])
    ease_v = -alpha * (hand.b_z * easing[0] + hand.b_pitch * easing[1])
    if feedback.lifts > 0.0:  # A' = (rest - A) / FOLLOW_S - lifts z; only the hand changes rest
        rise = feedback.lifts * FOLLOW_S * (P.T @ np.eye(6)[2])
        ease_p = hand.k_z * easing[0] - np.outer(V.T @ stand.J_harness[2], rise)
        ease_v = hand.b_z * easing[0]
    coupled = linalg.orth(np.hstack((C_q, C_v, integral.T, ease_p, ease_v)), rcond=ROUNDING)
    return _Laws(
        D=D,
        D_B=D_B,
        D_m=D_m,
        D_Bm=D_Bm,
        coupled=coupled,
        C_q=coupled.T @ C_q,
        C_v=coupled.T @ C_v,
        H=V.T @ stand.H @ V,
        J_open=(P.T @ stand.J @ V)[opened],
        T_open=(V.T @ stand.T @ P)[:, opened],
        ease_p=coupled.T @ ease_p,
        ease_v=coupled.T @ ease_v,
        integral=integral,
        integrated=coupled.T @ integral.T,
    )
