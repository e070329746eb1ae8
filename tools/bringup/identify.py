"""`xrl drive identify`: friction and reflected inertia from sine motions of a hanging leg. Pure.

The drive's own loop follows sines of a few frequencies, one after another. Once the motion of q is
steady, its Fourier series gives rate and acceleration without the lag of a filter, and

    tau = I q'' + d q' + c sign(q') + k (q - q_0) + tau_0

is linear in inertia I, viscous friction d, dry friction c, gravity's stiffness k, and tau_0. Two
frequencies separate I from k. I includes rotor and leg. The leg's inertia is computed from the
masses in the robot file, which are known only to a few percent, and subtracted. At an ankle the
"leg" is a foot; at a knee or hip its inertia is fifty times the rotor's.

A drive holds a target for one period, so its torque is a saw tooth. The fit uses the mean torque
around a sample. If the new target arrives at once (lockstep), this is half of the old target's
torque and half of the new one's. The later the new target arrives (over CAN about 1 ms), the larger
is the old target's share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from shared.arrays import Array
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from tools.bringup.hanging_leg import HEAVY, HangingJoint
from tools.bringup.motion import MotionPlan, Sample

TONES: Final = ((0.4, 5), (1.0, 8), (2.0, 12))
"""Frequency, Hz, and cycles of each tone; its first and last cycles, which fade, are not used."""
HEAVY_TONES: Final = ((0.2, 5), (0.5, 8))
AMPLITUDE_MAX: Final = 0.06
"""Maximum amplitude, rad."""
TORQUE_SHARE: Final = 0.4
"""Maximum torque of a tone for inertia and gravity, as a fraction of the torque limit."""
K_P: Final = (400.0, 3000.0)
"""Limits of k_p, N m/rad, for light and heavy joints. They are low, because a time error of the
samples adds an error of k_p times this time to the viscous friction."""
K_D: Final = (8.0, 35.0)
"""Limits of k_d, N m s/rad."""
PER_INERTIA: Final = (1600.0, 50.0)
"""k_p and k_d per inertia of a joint; the bandwidth is 40 rad/s."""
AFTER: Final = 0.25
"""Share of the new target's torque in the mean torque around a sample, assuming that the target
arrives 0.5 ms after the sample."""
TIME_SD: Final = 5e-4
"""Standard deviation of the target's arrival time, s."""
YIELDS: Final = 0.05
"""Relative uncertainty of an inertia, because leg and hoist on the joint's other side yield."""
DRY_SD: Final = 0.04
"""Standard deviation of dry friction due to cogging and play, N m."""
MASS_SD: Final = 0.03
"""Relative standard deviation of the leg's inertia as computed from the robot file."""
HALF_WIDTH: Final = 1.96
"""Half-width of the 95 % interval, standard deviations."""
HARMONICS: Final = 9
MOVING: Final = 0.3
"""Fraction of a tone's maximum rate. Slower samples are not used, because the joint may stick."""


class _Tone(NamedTuple):
    """One sine, which fades in during its first cycle and out during its last."""

    frequency_hz: float
    amplitude: float
    """rad"""
    cycles: int

    @property
    def duration_s(self) -> float:
        """Duration, s."""
        return self.cycles / self.frequency_hz

    def offset(self, t_s: float) -> tuple[float, float]:
        """Return the sine, rad, and its rate, rad/s, at a time since its start, s."""
        omega = 2.0 * math.pi * self.frequency_hz
        inside = min(1.0, t_s * self.frequency_hz, (self.duration_s - t_s) * self.frequency_hz)
        sign = 1.0 if t_s < 0.5 * self.duration_s else -1.0
        swell = 0.5 - 0.5 * math.cos(math.pi * inside)
        rising = 0.0
        if inside < 1.0:
            rising = sign * 0.5 * math.pi * self.frequency_hz * math.sin(math.pi * inside)
        sine, cosine = math.sin(omega * t_s), math.cos(omega * t_s)
        return (
            self.amplitude * swell * sine,
            self.amplitude * (rising * sine + swell * omega * cosine),
        )


