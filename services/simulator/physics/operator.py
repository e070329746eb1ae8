"""The simulated operator: a hand that leads or is led, and weight on the harness.

The hand is a clipped spring-damper between a path and the harness point, in height and pitch
(docs/simulator.md#reference-scenario), and sideways if the scenario sets a sideways path. The
person behind the hand has a mass and yields in height. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from services.simulator.physics.plant import Person
from shared.bus.messages import HandLead, Vector3
from shared.clamp import clamp
from shared.config.scenarios import Act, Lead
from shared.config.sections import OperatorConfig

BANDWIDTH: Final = 8.0
"""Bandwidth of the critically damped system with which the hand follows requests, rad/s."""
HEIGHT_MAX_RATE: Final = 0.25
"""Maximum rate of a led hand's height, m/s: the hand then pulls with up to 70 N. At 0.5 m/s it
would pull with 150 N, the limit of the `harness` trip."""
PITCH_MAX_RATE: Final = 1.0
"""Maximum rate of a led hand's pitch, rad/s."""
HEIGHTS: Final = (0.78, 1.2)
"""Range of the torso's height, m, within the legs' reach."""
PITCHES: Final = (-0.3, 0.9)
"""Range of the torso's pitch, rad."""
PUSH_MAX: Final = 120.0
"""Maximum push in each direction, N."""
PUSH_EXPIRES_S: Final = 0.3
"""Timeout of a push after its last message, s."""


class LedHand(msgspec.Struct):
    """Hand that follows an operator's requests, within limits and without jumps.

    Without a new request the hand stays in place, and its push ends. The fields, in this order, are
    `SimState.hand`.
    """

    leads: bool = False
    """True if requests lead the hand; False if they only push, and the scenario leads."""
    height: float = 0.0
    height_rate: float = 0.0
    pitch: float = 0.0
    pitch_rate: float = 0.0
    wanted_height: float = 0.0
    wanted_pitch: float = 0.0
    force_x: float = 0.0
    force_y: float = 0.0
    force_z: float = 0.0
    push_left_s: float = 0.0

    def request(self, asked: HandLead, now: Lead) -> None:
        """Accept a request, within the limits, unless one of its values is not finite.

        The first request that leads takes over from the scenario's lead `now`.
        """
        if not all(map(math.isfinite, (asked.height, asked.pitch, *asked.push))):
            return
        if asked.leads and not self.leads:
            self.leads = True
            self.height, self.height_rate = now.height, now.height_rate
            self.pitch, self.pitch_rate = now.pitch, now.pitch_rate
        if asked.leads:
            self.wanted_height = clamp(asked.height, *HEIGHTS)
            self.wanted_pitch = clamp(asked.pitch, *PITCHES)
        self.force_x, self.force_y, self.force_z = (
            clamp(part, -PUSH_MAX, PUSH_MAX) for part in asked.push
        )
        self.push_left_s = PUSH_EXPIRES_S if self.force_x or self.force_y or self.force_z else 0.0

    def advance(self, dt: float) -> None:
        """Advance by `dt`, s."""
        if self.leads:
            self.height, self.height_rate = follow(
                self.wanted_height, self.height, self.height_rate, HEIGHT_MAX_RATE, dt
            )
            self.pitch, self.pitch_rate = follow(
                self.wanted_pitch, self.pitch, self.pitch_rate, PITCH_MAX_RATE, dt
            )
        self.push_left_s = max(0.0, self.push_left_s - dt)

    def over(self, wanted: Lead) -> Lead:
        """Return the scenario's request, with this hand's height and pitch if it leads."""
        if not self.leads:
            return wanted
        return wanted._replace(
            height=self.height,
            height_rate=self.height_rate,
            pitch=self.pitch,
            pitch_rate=self.pitch_rate,
        )

    def numbers(self) -> tuple[float, ...]:
        """Return the fields as the log stores them."""
        return tuple(map(float, msgspec.structs.astuple(self)))

    @classmethod
    def of_numbers(cls, numbers: Sequence[float]) -> LedHand:
        """Return the hand with these `numbers`."""
        leads, *rest = numbers
        return cls(leads > 0.0, *rest)

    @property
    def push(self) -> Vector3 | None:
        """Push on the torso, N, world; None if the scenario pushes."""
        if self.push_left_s <= 0.0:
            return None
        return (self.force_x, self.force_y, self.force_z)


def follow(
    wanted: float, at: float, rate: float, rate_max: float, dt: float
) -> tuple[float, float]:
    """Return position and rate, `dt` s later, of a coordinate that follows its target.

    The follower is a critically damped second-order system with a rate limit. Its solution is in
    closed form, so it is stable for any `dt`.
    """
    # x'' = w^2 (wanted - x) - 2 w x', whose error is (a + b t) exp(-w t)
    error, w = at - wanted, BANDWIDTH
    slope = rate + w * error
    decay = math.exp(-w * dt)
    then = wanted + (error + slope * dt) * decay
    rate = (slope - w * (error + slope * dt)) * decay
    if abs(rate) > rate_max or abs(then - at) > rate_max * dt:
        rate = math.copysign(rate_max, wanted - at)
        then = at + rate * dt
    return then, rate


class HandForce(NamedTuple):
    """The hand's force and moment on the torso."""

    force_z: float
    """N, world, at the harness point."""
    moment_pitch: float
    """N m about the torso's pitch axis."""


