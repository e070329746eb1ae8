"""Detection of a fall from the robot's own measurements. Pure.

After a fall all six modules only damp (`services.joint.setpoint_law`); a false alarm would let a
standing robot sink to the floor. No sign counts alone: two must be present for `AFTER_NS`.

    tilted    by the IMU, the plane of the soles is off level by more than `TILT_MAX`
    apart     the two legs disagree about the torso by more than `APART_MAX`: a sole is up
    whirled   by the IMU's gyroscope, that plane turned faster than `WHIRL_MIN` a moment ago
    turned    the torso is turned on its legs farther than a person leads it
    tipped    a sole's pressure was near its edge a moment ago, while the soles bore the robot
    unloaded  the soles bear less than `UNLOADED` of the weight

With an IMU, one of the two must be `tilted` or `apart`. Without an IMU, the fall of a robot that
topples stiffly on straight legs is not detected (docs/hazards.md). On straight legs the joint
torques do not show the load of the soles. With `turned` or `apart`, an unknown load counts as
`unloaded`.

The fallen state ends when a module that was in DAMP or FAULT holds again, because a person re-armed
it. The planner then starts like a new one, and leads only a robot whose feet bear its weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from services.planner.law.feet import slope_of
from shared.bus.messages import Mode, Pair, Vector3
from shared.clock import NS_PER_MS
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.robot.fault_table import FALLEN_REMEDY
from shared.robot.trip_table import limits_of

AFTER_NS: Final = 150 * NS_PER_MS
"""Two signs must be present for this time; a robot that is caught in time swings back sooner."""
MOMENT_NS: Final = 500 * NS_PER_MS
"""Time for which `tipped` and `whirled` remain signs; from the edge to the floor, a fall takes 0.5
to 0.8 s."""
TILT_MAX: Final = 0.5
"""rad; the robot stands on slopes up to 0.12, and its legs swing by 0.4 on a hoist."""
WHIRL_MIN: Final = 0.5
"""rad/s"""
APART_MAX: Final = (0.15, 0.3)
"""m and rad; 0.1 m trips (`trips.legs`), and a stone under a sole causes 0.05 m."""
ROLL_YAW_MAX: Final = (0.3, 0.5)
"""rad; requests are at most 0.12."""
PITCH: Final = (-0.45, 1.6)
"""rad; a person leads from -0.1 to 1.2."""
TIPPING: Final = 0.75
"""Fraction of half the sole; 1 is the edge, but measured torques lag as a sole tips."""
BORNE: Final = 0.8
"""Minimum fraction of the weight on the soles for `tipped`; a hoist also tips the robot over an
edge, but unloads it first."""
UNLOADED: Final = 0.45
"""Fraction of the weight."""

_DOWN: Final = (Mode.DAMP, Mode.FAULT)
_STIFF: Final = (Mode.HOLD, Mode.TRACK)
_SURE: Final = ("tilted", "apart")


class Seen(NamedTuple):
    """Measurements of one tick."""

    pose: Sequence[float]
    """p (6,), m and rad."""
    rates: Sequence[float]
    """Its rate (6,)."""
    closure: Sequence[float]
    """Left minus right leg's estimate of the torso (6,), m and rad."""
    soles: Pair
    """Loads of the soles, N; NaN if unknown."""
    tipping: float
    """`services.planner.law.feet.Soles.tipping`."""
    up: Vector3 | None
    """Unit vector against gravity, torso axes; None if unknown."""
    turning: Vector3 | None
    """Angular velocity of the torso, rad/s, torso axes; None if unknown."""


class FallState(msgspec.Struct):
    """State of `FallWatch`."""

    since_ns: int = 0
    """Time from which two signs have been present; 0 if they are not."""
    tipped_ns: int = 0
    """Time at which a sole last tipped."""
    whirled_ns: int = 0
    """Time at which the soles last turned fast."""
    fell_ns: int = 0
    """Time at which the fall was detected; 0 if there was no fall."""
    signs: str = ""
    """Signs that showed the fall, as text."""
    down: int = 0
    """Bit i: module i has been in DAMP or FAULT since the fall."""

    def describe(self) -> str:
        """Return a message about the fall and its remedy; "" if there was no fall."""
        if not self.fell_ns:
            return ""
        return f"the robot has fallen ({self.signs}): {FALLEN_REMEDY}"


