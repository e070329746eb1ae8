"""DAMP: how a module sinks after an emergency stop, knowing only its own leg. Pure.

Every phi holds. The theta axes of `damp_sinks` lose their stiffness and carry their load
as feedforward that fades: a slow sink, never a drop. A knee is caught at its stop, or at its
present angle when the other knee does not sink with it. An ankle holds; as its knee folds, its
reference turns so that the hip joint stays as far ahead of it as it was, and with it the COM:

    ahead = l2 sin(ankle) + l1 sin(ankle + knee)

A hip that knows the angles of ankle and
knee holds the torso's attitude; a hip that does not know them damps, and the torso turns with the
thighs (`services.joint.neighbours`).

A module that must stiffen for a limp one stops sinking: it holds its position with its support
gains (`RobotConfig.support_gains`) and the load that it carries, feedforward or the spring of a
stop. A leg with a limp knee stands as a strut only on a stiff hip.
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
"""Time for which a reason to hold must last: a stop does not reach all six in the same cycle, and
services pause."""
LOW_M: Final = 0.1
"""A hip joint that is lower above its ankle is on the floor."""
LEAST_M: Final = 1e-6
"""A leg folded onto itself has no direction."""
LEVEL_MAX: Final = 0.1
"""rad; a torso that is farther off is brought back no harder than that."""


class SinkingState(msgspec.Struct, frozen=True):
    """State of `Sinking`."""

    stop: float | None = None
    """None: there is no stop (JSON has no infinity)."""
    upright: float | None = None
    held: Setpoint | None = None
    below: float | None = None
    caught: bool = False
    doubt_ns: int = -1
    held_ns: int = -1
    ahead: float | None = None
    start: float = 0.0


class Sinking:
    """One module's way down.

    Attributes:
        stop: where a knee is caught, rad; -inf: nowhere.
        upright: how the torso stood as it began, the leg's thetas together, rad; None: not known.
        held: the setpoint from which it stiffens for a limp module, at the angles that it had then,
            its load as feedforward; None: it does not.
        held_ns: when it did, from the beginning on; -1: it has not.
        leg: `NeighbourView.leg`'s angle when that was known last, rad; None: never.
        ahead: how far ahead of an ankle its hip joint is to stay, m; None: not known.
        start: the ankle's theta when that was found, rad.
        caught: True if a knee does not sink any more for the others' sake.
        doubt_ns: since when there is reason to, from the beginning on; -1: there is none.
    """

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take times and gains."""
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
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._stops = kind == "knee"
        self.stop = service.damp_knee_stop if kind == "knee" else -math.inf
        self.upright: float | None = None
        self.held: Setpoint | None = None
        self.leg: float | None = None
        self.ahead: float | None = None
        self.start = 0.0
        self.caught = False
        self.doubt_ns = self.held_ns = -1

    def begin(self, setpoint: Setpoint, q: Pair) -> Setpoint:
        """Return the setpoint that sinking starts from, at joint angles q (rad)."""
        self.stop = min(self.stop, q[1])
        self.upright = self.held = self.leg = self.ahead = None
        self.caught, self.doubt_ns, self.held_ns = False, -1, -1
        return pd_law.load_to_feedforward(setpoint, self._sinks, q)

    def law(
        self,
        frozen_setpoint: Setpoint,
        current: Setpoint,
        since_ns: int,
        q: Pair,
        near: NeighbourView,
    ) -> Setpoint:
        """Return the local law.

        Args:
            frozen_setpoint: the setpoint that `begin` returned.
            current: the setpoint in force until now.
            since_ns: time since then, ns.
            q: joint angles, rad.
            near: view of the other modules.
        """
        if near.stiffen and self.held is None:
            self.held, self.held_ns = self._carried(current, q), since_ns
        if self.held is not None:
            return self._stiffened(self.held, since_ns - self.held_ns)
        holds = self._is_to_hold(since_ns, near)
        sunk = self._sunk(frozen_setpoint, since_ns)
        if self._levels:
            return self._levelled(sunk, q[1], near, min(1.0, since_ns / self._blend_ns))
        if self._places:
            return self._placed(sunk, q[1], near)
        if holds and self._stops and not self.caught:
            self.caught, self.stop = True, max(self.stop, q[1])
        if q[1] < self.stop:
            return pd_law.add_stop(sunk, self.stop, self._k_p[1], self._k_d[1])
        return sunk

    def _sunk(self, frozen_setpoint: Setpoint, since_ns: int) -> Setpoint:
        """Return the law of sinking."""
        share = max(0.0, 1.0 - since_ns / self._fade_ns)
        risen = min(1.0, since_ns / self._blend_ns)  # at once it was a step of 33 N m
        held = pd_law.freeze(frozen_setpoint, max(0.0, 1.0 - since_ns / self._coupled_ramp_ns))
        held = pd_law.raise_gains(held, self._k_p, self._k_d, 1.0 - share)
        return pd_law.damp(held, self._sinks, self._damp_k_d, share, risen)

    def _carried(self, current: Setpoint, q: Pair) -> Setpoint:
        """Return a setpoint with the same torque that holds the axes that sink where they are."""
        carried = pd_law.load_to_feedforward(current, self._sinks, q)
        theta = q[1] if self._sinks[1] else carried.q_ref[1]
        return msgspec.structs.replace(carried, q_ref=(carried.q_ref[0], theta))

    def _stiffened(self, held: Setpoint, after_ns: int) -> Setpoint:
        """Return the law of a module that has held for `after_ns` with the load it had then."""
        start = pd_law.freeze(held, max(0.0, 1.0 - after_ns / self._coupled_ramp_ns))
        stands = pd_law.stand(held.q_ref, *self._support)
        stands = msgspec.structs.replace(stands, tau_ff=held.tau_ff)
        return pd_law.blend(start, stands, min(1.0, after_ns / self._blend_ns))

    def snapshot(self) -> SinkingState:
        """Return the state."""
        stop = self.stop if math.isfinite(self.stop) else None
        return SinkingState(
            stop, self.upright, self.held, self.leg, self.caught, self.doubt_ns, self.held_ns,
            self.ahead, self.start,
        )  # fmt: skip

    def restore(self, state: SinkingState) -> None:
        """Continue from a state."""
        self.stop = -math.inf if state.stop is None else state.stop
        self.upright, self.held, self.leg = state.upright, state.held, state.below
        self.caught, self.doubt_ns = state.caught, state.doubt_ns
        self.held_ns, self.ahead, self.start = state.held_ns, state.ahead, state.start

    def _is_to_hold(self, since_ns: int, near: NeighbourView) -> bool:
        if near.sinks:
            self.doubt_ns = -1
            return False
        if self.doubt_ns < 0:
            self.doubt_ns = since_ns
        return since_ns - self.doubt_ns >= DOUBT_NS

    def _levelled(
        self, sunk: Setpoint, theta: float, near: NeighbourView, risen: float
    ) -> Setpoint:
        """Return the law of a hip; if its leg is no longer seen, the leg's last angle holds."""
        rate = 0.0
        if near.leg is not None:
            self.leg, rate = near.leg
        if self.leg is None:
            return sunk
        if self.upright is None:
            self.upright = self.leg + theta
        wanted = self.upright - self.leg
        wanted = clamp(wanted, theta - LEVEL_MAX, theta + LEVEL_MAX)
        return pd_law.hold_theta(sunk, wanted, -rate, risen * self._k_p[1])

    def _placed(self, sunk: Setpoint, theta: float, near: NeighbourView) -> Setpoint:
        """Return the law of an ankle; if its knee is no longer seen, its last angle holds."""
        rate = 0.0
        if near.leg is not None:
            knee, rate = near.leg
            self.leg = clamp(knee, -math.pi, math.pi)  # the cosine of an infinity would raise
        if self.leg is None:
            return sunk
        if self.ahead is None:
            self.start = theta
            self.ahead = self._shank * math.sin(theta) + self._thigh * math.sin(theta + self.leg)
        # from ankle to hip joint: a link of this length, at this angle from the shank
        along = self._shank + self._thigh * math.cos(self.leg)
        across = self._thigh * math.sin(self.leg)
        length = max(math.hypot(along, across), abs(self.ahead), LEAST_M)
        place = math.asin(self.ahead / length) - math.atan2(across, along)
        low, high = self._limits
        place = clamp(place, min(low, self.start), max(high, self.start))
        wanted = sunk.q_ref[1] + place - self.start  # its spring goes on carrying its load
        up = self._thigh * math.cos(place + self.leg)
        height = self._shank * math.cos(place) + up
        v_ref = -rate * up / height if height > LOW_M else 0.0
        return pd_law.hold_theta(sunk, wanted, v_ref, sunk.k_p[1])
