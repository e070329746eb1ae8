"""`xrl drive zero`: tell drives where their joints are."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec
from rich import box
from rich.table import Table
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.drivers.base import Drive
from shared.bus import topics
from shared.bus.messages import JointState, Mode, Pair
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError, FleetError
from shared.joints import MODULES
from tools.bringup import drive_access
from tools.bringup.motion import within_stops
from tools.bringup.zeroing import DriveLook, is_right, look, refusal, why_outside, zero
from tools.flags import (
    Arg,
    FleetRobotFlags,
    Number,
    numbers,
    parsed,
    positional,
)
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console, marked

DEGREES_FROM: Final = 7.0
"""No joint has an angle of so many rad: more than a turn."""
CORRECTION_MAX: Final = 0.1
"""rad; more is no error of a protractor."""

HEARD_S: Final = 2.0
"""Longest wait for the states of joint services that are up."""


EXAMPLES: Final = """
xrl drive zero knee_left --at 0,-0.5          # by a protractor: phi, theta in rad
xrl drive zero ankle_right --at -0.02,0.14
xrl drive zero --all --standing 1.188         # in the jig: soles flat, hips 1.188 m above ankles
xrl drive zero knee_left --by 0,-0.009        # corrects a zero, as `xrl drive identify body` prints
"""


_PAIR: Final = numbers(2, "phi and theta in rad, such as 0,-0.5")


class ZeroFlags(FleetRobotFlags):
    """Which modules, and where their joints are."""

    module: Annotated[str | None, positional("MODULE", choices=MODULES, exclusive="which!")] = None
    """one module"""
    all: Annotated[bool, Arg(exclusive="which!")] = False
    """all six"""
    at: Annotated[Pair | None, parsed(_PAIR, "PHI,THETA", exclusive="where!")] = None
    """the joint is at these angles now, rad, as 0,-0.5"""
    by: Annotated[Pair | None, parsed(_PAIR, "PHI,THETA", exclusive="where!")] = None
    """the joint is this much farther, rad, than its present zero says"""
    standing: Annotated[Number | None, Arg(metavar="HEIGHT", exclusive="where!")] = None
    """the robot stands or hangs as if it stood: both soles flat and level, at their distance
    (geometry.w_base), torso upright, COM over the ankles, the hips' axis HEIGHT m above the
    ankles'; the angles then follow from the lengths in the robot file"""
    yes: bool = False
    """do not ask"""

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return MODULES if self.module is None else (self.module,)

    def check(self) -> None:
        """Refuse one module's angles for all."""
        super().check()
        if self.all and self.standing is None:
            raise DriveError("--at and --by are for one module; for all give --standing HEIGHT")


def run(flags: ZeroFlags) -> int:
    """Look, ask, set, read back."""
    console = Console()
    path = drive_access.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    wanted = angles_of(flags, robot, console)
    by = flags.by
    modules = tuple(wanted) or flags.modules
    holders = {module: drive_access.service_on(robot, module, flags.run_dir) for module in modules}
    with drive_access.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        refuse_services(robot, holders)
        with contextlib.ExitStack() as stack:
            drives = {module: _open(robot, module, flags.run_dir, stack) for module in modules}
            before = _look_all(robot, drives)
            if by is not None:
                wanted = corrected(before, by, robot)
            console.print(plan_table(wanted, before))
            _warn(wanted, holders, console)
            question = "Are the joints at these angles now?" if by is None else "Correct the zero?"
            if not drive_access.confirm(question, yes=flags.yes):
                console.print("nothing was changed")
                return DECLINED_EXIT_CODE
            refuse_services(robot, holders)  # a person may take minutes to answer
            now = _look_all(robot, drives)
            if by is not None:  # from where it hangs now: it may have been touched meanwhile
                wanted = corrected(now, by, robot)
            code = _set_all(robot, drives, wanted, console)
    if started:
        console.print(drive_access.GONE)
    return code


