"""DAMP: sinking of a module after an emergency stop, using the angles of its own leg. Pure.

Every phi holds. The theta axes of `damp_sinks` lose their stiffness and carry their load as
feedforward that fades, so they sink slowly and never drop. A knee is caught at its stop, or at its
present angle if another module stays up. An ankle holds. As its knee folds, the ankle's reference
turns so that the hip joint, and with it the COM, stays as far ahead of the ankle as before:

    ahead = l2 sin(ankle) + l1 sin(ankle + knee)

A hip that knows the angles of ankle and knee holds the torso's attitude. A hip that does not know
them damps, and the torso turns with the thighs (`services.joint.neighbours`).

A module that must stiffen for a limp module stops sinking. It holds its position with its support
gains (`RobotConfig.support_gains`), and keeps its load as feedforward, even the load on a
stop's spring. A leg with a limp knee stands as a strut only on a stiff hip.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.joint import pd_law
from services.joint.neighbours import NeighbourView
from services.joint.pd_law import Setpoint
from shared.bus.messages import Pair
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of

DOUBT_NS: Final = 100 * NS_PER_MS
"""Time for which a reason to hold must last, ns: a stop does not reach all six modules in the same
cycle, and services may pause."""
LOW_M: Final = 0.1
"""Height of a hip joint above its ankle below which the robot is on the floor, m."""
LEAST_M: Final = 1e-6
"""Minimum length of a leg, m; a leg folded onto itself has no direction."""
LEVEL_MAX: Final = 0.1
"""Maximum attitude error that the spring corrects, rad; larger errors count as this."""


class SinkingState(msgspec.Struct):
    """State of `Sinking`."""

    stop: float | None = None
    """Angle at which a knee is caught, rad; None without a stop."""
    upright: float | None = None
    """Sum of the leg's thetas at the start, which is the torso's attitude, rad; None if unknown."""
    held: Setpoint | None = None
    """Setpoint from which the module stiffens because another is limp, with its angles and load at
    that time; None if it does not stiffen."""
    below: float | None = None
    """Last known angle of `NeighbourView.leg`, rad; None before the first."""
    caught: bool = False
    """True if a knee has stopped sinking because another module does not sink."""
    doubt_ns: int = -1
    """Time after the start at which the present reason to hold began, ns; -1 without a reason."""
    held_ns: int = -1
    """Time after the start at which `held` was set, ns; -1 before."""
    ahead: float | None = None
    """Distance by which the hip joint must stay ahead of its ankle, m; None if unknown."""
    start: float = 0.0
    """The ankle's theta when that distance was measured, rad."""


