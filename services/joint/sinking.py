"""DAMP: how a module sinks after an emergency stop, with nobody but its own leg to know. Pure.

Ankles and every phi hold. The theta axes of `damp_sinks` lose their stiffness and carry their load
on as feedforward that fades: a slow sink, never a drop. A knee is caught at its stop, or where it
is once the other does not sink with it. A hip that knows how ankle and knee have turned holds the
torso as it stood; one that does not damps, and the torso goes with the thighs
(`services.joint.neighbours`).
"""

from __future__ import annotations

import math
from typing import Final

from services.joint import law
from services.joint.law import Setpoint
from services.joint.neighbours import Near
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import RobotConfig
from shared.joints import kind_of
from shared.messages import Pair

LEVEL_MAX: Final = 0.1
"""rad; a torso that is farther off is brought back no harder than that."""


class Sinking:
    """One module's way down.

    Attributes:
        stop: where a knee is caught, rad; -inf: nowhere.
        upright: how the torso stood as it began, the leg's thetas together, rad; None: not known.
        held: where a hip holds beside a limp knee, rad; None: it does not.
    """

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take times and gains."""
        service, kind = config.joint_service, kind_of(module)
        stand = config.stand_gains(module)
        self._k_p, self._k_d = stand.k_p, stand.k_d
        self._damp_k_d = service.damp_k_d
        self._sinks = (False, kind in service.damp_sinks)
        self._levels = kind == "hip" and self._sinks[1]
        self._fade_ns = service.damp_fade_s * NS_PER_S
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._stops = kind == "knee"
        self.stop = service.damp_knee_stop if kind == "knee" else -math.inf
        self.upright: float | None = None
        self.held: float | None = None

    def begin(self, setpoint: Setpoint, q: Pair) -> Setpoint:
        """Return what it starts from, of the setpoint in force until now and where the joint is."""
        self.stop = min(self.stop, q[1])
        self.upright = self.held = None
        return law.carrying(setpoint, self._sinks, q)

    def law(self, anchor: Setpoint, since_ns: int, q: Pair, near: Near) -> Setpoint:
        """Return the local law.

        Args:
            anchor: what `begin` returned.
            since_ns: since then.
            q: where the joint is, rad.
            near: what is known of the other modules.
        """
        share = max(0.0, 1.0 - since_ns / self._fade_ns)
        risen = min(1.0, since_ns / self._blend_ns)  # at once it was a step of 33 N m
        held = law.held(anchor, max(0.0, 1.0 - since_ns / self._coupled_ramp_ns))
        held = law.stiffened(held, self._k_p, self._k_d, 1.0 - share)
        sunk = law.damped(held, self._sinks, self._damp_k_d, share, risen)
        if self._levels:
            return self._levelled(sunk, q[1], near, risen)
        if self._stops and not near.sinks:
            self.stop = max(self.stop, q[1])
        if q[1] < self.stop:
            return law.caught(sunk, self.stop, self._k_p[1], self._k_d[1])
        return sunk

    def _levelled(self, sunk: Setpoint, theta: float, near: Near, risen: float) -> Setpoint:
        """Return the law of a hip."""
        if not near.sinks and self.held is None:
            self.held = theta
        if self.held is not None:
            wanted, rate = self.held, 0.0
        elif near.below is not None:
            below, its_rate = near.below
            if self.upright is None:
                self.upright = below + theta
            wanted, rate = self.upright - below, -its_rate
        else:
            return sunk
        wanted = min(theta + LEVEL_MAX, max(theta - LEVEL_MAX, wanted))
        return law.levelled(sunk, wanted, rate, risen * self._k_p[1])
