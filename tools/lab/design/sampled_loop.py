"""Models the sampled-data loop around a pose: linear, with a flexible drivetrain. Offline and pure.

The dynamic certificate (docs/law.md) rests on this model. Around a standing pose, in deviations
from it, with both feet in place:

    M p''     = T^T s - (K_geo + K_hand) p - (B_hand + d_joint T^T T) p'
    I theta'' = tau - s - d_motor theta',       s = k (theta - T p) + b (theta' - T p')
    lag tau'  = u - tau
    q^' = v^ + 2 w (theta - q^),  v^' = w^2 (theta - q^)        the drive's estimator

The controllers run on it, each at its own rate:

    drive          u = W - D_m q^ - D_Bm v^                     D_m: the module's mean
    joint service  W = tau + D_m q^ + D_Bm v^, tau the law of `services.joint.pd_law` on q^, v^
    planner        r = S J q^, q_ref = T r, tau_coupled filtered, sent d later than sampled

One planner period is a linear map. The loop is stable if the map's spectral radius is below 1.

A standing pose is symmetric, left to right. Its quantities therefore split into a sagittal half (x,
z, pitch) and a lateral one (y, roll, yaw): `halves`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from services.planner.law.coupling import pole_gain
from shared.joints import N_JOINTS, N_LEG

Array = NDArray[np.float64]


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
    """Feedback gains at one pose; matrices (12, 12) or (12,)."""

    D: Array
    D_B: Array
    C_q: Array
    """Coupled stiffness: tau_coupled = C_q e_q + C_v e_v, N m/rad."""
    C_v: Array
    """Coupled damping, N m s/rad."""
    bandwidth_hz: float
    """Bandwidth of the two poles of tau_coupled."""
    lead_easing: float = 0.0
    easing_bandwidth_hz: float = 40.0
    """Bandwidth of the pole on the hand's measured wrench."""


class Gains(NamedTuple):
    """Factors on parts of the loop; a margin is the largest stable factor."""

    coupling: float = 1.0
    """On tau_coupled."""
    torque: float = 1.0
    """On every torque that is feedback."""


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


