"""Table of faults and their consequences (docs/reference/faults.md).

`tests/lockstep/test_faults.py` causes every fault of a drive and compares module, neighbours and
drive with its row. `xrl study crash` does so live, with processes and recovery. `xrl faults` prints
the table.

The last column follows one rule: a module that lost torque is never re-armed automatically. A
person requests re-arming by restarting the module's service. A service that the supervisor
restarted after a crash does not re-arm the module (`services.joint.rearm_guard`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from shared.bus.messages import Cause
from shared.config.scenarios import FaultKind


class DriveFault(NamedTuple):
    """A fault of a module's ODrive.

    The module goes to FAULT, and the planner holds the other five, so that no leg works against the
    other. Without a `cause`, the module stays in control, or all six hold temporarily. If a knee
    may be limp, the other five stiffen, and its leg is a strut between a stiff ankle and a stiff
    hip. If an ankle may be limp, the knees stiffen (`shared.robot.hold_rules`).
    """

    drive: str
    """Reaction of the drive."""
    limp: bool
    """True if the module has no torque; False if the drive still holds it."""
    cause: Cause | None
    """Cause of FAULT, as `xrl status` and the service's log show it; None: no FAULT."""
    zero_lost: bool
    """True if the joint must be zeroed (`xrl drive zero`) before it can be armed again."""
    recovery: str
    """Action of a person before the service is restarted."""


_LIMP: Final = "that axis floats"
_BOTH_LIMP: Final = "both axes float"
_HANG: Final = "hang the robot"

DRIVE_FAULTS: Final[dict[FaultKind, DriveFault]] = {
    "over_temperature": DriveFault(
        f"the current is reduced near the limit; beyond it {_LIMP}", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; let the drive cool; check its airflow and current_lim",
    ),
    "over_voltage": DriveFault(
        _BOTH_LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; use a supply that absorbs the current of braking legs",
    ),
    "encoder": DriveFault(
        f"for 51 ms it stays armed and reports the last position; then {_LIMP}", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=True,
        recovery=f"{_HANG}; repair the encoder or its cable, then run `xrl drive zero`",
    ),
    "watchdog": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; switch the watchdog off for the onboard loop (`xrl doctor`)",
    ),
    "link_lost": DriveFault(
        "its own loop holds the last target", limp=False, cause=Cause.DRIVE_LOST, zero_lost=False,
        recovery="repair the cable; the restarted service takes over without a torque step",
    ),
    "disarmed": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; find the source of the idle request",
    ),
    "overspeed": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; check vel_limit with `xrl doctor`; find out why it moved too fast",
    ),
    "brown_out": DriveFault(
        "without power both axes float; it restarts without a zero", limp=True,
        cause=Cause.DRIVE_LOST, zero_lost=True,
        recovery=f"{_HANG}; repair the supply, then run `xrl drive zero`",
    ),
    "encoder_zero": DriveFault(
        "the position moves to the encoder's nearest whole turn and stays there, without an "
        f"encoder error; {_LIMP} at once if the position jumps by a tenth of a turn (OVERSPEED), "
        "else the service idles the drive, usually within 70 ms (POSITION_LOST)",
        limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=True,
        recovery=f"{_HANG}; repair the encoder's cable or supply, then run `xrl drive zero`",
    ),
    "encoder_gap": DriveFault(
        "it reports the last position and stays armed, without an error. The module goes to FAULT "
        "only if the count jumps by a tenth of a turn (OVERSPEED), or a turn may be missing (the "
        "service then clears the zero)", limp=False, cause=None,
        zero_lost=False,
        recovery="repair the encoder's cable",
    ),
    "no_ack": DriveFault(
        "its own loop holds the last target; frames queued in the kernel are discarded",
        limp=False, cause=Cause.DRIVE_LOST, zero_lost=False,
        recovery="repair its CAN receiver or the wires; the restarted service takes over",
    ),
    "bus_full": DriveFault(
        "its own loop holds the last target for 40 ms at a time", limp=False, cause=None,
        zero_lost=False,
        recovery="remove other traffic from the bus; `xrl doctor` shows the send queue",
    ),
    "bus_flap": DriveFault(
        "its own loop holds the last target for 60 ms at a time; no old frame reaches it",
        limp=False, cause=None, zero_lost=False,
        recovery="repair the adapter, its channel or cable",
    ),
}  # fmt: skip
"""Faults by the name that scenarios and `--fault` use."""


