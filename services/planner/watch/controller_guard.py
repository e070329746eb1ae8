"""Stands between a controller of somebody's own and the commands: certificate and form. Pure.

Gains that do not stand alone at this pose are never sent: the tick is UNCERTIFIED, and all hold.
So it is while the capture point, or the place where HOLD on this action would come to rest, is near
the edge of the soles: a controller that leads the robot over smoothly breaks no bound of a joint,
and made it fall.
A controller that raises, or returns what is no action, is not asked again: all hold until the
planner is restarted. Steps, references and torques beyond bounds are the joint services' to
refuse (`services.joint.envelope`).
"""

from __future__ import annotations

from typing import Any, Final

import msgspec
import numpy as np

from services.planner.controller import Action, Controller, Observation
from services.planner.law.hocca import Hocca, LawOutput
from services.planner.law.split import LocalGains
from shared.bus.messages import SplitSource
from shared.clamp import clamp
from shared.config.sections import GeometryConfig
from shared.joints import N_JOINTS
from shared.robot.frames import capture_point

SUPPORT: Final = 0.5
"""Fraction of the soles within which the capture point and the rest in HOLD must be."""
CALM: Final = 0.6
"""Fraction of that room within which the capture point must be before it is asked again."""
REST_S: Final = 1.0
"""Time for which all hold, calm, after an objection; it doubles with each, to `WAIT_MAX_S`."""
WAIT_MAX_S: Final = 60.0
FORGET_S: Final = 25.0
"""Led for so long without an objection, the time begins at `REST_S` again."""
_AT_REST: Final = (0.0,) * 6
WORDS: Final = 200
"""Longest reason that goes into a status."""


class GuardState(msgspec.Struct):
    """State of `ControllerGuard`; a controller's is its own affair: it is reset first."""

    failed: bool = False
    """It is not asked again."""
    why: str = ""
    """Why its action was not used at the last tick; "": it was."""
    rest_s: float = 0.0
    """Time for which all still hold."""
    wait_s: float = 0.0
    """The newest such time."""
    time_s: float = 0.0
    """Since it was last reset."""


class ControllerGuard:
    """Asks a controller, and lets through what holds."""

    def __init__(
        self,
        controller: Controller,
        law: Hocca,
        geometry: GeometryConfig,
    ) -> None:
        half = geometry.l_foot / 2, (geometry.w_base + geometry.w_foot) / 2
        self._room = SUPPORT * half[0], SUPPORT * half[1]
        self._controller, self._law = controller, law
        self._begun = False

    def act(self, state: GuardState, seen: Observation, *, leads: bool) -> LawOutput:
        """Return the tick's output.

        Args:
            state: of this guard, which changes.
            seen: at this tick; its `time_s` is set here.
            leads: the planner leads; else the controller is reset, and the shipped law's output is
                returned, which starts at the measured pose.
        """
        law = seen.law
        state.time_s = state.time_s + seen.dt if leads else 0.0
        if state.failed:
            return _uncertified(law)
        shown = _frozen(seen._replace(time_s=state.time_s))
        try:
            if not (leads and self._begun):
                self._controller.reset(shown)
                self._begun = True
            if not leads:
                return self._rested(state, seen)
            action = self._controller.step(shown)
            fault = _fault_of(action)
        except Exception as error:  # noqa: BLE001 - whatever somebody's code brings about
            fault = f"raised {type(error).__name__}: {error}"
        if fault:
            state.why, state.failed = f"the controller {fault}"[:WORDS], True
            return _uncertified(law)
        local = self._law.split.certify(action.D)
        state.why = self._objection(seen, action, local)
        if state.why:
            state.wait_s = clamp(2.0 * state.wait_s, REST_S, WAIT_MAX_S)
            state.rest_s = state.wait_s
            return _uncertified(law)
        if state.time_s > FORGET_S:
            state.wait_s = 0.0
        return law._replace(
            q_ref=action.q_ref,
            v_ref=action.v_ref,
            tau_ff=action.tau_ff,
            dtau_ff=action.dtau_ff,
            tau_coupled=action.tau_coupled,
            local=local,
        )

    def _rested(self, state: GuardState, seen: Observation) -> LawOutput:
        """Return the shipped law's output; after an objection all hold until it is calm."""
        if state.why:
            x, y = capture_point(seen.p.tolist(), seen.pdot.tolist(), seen.law.slope)
            calm = abs(x) <= CALM * self._room[0] and abs(y) <= CALM * self._room[1]
            state.rest_s = max(0.0, state.rest_s - seen.dt) if calm else state.wait_s
            if state.rest_s > 0.0:
                return _uncertified(seen.law)
            state.why = ""
        return seen.law

    def _objection(self, seen: Observation, action: Action, local: LocalGains) -> str:
        """Return why an action must not be sent at this pose; "" if it may."""
        if local.source is SplitSource.UNCERTIFIED:
            service, onboard = local.margins
            return f"the controller's gains do not stand alone: {service:.2f}, {onboard:.2f}"
        held = action.D * (action.q_ref - seen.q) + action.tau_ff - seen.law.tau_ff
        moves = self._law.rest_from_here(action.D, held)[:2].tolist()
        x, y, z = seen.p[:3].tolist()
        there = (x + moves[0], y + moves[1], z)
        places = {
            "the capture point": capture_point(seen.p.tolist(), seen.pdot.tolist(), seen.law.slope),
            "the rest in HOLD": capture_point(there, _AT_REST, seen.law.slope),
        }
        for name, (x, y) in places.items():
            if not (abs(x) <= self._room[0] and abs(y) <= self._room[1]):
                return f"{name} is at {1e3 * x:.0f}, {1e3 * y:.0f} mm, near the edge of the soles"
        return ""


def _fault_of(action: object) -> str:
    """Return what is wrong with what a controller returned; "" if it is an action."""
    if not isinstance(action, Action):
        return f"returned a {type(action).__name__}; an Action is right"
    for name, values in zip(Action._fields, action, strict=True):
        if not isinstance(values, np.ndarray) or values.shape != (N_JOINTS,):
            return (
                f"returned {name} of shape {np.shape(values)}; an array of ({N_JOINTS},) is right"
            )
        if values.dtype not in (np.float32, np.float64) or not np.isfinite(values).all():
            return f"returned {name} with a number that is not finite, or not a float"
    return ""


def _uncertified(law: LawOutput) -> LawOutput:
    """Return the shipped law's output, marked so that all six hold."""
    return law._replace(local=law.local._replace(source=SplitSource.UNCERTIFIED))


def _frozen(seen: Observation) -> Observation:
    """Return what a controller may look at; who writes into it raises.

    They are copies: guard, trips and status read the arrays themselves after the controller.
    """
    law = seen.law
    local = law.local._replace(D=_read_only(law.local.D), D_B=_read_only(law.local.D_B))
    return seen._replace(law=law._replace(**_arrays_of(law), local=local), **_arrays_of(seen))


def _arrays_of(values: LawOutput | Observation) -> dict[str, Any]:
    """Return copies of the arrays, by name."""
    named = values._asdict()
    return {name: _read_only(v) for name, v in named.items() if isinstance(v, np.ndarray)}


def _read_only(values: np.ndarray) -> np.ndarray:
    copied = values.copy()
    copied.setflags(write=False)
    return copied
