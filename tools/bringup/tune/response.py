"""How a reference is answered: step, frequency response, a second-order model, phase margin. Pure.

With stiffness K and damping B of the loop along one direction, its inertia M, and K_geo what weight
and hand add, an offset r of the reference without a rate is answered by

    y / r = H(s) = K / (M s^2 + B s + K + K_geo) = b_0 / (s^2 + a_1 s + a_0)

so b_0 = K / M, a_1 = B / M, a_0 = (K + K_geo) / M. The loop itself, cut at its torque, is

    L(s) = (K + B s) / (M s^2 + K_geo) = T / (1 - T),      T = H (1 + a_1 s / b_0)

and its phase margin is taken from the measured H, so that every delay is in it. Only B / K is the
model's, which takes up part of a delay: a loop 40 ms late is told 1 to 4 degrees better than it is,
one 10 ms late no better.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from shared.arrays import Array
from tools.bringup.tune.excitation import HOLD_S, REST_S, Excitation, SinePart

RISE: Final = (0.1, 0.9)
SETTLED: Final = 0.05
"""Fraction of the final value within which a step has settled."""
FINAL_S: Final = 1.0
"""The end of a step whose mean is its final value."""
MOVED_MIN: Final = 0.03
"""Fraction of the offset; a smaller response is too small to judge."""
BAND: Final = 0.3
"""Fraction of the largest response. The fit ends at the first frequency with less: flexible joints,
play and friction are seen there, and not the body."""
POINTS_MIN: Final = 4
MISFIT_MAX: Final = 0.25
"""With more, this is no second-order system: a heavy leg behind play and a soft drivetrain, seen by
an encoder at the motor."""


class StepAnswer(NamedTuple):
    """Answer to a step."""

    rise_s: float
    """From 10 to 90 % of the final value; NaN: it did not get there."""
    overshoot: float
    """Beyond the final value, as a fraction of it."""
    settling_s: float
    """Until it stays within 5 % of the final value; NaN: it does not."""
    final: float
    """Final value as a fraction of the step."""


class FrequencyPoint(NamedTuple):
    """Answer to one sine."""

    frequency_hz: float
    H: complex
    """y / r."""


class SecondOrder(NamedTuple):
    """y / r = b_0 / (s^2 + a_1 s + a_0)."""

    b_0: float
    a_1: float
    a_0: float

    @property
    def natural_frequency(self) -> float:
        """Without damping, rad/s."""
        return math.sqrt(self.a_0)

    @property
    def damping_ratio(self) -> float:
        """Damping as a fraction of the critical one."""
        return self.a_1 / (2.0 * self.natural_frequency)

    def at(self, omega: float) -> complex:
        """Return y / r at a frequency, rad/s."""
        s = 1j * omega
        return self.b_0 / (s * s + self.a_1 * s + self.a_0)


class ResponseFit(NamedTuple):
    """All of it."""

    step: StepAnswer
    points: tuple[FrequencyPoint, ...]
    model: SecondOrder
    phase_margin_deg: float
    """NaN: the loop's gain does not cross 1 within the frequencies."""
    misfit: float
    """Root mean square distance of points and model, relative to the points."""

    @property
    def is_second_order(self) -> bool:
        """True if the model says something: the points lie on it."""
        return self.misfit < MISFIT_MAX


def answer_of(t_s: Array, r: Array, y: Array, excitation: Excitation) -> ResponseFit | None:
    """Return how a reference's offsets r (n,) were answered by y (n,), both m or rad.

    None: it was hardly answered at all. Times are since the excitation began.
    """
    rest = t_s < REST_S
    y = y - np.mean(y[rest])
    step = _step(t_s, y, excitation.size)
    points = tuple(_point(t_s, r, y, sine) for sine in excitation.sines)
    if max(abs(point.H) for point in points) < MOVED_MIN:
        return None
    band = in_band(points)
    model = _fitted(band)
    off = [abs(p.H - model.at(2.0 * math.pi * p.frequency_hz)) / abs(p.H) for p in band]
    misfit = math.sqrt(sum(one * one for one in off) / len(off))
    return ResponseFit(step, points, model, _phase_margin(band, model), misfit)


def in_band(points: tuple[FrequencyPoint, ...]) -> tuple[FrequencyPoint, ...]:
    """Return the points that show the body: those before the answer has become small."""
    least = BAND * max(abs(point.H) for point in points)
    small = [n for n, point in enumerate(points) if abs(point.H) < least]
    return points[: max(POINTS_MIN, small[0] if small else len(points))]


