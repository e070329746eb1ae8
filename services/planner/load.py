"""What the torso carries beyond what the robot file says: its weight, and where it lies. Pure.

The open directions have no stiffness, so that a weight the law does not know moves the robot as
soon as nobody holds on. The joints' torques tell it, by a momentum observer. F is what joints and
person (w_h) hold up along p, n how far the harness point rises along each, M the torso's mass:

    F         = T^T (tau + J_harness^T f_h + J_pitch^T m_h)       [J; C] T = [I; 0]
    n         = T^T J_harness,z
    dm g      = (F_z - m g) / n_z - M zddot_harness
    a cos(pitch) + b sin(pitch) = F_pitch - n_pitch dm g - I pitchddot

a and b are the moments that hold up the surplus weight about the harness point, torso axes, N m: a
by how far behind it lies, b by how low. Low-passed and shrunk by what dry friction in the joints
hides, they are fed forward as the assist is, and so are part of every tick's own certificate.
Beyond `law.load_correction` the planner does not lead: schedule and studies are of another robot.
A harness that is off by f_h is taken for load.

A robot that hangs on a hoist is not led either: its feedforward lifts it off the hoist, and with
the payload missing on to straight legs, where torques tell nothing (0.1 m up). It holds until its
feet bear what the file says, within the limit. That takes no harness: no hand lifts half of it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.snapshots import LoadState
from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY

Array = NDArray[np.float64]

LED_S: Final = 2.0
HELD_S: Final = 0.25
"""Time constants. While it is led it is looked for at rest only, and slowly: in motion what the
drivetrain and a masses' error of 5 % do looks like 8 kg."""
STILL: Final = (0.05, 0.1)
"""m/s of the harness point and rad/s of the torso's pitch: at rest."""
HIDDEN: Final = (8.0, 1.5)
"""N and N m of the open directions that dry friction may be (0.3 N m a joint: 6 N)."""
WEIGHING_S: Final = 1.0
"""After it hung the load is within the limits for so long before it is led: four time constants."""
AGAIN_SHARE: Final = 0.8
"""Fraction of the limits within which a refused load is led again."""
BORNE_SHARE: Final = 0.25
"""Share of the file's weight: with less on the feet of a robot that is led it falls, or hangs."""
HANGS_SHARE: Final = 0.5
"""Share of the file's weight: with less on the feet of a robot that holds it hangs on a hoist."""


