"""Which way is up, seen from the floor under the feet. Pure.

The planner's axes are the floor's: z is its normal (docs/law.md#slopes). On a slope gravity leans
in them by the slope's angle, and a COM above the ankles by the floor's normal is not above them by
gravity: at a height of 1 m and 5 degrees it is 87 mm off, and the weight pulls it along the floor.

The IMU says where up is in torso axes, the joints say how the torso stands on the floor:

    up_floor = R_torso(q) up_torso,        followed through one pole of `imu.levelling_s`

Zero errors of the ankles turn R_torso and so up_floor: the COM is led above the ankles all the
same. Those of knees and hips do so too, where without an IMU they would not have mattered: half a
degree at both hips moves the COM by 8 mm. Joints that flex are not in q: a sway looks like a floor
that tilts, which is why it is followed slowly. A floor does not jump: with no IMU for a while the
last slope stands, with none since this planner began the floor is level, and an IMU that is first
heard while the planner leads is followed from level on.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shared.messages import Pair, Vector3

Array = NDArray[np.float64]

SLOPE_MAX: Final = 0.12
"""rad either way, 7 degrees: beyond it is no floor that this robot stands on, but an IMU that has
come loose, and what it says is left out."""


class Levelling:
    """The slope of the floor, low-passed.

    Attributes:
        slope: rise of the floor along x and along y, rad, as in the plant's `floor.slope`.
    """

    def __init__(self, levelling_s: float) -> None:
        """Begin on a level floor.

        Args:
            levelling_s: time constant, s.
        """
        self.slope: Pair = (0.0, 0.0)
        self._levelling_s = levelling_s
        self._known = False
        self._up: Array = np.array((0.0, 0.0, 1.0))

    @property
    def up(self) -> Array:
        """(3,) unit vector against gravity, floor axes."""
        return self._up

    def advance(
        self, up_torso: Vector3 | None, angles: Array, dt: float, *, jump: bool = False
    ) -> None:
        """Take what the IMU says.

        Args:
            up_torso: unit vector against gravity, torso axes; None: not known now.
            angles: the torso's roll, pitch and yaw on the floor by the joints, rad.
            dt: since the last call, s.
            jump: nobody is led: the first that is heard is taken as it is.
        """
        if up_torso is None:
            return
        x, y = slope_of(up_torso, *angles.tolist())
        if max(abs(x), abs(y)) > SLOPE_MAX:
            return
        whole = jump and not self._known
        self._known = True
        share = 1.0 if whole else 1.0 - math.exp(-dt / self._levelling_s)
        before = self.slope
        self._stand_on((before[0] + share * (x - before[0]), before[1] + share * (y - before[1])))

    def snapshot(self) -> tuple[bool, float, float]:
        """Return whether a slope is known, and the slope, rad."""
        return (self._known, *self.slope)

    def restore(self, memory: tuple[bool, float, float]) -> None:
        """Go on from what `snapshot` returned."""
        self._known = memory[0]
        self._stand_on(memory[1:])

    def _stand_on(self, slope: Pair) -> None:
        self.slope = slope
        self._up[:] = up_of(slope)


def up_of(slope: Pair) -> Vector3:
    """Return the unit vector against gravity, floor axes, on a floor with this slope, rad."""
    x, y = math.sin(slope[0]), math.sin(slope[1])
    return x, y, math.sqrt(1.0 - x * x - y * y)


def slope_of(up_torso: Vector3, roll: float, pitch: float, yaw: float) -> Pair:
    """Return the floor's rise along x and y, rad; upside down is steeper than any floor.

    Args:
        up_torso: unit vector against gravity, torso axes.
        roll: of the torso on the floor, rad; R = Rz(yaw) Rx(roll) Ry(pitch).
        pitch: rad.
        yaw: rad.
    """
    x, y, z = up_torso
    x, z = math.cos(pitch) * x + math.sin(pitch) * z, math.cos(pitch) * z - math.sin(pitch) * x
    y, z = math.cos(roll) * y - math.sin(roll) * z, math.cos(roll) * z + math.sin(roll) * y
    x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.cos(yaw) * y + math.sin(yaw) * x
    if z <= 0.0:
        return math.pi, math.pi
    return math.asin(min(1.0, max(-1.0, x))), math.asin(min(1.0, max(-1.0, y)))