def angles_of(flags: ZeroFlags, robot: RobotConfig, console: Console) -> dict[str, Pair]:
    """Return the position (phi, theta), rad, of each selected module; none yet for `--by`.

    Raises:
        DriveError: an angle is outside the limits.
        RunError: there is no such stand.
    """
    wanted: dict[str, Pair] = {}
    if flags.at is not None:
        wanted = dict.fromkeys(flags.modules, flags.at)
    elif flags.standing is not None:
        from tools.bringup.stand_angles import stand_angles  # noqa: PLC0415 - takes a second

        stand = stand_angles(robot, flags.standing)
        console.print(
            f"a stand with the hips {flags.standing:g} m above the ankles and "
            f"{abs(stand.hips_forward):.3f} m {'before' if stand.hips_forward > 0 else 'behind'} "
            "them, torso upright, soles flat"
        )
        wanted = {module: stand.q[module] for module in flags.modules}
    for module, q in wanted.items():
        if fault := why_outside(robot, module, q):
            raise DriveError(f"{module}: {fault}{_if_degrees(q)}")
    return wanted


def corrected(before: Mapping[str, DriveLook], by: Pair, robot: RobotConfig) -> dict[str, Pair]:
    """Return where modules are if they are farther than their present zeros say.

    Args:
        before: the drives as they are.
        by: how much farther, (phi, theta), rad.
        robot: its limits.

    Raises:
        DriveError: a drive has no zero that could be corrected, or it would be beyond its limits.
    """
    if not all(abs(part) <= CORRECTION_MAX for part in by):  # so that a NaN is refused
        raise DriveError(
            f"--by: at most {CORRECTION_MAX:g} rad either way is a correction; else use --at"
        )
    wanted = {}
    for module, seen in before.items():
        if not seen.zeroed:
            raise DriveError(f"{module}: it has no zero to correct; give --at PHI,THETA")
        wanted[module] = (seen.q[0] + by[0], seen.q[1] + by[1])
        if fault := why_outside(within_stops(robot), module, wanted[module]):
            raise DriveError(f"{module}: {fault}")  # a knee may hang on its stop
    return wanted


def _if_degrees(q: Pair) -> str:
    """Return what to write instead of angles that can only be degrees; "" if they cannot."""
    if not max(map(abs, q)) > DEGREES_FROM:
        return ""
    phi, theta = map(math.radians, q)
    return f"; if these are degrees: --at {phi:.4g},{theta:.4g}"


def refuse_services(robot: RobotConfig, holders: Mapping[str, SupervisedFleet | None]) -> None:
    """Refuse where a joint service has the drive's USB, or is not DISARMED.

    Raises:
        FleetError: naming the first such module, and what to do.
    """
    up = {module: fleet for module, fleet in holders.items() if fleet is not None}
    for module, fleet in up.items():
        if robot.joint_service.driver == "odrive_usb":
            raise FleetError(
                f"{module}: its joint service in {fleet.run.path} has the drive's USB; "
                "`xrl down` first"
            )
    for fleet in {fleet.run.path: fleet for fleet in up.values()}.values():
        served = [module for module, other in up.items() if other.run.path == fleet.run.path]
        states = _states(robot, fleet, served)
        for module in served:
            state = states.get(module)
            if state is None:
                raise FleetError(
                    f"{module}: its joint service in {fleet.run.path} is up, but sends no state; "
                    "see `xrl status`, or `xrl down` first"
                )
            if state.mode != Mode.DISARMED:
                raise FleetError(f"{module}: {_way_out(module, Mode(state.mode))}")


def plan_table(wanted: Mapping[str, Pair], before: Mapping[str, DriveLook]) -> Table:
    """Return the changes as a table for the terminal."""
    table = _table("before, rad", "after, rad", "change, rad")
    for module, q in wanted.items():
        seen = before[module]
        if seen.zeroed:
            change = (q[0] - seen.q[0], q[1] - seen.q[1])
            table.add_row(module, _angles(seen.q), _angles(q), _angles(change))
        else:
            table.add_row(module, "unzeroed", _angles(q), "-")
    return table


