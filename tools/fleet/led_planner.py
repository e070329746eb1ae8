"""Who requests something of the planner (`operator/intent`)."""

from __future__ import annotations

import os

from shared.bus.messages import PlannerStatus
from shared.config.scenarios import SCENARIO
from shared.places import user_name


def asker(verb: str) -> str:
    """Return the requester's name for a verb, as `OperatorIntent.source` has it."""
    return f"xrl {verb} by {user_name()} ({os.getpid()})"


def other_asker(status: PlannerStatus | None, own: str) -> str:
    """Return who else requests something of the planner; "" if only a scenario or nobody does."""
    by = "" if status is None else status.requested_by
    return "" if by in (SCENARIO, own) else by