class Acting(NamedTuple):
    """Actions of the person besides leading."""

    load: float = 0.0
    """Weight on the harness beyond the requested assist, N."""
    up: float = 0.0
    """Force of bumps and tremor, N, up."""
    ahead: float = 0.0
    """Force along world x, N."""
    grip: float = 1.0
    """Fraction of the hand's full grip."""


NO_ACT: Final = Acting()
TREMOR_HZ: Final = 6.0
"""Frequency of the tremor, Hz; tremor under effort has 4 to 12 Hz."""
RELAXED: Final = 0.25
_GRIPS: Final = {"relax": RELAXED, "limp": 0.0, "let_go": 0.0}


def acting(acts: Sequence[Act], t: float) -> Acting:
    """Return the person's actions at scenario time t, s."""
    load = up = ahead = 0.0
    grip = 1.0
    for act in acts:
        since = t - act.at
        if not 0.0 <= since < act.duration:
            continue
        left = act.duration - since
        release = act.ramp if act.release is None else act.release
        share = min(1.0, since / act.ramp if act.ramp > 0.0 else 1.0)
        share = min(share, left / release if release > 0.0 else 1.0)
        if act.kind in ("rest", "relax", "limp"):
            load += share * act.force
        elif act.kind == "bump":
            up += act.force * math.sin(math.pi * since / act.duration)
        elif act.kind == "tremor":
            up += share * act.force * math.sin(2.0 * math.pi * TREMOR_HZ * since)
        elif act.kind == "pull":
            ahead += share * act.force
        held = _GRIPS.get(act.kind, 1.0)
        grip = min(grip, held if held == 0.0 else 1.0 + share * (held - 1.0))
    return Acting(load, up, ahead, grip)


REACH_S: Final = 0.4
"""Time constant with which a hand that grips the robot joins the path, s."""


class Wearer(msgspec.Struct):
    """The person's mass behind the hand, which yields to the robot's force.

    The hand grips the robot in place and then joins the path. Under its force f on the robot, its
    height d above the path follows m d'' = -m w^2 d - 2 zeta m w d' - f. Without a mass the hand
    follows the path exactly.
    """

    person: Person
    above: float = 0.0
    """m"""
    rate: float = 0.0
    """m/s"""
    load_n: float = 0.0
    """Weight on the harness, N."""
    asked_n: float = 0.0
    """Part of that weight within the requested assist, N."""
    reach: float = 0.0
    """Remaining distance to the path since the grip, m; it decays before a scenario starts."""
    holds: bool = False

    def grip(self, above: float) -> None:
        """Grip the robot where it is, `above` m above the path, unless the hand grips already."""
        if not self.holds:
            self.holds, self.reach = True, above

    def motion(self) -> tuple[float, float]:
        """Return the hand's height above its path, m, and its rate, m/s."""
        return self.above + self.reach, self.rate - self.reach / REACH_S

    def step(self, dt: float, force_on_robot: float, assist: float, load: float = 0.0) -> None:
        """Advance by `dt`, s, under the hand's force on the robot, N, up.

        The person rests a fraction of the requested assist, N, on the harness, with a lag. An
        unrequested `load`, N, is added.
        """
        person = self.person
        if person.mass > 0.0:
            w = 2.0 * math.pi * person.leg_frequency_hz
            b = 2.0 * person.leg_damping_ratio * w
            acceleration = -(1.0 / person.mass) * force_on_robot - w * w * self.above
            self.rate = (self.rate + dt * acceleration) / (1.0 + dt * b)
            self.above += dt * self.rate
        self.reach -= self.reach * dt / REACH_S
        wanted, lag = person.load_scale * assist, person.load_lag_s
        self.asked_n += (wanted - self.asked_n) * (min(1.0, dt / lag) if lag > 0.0 else 1.0)
        self.load_n = self.asked_n + load


class Operator:
    """The hand's spring-damper."""

    def __init__(self, hand: OperatorConfig, harness_point: Vector3) -> None:
        """Set the spring-damper and its point on the torso, m, torso axes."""
        self._hand = hand
        self._point = harness_point

    def force(
        self, wanted: Lead, height: float, rate: float, pitch: float, pitch_rate: float
    ) -> HandForce:
        """Return the hand's force, from the wanted and the actual pose.

        `height` is that of the harness point above the ankles, m; `pitch` is the torso's, rad.
        """
        x, _, z = self._point
        sine, cosine = math.sin(wanted.pitch), math.cos(wanted.pitch)
        point_height = wanted.height - x * sine + z * cosine
        point_rate = wanted.height_rate - (x * cosine + z * sine) * wanted.pitch_rate
        hand = self._hand
        spring = hand.k_z * (point_height - height)
        if hand.soft_n > 0.0:
            spring /= 1.0 + abs(spring) / hand.soft_n
        force = spring + hand.b_z * (point_rate - rate)
        moment = hand.k_pitch * (wanted.pitch - pitch) + hand.b_pitch * (
            wanted.pitch_rate - pitch_rate
        )
        return HandForce(
            clamp(force, -hand.force_max, hand.force_max),
            clamp(moment, -hand.moment_max, hand.moment_max),
        )

    def force_side(self, wanted: Lead, side: float, rate: float) -> float:
        """Return the hand's force along world y, N; 0 if the scenario sets no sideways path.

        The harness point is at `side`, m, and moves at `rate`, m/s.
        """
        if wanted.side is None:
            return 0.0
        hand = self._hand
        force = hand.k_y * (wanted.side - side) + hand.b_y * (wanted.side_rate - rate)
        return clamp(force, -hand.force_max, hand.force_max)
