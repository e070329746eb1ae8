"""Which way is up, seen from the floor under the feet. Pure.

The planner's axes are the floor's: z is its normal (design section 3 a). On a slope gravity leans
in them by the slope's angle, and a COM above the ankles by the floor's normal is not above them by
gravity: at a height of 1 m and 5 degrees it is 87 mm off, and the weight pulls it along the floor.

The IMU says where up is in torso axes, the joints say how the torso stands on the floor:

    up_floor = R_torso(q) up_torso,        followed through one pole of `law.levelling_s`

Zero errors of the joints turn R_torso and so up_floor: the COM is led above the ankles all the
same. Joints that flex are not in q: a sway looks like a floor that tilts, which is why it is
followed slowly. A floor does not jump, so with no IMU for a while the last slope stands; with none
ever the floor is level.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shared.messages import Pair, Vector3

Array = NDArray[np.float64]

SLOPE_MAX: Final = 0.15
"""rad either way: beyond, it is not believed to be a floor that anybody stands on."""


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

    def advance(self, up_torso: Vector3 | None, angles: Array, dt: float) -> None:
        """Take what the IMU says.

        Args:
            up_torso: unit vector against gravity, torso axes; None: not known now.
            angles: the torso's roll, pitch and yaw on the floor by the joints, rad.
            dt: since the last call, s.
        """
        if up_torso is None:
            return
        x, y = slope_of(up_torso, *angles.tolist())
        share = 1.0 - math.exp(-dt / self._levelling_s) if self._known else 1.0
        self._known = True
        before = self.slope
        self._stand_on((before[0] + share * (x - before[0]), before[1] + share * (y - before[1])))

    def remember(self) -> tuple[bool, float, float]:
        """Return whether a slope is known, and the slope, rad."""
        return (self._known, *self.slope)

    def recall(self, memory: tuple[bool, float, float]) -> None:
        """Go on from what `remember` returned."""
        self._known = memory[0]
        self._stand_on(memory[1:])

    def _stand_on(self, slope: Pair) -> None:
        self.slope = slope
        x, y = math.sin(slope[0]), math.sin(slope[1])
        self._up[:] = x, y, math.sqrt(1.0 - x * x - y * y)


def slope_of(up_torso: Vector3, roll: float, pitch: float, yaw: float) -> Pair:
    """Return the floor's rise along x and y, rad, at most `SLOPE_MAX` either way.

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
    return _bounded_angle(x), _bounded_angle(y)


def _bounded_angle(sine: float) -> float:
    most = math.sin(SLOPE_MAX)
    return math.asin(min(most, max(-most, sine)))
