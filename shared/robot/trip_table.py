"""Table of trips: causes, and remedies that let the planner lead again.

On a trip the module goes to HOLD, or all six do at the planner's request. HOLD needs no planner.
The limits and times are in [trips] of the robot file. `xrl faults` prints the table.
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
    Wearing.RESTS: "parked: tug up to unpark it",
    Wearing.AWAY: "parked: nobody touches it",
    Wearing.PULLS: "somebody pulls horizontally",
    Wearing.BUMPED: "a bump had no effect",
}
"""Text about the wearer, by `PlannerStatus.wearer`."""


class TripRow(NamedTuple):
    """One trip."""

    key: str
    """Key in [trips] of the robot file."""
    measured: str
    unit: str
    recovery: str
    least: bool = False
    """True if a value below the limit trips."""


_GAINS: Final = (
    "the drivetrain is softer, or its delay longer, than in [robustness] of the robot file: "
    "correct these values, then run `xrl gains`"
)

JOINT_TRIPS: Final[dict[Cause, TripRow]] = {
    Cause.SHAKING: TripRow(
        "shaking", "its torque shakes: root mean square above 8 Hz", "N m", _GAINS
    ),
    Cause.TORQUE_LIMIT: TripRow(
        "torque_limit", "its torque is at the limit of its motors", "times joint.tau_module_max",
        "reduce the load; check whether a leg is caught or stands on an edge",
    ),
    Cause.TOO_FAST: TripRow(
        "speed", "its joint turns fast", "rad/s", "lead more slowly; check its encoder"
    ),
}  # fmt: skip
"""Trips of a joint service while it tracks; the planner then holds the others. After a wait, which
each trip doubles, the module can be led again."""

PLANNER_TRIPS: Final[dict[Trip, TripRow]] = {
    Trip.LEGS: TripRow(
        "legs", "the legs disagree about the torso", "m",
        "put both soles flat on the floor; if it persists, run `xrl drive zero`",
    ),
    Trip.REACH: TripRow(
        "reach", "the reference pose is out of reach", "m", "lead back within the legs' reach"
    ),
    Trip.TRACKING: TripRow(
        "tracking", "a joint is far from its reference", "rad",
        "let the robot move freely; check whether a joint is caught or its zero is wrong",
    ),
    Trip.UNLOADED: TripRow(
        "unloaded", "a leg carries almost no load", "N", "stand on both feet", least=True
    ),
    Trip.SINKING: TripRow("sinking", "the COM sinks or rises fast", "m/s", "lead more slowly"),
    Trip.TURNING: TripRow("turning", "the torso turns fast", "rad/s", "lead more slowly"),
    Trip.HARNESS: TripRow(
        "harness", "the force on the wearer differs from the requested assist", "N",
        "take weight off the harness, or request more assist",
    ),
    Trip.SAGGING: TripRow(
        "sagging", "the person sinks with weight on the harness", "W",
        "let the person stand up; request more assist, or lead down more slowly",
    ),
    Trip.UNATTENDED: TripRow(
        "unattended", "the robot drifts without a hand on it", "m",
        "take hold of it",
    ),
    Trip.EDGE: TripRow(
        "edge", "a sole is loaded near its edge, sideways", "of its half width",
        "do not lean on the robot from the side",
    ),
    Trip.TIPPING: TripRow(
        "tipping", "a sole is loaded at its edge, sideways", "of its half width",
        "do not push the robot from the side",
    ),
    Trip.OFF_BALANCE: TripRow(
        "balance", "the COM is ahead of or behind its reference", "m",
        "do not push the robot. If nobody pushes, run `xrl kill planner`",
    ),
}  # fmt: skip
"""Trips of the planner while it leads. It leads again once every value has been within its limit
for a second."""


def limits_of(config: RobotConfig) -> TripsConfig:
    """Return the robot's limits; without certified gains nothing trips.

    The paper's split is for comparison: at 20 ms of delay it shakes, and a trip would hide that.
    """
    return config.trips if config.law.split == "certified" else _NEVER


def untripped(config: RobotConfig) -> RobotConfig:
    """Return the robot without trips, as a baseline for studies only.

    Its load is not estimated either: shaking would look like a load, and the planner would not
    lead.
    """
    law = msgspec.structs.replace(config.law, load_correction=(0.0, 0.0))
    return msgspec.structs.replace(config, trips=_NEVER, law=law)


_NEVER: Final = TripsConfig(
    **{
        row.key: TripLimit(limit=-math.inf if row.least else math.inf)
        for row in (*JOINT_TRIPS.values(), *PLANNER_TRIPS.values())
    }
)

# ---- remedies, worded alike in the status, on the page and in ROS 2

RESTART: Final = "xrl kill MODULE"
"""Command that kills a module's service, which the supervisor then restarts."""
REARM: Final = "xrl rearm"
"""Command that re-arms all six modules together, or none."""
OTHER_VERSION: Final = "its service has another version: use the same checkout on every host"


def remedy_of(state: JointState) -> str:
    """Return the remedy that lets a module track again; "" if none is needed.

    In the remedy, MODULE stands for the module's name.
    """
    try:
        mode, cause, drive = Mode(state.mode), Cause(state.cause), DriveStatus(state.drive)
        outside = Outside(state.outside)
    except ValueError:  # a code that this version does not know
        return OTHER_VERSION
    if mode is Mode.FAULT:
        return f"{recovery_of(cause)}; then run {RESTART}"
    if mode is Mode.DAMP:
        return FALLEN_REMEDY if cause is Cause.FALLEN else REARM
    if drive is DriveStatus.UNZEROED:
        return "hang the robot, then run xrl drive zero"
    if drive is DriveStatus.UNACKNOWLEDGED:
        return "no node acknowledges on its CAN bus: check power of drive and adapter, and cable"
    if drive is DriveStatus.HOLDING:
        return "automatic once the planner runs: the drive holds"
    if mode is Mode.DISARMED and drive in (DriveStatus.IDLE, DriveStatus.ERROR):
        return f"if it persists, read its log; hang the robot, then run {RESTART}"
    if mode is Mode.HOLD and cause in JOINT_TRIPS:
        return f"automatic, after a wait; if it trips again: {JOINT_TRIPS[cause].recovery}"
    if outside:
        return (
            f"the planner's {outside.name.lower()} is refused; recovery is automatic after a push "
            "or a stall. If the refusal persists, run xrl kill planner"
        )
    return ""


def reason_of(status: PlannerStatus) -> str:
    """Return why the planner does not lead, beyond its mode, and after a trip the remedy."""
    if status.trip not in PLANNER_TRIPS:
        return status.why
    return f"{status.why}: {PLANNER_TRIPS[Trip(status.trip)].recovery}"