FALLEN_REMEDY: Final = "free the person and hang the robot, then run xrl rearm"


class _LossRow(NamedTuple):
    """A lost process or link, or the emergency stop."""

    module: str
    """Reaction of the affected module, or of all six."""
    others: str
    """Reaction of the other modules and the planner."""
    visible: str
    """Signs of it in status and messages."""
    recovery: str


LOSSES: Final[dict[str, _LossRow]] = {
    "joint service killed or hung": _LossRow(
        "the drive's own loop holds, with the coupled torque frozen",
        "HOLD: the planner requests it when the module's state is stale",
        "`xrl status`: no states, restarts; planner/status: hold",
        "automatic: the supervisor restarts the service, which takes over the drive once a planner "
        "runs; then all six track again. If the service hangs, run `xrl kill MODULE`; if the drive "
        "lost torque meanwhile, hang the robot first",
    ),
    "planner killed or hung": _LossRow(
        "HOLD within `max_command_age_ms`, with local gains and frozen references",
        "the same",
        "`xrl status`: HOLD because PLANNER_ENDED (on the planner's own host) or COMMAND_STALE",
        "automatic: a new planner starts from the measured pose and leads after a blend. If the "
        "planner hangs, run `xrl kill planner`",
    ),
    "bus slow, lossy or cut": _LossRow(
        "HOLD when its commands are too old",
        "HOLD: the planner requests it",
        "`xrl status`: HOLD, ages, dropouts",
        "automatic, after a wait that grows with each dropout",
    ),
    "harness lost": _LossRow(
        "nothing",
        "the planner continues to lead, without correcting the assist or easing the lead. It "
        "detects no overload and no HARNESS, SAGGING or UNATTENDED trip; an active overload, "
        "HARNESS or SAGGING trip stays",
        "harness/wrench: not valid",
        "automatic; an overload or trip that stayed ends when the harness is back, or with "
        "`xrl kill planner`",
    ),
    "IMU lost, where one is fitted": _LossRow(
        "nothing",
        "the planner continues to lead with the last slope; a new planner assumes a level floor",
        "imu/attitude: not valid",
        "automatic",
    ),
    "recorder lost": _LossRow(
        "nothing",
        "nothing",
        "`xrl status`: restarts",
        "automatic: it writes a new file; the old one is readable up to its last flush",
    ),
    "emergency stop": _LossRow(
        "DAMP: knees sink slowly, hips keep the torso's attitude, ankles keep the hips above the "
        "feet, frontal axes hold; if a module of the host does not sink, all hold",
        "the same",
        "`xrl status`: DAMP because ESTOP",
        "once the robot is at rest: `xrl rearm` re-arms all six together, or none",
    ),
    "feet away from their place before the planner leads": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISPLACED; `xrl status` shows the direction",
        "automatic, once the feet are within `law.stance_max`",
    ),
    "a load far from the robot file's": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISLOADED; `xrl status` shows the difference",
        "automatic, once the load is within `law.load_correction`; or set mass.payload, then run "
        "`xrl gains`",
    ),
    "a trip": _LossRow(
        "HOLD: it detects shaking, torque and speed itself",
        "HOLD, at the planner's request; the planner's own trips hold all six",
        "`xrl status`: HOLD because SHAKING, TORQUE_LIMIT or TOO_FAST; planner/status: TRIPPED",
        "automatic, after a wait that grows with each trip",
    ),
    "a fall": _LossRow(
        "DAMP: every axis only damps, without stiffness",
        "the same",
        "planner/status: FALLEN, and the signs; `xrl status`: DAMP because FALLEN, exit code 1",
        f"{FALLEN_REMEDY}; the robot can be led once its feet carry its weight",
    ),
    "overload at the harness": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: OVERLOADED",
        "automatic, `harness.overload_release_s` after the harness is released",
    ),
}
"""Rows by the kind of loss."""


def recovery_of(cause: Cause) -> str:
    """Return a short remedy for a module that is in FAULT for this cause."""
    if cause is Cause.DRIVE_LOST:
        return "repair power or cable (after a loss of power, run xrl drive zero)"
    if cause is Cause.POSITION_LOST:
        return "hang the robot, repair the encoder, run xrl drive zero"
    return "hang the robot, find out why the drive disarmed"
