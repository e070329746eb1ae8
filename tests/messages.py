"""Messages for tests: one builder for each that has many fields, and one for any type."""

from __future__ import annotations

import random
from collections.abc import Mapping
from functools import cache
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgspec

from shared.bus.messages import (
    DriveStatus,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    Tare,
    Vector6,
    Wrench,
)
from shared.joints import MODULES

ZERO6: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LEAVES: Final[Mapping[type, Any]] = {bool: True, int: 1, float: 0.25, str: "word"}


def sample(message_type: type[Any], **fields: Any) -> Any:
    """Return a message with a value of the right type in every field."""
    return msgspec.convert(_plain(message_type) | fields, message_type)


@cache
def _plain(message_type: type[Any]) -> dict[str, Any]:
    """Return its fields: to find their types takes milliseconds."""
    found: dict[str, Any] = msgspec.to_builtins(filled(message_type, LEAVES))
    return found


def filled(message_type: type[Any], leaves: Mapping[type, Any]) -> Any:
    """Return a message whose booleans, numbers and texts are these; a sequence has one entry."""

    def value(hint: Any) -> Any:
        if get_origin(hint) is tuple:
            items = get_args(hint)
            return tuple(value(item) for item in (items[:1] if items[-1] is Ellipsis else items))
        return filled(hint, leaves) if issubclass(hint, msgspec.Struct) else leaves[hint]

    hints = get_type_hints(message_type)
    return message_type(**{name: value(hints[name]) for name in message_type.__struct_fields__})


def joint_state(seed: int = 0, **changes: object) -> JointState:
    """Return a module that tracks, at drawn angles."""
    dice = random.Random(seed)
    begin: dict[str, object] = {
        "t_ns": 1, "seq": 1, "mode": int(Mode.TRACK), "cause": 2, "ready": True,
        "age_ns": 4_000_000,
        "q": (dice.uniform(-0.3, 0.3), dice.uniform(-1.5, 1.5)),
        "v": (dice.uniform(-1, 1), dice.uniform(-1, 1)),
        "tau": (dice.uniform(-9, 9), dice.uniform(-90, 90)),
        "session": 5, "command_seq": 9, "cycle": 100, "late": 0, "dropouts": 0, "refused": 0,
        "drive": int(DriveStatus.ARMED), "drive_error": 0,
    }  # fmt: skip
    return JointState(**begin | changes)  # type: ignore[arg-type]


def all_states(**changes: object) -> dict[str, JointState]:
    """Return six of them."""
    return {name: joint_state(number, **changes) for number, name in enumerate(MODULES)}


def planner_status(**changes: object) -> PlannerStatus:
    """Return a planner that leads."""
    begin: dict[str, object] = {
        "t_ns": 1, "seq": 1, "session": 5, "mode": int(PlannerMode.LEADING), "hold": False,
        "p": (0.01, 0.0, 0.9, 0.0, 0.1, 0.0), "pdot": ZERO6, "p_ref": ZERO6, "closure": ZERO6,
        "assist_n": 0.0, "margin": 1.1, "margin_onboard": 1.0, "split": 1, "ik_iterations": 1,
        "ik_residual": 0.0, "tick_us": 300.0, "state_seq": (1,) * 6, "wrench_seq": 1,
        "assist_requested_n": 0.0, "state_age_ns": (2_000_000,) * 6,
    }  # fmt: skip
    return PlannerStatus(**begin | changes)  # type: ignore[arg-type]


def wrench(**changes: object) -> Wrench:
    """Return what the harness feels of a light hand."""
    begin: dict[str, object] = {
        "t_ns": 1, "seq": 1, "force": (1.0, -2.0, 30.0), "moment": (0.1, 0.2, 0.3), "valid": True,
        "saturated": False, "tare": int(Tare.DONE), "age_ns": 1_000_000,
    }  # fmt: skip
    return Wrench(**begin | changes)  # type: ignore[arg-type]
