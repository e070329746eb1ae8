"""Faults, and what then happens: one table (docs/reference/faults.md).

Each row is a claim. `tests/lockstep/test_faults.py` brings about every fault of a drive and
compares module, neighbours and drive with the row; `xrl study crash` does so live, with processes
and recovery. `xrl faults` prints the table.

The rule behind the last column: a module that lost torque is never re-armed automatically. A person
asks for it by restarting the module's service; a service that crashed and was started by the
supervisor knows the difference (`services.joint.rearm_guard`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from shared.bus.messages import Cause
from shared.config.scenarios import FaultKind


class DriveFault(NamedTuple):
    """A fault of a module's ODrive.

    The module goes to FAULT, and the planner holds the other five, so that no leg works against
    the other. Without a `cause` it stays in control, or all six hold for a while. If a knee may be
    limp the other five stiffen: its leg then stands as a strut between a stiff ankle and a stiff
    hip. If an ankle may be limp the knees stiffen (`shared.robot.hold_rules`).
    """

    drive: str
    """Reaction of the drive by itself."""
    limp: bool
    """True if the module gives no torque; False if the drive goes on holding it."""
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
        f"less current near the limit, beyond it {_LIMP}", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; let the drive cool, check its airflow and current_lim",
    ),
    "over_voltage": DriveFault(
        _BOTH_LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; make the supply absorb the current of braking legs",
    ),
    "encoder": DriveFault(
        f"it reports the last position, armed and blind for 51 ms; then {_LIMP}", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=True,
        recovery=f"{_HANG}; repair the encoder or its cable, then `xrl drive zero`",
    ),
    "watchdog": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; switch the watchdog off for the onboard loop: `xrl doctor`",
    ),
    "link_lost": DriveFault(
        "its own loop holds the last target", limp=False, cause=Cause.DRIVE_LOST, zero_lost=False,
        recovery="mend the cable; the restarted service takes the drive over without a torque step",
    ),
    "disarmed": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; find out what requested idle",
    ),
    "overspeed": DriveFault(
        _LIMP, limp=True, cause=Cause.DRIVE_DISARMED, zero_lost=False,
        recovery=f"{_HANG}; check vel_limit by `xrl doctor`, and what moved so fast",
    ),
    "brown_out": DriveFault(
        "no power: both axes float; it restarts without a zero", limp=True,
        cause=Cause.DRIVE_LOST, zero_lost=True,
        recovery=f"{_HANG}; mend the supply, then `xrl drive zero`",
    ),
    "encoder_zero": DriveFault(
        "the position goes to the encoder's nearest turn and stays, with no encoder error; "
        f"{_LIMP}, at once if that is a jump (OVERSPEED), else within 70 ms", limp=True,
        cause=Cause.DRIVE_DISARMED, zero_lost=True,
        recovery=f"{_HANG}; repair the encoder's cable or supply, then `xrl drive zero`",
    ),
    "encoder_gap": DriveFault(
        "it holds the last position, armed and blind, and goes on without an error; where the "
        "count jumps by a tenth of a turn: OVERSPEED; if a turn may be missing, it is idled and "
        "forgets its zero", limp=False, cause=None,
        zero_lost=False,
        recovery="repair the encoder's cable",
    ),
    "no_ack": DriveFault(
        "its own loop holds the last target; what waits for it in the kernel is thrown away",
        limp=False, cause=Cause.DRIVE_LOST, zero_lost=False,
        recovery="mend its CAN receiver or the wires; then as for link_lost",
    ),
    "bus_full": DriveFault(
        "its own loop holds the last target for 40 ms at a time", limp=False, cause=None,
        zero_lost=False, recovery="take other traffic off the bus; `xrl doctor`: send queue",
    ),
    "bus_flap": DriveFault(
        "its own loop holds the last target for 60 ms at a time; no old frame reaches it",
        limp=False, cause=None, zero_lost=False, recovery="mend the adapter, its channel or cable",
    ),
}  # fmt: skip
"""By the name that scenarios and `--fault` use."""


FALLEN_REMEDY: Final = "free the person and hang the robot, then xrl rearm"


class _LossRow(NamedTuple):
    """A lost process or link, or the emergency stop."""

    module: str
    """Reaction of the affected module, or of all six."""
    others: str
    """Reaction of the rest."""
    visible: str
    """What the operator sees."""
    recovery: str


LOSSES: Final[dict[str, _LossRow]] = {
    "joint service killed or hung": _LossRow(
        "its drive's own loop holds, with the coupled torque frozen",
        "HOLD: the planner asks for it when the module's state is stale",
        "`xrl status`: no states, restarts; planner/status: hold",
        "automatic: the supervisor restarts it; it takes the drive over once a planner is there, "
        "and all track again. A hung service: `xrl kill`. If the drive lost torque meanwhile: hang "
        "the robot, then `xrl kill`",
    ),
    "planner killed or hung": _LossRow(
        "HOLD within max_command_age: local gains, references frozen",
        "the same",
        "`xrl status`: HOLD because PLANNER_ENDED (its process ended, same host) or COMMAND_STALE",
        "automatic: a new planner starts from the measured pose and leads after a blend",
    ),
    "bus slow, lossy or cut": _LossRow(
        "HOLD when its commands are too old",
        "HOLD: the planner asks for it",
        "`xrl status`: HOLD, ages, drop-outs",
        "automatic, after a wait that each drop-out doubles",
    ),
    "harness lost": _LossRow(
        "nothing",
        "the planner leads on without closed assist force and without easing the lead; no overload "
        "and no trip by harness, sagging or unattended is seen, and one that is there stays",
        "harness/wrench: not valid",
        "automatic; a trip that stays ends with the harness back, or by `xrl kill planner`",
    ),
    "IMU lost, where one is fitted": _LossRow(
        "nothing",
        "the planner leads on with the last slope; a new planner takes the floor as level",
        "imu/attitude: not valid",
        "automatic",
    ),
    "recorder lost": _LossRow(
        "nothing",
        "nothing",
        "`xrl status`: restarts",
        "automatic: a new file; the old one is readable as far as it was flushed",
    ),
    "emergency stop": _LossRow(
        "DAMP: knees sink slowly, hips keep the torso's attitude, ankles keep the hips above the "
        "feet, frontal axes hold; beside any module of the host that does not go down with them "
        "all hold where they are",
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
        "automatic, when the load is within `law.load_correction`; or set mass.payload, then "
        "`xrl gains`",
    ),
    "a trip": _LossRow(
        "HOLD: the module trips by itself on shaking, torque or speed",
        "HOLD, on the planner's request; the planner's own trips hold all six",
        "`xrl status`: because SHAKING, TORQUE_LIMIT, TOO_FAST; planner/status: TRIPPED, and why",
        "automatic, after a wait that each trip lengthens",
    ),
    "a fall": _LossRow(
        "DAMP: every axis only damps, none is stiff",
        "the same",
        "planner/status: FALLEN, and the signs; `xrl status`: DAMP because FALLEN, exit code 1",
        f"{FALLEN_REMEDY}; it is led once its feet bear its weight",
    ),
    "overload at the harness": _LossRow(
        "HOLD",
        "HOLD",
        "planner/status: OVERLOADED",
        "automatic, after the harness has been released for a while",
    ),
}
"""Rows by what is lost."""


def recovery_of(cause: Cause) -> str:
    """Return a person's action for a module in FAULT for this cause, in short."""
    if cause is Cause.DRIVE_LOST:
        return "mend power or cable (after a loss of power: xrl drive zero)"
    if cause is Cause.POSITION_LOST:
        return "hang the robot, mend the encoder, xrl drive zero"
    return "hang the robot, find out why it disarmed"
