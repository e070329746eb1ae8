"""DAMP: how a module sinks after an emergency stop, knowing only its own leg. Pure.

Ankles and every phi hold. The theta axes of `damp_sinks` lose their stiffness and carry their load
as feedforward that fades: a slow sink, never a drop. A knee is caught at its stop, or at its
present angle when the other knee does not sink with it. A hip that knows the angles of ankle and
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
from shared.robot.joints import kind_of

DOUBT_NS: Final = 100 * NS_PER_MS
"""Time for which a reason to hold must last: a stop does not reach all six in the same cycle, and
services pause."""
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


class Sinking:
    """One module's way down.

    Attributes:
        stop: where a knee is caught, rad; -inf: nowhere.
        upright: how the torso stood as it began, the leg's thetas together, rad; None: not known.
        held: the setpoint from which it stiffens for a limp module, at the angles that it had then,
            its load as feedforward; None: it does not.
        held_ns: when it did, from the beginning on; -1: it has not.
        below: how ankle and knee had turned when that was known last, rad; None: never.
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
        self._fade_ns = service.damp_fade_s * NS_PER_S
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._stops = kind == "knee"
        self.stop = service.damp_knee_stop if kind == "knee" else -math.inf
        self.upright: float | None = None
        self.held: Setpoint | None = None
        self.below: float | None = None
        self.caught = False
        self.doubt_ns = self.held_ns = -1

    def begin(self, setpoint: Setpoint, q: Pair) -> Setpoint:
        """Return the setpoint that sinking starts from, at joint angles q (rad)."""
        self.stop = min(self.stop, q[1])
        self.upright = self.held = self.below = None
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
            stop, self.upright, self.held, self.below, self.caught, self.doubt_ns, self.held_ns
        )

    def restore(self, state: SinkingState) -> None:
        """Continue from a state."""
        self.stop = -math.inf if state.stop is None else state.stop
        self.upright, self.held, self.below = state.upright, state.held, state.below
        self.caught, self.doubt_ns = state.caught, state.doubt_ns
        self.held_ns = state.held_ns

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
        if near.below is not None:
            self.below, rate = near.below
        if self.below is None:
            return sunk
        if self.upright is None:
            self.upright = self.below + theta
        wanted = self.upright - self.below
        wanted = clamp(wanted, theta - LEVEL_MAX, theta + LEVEL_MAX)
        return pd_law.hold_theta(sunk, wanted, -rate, risen * self._k_p[1])