def _set_all(
    robot: RobotConfig, drives: Mapping[str, Drive], wanted: Mapping[str, Pair], console: Console
) -> int:
    """Set all, read all back, show it; return the exit code."""
    table = _table("written, rad", "read back, rad", "")
    code = 0
    for module, q in wanted.items():
        try:
            back = zero(drives[module], q, robot)
        except DriveError as error:  # one that fails does not stop the others
            console.print(marked("[bold red]{}[/]: {}", module, error))
            back = None
        good = is_right(back, q)
        code = code if good else FAULT_EXIT_CODE
        read = "nothing" if back is None else _angles(back.q)
        outcome = Text("zeroed") if good else Text("NOT zeroed", "bold red")
        table.add_row(module, _angles(q), read, outcome)
    console.print(table)
    if code:
        console.print(
            marked("[bold red]do not arm an unzeroed drive[/]: check it, and zero it again")
        )
    return code


def _look_all(robot: RobotConfig, drives: Mapping[str, Drive]) -> dict[str, DriveLook]:
    """Look at every drive.

    Raises:
        DriveError: one cannot be zeroed now; names all that cannot.
    """
    mark, gear_ratio = robot.drive.zero_mark_turns, robot.joint.gear_ratio
    seen = {module: look(drive, mark, gear_ratio) for module, drive in drives.items()}
    faults = [f"{module}: {why}" for module, one in seen.items() if (why := refusal(one))]
    if faults:
        raise DriveError("; ".join(faults) + "; nothing was changed")
    return seen


def _open(robot: RobotConfig, module: str, run_dir: Path, stack: contextlib.ExitStack) -> Drive:
    """Return a module's drive as it counts itself; the stack releases it."""
    unmarked = msgspec.structs.replace(robot.drive, zero_mark_turns=0.0)
    drive = open_drive(msgspec.structs.replace(robot, drive=unmarked), module, run_dir)
    stack.callback(drive.close)
    return drive


def _warn(
    wanted: Mapping[str, Pair], holders: Mapping[str, SupervisedFleet | None], console: Console
) -> None:
    """Say what comes by itself once a drive is zeroed."""
    armed = [module for module in wanted if holders[module] is not None]
    if armed:
        console.print(
            marked(
                "[yellow]{}: the joint service is up and, unless it is read-only, "
                "arms the drive as soon as it is zeroed[/]",
                ", ".join(armed),
            )
        )


def _states(
    robot: RobotConfig, fleet: SupervisedFleet, modules: list[str]
) -> dict[str, JointState]:
    """Return one state of each module of a fleet that sends any."""
    states: dict[str, JointState] = {}
    with open_session(robot, "zero", fleet.run.path) as session:
        ends = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in modules}
        deadline = time.monotonic() + HEARD_S
        while time.monotonic() < deadline and len(states) < len(modules):
            for module, latest in ends.items():
                state = latest.take()
                if state is not None:  # its stamp is the drive's, which may be silent
                    states[module] = state
            time.sleep(0.01)
    return states


def _way_out(module: str, mode: Mode) -> str:
    """Return why a joint service in this mode is in the way, and what to do."""
    if mode in (Mode.HOLD, Mode.TRACK):
        return f"its joint service holds it ({mode.name}); hang the robot and `xrl down` first"
    return (
        f"its joint service is in {mode.name}; hang the robot and `xrl kill {module}` "
        "(a restart leaves it), or `xrl down` first"
    )


def _angles(q: Pair) -> str:
    return f"{q[0]:+.4f} {q[1]:+.4f}"


def _table(*columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, caption="phi, theta", caption_justify="left")
    for heading in ("module", *columns):
        table.add_column(heading, no_wrap=True)
    return table