class _Tones(NamedTuple):
    """Tones one after another; implements `tools.bringup.motion.AxisCourse`."""

    tones: tuple[_Tone, ...]

    @property
    def duration_s(self) -> float:
        """Duration of all tones, s."""
        return sum(tone.duration_s for tone in self.tones)

    @property
    def span(self) -> Pair:
        """Lowest and highest offset, rad."""
        most = max(tone.amplitude for tone in self.tones)
        return -most, most

    @property
    def rate_max(self) -> float:
        """Maximum requested rate, rad/s."""
        return max(2.0 * math.pi * tone.frequency_hz * tone.amplitude for tone in self.tones)

    def at(self, t_s: float) -> Pair:
        """Return offset, rad, and rate, rad/s."""
        for begin_s, tone in self.begins():
            if begin_s <= t_s < begin_s + tone.duration_s:
                return tone.offset(t_s - begin_s)
        return 0.0, 0.0

    def begins(self) -> list[tuple[float, _Tone]]:
        """Return each tone with its start time, s."""
        found, at = [], 0.0
        for tone in self.tones:
            found.append((at, tone))
            at += tone.duration_s
        return found


SinePlan = MotionPlan[_Tones]


class _JointFit(NamedTuple):
    """Results of the fit: values and their standard deviations."""

    inertia: tuple[float, float]
    """Inertia of rotor and leg, kg m^2."""
    viscous: tuple[float, float]
    """N m s/rad"""
    dry: tuple[float, float]
    """N m"""
    stiffness: tuple[float, float]
    """Stiffness from gravity, N m/rad."""


def plan_for(axis: int, torque: float, armature: float, joint: HangingJoint) -> SinePlan:
    """Return a plan of sines for a joint, which is first moved inside its limits.

    The torque limit is `torque`, N m, plus the torque that holds the leg at its bias.
    """
    inertia, gravity = joint.inertia + armature, joint.gravity
    tones = []
    for hertz, cycles in HEAVY_TONES if inertia > HEAVY else TONES:
        needed = abs(inertia * (2.0 * math.pi * hertz) ** 2 - gravity)
        most = TORQUE_SHARE * torque / max(needed, gravity, 1e-9)
        tones.append(_Tone(hertz, float(min(AMPLITUDE_MAX, most)), cycles))
    k_p = min(max(PER_INERTIA[0] * inertia, K_P[0]), K_P[1])
    k_d = min(max(PER_INERTIA[1] * inertia, K_D[0]), K_D[1])
    # equal for both axes, so that the motors' own loops apply all of it
    soft = ((k_p, k_p), (k_d, k_d))
    return SinePlan(axis, _Tones(tuple(tones)), torque + joint.held_torque, joint.bias, soft)


def fit_sines(samples: Sequence[Sample], plan: SinePlan) -> _JointFit | None:
    """Fit the steady samples of a motion; return None if there are too few."""
    parts = []
    for along_s, tone in plan.course.begins():
        begin_s = plan.rest_s + along_s
        period = 1.0 / tone.frequency_hz
        first, last = begin_s + period, begin_s + tone.duration_s - period
        rows = [s for s in samples if first <= s.t_s < last]
        if len(rows) < 20 * (tone.cycles - 2):
            return None
        parts.append(_steady(rows, begin_s, tone, plan.axis))
    regressors, tau, cycle, weight = map(np.concatenate, zip(*parts, strict=True))
    weighted = regressors * weight[:, None]
    H = np.linalg.inv(weighted.T @ regressors)
    x = H @ (weighted.T @ tau)
    left = tau - regressors @ x
    scores = np.array([weighted[cycle == k].T @ left[cycle == k] for k in np.unique(cycle)])
    covariance = H @ scores.T @ scores @ H
    inertia_sd, viscous_sd, dry_sd, stiffness_sd = np.sqrt(np.diag(covariance)[:4]).tolist()
    assert plan.own_gains is not None  # noqa: S101 - `plan_for` gives them
    (k_p, _), (k_d, _) = plan.own_gains
    inertia, viscous, dry, stiffness = x[:4].tolist()
    inertia_sd = math.hypot(inertia_sd, k_d * TIME_SD, YIELDS * inertia)
    viscous_sd = math.hypot(viscous_sd, k_p * TIME_SD)
    dry_sd = math.hypot(dry_sd, DRY_SD)
    return _JointFit(
        inertia=(inertia, inertia_sd),
        viscous=(viscous, viscous_sd),
        dry=(dry, dry_sd),
        stiffness=(stiffness, stiffness_sd),
    )