class Sinking:
    """Sinking law of one module."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        service, kind = config.joint_service, kind_of(module)
        stand = config.stand_gains(module)
        self._k_p, self._k_d = stand.k_p, stand.k_d
        self._support = config.support_gains(module)
        self._damp_k_d = service.damp_k_d
        self._sinks = (False, kind in service.damp_sinks)
        self._levels = kind == "hip" and self._sinks[1]
        self._places = kind == "ankle" and "knee" in service.damp_sinks
        self._thigh, self._shank = config.geometry.l1, config.geometry.l2
        self._limits = config.limits.ankle.theta
        self._fade_ns = service.damp_fade_s * NS_PER_S
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._stiffen_ns = service.stiffen_ms * NS_PER_MS
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._stop = service.damp_knee_stop if kind == "knee" else None

    def start(self) -> SinkingState:
        """Return the state of a module that has never sunk."""
        return SinkingState(stop=self._stop)

    def begin(self, s: SinkingState, setpoint: Setpoint, q: Pair) -> Setpoint:
        """Return the setpoint that sinking starts from, at joint angles q (rad)."""
        if s.stop is not None:
            s.stop = min(s.stop, q[1])
        s.upright = s.held = s.below = s.ahead = None
        s.caught, s.doubt_ns, s.held_ns = False, -1, -1
        return pd_law.load_to_feedforward(setpoint, self._sinks, q)

    def law(
        self,
        s: SinkingState,
        frozen_setpoint: Setpoint,
        current: Setpoint,
        since_ns: int,
        q: Pair,
        near: NeighbourView,
    ) -> Setpoint:
        """Return the setpoint of this instant.

        Args:
            s: state of the sinking, updated in place.
            frozen_setpoint: the setpoint that `begin` returned.
            current: the setpoint of the last cycle.
            since_ns: time since `begin`, ns.
            q: joint angles, rad.
            near: view of the other modules.
        """
        if near.stiffen and s.held is None:
            s.held, s.held_ns = self._carried(current, q), since_ns
        if s.held is not None:
            return self._stiffened(s.held, since_ns - s.held_ns)
        holds = _is_to_hold(s, since_ns, near)
        sunk = self._sunk(frozen_setpoint, since_ns)
        if self._levels:
            return self._levelled(s, sunk, q[1], near, min(1.0, since_ns / self._blend_ns))
        if self._places:
            return self._placed(s, sunk, q[1], near)
        if s.stop is None:
            return sunk
        if holds and not s.caught:
            s.caught, s.stop = True, max(s.stop, q[1])
        if q[1] < s.stop:
            return pd_law.hold_theta(sunk, s.stop, sunk.v_ref[1], self._k_p[1], self._k_d[1])
        return sunk

    def _sunk(self, frozen_setpoint: Setpoint, since_ns: int) -> Setpoint:
        """Return the law of sinking."""
        share = max(0.0, 1.0 - since_ns / self._fade_ns)
        risen = min(1.0, since_ns / self._blend_ns)  # without the ramp there is a step of 33 N m
        held = pd_law.freeze(frozen_setpoint, max(0.0, 1.0 - since_ns / self._coupled_ramp_ns))
        held = pd_law.raise_gains(held, self._k_p, self._k_d, 1.0 - share)
        return pd_law.damp(held, self._sinks, self._damp_k_d, share, risen)

    def _carried(self, current: Setpoint, q: Pair) -> Setpoint:
        """Return a setpoint of the same torque that holds the sinking axes at their position."""
        carried = pd_law.load_to_feedforward(current, self._sinks, q)
        theta = q[1] if self._sinks[1] else carried.q_ref[1]
        return msgspec.structs.replace(carried, q_ref=(carried.q_ref[0], theta))

    def _stiffened(self, held: Setpoint, after_ns: int) -> Setpoint:
        """Return the law of a module that has stiffened for `after_ns`, with its initial load."""
        start = pd_law.freeze(held, max(0.0, 1.0 - after_ns / self._coupled_ramp_ns))
        stands = pd_law.stand(held.q_ref, *self._support)
        stands = msgspec.structs.replace(stands, tau_ff=held.tau_ff)
        return pd_law.blend(start, stands, min(1.0, after_ns / self._stiffen_ns))

    def _levelled(
        self, s: SinkingState, sunk: Setpoint, theta: float, near: NeighbourView, risen: float
    ) -> Setpoint:
        """Return the law of a hip; without new angles of its leg, it uses the last ones."""
        rate = 0.0
        if near.leg is not None:
            s.below, rate = near.leg
        if s.below is None:
            return sunk
        if s.upright is None:
            s.upright = s.below + theta
        wanted = s.upright - s.below
        wanted = clamp(wanted, theta - LEVEL_MAX, theta + LEVEL_MAX)
        return pd_law.hold_theta(sunk, wanted, -rate, risen * self._k_p[1], sunk.k_d[1])

    def _placed(
        self, s: SinkingState, sunk: Setpoint, theta: float, near: NeighbourView
    ) -> Setpoint:
        """Return the law of an ankle; without a new angle of its knee, it uses the last one."""
        rate = 0.0
        if near.leg is not None:
            knee, rate = near.leg
            s.below = clamp(knee, -math.pi, math.pi)  # the cosine of an infinity would raise
        if s.below is None:
            return sunk
        if s.ahead is None:
            s.start = theta
            s.ahead = self._shank * math.sin(theta) + self._thigh * math.sin(theta + s.below)
        # from ankle to hip joint: a link of this length, at this angle from the shank
        along = self._shank + self._thigh * math.cos(s.below)
        across = self._thigh * math.sin(s.below)
        length = max(math.hypot(along, across), abs(s.ahead), LEAST_M)
        place = math.asin(s.ahead / length) - math.atan2(across, along)
        low, high = self._limits
        place = clamp(place, min(low, s.start), max(high, s.start))
        wanted = sunk.q_ref[1] + place - s.start  # the spring keeps its load
        up = self._thigh * math.cos(place + s.below)
        height = self._shank * math.cos(place) + up
        v_ref = -rate * up / height if height > LOW_M else 0.0
        return pd_law.hold_theta(sunk, wanted, v_ref, sunk.k_p[1], sunk.k_d[1])


def _is_to_hold(s: SinkingState, since_ns: int, near: NeighbourView) -> bool:
    if near.sinks:
        s.doubt_ns = -1
        return False
    if s.doubt_ns < 0:
        s.doubt_ns = since_ns
    return since_ns - s.doubt_ns >= DOUBT_NS
