"""Check of a custom controller's actions before they become commands. Pure.

Gains that cannot hold the robot alone in this pose are never sent: the tick is UNCERTIFIED, and all
modules hold. They also hold while the capture point, or the pose in which HOLD would settle on this
action, is near the edge of the soles. Without this check, a controller that smoothly tipped the
robot over made it fall although every joint stayed within its bounds. If a controller raises or
returns an invalid action, the guard never calls it again: all modules hold until the planner
restarts. The joint services refuse steps, references and torques beyond their bounds
(`services.joint.envelope`).
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
"""Fraction of the support area's half length and half width, within which the capture point and the
rest pose in HOLD must be."""
CALM: Final = 0.6
"""Fraction of that range within which the capture point must be before the controller resumes."""
REST_S: Final = 1.0
"""Hold time after the first objection, s, counted while calm; each further objection doubles it, up
to `WAIT_MAX_S`."""
WAIT_MAX_S: Final = 60.0
FORGET_S: Final = 25.0
"""Time of leading without objection, s, after which the next hold time is `REST_S` again."""
_AT_REST: Final = (0.0,) * 6
WORDS: Final = 200
"""Maximum length of a reason in the status, characters."""


class GuardState(msgspec.Struct):
    """State of `ControllerGuard`; the controller's own state is not part of it."""

    failed: bool = False
    """True once the guard no longer calls the controller."""
    why: str = ""
    """Reason why the last tick did not use the controller's action, or ""."""
    rest_s: float = 0.0
    """Remaining hold time, s."""
    wait_s: float = 0.0
    """Full hold time after the last objection, s."""
    time_s: float = 0.0
    """Time since the controller's last reset, s."""


class ControllerGuard:
    """Runs a controller, and accepts those of its actions that pass every check."""

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
            state: state of this guard; updated in place.
            seen: observation of this tick; its `time_s` is set here.
            leads: True if the planner leads; otherwise the controller is reset, and the shipped
                law's output is returned.
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
        except Exception as error:  # noqa: BLE001 - a custom controller may raise anything
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
        """Return the shipped law's output, marked uncertified while a hold time runs."""
        if state.why:
            x, y = capture_point(seen.p.tolist(), seen.pdot.tolist(), seen.law.slope)
            calm = abs(x) <= CALM * self._room[0] and abs(y) <= CALM * self._room[1]
            state.rest_s = max(0.0, state.rest_s - seen.dt) if calm else state.wait_s
            if state.rest_s > 0.0:
                return _uncertified(seen.law)
            state.why = ""
        return seen.law

    def _objection(self, seen: Observation, action: Action, local: LocalGains) -> str:
        """Return the reason for not sending an action at this pose; "" if it may be sent."""
        if local.source is SplitSource.UNCERTIFIED:
            service, onboard = local.margins
            return (
                f"the controller's gains do not hold the robot alone (margins {service:.2f} and "
                f"{onboard:.2f}), or are outside 0 to joint_service.k_p_max"
            )
        held = action.D * (action.q_ref - seen.q) + action.tau_ff - seen.law.tau_ff
        moves = self._law.rest_from_here(action.D, held)[:2].tolist()
        x, y, z = seen.p[:3].tolist()
        there = (x + moves[0], y + moves[1], z)
        places = {
            "the capture point": capture_point(seen.p.tolist(), seen.pdot.tolist(), seen.law.slope),
            "the rest position in HOLD": capture_point(there, _AT_REST, seen.law.slope),
        }
        for name, (x, y) in places.items():
            if not (abs(x) <= self._room[0] and abs(y) <= self._room[1]):
                return f"{name} is at {1e3 * x:.0f}, {1e3 * y:.0f} mm, near the edge of the soles"
        return ""


def _fault_of(action: object) -> str:
    """Return the fault of a controller's result; "" if it is a valid action."""
    if not isinstance(action, Action):
        return f"returned a {type(action).__name__}; it must return an Action"
    for name, values in zip(Action._fields, action, strict=True):
        if not isinstance(values, np.ndarray) or values.shape != (N_JOINTS,):
            return f"returned {name} of shape {np.shape(values)}; it must have shape ({N_JOINTS},)"
        if values.dtype not in (np.float32, np.float64) or not np.isfinite(values).all():
            return f"returned {name} with a number that is not finite, or not a float"
    return ""


def _uncertified(law: LawOutput) -> LawOutput:
    """Return the shipped law's output, marked so that all six hold."""
    return law._replace(local=law.local._replace(source=SplitSource.UNCERTIFIED))


def _frozen(seen: Observation) -> Observation:
    """Return a read-only copy of the observation for the controller.

    Guard, trips and status read the original arrays after the controller has run.
    """
    law = seen.law
    local = law.local._replace(D=_read_only(law.local.D), D_B=_read_only(law.local.D_B))
    return seen._replace(law=law._replace(**_arrays_of(law), local=local), **_arrays_of(seen))


def _arrays_of(values: LawOutput | Observation) -> dict[str, Any]:
    named = values._asdict()
    return {name: _read_only(v) for name, v in named.items() if isinstance(v, np.ndarray)}


def _read_only(values: np.ndarray) -> np.ndarray:
    copied = values.copy()
    copied.setflags(write=False)
    return copied