class SampledLoop:
    """One half of the loop at one pose, with one drivetrain, hand and timing."""

    def __init__(
        self,
        stand: Stand,
        half: Half,
        feedback: Feedback,
        drivetrain: DrivetrainModel,
        timing: LoopTiming,
        hand: HandModel = NO_HAND,
        served: Array | None = None,
    ) -> None:
        """Discretise the plant over one step of the drives.

        Args:
            stand: the pose.
            half: part of the loop to analyse.
            feedback: of services and planner.
            drivetrain: of every joint.
            timing: periods and delays of the loop.
            hand: at the harness.
            served: (12,), 0 for joints whose service is dead: their drives keep their last target.
                Only with the whole loop. None if all services run.
        """
        self._timing, self._feedback = timing, feedback
        P, V = half.P, half.V
        self._n_p, self._n_q = P.shape[1], V.shape[1]
        n = self._n_q
        self._T = V.T @ stand.T @ P
        self._J = P.T @ stand.J @ V
        S = P.T @ stand.S
        self._open = np.flatnonzero(S > 0.0)
        self._T_open = self._T[:, self._open]
        self._J_open = self._J[self._open]
        self._H = V.T @ stand.H @ V
        self._D, self._D_B = (V.T @ np.diag(gain) @ V for gain in (feedback.D, feedback.D_B))
        mean = [np.repeat(g.reshape(-1, 2).mean(axis=1), 2) for g in (feedback.D, feedback.D_B)]
        self._D_m, self._D_Bm = (V.T @ np.diag(gain) @ V for gain in mean)
        self._served = V.T @ np.diag(np.ones(N_JOINTS) if served is None else served) @ V
        self._C_q, self._C_v = V.T @ feedback.C_q @ V, V.T @ feedback.C_v @ V
        n_z = P.T @ (stand.J_harness[2] @ stand.T)
        n_pitch = P.T @ np.eye(6)[4]
        self._K_hand = hand.k_z * np.outer(n_z, n_z) + hand.k_pitch * np.outer(n_pitch, n_pitch)
        self._B_hand = hand.b_z * np.outer(n_z, n_z) + hand.b_pitch * np.outer(n_pitch, n_pitch)
        easing = np.outer(V.T @ stand.J_harness[2], n_z), np.outer(V.T @ stand.J[4], n_pitch)
        alpha = feedback.lead_easing
        self._ease_p = -alpha * (hand.k_z * easing[0] + hand.k_pitch * easing[1])
        self._ease_v = -alpha * (hand.b_z * easing[0] + hand.b_pitch * easing[1])
        self.n_z = n_z
        """(n_p,): rise of the harness point along p."""
        self._plant(P.T @ stand.M @ P, P.T @ stand.K_geo @ P, drivetrain)
        self._n_x = 2 * self._n_p + 5 * n

    def _plant(self, M: Array, K_geo: Array, drivetrain: DrivetrainModel) -> None:
        """Build the step of plant and estimator: x+ = E x + G u + G_f f, f a force on p."""
        n_p, n, T, d = self._n_p, self._n_q, self._T, drivetrain
        n_x = 2 * n_p + 5 * n
        A, B = np.zeros((n_x, n_x)), np.zeros((n_x, n + n_p))
        at = np.cumsum([0, n_p, n_p, n, n, n, n, n])
        self._p, self._pd, self._theta, self._omega, self._tau, self._q, self._v = (
            slice(a, b) for a, b in pairwise(at)
        )
        p, pd, theta, omega, tau, q, v = (
            self._p, self._pd, self._theta, self._omega, self._tau, self._q, self._v,
        )  # fmt: skip
        inverse, eye = np.linalg.inv(M), np.eye(n)
        k, b = d.stiffness, d.damping
        A[p, pd] = np.eye(n_p)
        A[pd, p] = -inverse @ (k * T.T @ T + K_geo + self._K_hand)
        A[pd, pd] = -inverse @ ((b + d.joint_damping) * T.T @ T + self._B_hand)
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
        self.A, self.B = A, B
        block = np.zeros((n_x + B.shape[1],) * 2)
        block[:n_x, :n_x], block[:n_x, n_x:] = A, B
        exact = scipy.linalg.expm(block * self._timing.drive_step)[:n_x]
        self._E, self._G, self._G_f = exact[:, :n_x], exact[:, n_x : n_x + n], exact[:, n_x + n :]

    def period_map(
        self, gains: Gains = NOMINAL, delay: float | None = None, slots: int = 0
    ) -> tuple[Array, Array]:
        """Return (Phi, Gamma): X+ = Phi X + Gamma f over one planner period.

        X holds plant and estimator, the drives' targets, the filters, and the commands in transit.
        f is a force along p, constant over the period.

        Args:
            gains: on parts of the loop, for its margins.
            delay: s; None uses the delay of the timing.
            slots: least number of slots for commands in transit, so that maps of different delays
                have the same size.
        """
        t, n, n_open, n_x = self._timing, self._n_q, len(self._open), self._n_x
        delay = t.delay if delay is None else delay
        torque = gains.torque
        cycles = round(t.planner_period / t.joint_period)
        steps = round(t.joint_period / t.drive_step)
        late = round(t.write_delay / t.drive_step)
        slots = max(slots, math.ceil(delay / t.planner_period - 1e-9))
        entry = 2 * n_open + n
        width = n_x + 4 * n + slots * entry
        X = np.eye(width, width + self._n_p)
        at = n_x
        x, force = X[:n_x].copy(), np.eye(width + self._n_p)[width:]
        W, f_1, f_2, eased = (X[at + i * n : at + (i + 1) * n].copy() for i in range(4))
        at += 4 * n
        queue = [X[at + i * entry : at + (i + 1) * entry].copy() for i in range(slots)]
        f_1, f_2, eased, newest = self._tick(x, f_1, f_2, eased)
        queue.insert(0, newest)
        feedback = self._D_m, self._D_Bm
        closed = self._E.copy()
        closed[:, self._q] -= torque * self._G @ feedback[0]
        closed[:, self._v] -= torque * self._G @ feedback[1]
        before = _repeated(closed, torque * self._G, self._G_f, late)
        after = _repeated(closed, torque * self._G, self._G_f, steps - late)
        for cycle in range(cycles):
            since = cycle * t.joint_period
            slot = max(0, math.ceil((delay - since) / t.planner_period - 1e-9))
            age = slot * t.planner_period + since
            old, W = W, self._target(x, queue[slot], age, gains)
            for (F, G, G_f), w in ((before, old), (after, W)):
                x = F @ x + G @ w + G_f @ force
        out = np.vstack((x, W, f_1, f_2, eased, *queue[:slots]))
        return out[:, :width], out[:, width:]

    def eigenvalues(self, gains: Gains = NOMINAL) -> NDArray[np.complex128]:
        """Return the eigenvalues of one planner period; stable inside the unit circle."""
        return np.asarray(np.linalg.eigvals(self.period_map(gains)[0]), complex)

    def growth(self, gains: Gains = NOMINAL, above_hz: float = 0.0) -> Growth:
        """Return the growth rate of the loop's slowest decay, and its frequency.

        Args:
            gains: on parts of the loop.
            above_hz: ignore slower motions.
        """
        values = self.eigenvalues(gains)
        if above_hz > 0.0:
            least = 2.0 * math.pi * above_hz * self._timing.planner_period
            values = values[np.abs(np.angle(values)) >= least]
        worst = values[np.abs(values).argmax()]
        period = self._timing.planner_period
        rate = math.log(max(abs(worst), 1e-12)) / period
        return Growth(rate, abs(np.angle(worst)) / (2.0 * math.pi * period))

    def impedance_z(self, w: float) -> complex:
        """Return force over velocity of the harness point, N s/m, when a hand moves it at w rad/s.

        Valid only for the half that holds z. The force acts along the world's z at the harness.
        """
        Phi, Gamma = self.period_map()
        z = np.exp(1j * w * self._timing.planner_period)
        X = np.linalg.solve(z * np.eye(len(Phi)) - Phi, Gamma @ self.n_z)
        return complex(1.0 / (self.n_z @ X[self._pd]))

    def _tick(
        self, x: Array, f_1: Array, f_2: Array, eased: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Run the planner on the current samples; return its filter states and its command."""
        q, v = x[self._q], x[self._v]
        r, rate = self._J_open @ q, self._J_open @ v
        e_q, e_v = self._T_open @ r - q, self._T_open @ rate - v
        raw = self._C_q @ e_q + self._C_v @ e_v
        gain = pole_gain(self._feedback.bandwidth_hz, self._timing.planner_period)
        f_1 = f_1 + gain * (raw - f_1)
        f_2 = f_2 + gain * (f_1 - f_2)
        gain = pole_gain(self._feedback.easing_bandwidth_hz, self._timing.planner_period)
        felt = self._ease_p @ x[self._p] + self._ease_v @ x[self._pd]
        eased = eased + gain * (felt - eased)
        return f_1, f_2, eased, np.vstack((r, rate, f_2 + eased))

    def _target(self, x: Array, entry: Array, age: float, gains: Gains) -> Array:
        """Run the joint service on the current samples; return W of the drives' law."""
        q, v, n_open = x[self._q], x[self._v], len(self._open)
        r, rate, coupled = entry[:n_open], entry[n_open : 2 * n_open], entry[2 * n_open :]
        q_ref, v_ref = self._T_open @ (r + age * rate), self._T_open @ rate
        tau = self._D @ (q_ref - q) + self._D_B @ (v_ref - v) + gains.coupling * coupled
        # a gain on all feedback does not scale the weight's feedforward
        tau = tau + self._H @ q_ref / gains.torque
        return np.asarray(self._served @ (tau + self._D_m @ q + self._D_Bm @ v), float)


def _repeated(F: Array, G: Array, G_f: Array, times: int) -> tuple[Array, Array, Array]:
    """Return the map of `times` steps with constant inputs."""
    total, by_w, by_f = np.eye(len(F)), np.zeros_like(G), np.zeros_like(G_f)
    for _ in range(times):
        total, by_w, by_f = F @ total, F @ by_w + G, F @ by_f + G_f
    return total, by_w, by_f
