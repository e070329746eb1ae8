"""What goes wrong, and what then happens: one table (docs/drives.md).

Each row is a claim. `tests/lockstep/test_faults.py` brings the robot into every drive's fault
and holds module, others and drive to the row; `xrl crashtest` does so live, processes and
recovery included. `xrl faults` prints it.

The rule behind the last column: what has let go of the robot never takes hold of it again by
itself. It is asked for, by a person, by starting the module's service again; a service that crashes
and is started by the supervisor knows the difference (`services.joint.rearm_guard`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from shared.messages import Cause
from shared.scenarios import FaultKind


class DriveFault(NamedTuple):
    """What comes of a fault of a module's ODrive.

    In every one the module's own mode is FAULT, and the planner has the other five go to HOLD:
    no leg works against the other. If it is a knee the other five stiffen: it may be limp, and
    then its leg stands as a strut between an ankle and a hip that are stiff. If it is an ankle
    the knees stiffen (`shared.limp_leg_support`).
    """

    drive: str
    """What the drive does by itself."""
    limp: bool
    """The module bears nothing any more; False: the drive goes on holding it."""
    cause: Cause
    """Why the module is in FAULT: `because` in `xrl status`, and in its service's log."""
    zero_lost: bool
    """Its joint has to be zeroed (`xrl zero`) before it can be armed again."""
    recovery: str
    """What a person does about it, before the service is started again."""


_LIMP: Final = "that axis floats"
_BOTH_LIMP: Final = "both axes float"
_HANG: Final = "hang the robot"

DRIVE_FAULTS: Final[dict[FaultKind, DriveFault]] = {
    "over_temperature": DriveFault(
        f"less current near the limit, beyond it {_LIMP}",
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=False,
        recovery=f"{_HANG}; let the drive cool, look at its airflow and at current_lim",
    ),
    "over_voltage": DriveFault(
        _BOTH_LIMP,
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=False,
        recovery=f"{_HANG}; see that the supply takes back what braking legs give",
    ),
    "encoder": DriveFault(
        f"it goes on reporting where it was; {_LIMP}",
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=True,
        recovery=f"{_HANG}; repair the encoder or its cable, then `xrl zero`",
    ),
    "watchdog": DriveFault(
        _LIMP,
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=False,
        recovery=f"{_HANG}; with the onboard loop the watchdog has to be off: `xrl doctor`",
    ),
    "link_lost": DriveFault(
        "it holds by its own loop what it was told last",
        limp=False,
        cause=Cause.DRIVE_LOST,
        zero_lost=False,
        recovery="mend the cable; the new service takes over what the drive holds, without a step",
    ),
    "disarmed": DriveFault(
        _LIMP,
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=False,
        recovery=f"{_HANG}; find out who asked it to go idle",
    ),
    "overspeed": DriveFault(
        _LIMP,
        limp=True,
        cause=Cause.DRIVE_DISARMED,
        zero_lost=False,
        recovery=f"{_HANG}; compare vel_limit by `xrl doctor`, and look what moved so fast",
    ),
    "brown_out": DriveFault(
        "no power, both axes float; then it starts up and knows no zero",
        limp=True,
        cause=Cause.DRIVE_LOST,
        zero_lost=True,
        recovery=f"{_HANG}; mend the supply, then `xrl zero`",
    ),
}
"""By the names that scenarios and `--fault` use."""


class LossRow(NamedTuple):
    """What comes of a process or a link that is lost, and of the emergency stop."""

    module: str
    """What the module does whose service it is, or all six."""
    others: str
    """What the rest does."""
    told: str
    """What the operator sees."""
    recovery: str


LOSSES: Final[dict[str, LossRow]] = {
    "joint service killed or hung": LossRow(
        "its drive holds by its own loop, the torques of the coupling frozen",
        "HOLD: the planner asks for it once the module's state is stale",
        "`xrl status`: not heard, restarts; planner/status: hold",
        "by itself: the supervisor starts it, it takes the drive over once a planner is heard, and "
        "all track again; a hung one by `xrl kill`. If the drive has let go in the meantime: hang "
        "the robot, then `xrl kill`",
    ),
    "planner killed or hung": LossRow(
        "HOLD within max_command_age: local gains, references frozen",
        "the same",
        "`xrl status`: HOLD because COMMAND_STALE",
        "by itself: a new planner starts from the measured pose and leads after a blend",
    ),
    "bus slow, lossy or cut": LossRow(
        "HOLD once its commands are too old",
        "HOLD: the planner asks for it",
        "`xrl status`: HOLD, ages, drop-outs",
        "by itself, after a wait that each drop-out doubles",
    ),
    "harness lost": LossRow(
        "nothing",
        "the planner leads on, without the closed assist force and without easing the lead",
        "harness/wrench: not valid",
        "by itself",
    ),
    "IMU lost, where one is fitted": LossRow(
        "nothing",
        "the planner leads on, and takes the floor to slope as it last did; a new planner takes "
        "it as level",
        "imu/attitude: not valid",
        "by itself",
    ),
    "recorder lost": LossRow(
        "nothing",
        "nothing",
        "`xrl status`: restarts",
        "by itself: a new file; the old one is read as far as it was flushed",
    ),
    "emergency stop": LossRow(
        "DAMP: knees sink slowly, hips keep the torso as it stood, ankles and frontal axes hold; "
        "beside a dead knee or a limp ankle it holds where it is; beside a limp knee it falls",
        "the same",
        "`xrl status`: DAMP because ESTOP",
        "by starting the joint services again",
    ),
    "feet astray before the planner leads": LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISPLACED; `xrl status` says which way",
        "by itself, once the feet stand within `law.stance_max` of the robot file's place",
    ),
    "a load far from the robot file's": LossRow(
        "HOLD",
        "HOLD",
        "planner/status: MISLOADED; `xrl status` says by how much",
        "by itself, once the load is within `law.load_correction`; or set mass.payload, then "
        "`xrl gains`",
    ),
    "trouble noticed": LossRow(
        "HOLD: it trips by itself, for what it alone sees (shaking, torque, speed)",
        "HOLD, by the planner's word; or all six, for what the planner sees",
        "`xrl status`: because SHAKING, TORQUE_LIMIT, TOO_FAST; planner/status: TRIPPED, and why",
        "by itself, after a wait that each one lengthens",
    ),
    "overload at the harness": LossRow(
        "HOLD",
        "HOLD",
        "planner/status: OVERLOADED",
        "by itself, once it has been let go for a while",
    ),
}
"""By what is lost."""


def recovery_of(cause: Cause) -> str:
    """Return what a person does about a module that is in FAULT for this cause, in short."""
    if cause is Cause.DRIVE_LOST:
        return "mend power or cable (after a loss of power: xrl zero)"
    if cause is Cause.POSITION_LOST:
        return "hang the robot, mend the encoder, xrl zero"
    return "hang the robot, find out why it disarmed"
