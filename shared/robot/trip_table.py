"""Table of trips: their causes, their effects, and what lets the robot lead again.

On a trip the module, or all six at the planner's request, goes to HOLD, which needs no planner. The
limits and times are in [trips] of the robot file. `xrl faults` prints the table.
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
    Wearing.BUMPED: "parked: a bump did not unpark it",
}
"""Text of a status about the wearer, by its `wearer`."""


class TripRow(NamedTuple):
    """One trip."""

    key: str
    """Key in [trips] of the robot file."""
    measured: str
    unit: str
    recovery: str
    least: bool = False
    """True if it trips below its limit, not above."""


_GAINS: Final = (
    "the drivetrain is softer, or has more delay, than [robustness] of the robot file says: "
    "compare them, then run `xrl gains`"
)

JOINT_TRIPS: Final[dict[Cause, TripRow]] = {
    Cause.SHAKING: TripRow(
        "shaking", "its own torque above the law's band, root mean square", "N m", _GAINS
    ),
    Cause.TORQUE_LIMIT: TripRow(
        "torque_limit", "its torque at the limit of its motors", "of tau_module_max",
        "reduce the load; check whether a leg is caught or stands on an edge",
    ),
    Cause.TOO_FAST: TripRow(
        "speed", "its joint's speed", "rad/s", "lead more slowly; check its encoder"
    ),
}  # fmt: skip
"""Trips of a joint service while it tracks; the planner then holds the others. After its wait,
which each trip doubles, it may be led again."""

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
        "let it move freely; check whether a joint is caught or its zero is wrong",
    ),
    Trip.UNLOADED: TripRow(
        "unloaded", "a leg carries almost no load", "N", "stand on both feet", least=True
    ),
    Trip.SINKING: TripRow("sinking", "it sinks or rises fast", "m/s", "lead more slowly"),
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
        "unattended", "it drifts without a hand on it", "m",
        "take hold of it; the planner leads again a second later",
    ),
    Trip.EDGE: TripRow(
        "edge", "a sole is loaded near its edge, sideways", "of its half width",
        "do not lean on it from the side; the planner leads again a second later",
    ),
    Trip.TIPPING: TripRow(
        "tipping", "a sole is loaded at its edge, sideways", "of its half width",
        "do not push it from the side; the planner leads again a second later",
    ),
    Trip.OFF_BALANCE: TripRow(
        "balance", "its COM is ahead of or behind where it is held", "m",
        "do not push it; the planner leads again a second later. If nobody pushes, run "
        "`xrl kill planner`",
    ),
}  # fmt: skip
"""Trips of the planner while it leads. It leads again once every value has been within its limit
for a second."""


def limits_of(config: RobotConfig) -> TripsConfig:
    """Return the robot's limits; with gains that no schedule certifies nothing trips.

    The paper's split serves for comparison: 20 ms late it shakes, and a trip would hide that.
    """
    return config.trips if config.law.split == "certified" else _NEVER


def untripped(config: RobotConfig) -> RobotConfig:
    """Return the robot without trips, as a baseline for studies only.

    Its load is not estimated either: shaking would look like a load, and the robot would not be
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

# ---- remedies, in the same words for status, page and ROS 2

RESTART: Final = "xrl kill MODULE"
"""Its supervisor starts it again."""
REARM: Final = "xrl rearm"
"""All six modules together, or none."""
OTHER_VERSION: Final = "its service has another version: use the same checkout on every host"


def remedy_of(state: JointState) -> str:
    """Return what lets a module track again, with MODULE for its name; "" if nothing is needed."""
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
        return f"if it persists, its log says why; hang the robot, then run {RESTART}"
    if mode is Mode.HOLD and cause in JOINT_TRIPS:
        return f"automatic, after a wait; if it trips again: {JOINT_TRIPS[cause].recovery}"
    if outside:
        refused = f"the planner's {outside.name.lower()} is refused"
        return f"{refused}: automatic after a push or a stall; if it persists, run xrl kill planner"
    return ""


def reason_of(status: PlannerStatus) -> str:
    """Return why the planner does not lead, and the remedy, beyond what its mode says."""
    if status.trip not in PLANNER_TRIPS:
        return status.why
    return f"{status.why}: {PLANNER_TRIPS[Trip(status.trip)].recovery}"
