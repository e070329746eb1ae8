"""What trips the robot out of being led, what then happens, and what lets it lead again.

A trip asks nobody: the module, or all six by the planner's word, goes to HOLD, which needs no one.
The limits and times stand in [trips] of the robot file. `xrl faults` prints the table.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import msgspec

from shared.bus.messages import (
    Cause,
    DriveStatus,
    JointState,
    Mode,
    Outside,
    PlannerStatus,
    Trip,
    Wearing,
)
from shared.config.robot_config import RobotConfig
from shared.config.sections import TripLimit, TripsConfig
from shared.robot.fault_table import FALLEN_REMEDY, recovery_of

WEARING: Final[dict[int, str]] = {
    Wearing.LEADS: "",
    Wearing.RESTS: "parked: a tug up opens it",
    Wearing.AWAY: "parked, and nobody touches it",
    Wearing.PULLS: "somebody pulls along the floor",
    Wearing.BUMPED: "parked; a bump did not open it",
}
"""What a status says of the person, by its `wearer`."""


class TripRow(NamedTuple):
    """One trip."""

    key: str
    """In [trips] of the robot file."""
    measured: str
    unit: str
    recovery: str
    """Remedy."""
    least: bool = False
    """Trips below its limit, not above."""


_GAINS: Final = (
    "the drivetrain is softer, or later, than [robustness] of the robot file says: compare, then "
    "`xrl gains`"
)

JOINT_TRIPS: Final[dict[Cause, TripRow]] = {
    Cause.SHAKING: TripRow(
        "shaking", "its own torque above the law's band, root mean square", "N m", _GAINS
    ),
    Cause.TORQUE_LIMIT: TripRow(
        "torque_limit", "its torque at the limit of its motors", "of tau_module_max",
        "take load off; is a leg caught, or does it stand on an edge?",
    ),
    Cause.TOO_FAST: TripRow(
        "speed", "its joint's speed", "rad/s", "lead more slowly; is its encoder sound?"
    ),
}  # fmt: skip
"""By a joint service, while it tracks; the others follow by the planner's word. After its wait,
which each doubles, it may be led again."""

PLANNER_TRIPS: Final[dict[Trip, TripRow]] = {
    Trip.LEGS: TripRow(
        "legs", "the legs disagree about the torso", "m",
        "stand both soles flat; if it lasts: `xrl drive zero`",
    ),
    Trip.REACH: TripRow(
        "reach", "the reference pose is out of reach", "m", "lead back to where the legs reach"
    ),
    Trip.TRACKING: TripRow(
        "tracking", "a joint is far from its reference", "rad",
        "let it move freely; is a joint caught, or its zero wrong?",
    ),
    Trip.UNLOADED: TripRow(
        "unloaded", "a leg carries hardly anything", "N", "stand on both feet", least=True
    ),
    Trip.SINKING: TripRow("sinking", "it sinks or rises fast", "m/s", "lead more slowly"),
    Trip.TURNING: TripRow("turning", "the torso turns fast", "rad/s", "lead more slowly"),
    Trip.HARNESS: TripRow(
        "harness", "the person is carried otherwise than asked", "N",
        "take weight off the harness, or ask for more assist",
    ),
    Trip.SAGGING: TripRow(
        "sagging", "the person sinks with weight on the harness", "W",
        "let the person stand up; ask for more assist, or lead down more slowly",
    ),
    Trip.UNATTENDED: TripRow(
        "unattended", "it drifts with nobody's hand on it", "m",
        "take hold of it: it leads again a second later",
    ),
    Trip.EDGE: TripRow(
        "edge", "a sole is loaded near its edge, sideways", "of its half width",
        "do not lean on it from the side: it leads again a second later",
    ),
    Trip.TIPPING: TripRow(
        "tipping", "a sole is loaded at its edge, sideways", "of its half width",
        "do not shove it from the side: it leads again a second later",
    ),
    Trip.OFF_BALANCE: TripRow(
        "balance", "its COM is ahead of or behind where it is held", "m",
        "do not push it: it leads again a second later; if nobody does, `xrl kill planner`",
    ),
}  # fmt: skip
"""By the planner, while it leads. It leads again once all is within its limits for a second."""


def limits_of(config: RobotConfig) -> TripsConfig:
    """Return the robot's limits; with gains that no schedule certifies nothing trips.

    The paper's split is there to be compared with: 20 ms late it shakes, and that is to be seen.
    """
    return config.trips if config.law.split == "certified" else _NEVER


def untripped(config: RobotConfig) -> RobotConfig:
    """Return the robot without trips, as a baseline for studies only.

    Its load is not estimated either: shaking would be taken for a load, and the robot would not be
    led.
    """
    law = msgspec.structs.replace(config.law, load_correction=(0.0, 0.0))
    return msgspec.structs.replace(config, trips=_NEVER, law=law)


_NEVER: Final = TripsConfig(
    **{
        row.key: TripLimit(limit=-math.inf if row.least else math.inf)
        for row in (*JOINT_TRIPS.values(), *PLANNER_TRIPS.values())
    }
)

# ---- one text of what helps, for status, page and ROS 2

RESTART: Final = "xrl kill MODULE"
"""Its supervisor starts it again."""
REARM: Final = "xrl rearm"
"""All six modules together, or none."""
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
        return FALLEN_REMEDY if cause is Cause.FALLEN else REARM
    if drive is DriveStatus.UNZEROED:
        return "hang the robot, xrl drive zero"
    if drive is DriveStatus.UNACKNOWLEDGED:
        return "nobody acknowledges on its CAN bus: power of drive and adapter, cable"
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