def _steady(
    samples: Sequence[Sample], begin_s: float, tone: _Tone, axis: int
) -> tuple[Array, Array, Array, Array]:
    """Return regressors (n, 5), torque (n,), cycle and weight of a tone's steady part.

    The weight of a sample is the distance that the joint covers during it. Cogging slows the joint
    wherever it opposes the motion, so with equal weights it would count as friction.
    """
    t = np.array([s.t_s - begin_s for s in samples])
    q = np.array([s.q[axis] for s in samples])
    before, after = (np.array([row[axis] for row in rows]) for rows in zip(
        *((s.tau_before, s.tau) for s in samples), strict=True
    ))  # fmt: skip
    tau = before + AFTER * (after - before)
    omega = 2.0 * math.pi * tone.frequency_hz
    k = omega * np.arange(1, HARMONICS + 1)
    cosine, sine = np.cos(np.outer(t, k)), np.sin(np.outer(t, k))
    basis = np.hstack([np.ones((len(t), 1)), t[:, None], cosine, sine])
    a, *_ = np.linalg.lstsq(basis, q, rcond=None)
    a_cos, a_sin = a[2 : 2 + HARMONICS], a[2 + HARMONICS :]
    v = sine @ (-k * a_cos) + cosine @ (k * a_sin)
    acceleration = cosine @ (-k * k * a_cos) + sine @ (-k * k * a_sin)
    smooth = basis @ a
    rows = np.stack([acceleration, v, np.sign(v), smooth, np.ones(len(t))], axis=1)
    cycle = np.floor(t * tone.frequency_hz) + 1000.0 * tone.frequency_hz
    moving = np.abs(v) > MOVING * np.max(np.abs(v))
    way = np.abs(np.gradient(q)) / np.mean(np.abs(v)) / np.mean(np.diff(t))
    return rows[moving], tau[moving], cycle[moving], way[moving]


Verdict = Literal["change", "agrees", "measured", "not shown"]
"""The robot file's value is outside the interval (change) or inside (agrees), the file has no value
(measured), or the interval is too wide for a verdict (not shown)."""


class Estimate(NamedTuple):
    """Estimate of one quantity of a joint."""

    what: str
    unit: str
    file: float | None
    """Value of the robot file, or None."""
    value: float
    half_width: float
    """Half-width of the 95 % interval."""
    verdict: Verdict

    @property
    def digits(self) -> int:
        """Decimals to print, down to a tenth of the half-width."""
        return max(0, 1 - math.floor(math.log10(max(self.half_width, 1e-9))))

    def describes(self, truth: float) -> bool:
        """Return True if a value lies within the interval."""
        return abs(truth - self.value) <= self.half_width


class JointResult(NamedTuple):
    """Fit of one joint."""

    joint: str
    fit: _JointFit
    leg_inertia: float
    """Inertia of the parts below the joint by the robot file, without its rotor, kg m^2."""


def estimates_of(results: Sequence[JointResult], robot: RobotConfig) -> list[Estimate]:
    """Return the estimates; the last row is the rotors' reflected inertia, equal for all joints.

    Its verdict is "not shown" if its half-width exceeds half of the robot file's value.
    """
    armature, rows, rotors = robot.joint.armature, [], []
    for joint, fit, leg_inertia in results:
        inertia = fit.inertia[0], math.hypot(fit.inertia[1], MASS_SD * leg_inertia)
        rotors.append((inertia[0] - leg_inertia, inertia[1]))
        rows += [
            _estimate(f"dry friction {joint}", "N m", fit.dry),
            _estimate(f"viscous friction {joint}", "N m s/rad", fit.viscous),
            _estimate(f"inertia {joint}", "kg m^2", inertia, leg_inertia + armature),
        ]
    weight = sum(1.0 / sd**2 for _, sd in rotors)
    mean = sum(value / sd**2 for value, sd in rotors) / weight
    sd = max(weight**-0.5, YIELDS * armature)
    last = _estimate("reflected inertia", "kg m^2", (mean, sd), armature)
    known = HALF_WIDTH * sd < 0.5 * armature
    return [*rows, last if known else last._replace(verdict="not shown")]


def _estimate(what: str, unit: str, of: tuple[float, float], file: float | None = None) -> Estimate:
    value, half_width = of[0], HALF_WIDTH * of[1]
    verdict: Verdict = "measured"
    if file is not None:
        verdict = "agrees" if abs(value - file) <= half_width else "change"
    return Estimate(what, unit, file, value, half_width, verdict)
