"""Estimate of the torso's load beyond the robot file: its weight and its position. Pure.

The open directions have no stiffness, so an unknown weight moves the robot as soon as nobody holds
it. A momentum observer estimates the weight from the joint torques. F is the wrench along p that
joints and person support, and n the rise of the harness point along p. f_h and m_h are the person's
force and pitch moment. m is the robot's mass in the file, dm the surplus mass; M and I are the
torso's mass and inertia about pitch:

    F         = T^T (tau + J_harness^T f_h + J_pitch^T m_h)       [J; C] T = [I; 0]
    n         = T^T J_harness,z
    dm g      = (F_z - m g) / n_z - M zddot_harness
    a cos(pitch) + b sin(pitch) = F_pitch - n_pitch dm g - I pitchddot

a and b are the moments that support the surplus weight about the harness point, torso axes, N m. a
depends on how far behind the weight lies, b on how low. The estimate is low-passed, and reduced by
the amount that dry friction in the joints hides. It is fed forward like the assist, so it is part
of every tick's certificate. Beyond `law.load_correction` the planner does not engage, because
schedule and studies then describe another robot. An error of the harness sensor looks like load.

Nor does the planner engage while the robot hangs on a hoist, because the feedforward would lift it
off the hoist. Without its payload, it would rise to straight legs (0.1 m up), where torques do not
show the load. The planner holds until the feet carry the file's weight within the limit. This check
needs no harness, because no hand lifts half the robot.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from shared.arrays import Array
from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY

LEADING_S: Final = 2.0
HOLDING_S: Final = 0.25
"""s, time constants. While engaged, the load is estimated at rest only, and slowly. In motion, the
drivetrain and a mass error of 5 % look like 8 kg."""
STILL_RATES: Final = (0.05, 0.1)
"""m/s of the harness point and rad/s of the torso's pitch; slower counts as rest."""
FRICTION_BAND: Final = (8.0, 1.5)
"""Force, N, and moment, N m, that dry friction may hide (0.3 N m per joint hides 6 N)."""
WEIGHING_S: Final = 1.0
"""s; time for which a lowered robot's load must stay within the limits: four time constants."""
RESUME_FRACTION: Final = 0.8
"""Fraction of the limits within which a refused load is accepted again."""
CARRIED_FRACTION: Final = 0.25
"""Fraction of the file's weight; with less on its feet, a robot in TRACK is falling or hanging."""
HANGING_FRACTION: Final = 0.5
"""Fraction of the file's weight; with less on its feet, a robot in HOLD hangs on a hoist."""


class LoadState(msgspec.Struct):
    """State of `Load`."""

    kg: float = 0.0
    """Surplus mass."""
    a: float = 0.0
    """N m about pitch, for a load behind (+) or ahead of the file's centre."""
    b: float = 0.0
    """N m about pitch, for a load below (+) or above it, with the torso at 90 degrees."""
    rates: Pair | None = None
    """Rates of harness height and torso pitch at the last update; None while the estimate pauses,
    because a state is stale or a leg's load unknown."""
    refused: bool = False
    weighing_s: float = 0.0
    looked: bool = False
    """True once the first update has checked whether the robot hangs."""

    @property
    def blocks(self) -> bool:
        """True while the load differs too much from the file, or is still being weighed."""
        return self.refused or self.weighing_s > 0.0

    def moment(self, pitch: float) -> float:
        """Return the moment of the surplus load about the harness point, N m, at a pitch, rad."""
        return self.a * math.cos(pitch) + self.b * math.sin(pitch)


