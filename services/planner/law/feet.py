"""Stance of the feet, slope of the floor, and loads of the soles. Pure.

**Stance**, relative to the robot file. The law locates the feet from the joint angles alone. Both
legs carry the same torso, so a difference between their estimates of it shows a foot that is ahead,
turned, or closer than `geometry.w_base`. Before the planner engages, it adopts the stance in which
the legs agree, and keeps it while engaged. The legs then do not work against each other, and each
foot gets a wrench that suits its position.

Until its first lead, a planner adopts the stance at once. If a push tips the soles just then, it
keeps that wrong stance until it disengages. In later holds, the stance follows the joints slowly.
So it follows feet that were moved in HOLD, and ignores a sole that lifts briefly in a sway.

Errors in the joints' zeros look like slightly displaced feet, so they become part of the stance.
The planner refuses a stance beyond `law.stance_max`: no study shows that the robot stands in it,
and a sensor may be broken.

**Slope**, from IMU and joints, as the direction of up in floor axes. The planner's axes are the
floor's: z is the floor's normal (docs/law.md#slopes). On a slope, gravity leans in these axes by
the slope's angle. A COM above the ankles along the floor's normal is then not above them along
gravity. At a height of 1 m and 5 degrees it is 87 mm off, and the weight pulls it downhill.

The IMU measures up in torso axes; the joints give the torso's orientation on the floor:

    up_floor = R_torso(q) up_torso,        low-passed by one pole of `imu.levelling_s`

Errors in the ankles' zeros turn R_torso and thus up_floor, but the law still keeps the COM above
the ankles. Errors in the zeros of knees and hips also turn R_torso, and matter only with an IMU:
half a degree at both hips moves the COM by 8 mm.

q lacks the deflection of flexible joints, so a sway looks like a tilting floor. The filter is
therefore slow. The planner keeps the last slope if the IMU drops out, because a floor does not
jump. A planner that never received an attitude assumes a level floor. If the first attitude arrives
while the planner is engaged, the filter starts from level.

**Soles**, from the joint torques. A sole tips when its centre of pressure reaches its edge. HOLD
withstands a harder push from the side than the led robot (docs/results.md), so the planner trips
before a sole tips.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from shared.arrays import Array, vector6
from shared.bus.messages import AS_CONFIGURED, Pair, Vector3, Vector6
from shared.clamp import clamp
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULE_INDEX, SIDES

_ROWS: Final = (
    ("ahead of", "behind", "mm"),
    ("too near", "too far from", "mm"),
    ("higher than", "lower than", "mm"),
    ("tilted inner edge up relative to", "tilted outer edge up relative to", "deg"),
    ("pitched toes down relative to", "pitched toes up relative to", "deg"),
    ("turned inwards relative to", "turned outwards relative to", "deg"),
)
"""Right foot relative to the left: texts for a positive and a negative value of each row of a
stance, and the unit."""
_TO_UNIT: Final = {"mm": 1e3, "deg": 180.0 / math.pi}

FOLLOW_S: Final = 2.0
"""s; time constant with which a planner that has led before follows a new stance."""
FOLLOW_TOLERANCE: Final = 0.03
"""m or rad; the planner does not engage while adopted and measured stance differ by more."""


class StanceState(msgspec.Struct):
    """State of `Stance`."""

    taken: Vector6 = AS_CONFIGURED
    """Adopted stance of the right foot relative to the left, as a deviation from the robot file: x,
    y, z in m and a rotation vector in rad, world axes."""
    refusal: str = ""
    """Reason for refusing the last measured stance: it is beyond the limits, or not adopted yet. ""
    if it is accepted."""


class Stance:
    """Stance of the feet, followed within limits."""

    def __init__(self, stance_max: Sequence[float]) -> None:
        """Set the limits.

        Args:
            stance_max: `law.stance_max`, m and rad; a row with limit 0 is neither adopted nor
                refused.
        """
        self._stance_max: Array = np.array(stance_max)

    def advance(self, s: StanceState, measured: Array, fraction: float = 1.0) -> None:
        """Move the adopted stance towards the measured one, in which the legs agree now.

        Args:
            s: the stance; updated in place.
            measured: measured stance (6,), m and rad.
            fraction: step towards it, as a fraction; 1 adopts it at once.
        """
        if not np.isfinite(measured).all():
            s.refusal = "the joint angles give no stance: check the encoders"
            return
        checked, taken = self._stance_max > 0.0, np.array(s.taken)
        beyond = bool((checked & (np.abs(measured) > self._stance_max)).any())
        wanted = np.where(checked, measured, 0.0)
        if not beyond:  # a refused stance is not followed: an encoder may be broken
            taken += fraction * (wanted - taken)
            s.taken = vector6(taken)
        moved = bool((np.abs(wanted - taken) > FOLLOW_TOLERANCE).any())
        s.refusal = self._refusal(measured) if beyond or moved else ""

    def _refusal(self, measured: Array) -> str:
        rows = zip(measured.tolist(), self._stance_max.tolist(), _ROWS, strict=True)
        return (
            "; ".join(
                f"the right foot is {abs(value) * _TO_UNIT[unit]:.0f} {unit} "
                f"{positive if value > 0.0 else negative} the left: "
                f"at most {limit * _TO_UNIT[unit]:.0f} {unit} is accepted (law.stance_max)"
                for value, limit, (positive, negative, unit) in rows
                if 0.0 < limit < abs(value)
            )
            or "the feet have moved: wait until the planner has adopted the new stance"
        )


SLOPE_MAX: Final = 0.12
"""rad each way, 7 degrees. This robot cannot stand on a steeper floor, so a larger value means a
loose IMU and is ignored."""


class LevellingState(msgspec.Struct):
    """State of `Levelling`."""

    slope: Pair = (0.0, 0.0)
    """Rise of the floor along x and along y, rad, as in the plant's `floor.slope`."""
    known: bool = False