class FallWatch:
    """Detector of a fall: two of six signs must be present."""

    def __init__(self, config: RobotConfig) -> None:
        """Set the weight; without trips, as in some studies, falls are not detected."""
        self._weight = config.total_mass * GRAVITY
        self._looks = math.isfinite(limits_of(config).legs.limit)

    def advance(self, s: FallState, now_ns: int, modes: Sequence[int], seen: Seen) -> bool:
        """Advance by one tick; return True if a person has just re-armed a robot that had fallen.

        Args:
            s: state of this watch; updated in place.
            now_ns: the planner's clock.
            modes: modes of the six modules; unless one is HOLD or TRACK, no fall is detected.
            seen: measurements of this tick.
        """
        if s.fell_ns:
            return _is_rearmed(s, modes)
        borne = sum(seen.soles)
        if seen.tipping > TIPPING and borne > BORNE * self._weight:
            s.tipped_ns = now_ns
        if seen.turning is not None and _whirl(seen, seen.turning) > WHIRL_MIN:
            s.whirled_ns = now_ns
        signs = self._signs(s, now_ns, seen, borne)
        agree = len(signs) >= 2 and (seen.up is None or signs[0] in _SURE)
        if not agree or not self._looks or not any(mode in _STIFF for mode in modes):
            s.since_ns = 0
            return False
        s.since_ns = s.since_ns or now_ns
        if now_ns - s.since_ns >= AFTER_NS:
            s.fell_ns, s.signs, s.since_ns, s.down = now_ns, " and ".join(signs), 0, 0
        return False

    def _signs(self, s: FallState, now_ns: int, seen: Seen, borne: float) -> list[str]:
        """Return the present signs, `tilted` and `apart` first."""
        signs = []
        _, _, _, roll, pitch, yaw = seen.pose
        if seen.up is not None and max(map(abs, slope_of(seen.up, roll, pitch, yaw))) > TILT_MAX:
            signs.append("tilted")
        is_apart = (
            math.hypot(*seen.closure[:3]) > APART_MAX[0]
            or max(map(abs, seen.closure[3:])) > APART_MAX[1]
        )
        if is_apart:
            signs.append("apart")
        if s.whirled_ns and now_ns - s.whirled_ns < MOMENT_NS:
            signs.append("whirled")
        is_turned = (
            abs(roll) > ROLL_YAW_MAX[0]
            or abs(yaw) > ROLL_YAW_MAX[1]
            or not PITCH[0] < pitch < PITCH[1]
        )
        if is_turned:
            signs.append("turned")
        if s.tipped_ns and now_ns - s.tipped_ns < MOMENT_NS:
            signs.append("tipped")
        is_unknown = math.isnan(borne) and (is_apart or is_turned)
        if is_unknown or borne < UNLOADED * self._weight:
            signs.append("unloaded")
        return signs


def _is_rearmed(s: FallState, modes: Sequence[int]) -> bool:
    """Return True, and end the fall, once a module that was in DAMP or FAULT is stiff again."""
    for i, mode in enumerate(modes):
        if mode in _DOWN:
            s.down |= 1 << i
        elif s.down & 1 << i and mode in _STIFF:
            s.fell_ns, s.signs = 0, ""
            return True
    return False


def _whirl(seen: Seen, turning: Vector3) -> float:
    """Return the rate of the soles' plane, rad/s: the torso's rate minus its rate on its legs."""
    roll, pitch, yaw = seen.rates[3:]
    cosine, sine = math.cos(seen.pose[4]), math.sin(seen.pose[4])
    x, y, z = turning  # R = Rz(yaw) Rx(roll) Ry(pitch), with little roll
    return math.hypot(x - (cosine * roll - sine * yaw), y - pitch, z - (sine * roll + cosine * yaw))
