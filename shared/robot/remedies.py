"""What lets a module or the planner lead again: one text for status, page and ROS 2. Pure."""

from __future__ import annotations

from typing import Final

from shared.bus.messages import (
    Cause,
    DriveStatus,
    JointState,
    Mode,
    Outside,
    PlannerStatus,
    Trip,
)
from shared.robot.fault_table import recovery_of
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS

RESTART: Final = "xrl kill MODULE"
"""Its supervisor starts it again."""
OTHER_VERSION: Final = "its service is of another version: the same checkout on every host"


def remedy_of(state: JointState) -> str:
    """Return what lets a module track again, with MODULE for its name; "" if nothing is needed."""
    try:
        mode, cause, drive = Mode(state.mode), Cause(state.cause), DriveStatus(state.drive)
        outside = Outside(state.outside)
    except ValueError:  # a code that this version does not know
        return OTHER_VERSION
    if mode is Mode.FAULT:
        return f"{recovery_of(cause)}; then {RESTART}"
    if mode is Mode.DAMP:
        return RESTART
    if drive is DriveStatus.UNZEROED:
        return "hang the robot, xrl drive zero"
    if drive is DriveStatus.HOLDING:
        return "by itself, with the planner: the drive holds"
    if mode is Mode.DISARMED and drive in (DriveStatus.IDLE, DriveStatus.ERROR):
        return f"if it lasts: its log says why; hang the robot, then {RESTART}"
    if mode is Mode.HOLD and cause in JOINT_TRIPS:
        return f"by itself, after a wait; if again: {JOINT_TRIPS[cause].recovery}"
    if outside:
        refused = f"the planner's {outside.name.lower()} is refused"
        return f"{refused}: by itself after a push or a stall; if it lasts, xrl kill planner"
    return ""


def reason_of(status: PlannerStatus) -> str:
    """Return why the planner does not lead and what helps, where its mode does not say it all."""
    if status.trip not in PLANNER_TRIPS:
        return status.why
    return f"{status.why}: {PLANNER_TRIPS[Trip(status.trip)].recovery}"
