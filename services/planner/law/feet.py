"""The feet: their stance, the slope of the floor, and what the soles bear. Pure.

**Stance**, relative to the robot file. The law knows its feet by the joints alone. Both legs carry
the same torso, so two estimates of one torso show a foot that is ahead, turned, or nearer than
`geometry.w_base`. Before the planner engages, it adopts the stance in which the legs agree. It
keeps that stance while engaged. No leg then works against the other, and each foot gets a wrench
that its own position allows. With the feet taken from the file, 0.1 m too wide tipped a sole by
0.18 rad; with the measured stance, by 0.002 rad.

While the planner is not engaged, the stance follows the joints slowly. Feet that were moved in HOLD
are found, and a sole that lifts in a sway is not mistaken for one. A planner that has not been
engaged yet cannot tell the two apart. If it starts while a push tips the soles, it keeps that
stance until it disengages again.

Zero errors of the joints become part of the stance: they look like feet that are slightly off. The
planner refuses a stance beyond `law.stance_max`: it was not shown to stand, or something is broken.

**Slope**, from IMU and joints, as the direction of up in floor axes. The planner's axes are the
floor's: z is the floor's normal (docs/law.md#slopes). On a slope, gravity leans in these axes by
the slope's angle. A COM above the ankles along the floor's normal is then not above them along
gravity. At a height of 1 m and 5 degrees it is 87 mm off, and the weight pulls it downhill.

The IMU gives up in torso axes, and the joints give the torso's orientation on the floor:

    up_floor = R_torso(q) up_torso,        low-passed by one pole of `imu.levelling_s`

Zero errors of the ankles turn R_torso and so up_floor, but the COM is still controlled to be above
the ankles. Zero errors of knees and hips also turn it; without an IMU they would not matter. Half a
degree at both hips moves the COM by 8 mm.

Deflection of flexible joints is not in q, so a sway looks like a floor that tilts. The slope is
therefore followed slowly. A floor does not jump: without an IMU the last slope stays. If this
planner never received one, the floor counts as level. An IMU first received while the planner is
engaged is followed from level on.

**Soles**, by the joints' torques. A sole whose centre of pressure reaches its edge tips, and a
robot that is led is soft against that: leaned on from the side it fell from 50 N on. HOLD is
stiffer, and bears 65 N and more if it begins while both soles are flat.
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
    ("inner edge up against", "outer edge up against", "deg"),
    ("pitched toes down against", "pitched toes up against", "deg"),
    ("turned inwards against", "turned outwards against", "deg"),
)
"""Right foot relative to the left: text for a positive and a negative row of a stance, and its
unit."""
_TO_UNIT: Final = {"mm": 1e3, "deg": 180.0 / math.pi}

FOLLOW_S: Final = 2.0
"""s; time constant with which a planner that was engaged before follows a new stance."""
FOLLOW_TOLERANCE: Final = 0.03
"""m or rad; the planner does not engage while adopted and measured stance differ by more."""


class StanceState(msgspec.Struct):
    """State of `Stance`."""

    taken: Vector6 = AS_CONFIGURED
    """Adopted stance of the right foot relative to the left, as deviation from the robot file:
    x, y, z in m and a rotation vector in rad, world axes."""
    refusal: str = ""
    """Why the stance measured last is refused: it is beyond the limits, or the feet have moved and
    their new stance is not adopted yet. "" if it is accepted."""


class Stance:
    """Follows the stance of the feet within limits."""

    def __init__(self, stance_max: Sequence[float]) -> None:
        """Set the limits.

        Args:
            stance_max: `law.stance_max`, m and rad; a zero row is neither adopted nor refused.
        """
        self._stance_max: Array = np.array(stance_max)

    def advance(self, s: StanceState, measured: Array, fraction: float = 1.0) -> None:
        """Adopt the stance in which the legs agree now.

        Args:
            s: the stance, which changes.
            measured: (6,), m and rad.
            fraction: of the way to it; 1 adopts it at once.
        """
        if not np.isfinite(measured).all():  # nothing to follow
            s.refusal = "the joint angles give no stance: check the encoders"
            return
        checked, taken = self._stance_max > 0.0, np.array(s.taken)
        beyond = bool((checked & (np.abs(measured) > self._stance_max)).any())
        wanted = np.where(checked, measured, 0.0)
        if not beyond:  # a refused stance is not followed: it may be a broken encoder
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


ANKLES = tuple(2 * MODULE_INDEX[f"ankle_{side}"] for side in SIDES)
"""Indices of the ankles' phi among the joints."""
LOAD_MIN = 50.0
"""N; a sole that bears less counts as one that bears this."""


class Soles:
    """Loads of the right and the left sole."""

    def __init__(self, config: RobotConfig) -> None:
        self._half_width = 0.5 * config.geometry.w_foot
        self._half_length = 0.5 * config.geometry.l_foot
        self._leg_weight = config.leg_weight
        self._at_rest = 0.5 * (config.total_mass * GRAVITY + config.leg_weight)

    def loads(self, leg_loads: Pair) -> Pair:
        """Return what the soles bear, N: the legs' forces on the torso, and their own weight.

        NaN for a leg whose force is not known.

        Args:
            leg_loads: of the right and the left leg, N (`Measured.leg_loads`).
        """
        right, left = leg_loads
        return right + self._leg_weight, left + self._leg_weight

    def edge(self, tau: Array, loads: Pair) -> float:
        """Return how far out a sole's pressure is sideways: 0 below the ankle, 1 at its edge.

        The larger one of both; a load that is not known counts as half of the weight.

        Args:
            tau: joint torques (12,), N m.
            loads: of the soles, N.
        """
        out = 0.0
        for ankle, load in zip(ANKLES, loads, strict=True):
            borne = self._at_rest if math.isnan(load) else max(load, LOAD_MIN)
            out = max(out, abs(float(tau[ankle])) / borne)
        return out / self._half_width

    def tipping(self, tau: Array, loads: Pair) -> float:
        """Return how far out a sole's pressure is in any direction: 1 at an edge, toe or heel.

        The larger one of both. A sole of unknown load, or under `LOAD_MIN`, counts as 0.

        Args:
            tau: joint torques (12,), N m.
            loads: of the soles, N.
        """
        out = 0.0
        for ankle, load in zip(ANKLES, loads, strict=True):
            if load > LOAD_MIN:
                sideways = abs(float(tau[ankle])) / self._half_width
                along = abs(float(tau[ankle + 1])) / self._half_length
                out = max(out, sideways / load, along / load)
        return out