class Load:
    """Estimator of the surplus load, low-passed."""

    def __init__(self, correction_max: Pair, weight: float, mass: float, inertia: float) -> None:
        """Set the limits, and the robot file's weight, mass and inertia.

        Args:
            correction_max: `law.load_correction`: kg and N m; two zeros disable the estimate.
            weight: weight of the whole robot in the file, N.
            mass: mass of the torso, kg.
            inertia: inertia of the torso about pitch, kg m^2.
        """
        self._kg_max, self._moment_max = correction_max
        self.enabled = any(correction_max)
        self._weight, self._mass, self.inertia = weight, mass, inertia

    def refusal(self, s: LoadState) -> str:
        """Return the reason for refusing the load and the remedy; "" if it is accepted."""
        if not s.refused:
            return "the load is being weighed" if s.weighing_s > 0.0 else ""
        if self._is_hung(s):
            return (
                "the robot hangs: lower it until its feet bear its weight. If it stands, it "
                f"carries {-s.kg:.0f} kg less than the robot file says: set mass.payload, "
                "then run `xrl gains`"
            )
        reasons = []
        if abs(s.kg) > RESUME_FRACTION * self._kg_max:
            more = "more" if s.kg > 0.0 else "less"
            held_up = "" if s.kg > 0.0 else " and nothing holds it up"
            reasons.append(
                f"the robot carries {abs(s.kg):.1f} kg {more} than the robot file says, or its "
                f"harness measures wrongly: at most {self._kg_max:g} kg is accepted "
                f"({RESUME_FRACTION * self._kg_max:g} once refused). First tare the unloaded "
                f"harness (`xrl drive tare`); if that changes nothing{held_up}, set mass.payload, "
                "then run `xrl gains`"
            )
        for moment, positive, negative in ((s.a, "behind", "ahead"), (s.b, "down", "up")):
            if abs(moment) > RESUME_FRACTION * self._moment_max:
                reasons.append(
                    f"the load lies too far {positive if moment > 0.0 else negative}, by "
                    f"{abs(moment):.0f} N m: centre it; at most {self._moment_max:g} N m is "
                    f"accepted ({RESUME_FRACTION * self._moment_max:g} once refused)"
                )
        return "; ".join(reasons)

    def force(self, s: LoadState) -> float:
        """Return the surplus weight beyond friction, N at the harness point, within the limit."""
        return _deadband(GRAVITY * s.kg, FRICTION_BAND[0], GRAVITY * self._kg_max)

    def moment(self, s: LoadState, pitch: float) -> float:
        """Return the surplus pitch moment beyond friction, N m, within the limit."""
        return _deadband(s.moment(pitch), FRICTION_BAND[1], self._moment_max)

    def advance(
        self, s: LoadState, F: Array, n: Array, pitch: float, rates: Pair, dt: float, *, led: bool
    ) -> None:
        """Update with the wrench that joints and person support.

        Args:
            s: state of the estimate; updated in place.
            F: wrench along p (6,), N and N m, world.
            n: rise of the harness point along p (6,), m/m and m/rad.
            pitch: torso pitch, rad.
            rates: rates of the harness point's height, m/s, and of the torso's pitch, rad/s.
            dt: time since the last call, s.
            led: True while the planner is engaged.
        """
        before, s.rates = s.rates, rates
        surplus = float(F[2]) - self._weight
        if self._hangs_at_start(s, surplus, led=led) or before is None:
            return
        if led and surplus < (CARRIED_FRACTION - 1.0) * self._weight:
            return
        if led and (abs(rates[0]) > STILL_RATES[0] or abs(rates[1]) > STILL_RATES[1]):
            return
        pole_s = LEADING_S if led else HOLDING_S
        weight = surplus / float(n[2])
        moment = float(F[4]) - float(n[4]) * GRAVITY * s.kg
        s.kg += min(1.0, dt / pole_s) * (weight / GRAVITY - s.kg)
        s.kg -= self._mass * (rates[0] - before[0]) / (GRAVITY * pole_s)
        error = dt * (moment - s.moment(pitch)) - self.inertia * (rates[1] - before[1])
        error /= pole_s
        s.a += error * math.cos(pitch)
        s.b += error * math.sin(pitch)
        if not led and self._is_hung(s):
            s.weighing_s = WEIGHING_S
        scale = RESUME_FRACTION if s.blocks else 1.0
        moment = max(abs(s.a), abs(s.b))
        s.refused = abs(s.kg) > scale * self._kg_max or moment > scale * self._moment_max
        if s.weighing_s > 0.0:
            s.weighing_s = WEIGHING_S if s.refused else max(0.0, s.weighing_s - dt)

    def advance_without_harness(self, s: LoadState, F_z: float, dt: float, *, led: bool) -> None:
        """Update from the joints' force along z, N: only check whether the robot hangs.

        Without a harness, a load cannot be distinguished from a hand. Once the robot is lowered,
        the file's load is assumed.
        """
        surplus, s.rates = F_z - self._weight, None
        if self._hangs_at_start(s, surplus, led=led) or s.weighing_s == 0.0:
            return
        s.kg += min(1.0, dt / HOLDING_S) * (surplus / GRAVITY - s.kg)
        if not self._is_hung(s):
            s.refused, s.weighing_s = False, 0.0
            s.kg = s.a = s.b = 0.0

    def _is_hung(self, s: LoadState) -> bool:
        return GRAVITY * s.kg < (HANGING_FRACTION - 1.0) * self._weight

    def _hangs_at_start(self, s: LoadState, surplus: float, *, led: bool) -> bool:
        """Return True at the first update of a robot that hangs.

        The planner then does not engage before its load is weighed.

        Args:
            s: state of the estimate; updated in place.
            surplus: force on the feet beyond the file's weight, N.
            led: True while the planner is engaged.
        """
        first, s.looked = not s.looked, True
        hangs = first and not led and surplus < (HANGING_FRACTION - 1.0) * self._weight
        if hangs:
            s.kg, s.refused, s.weighing_s = surplus / GRAVITY, True, WEIGHING_S
        return hangs


def _deadband(value: float, width: float, limit: float) -> float:
    """Return a value moved towards zero by `width`, and within a limit."""
    beyond = max(0.0, abs(value) - width)
    return math.copysign(min(limit, beyond), value)
