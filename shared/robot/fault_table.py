"""Table of faults and their consequences (docs/reference/faults.md).

Each row is a claim. `tests/lockstep/test_faults.py` causes every fault of a drive and compares
module, neighbours and drive with the row. `xrl study crash` does so live, with processes and
recovery. `xrl faults` prints the table.

The last column follows one rule: a module that lost torque is never re-armed automatically. A
person requests it by restarting the module's service. A service that crashed and was restarted by
the supervisor knows the difference (`services.joint.rearm_guard`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from shared.bus.messages import Cause
from shared.config.scenarios import FaultKind


class DriveFault(NamedTuple):
    """A fault of a module's ODrive.

    The module goes to FAULT, and the planner holds the other five, so that no leg works against the
    other. Without a `cause` it stays in control, or all six hold temporarily. If a knee may be limp
    the other five stiffen: its leg then stands as a strut between a stiff ankle and a stiff hip. If
    an ankle may be limp the knees stiffen (`shared.robot.hold_rules`).
    """

    drive: str
    """Reaction of the drive."""
    limp: bool
    """True if the module gives no torque; False if the drive still holds it."""
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
        f"current is reduced near the limit; beyond it {_LIMP}", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; let the drive cool; check its airflow and current_lim",
    ),
    "over_voltage": DriveFault(
        _BOTH_LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; make the supply absorb the current of braking legs",
    ),
    "encoder": DriveFault(
        f"it stays armed and reports the last position for 51 ms; then {_LIMP}", limp=True,
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
        recovery=f"{_HANG}; find out what requested idle",
    ),
    "overspeed": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; check vel_limit with `xrl doctor`; find out why it moved too fast",
    ),
    "brown_out": DriveFault(
        "no power: both axes float; it restarts without a zero", limp=True,
        cause=Cause.DRIVE_LOST, zero_lost=True,
        recovery=f"{_HANG}; repair the supply, then run `xrl drive zero`",
    ),
    "encoder_zero": DriveFault(
        "the position goes to the encoder's nearest turn and stays, without an encoder error; "
        f"{_LIMP}, at once if the position jumps (OVERSPEED), else within 70 ms", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=True,
        recovery=f"{_HANG}; repair the encoder's cable or supply, then run `xrl drive zero`",
    ),
    "encoder_gap": DriveFault(
        "it holds the last position, stays armed and reports no error; OVERSPEED if the count "
        "jumps by a tenth of a turn; if a turn may be missing, its service idles it and clears "
        "its zero", limp=False, cause=None,
        zero_lost=False,
        recovery="repair the encoder's cable",
    ),
    "no_ack": DriveFault(
        "its own loop holds the last target; frames queued in the kernel are discarded",
        limp=False, cause=Cause.DRIVE_LOST, zero_lost=False,
        recovery="repair its CAN receiver or the wires; then as for link_lost",
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
"""By the name that scenarios and `--fault` use."""


FALLEN_REMEDY: Final = "free the person and hang the robot, then run xrl rearm"


class _LossRow(NamedTuple):
    """A lost process or link, or the emergency stop."""

    module: str
    """Reaction of the affected module, or of all six."""
    others: str
    """Reaction of the rest."""
    visible: str
    """Signs that the operator sees."""
    recovery: str


LOSSES: Final[dict[str, _LossRow]] = {
    "joint service killed or hung": _LossRow(
        "its drive's own loop holds, with the coupled torque frozen",
        "HOLD: the planner requests it when the module's state is stale",
        "`xrl status`: no states, restarts; planner/status: hold",
        "automatic: the supervisor restarts it; it takes over the drive once a planner runs, and "
        "all six track again. If the service hangs, run `xrl kill`. If the drive lost torque "
        "meanwhile, hang the robot, then run `xrl kill`",
    ),
    "planner killed or hung": _LossRow(
        "HOLD within max_command_age: local gains, references frozen",
        "the same",
        "`xrl status`: HOLD because PLANNER_ENDED (its process ended, same host) or COMMAND_STALE",
        "automatic: a new planner starts from the measured pose and leads after a blend",
    ),
    "bus slow, lossy or cut": _LossRow(
        "HOLD when its commands are too old",
        "HOLD: the planner requests it",
        "`xrl status`: HOLD, ages, drop-outs",
        "automatic, after a wait that doubles with each drop-out",
    ),
    "harness lost": _LossRow(
        "nothing",
        "the planner continues to lead, without closed assist force and without easing the lead. "
        "It detects no overload and no harness, sagging or unattended trip; an active trip stays",
        "harness/wrench: not valid",
        "automatic; an active trip ends when the harness is back, or with `xrl kill planner`",
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
        "automatic: a new file; the old file is readable up to its last flush",
    ),
    "emergency stop": _LossRow(
        "DAMP: knees sink slowly, hips keep the torso's attitude, ankles keep the hips above the "
        "feet, frontal axes hold; if a module of the host does not go down with them, all hold "
        "where they are",
        "the same",
        "`xrl status`: DAMP because ESTOP",
        "once the robot is at rest: `xrl rearm` re-arms all six together, or none",
    ),
    "feet away from their place before the planner leads": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISPLACED; `xrl status` says which way",
        "automatic, when the feet stand within `law.stance_max` of their place",
    ),
    "a load far from the robot file's": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISLOADED; `xrl status` says by how much",
        "automatic, when the load is within `law.load_correction`; or set mass.payload, then run "
        "`xrl gains`",
    ),
    "a trip": _LossRow(
        "HOLD: the module trips on its own on shaking, torque or speed",
        "HOLD, at the planner's request; the planner's own trips hold all six",
        "`xrl status`: because SHAKING, TORQUE_LIMIT, TOO_FAST; planner/status: TRIPPED, and why",
        "automatic, after a wait that grows with each trip",
    ),
    "a fall": _LossRow(
        "DAMP: every axis only damps, none is stiff",
        "the same",
        "planner/status: FALLEN, and the signs; `xrl status`: DAMP because FALLEN, exit code 1",
        f"{FALLEN_REMEDY}; it can be led once its feet bear its weight",
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
    """Return a person's action for a module in FAULT for this cause, in short."""
    if cause is Cause.DRIVE_LOST:
        return "repair power or cable (after a loss of power, run xrl drive zero)"
    if cause is Cause.POSITION_LOST:
        return "hang the robot, repair the encoder, run xrl drive zero"
    return "hang the robot, find out why it disarmed"