class Levelling:
    """Low-passed slope of the floor."""

    def __init__(self, levelling_s: float) -> None:
        self._levelling_s = levelling_s

    def advance(
        self,
        s: LevellingState,
        up_torso: Vector3 | None,
        angles: Array,
        dt: float,
        *,
        jump: bool = False,
    ) -> None:
        """Update the slope with the IMU's newest attitude.

        Args:
            s: the slope; updated in place.
            up_torso: unit vector against gravity, torso axes; None if unknown.
            angles: the torso's roll, pitch and yaw on the floor from the joints, rad.
            dt: time since the last call, s.
            jump: adopt the first known slope at once, because the planner is not engaged.
        """
        if up_torso is None:
            return
        x, y = slope_of(up_torso, *angles.tolist())
        if max(abs(x), abs(y)) > SLOPE_MAX:
            return
        at_once = jump and not s.known
        s.known = True
        gain = 1.0 if at_once else 1.0 - math.exp(-dt / self._levelling_s)
        before = s.slope
        s.slope = before[0] + gain * (x - before[0]), before[1] + gain * (y - before[1])


def up_of(slope: Pair) -> Vector3:
    """Return the unit vector against gravity, floor axes, on a floor with this slope, rad."""
    x, y = math.sin(slope[0]), math.sin(slope[1])
    return x, y, math.sqrt(1.0 - x * x - y * y)


def slope_of(up_torso: Vector3, roll: float, pitch: float, yaw: float) -> Pair:
    """Return the floor's rise along x and y, rad; (pi, pi) if it seems vertical or upside down.

    Args:
        up_torso: unit vector against gravity, torso axes.
        roll: torso roll on the floor, rad; R = Rz(yaw) Rx(roll) Ry(pitch).
        pitch: torso pitch on the floor, rad.
        yaw: torso yaw on the floor, rad.
    """
    x, y, z = up_torso
    x, z = math.cos(pitch) * x + math.sin(pitch) * z, math.cos(pitch) * z - math.sin(pitch) * x
    y, z = math.cos(roll) * y - math.sin(roll) * z, math.cos(roll) * z + math.sin(roll) * y
    x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.cos(yaw) * y + math.sin(yaw) * x
    if z <= 0.0:
        return math.pi, math.pi
    return math.asin(clamp(x, -1.0, 1.0)), math.asin(clamp(y, -1.0, 1.0))


ANKLES = tuple(2 * MODULE_INDEX[f"ankle_{side}"] for side in SIDES)
"""Indices of the ankles' phi among the joints."""
LOAD_MIN = 50.0
"""N; for a smaller load, `Soles.edge` uses this value, and `Soles.tipping` ignores the sole."""


class Soles:
    """Loads of the right and the left sole, and the offsets of their centres of pressure."""

    def __init__(self, config: RobotConfig) -> None:
        self._half_width = 0.5 * config.geometry.w_foot
        self._half_length = 0.5 * config.geometry.l_foot
        self._leg_weight = config.leg_weight
        self._at_rest = 0.5 * (config.total_mass * GRAVITY + config.leg_weight)

    def loads(self, leg_loads: Pair) -> Pair:
        """Return the loads of the soles, N: each leg's force on the torso plus the leg's weight.

        NaN for a leg whose force is unknown.

        Args:
            leg_loads: forces of the right and the left leg, N (`Measured.leg_loads`).
        """
        right, left = leg_loads
        return right + self._leg_weight, left + self._leg_weight

    def edge(self, tau: Array, loads: Pair) -> float:
        """Return the larger lateral pressure offset of the soles: 0 below the ankle, 1 at an edge.

        An unknown load counts as half of the weight.

        Args:
            tau: joint torques (12,), N m.
            loads: loads of the soles, N.
        """
        out = 0.0
        for ankle, load in zip(ANKLES, loads, strict=True):
            borne = self._at_rest if math.isnan(load) else max(load, LOAD_MIN)
            out = max(out, abs(float(tau[ankle])) / borne)
        return out / self._half_width

    def tipping(self, tau: Array, loads: Pair) -> float:
        """Return the largest pressure offset of the soles, across or along: 1 at edge, toe or heel.

        A sole whose load is unknown or below `LOAD_MIN` counts as 0.

        Args:
            tau: joint torques (12,), N m.
            loads: loads of the soles, N.
        """
        out = 0.0
        for ankle, load in zip(ANKLES, loads, strict=True):
            if load > LOAD_MIN:
                sideways = abs(float(tau[ankle])) / self._half_width
                along = abs(float(tau[ankle + 1])) / self._half_length
                out = max(out, sideways / load, along / load)
        return out