class Load:
    """The surplus load, low-passed.

    Attributes:
        kg: surplus mass.
        a: N m along pitch, for what lies behind (+) or ahead of the file's centre.
        b: N m along pitch, for what lies below (+) or above it, with the torso at 90 degrees.
    """

    def __init__(self, largest: Pair, weight: float, mass: float, inertia: float) -> None:
        """Begin with what the file says.

        Args:
            largest: `law.load_correction`: kg and N m; zero: nothing is looked for.
            weight: of the whole robot by the file, N.
            mass: of its torso, kg.
            inertia: of its torso about pitch, kg m^2.
        """
        self._kg_max, self._moment_max = largest
        self.enabled = any(largest)
        self._weight, self._mass, self._inertia = weight, mass, inertia
        self._rates: Pair | None = None
        self._refused = False
        self._weighing_s = 0.0
        self._looked = False
        self.kg = self.a = self.b = 0.0

    @property
    def refused(self) -> bool:
        """True while the load is farther from the file than the law leads, or not known yet."""
        return self._refused or self._weighing_s > 0.0

    def refusal(self) -> str:
        """Return in words why it is not led, and what would be right; "" if it is."""
        if not self._refused:
            return "its load is weighed" if self._weighing_s > 0.0 else ""
        if self._is_hung:
            less = f"carries {-self.kg:.0f} kg less than its file says"
            return f"it hangs, or {less}: it is led once its feet bear its weight"
        words = []
        if abs(self.kg) > AGAIN_SHARE * self._kg_max:
            more = "more" if self.kg > 0.0 else "less"
            words.append(
                f"the robot carries {abs(self.kg):.1f} kg {more} than its file says: at most "
                f"{self._kg_max:g} kg are led ({AGAIN_SHARE * self._kg_max:g} again); set "
                "mass.payload, then `xrl gains`"
            )
        for moment, positive, negative in ((self.a, "behind", "ahead"), (self.b, "low", "high")):
            if abs(moment) > AGAIN_SHARE * self._moment_max:
                words.append(
                    f"the load lies too far {positive if moment > 0.0 else negative}, by "
                    f"{abs(moment):.0f} N m: at most {self._moment_max:g} N m are led "
                    f"({AGAIN_SHARE * self._moment_max:g} again)"
                )
        return "; ".join(words)

    def force(self) -> float:
        """Return what is certain of its weight, N at the harness point, within the limit."""
        return _shrunk(GRAVITY * self.kg, HIDDEN[0], GRAVITY * self._kg_max)

    def moment(self, pitch: float) -> float:
        """Return what is certain of its moment along pitch, N m, within the limit."""
        return _shrunk(self._moment(pitch), HIDDEN[1], self._moment_max)

    def advance(
        self, F: Array, n: Array, pitch: float, rates: Pair, dt: float, *, led: bool
    ) -> None:
        """Take what joints and person hold up.

        Args:
            F: wrench along p (6,), N and N m, world.
            n: how far the harness point rises along p (6,), m/m and m/rad.
            pitch: of the torso, rad.
            rates: of the harness point's height, m/s, and of the torso's pitch, rad/s.
            dt: since the last call, s.
            led: the planner leads.
        """
        before, self._rates = self._rates, rates
        up = float(F[2]) - self._weight
        if self._hangs_at_first(up, led=led) or before is None:
            return
        if led and up < (BORNE_SHARE - 1.0) * self._weight:
            return
        if led and (abs(rates[0]) > STILL[0] or abs(rates[1]) > STILL[1]):
            return
        pole_s = LED_S if led else HELD_S
        weight = up / float(n[2])
        moment = float(F[4]) - float(n[4]) * GRAVITY * self.kg
        self.kg += min(1.0, dt / pole_s) * (weight / GRAVITY - self.kg)
        self.kg -= self._mass * (rates[0] - before[0]) / (GRAVITY * pole_s)
        error = dt * (moment - self._moment(pitch)) - self._inertia * (rates[1] - before[1])
        error /= pole_s
        self.a += error * math.cos(pitch)
        self.b += error * math.sin(pitch)
        if not led and self._is_hung:
            self._weighing_s = WEIGHING_S
        share = AGAIN_SHARE if self.refused else 1.0
        moment = max(abs(self.a), abs(self.b))
        self._refused = abs(self.kg) > share * self._kg_max or moment > share * self._moment_max
        if self._weighing_s > 0.0:
            self._weighing_s = WEIGHING_S if self._refused else max(0.0, self._weighing_s - dt)

    def pause(self) -> None:
        """Take it that nothing can be known now; what was found stands."""
        self._rates = None

    def advance_without_harness(self, F_z: float, dt: float, *, led: bool) -> None:
        """Take what the joints hold up along z, N, while a hand may be on it: does it hang?

        A load is not told from a hand then: once it is let down the file is believed.
        """
        up, self._rates = F_z - self._weight, None
        if self._hangs_at_first(up, led=led) or self._weighing_s == 0.0:
            return
        self.kg += min(1.0, dt / HELD_S) * (up / GRAVITY - self.kg)
        if not self._is_hung:
            self._refused, self._weighing_s = False, 0.0
            self.kg = self.a = self.b = 0.0

    @property
    def _is_hung(self) -> bool:
        return GRAVITY * self.kg < (HANGS_SHARE - 1.0) * self._weight

    def _hangs_at_first(self, up: float, *, led: bool) -> bool:
        """Return True at the first look at a robot that hangs; `up`: borne beyond the file, N.

        It is weighed from there on, and not led before its load is known.
        """
        first, self._looked = not self._looked, True
        hangs = first and not led and up < (HANGS_SHARE - 1.0) * self._weight
        if hangs:
            self.kg, self._refused, self._weighing_s = up / GRAVITY, True, WEIGHING_S
        return hangs

    def snapshot(self) -> LoadState:
        """Return the state."""
        return LoadState(
            self.kg, self.a, self.b, self._rates, self._refused, self._weighing_s, self._looked
        )

    def restore(self, memory: LoadState) -> None:
        """Continue from a state."""
        self.kg, self.a, self.b = memory.kg, memory.a, memory.b
        self._rates, self._refused = memory.rates, memory.refused
        self._weighing_s, self._looked = memory.weighing_s, memory.looked

    def _moment(self, pitch: float) -> float:
        return self.a * math.cos(pitch) + self.b * math.sin(pitch)


def _shrunk(value: float, hidden: float, most: float) -> float:
    """Return a value brought nearer to zero by what is hidden, and within a limit."""
    certain = max(0.0, abs(value) - hidden)
    return math.copysign(min(most, certain), value)
