"""Estimates the floor's slope from IMU and joints, as the direction of up in floor axes. Pure.

The planner's axes are the floor's: z is the floor's normal (docs/law.md#slopes). On a slope,
gravity leans in these axes by the slope's angle. A COM above the ankles along the floor's normal is
then not above them along gravity. At a height of 1 m and 5 degrees it is 87 mm off, and the weight
pulls it downhill.

The IMU gives up in torso axes, and the joints give the torso's orientation on the floor:

    up_floor = R_torso(q) up_torso,        low-passed by one pole of `imu.levelling_s`

Zero errors of the ankles turn R_torso and so up_floor, but the COM is still controlled to be above
the ankles. Zero errors of knees and hips also turn it; without an IMU they would not matter. Half a
degree at both hips moves the COM by 8 mm.

Deflection of flexible joints is not in q, so a sway looks like a floor that tilts. The slope is
therefore followed slowly. A floor does not jump: without an IMU the last slope stays. If this
planner never received one, the floor counts as level. An IMU first received while the planner is
engaged is followed from level on.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from shared.arrays import Array
from shared.bus.messages import Pair, Vector3
from shared.clamp import clamp

SLOPE_MAX: Final = 0.12
"""rad each way, 7 degrees. This robot stands on no steeper floor, so a larger value means an IMU
that has come loose, and is ignored."""


class LevellingState(msgspec.Struct):
    """State of `Levelling`."""

    slope: Pair = (0.0, 0.0)
    """Rise of the floor along x and along y, rad, as in the plant's `floor.slope`."""
    known: bool = False


class Levelling:
    """Low-passed slope of the floor."""

    def __init__(self, levelling_s: float) -> None:
        """Set the time constant, s."""
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
            s: the slope, which changes.
            up_torso: unit vector against gravity, torso axes; None if it is not known now.
            angles: the torso's roll, pitch and yaw on the floor from the joints, rad.
            dt: time since the last call, s.
            jump: the planner is not engaged: take the first known slope at once.
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
    """Return the floor's rise along x and y, rad; (pi, pi) if the torso is upside down.

    Args:
        up_torso: unit vector against gravity, torso axes.
        roll: of the torso on the floor, rad; R = Rz(yaw) Rx(roll) Ry(pitch).
        pitch: of the torso on the floor, rad.
        yaw: of the torso on the floor, rad.
    """
    x, y, z = up_torso
    x, z = math.cos(pitch) * x + math.sin(pitch) * z, math.cos(pitch) * z - math.sin(pitch) * x
    y, z = math.cos(roll) * y - math.sin(roll) * z, math.cos(roll) * z + math.sin(roll) * y
    x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.cos(yaw) * y + math.sin(yaw) * x
    if z <= 0.0:
        return math.pi, math.pi
    return math.asin(clamp(x, -1.0, 1.0)), math.asin(clamp(y, -1.0, 1.0))