def _step(t_s: Array, y: Array, size: float) -> StepAnswer:
    held = (t_s >= REST_S) & (t_s < REST_S + HOLD_S)
    t, moved = t_s[held] - REST_S, y[held] / size
    final = float(np.mean(moved[t > HOLD_S - FINAL_S]))
    if final < MOVED_MIN:
        return StepAnswer(math.nan, math.nan, math.nan, final)
    part = moved / final
    low, high = (_first(t, part >= share) for share in RISE)
    outside = np.flatnonzero(np.abs(part - 1.0) > SETTLED)
    late = bool(len(outside)) and outside[-1] + 1 >= len(t)
    settling = math.nan if late else float(t[outside[-1] + 1]) if len(outside) else 0.0
    return StepAnswer(high - low, max(0.0, float(part.max()) - 1.0), settling, final)


def _first(t: Array, reached: NDArray[np.bool_]) -> float:
    return float(t[np.argmax(reached)]) if reached.any() else math.nan


def _point(t_s: Array, r: Array, y: Array, sine: SinePart) -> FrequencyPoint:
    """Return y / r at a sine, by least squares over whole cycles without the first."""
    hertz = sine.frequency_hz
    chosen = (t_s >= sine.begin_s + 1.0 / hertz) & (t_s < sine.end_s)
    t = t_s[chosen]
    omega = 2.0 * math.pi * hertz
    basis = np.stack([np.cos(omega * t), np.sin(omega * t), np.ones(len(t)), t], axis=1)
    (a, b, *_), (c, d, *_) = (
        np.linalg.lstsq(basis, values[chosen], rcond=None)[0] for values in (r, y)
    )
    return FrequencyPoint(hertz, complex(c, -d) / complex(a, -b))


def _fitted(points: tuple[FrequencyPoint, ...]) -> SecondOrder:
    """Return the second-order model nearest to the points, each relative to its own size."""
    omega = np.array([2.0 * math.pi * point.frequency_hz for point in points])
    H = np.array([point.H for point in points])
    weight = 1.0 / np.maximum(np.abs(H), 0.1)

    def off(x: Array) -> Array:
        b_0, a_1, a_0 = np.exp(x)
        left = (b_0 / (a_0 - omega * omega + 1j * a_1 * omega) - H) * weight
        return np.concatenate([left.real, left.imag])

    peak = float(omega[np.argmax(np.abs(H))])
    starts = [np.log([w * w, 2.0 * z * w, w * w]) for w in (0.5 * peak, peak, 2.0 * peak, 6.0)
              for z in (0.2, 0.7)]  # fmt: skip
    scale = math.log(max(peak, 1.0))
    low, high = np.array([-9.0, -9.0, -4.0]) + scale, np.array([5.0, 4.0, 5.0]) + 2.0 * scale
    best = min(
        (least_squares(off, np.clip(start, low, high), bounds=(low, high)) for start in starts),
        key=lambda found: found.cost,
    )
    b_0, a_1, a_0 = np.exp(best.x).tolist()
    return SecondOrder(b_0, a_1, a_0)


def _phase_margin(points: tuple[FrequencyPoint, ...], model: SecondOrder) -> float:
    """Return the smallest phase margin where |L| crosses 1 between the points, degrees."""
    loop = []
    for point in points:
        s = 2j * math.pi * point.frequency_hz
        T = point.H * (1.0 + model.a_1 * s / model.b_0)
        loop.append(T / (1.0 - T))
    margins = []
    for a, b in pairwise(loop):
        size_a, size_b = math.log(abs(a)), math.log(abs(b))
        if size_a * size_b > 0.0 or size_a == size_b:
            continue
        share = size_a / (size_a - size_b)
        phase_a = math.atan2(a.imag, a.real)
        turned = math.atan2((b / a).imag, (b / a).real)
        phase = math.degrees(phase_a + share * turned)
        margins.append((phase + 180.0 + 180.0) % 360.0 - 180.0)
    return min(margins, key=abs) if margins else math.nan


def propose(
    model: SecondOrder,
    gains: tuple[float, float],
    inertia: float,
    *,
    bandwidth: float,
    damping_ratio: float,
) -> tuple[float, float]:
    """Return K_p and B_p that make the measured answer the wanted one; below 0 there are none.

    The model's a_0 and a_1 are all stiffness and damping over inertia, whoever gives them; what is
    missing or too much is added to the gains of the robot file.

    Args:
        model: measured.
        gains: K_p and B_p of the robot file, N/m and N s/m, or N m/rad and N m s/rad.
        inertia: along the direction, kg or kg m^2.
        bandwidth: wanted natural frequency, rad/s.
        damping_ratio: wanted.
    """
    K_p, B_p = gains
    return (
        K_p + inertia * (bandwidth**2 - model.a_0),
        B_p + inertia * (2.0 * damping_ratio * bandwidth - model.a_1),
    )
