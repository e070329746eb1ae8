"""Moves a module that hangs: look, tell, ask, move, give the limits back, say how it ended.

A drive keeps a motion's small limits until a service arms it or it restarts. `xrl doctor` would
find them wrong, and `xrl drive configure --apply` would restart the board: it loses its zero.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, Generic, NamedTuple

from rich.live import Live
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.drivers.base import Drive
from services.joint.drivers.can_link import CanLink
from services.joint.drivers.odrive_frames import messages_of
from shared.bus.messages import Pair
from shared.can import cansimple, drive_settings
from shared.can.cansimple import Command
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError, XrlError
from shared.joints import AXES
from tools.bringup.boards import Value, equal
from tools.bringup.can_monitor import bus_config
from tools.bringup.drive_access import boards_on_usb, confirm, refuse_service
from tools.bringup.hanging_leg import leg_of
from tools.bringup.motion import (
    AnyPlan,
    C,
    MotionPlan,
    Sample,
    limit_drives,
    why_out_of_reach,
    within_stops,
)
from tools.bringup.motion_runner import NOT_IDLE, Interrupts, hanging_angles, run_motion
from tools.flags import MotionFlags
from tools.terminal import Console, marked

LIFTED: Final = 0.2
"""m; the emulated robot is hung this much higher for a leg's motion, feet clear of the floor."""
LIMITS_TIMES: Final = 3
"""CAN of firmware 0.5 does not tell its limits, and a frame may be lost."""
_APART_S: Final = 0.02


class Moved(NamedTuple, Generic[C]):
    """A joint that was moved to the end of its plan."""

    samples: list[Sample]
    plan: MotionPlan[C]
    q: dict[str, Pair]
    """Where the modules were before, (phi, theta), rad."""


class Stopped(NamedTuple):
    """A motion that did not come to its end, or did not begin."""

    why: str
    not_idle: tuple[str, ...] = ()
    """Modules whose drives do not say that they are idle."""
    declined: bool = False
    """The person said no."""


def tell_stopped(stopped: Stopped, console: Console) -> int:
    """Print why a motion ended, a danger last; return the exit code."""
    if stopped.declined:
        console.print(stopped.why)
        return DECLINED_EXIT_CODE
    console.print(marked("[bold red]STOPPED[/]: {}", stopped.why))
    for module in stopped.not_idle:
        console.print(marked("[bold red]{}: {}[/]", module, NOT_IDLE))
    return FAULT_EXIT_CODE


def exit_if_interrupted(interrupts: Interrupts) -> None:
    """End the process as a shell has it after a signal."""
    if interrupts.number:
        sys.exit(128 + interrupts.number)


def refuse_services(robot: RobotConfig, modules: Sequence[str], run_dir: Path) -> None:
    """Refuse if the leg of one of these modules has a joint service up."""
    for name in leg_of(*modules):
        refuse_service(robot, name, run_dir)


def ask_and_move(
    flags: MotionFlags,
    robot: RobotConfig,
    joint: tuple[str, int],
    plan_of: Callable[[Mapping[str, Pair]], MotionPlan[C]],
    interrupts: Interrupts,
    console: Console,
    *,
    alone: bool = False,
) -> Moved[C] | Stopped | None:
    """Look at a leg, ask, and move a joint; return how it ended, or None for a dry run.

    Args:
        flags: of the verb.
        robot: its file.
        joint: module and axis.
        plan_of: returns the motion of modules that are there, (phi, theta), rad, and tells of it.
        interrupts: kept while drives may be armed.
        console: to speak on.
        alone: the module alone, within its soft limits. Else its leg hangs still first, on the
            mechanism's stops perhaps, and the leg's other modules are held.
    """
    module, axis = joint
    modules = (module,) if alone else leg_of(module)
    with (
        open_drives(robot, modules, flags.run_dir) as drives,
        interrupts.kept(),
        console.status("looking" if alone else "waiting until the leg hangs still"),
    ):
        q = hanging_angles(drives, robot, interrupts, until_still=not alone)
    if q is None:
        return Stopped("nothing was moved yet")
    plan = plan_of(q)
    bounded = robot if alone else within_stops(robot)
    limited = limit_drives(bounded, plan)
    if why := why_out_of_reach(bounded, module, plan, q[module]):
        raise DriveError(f"{module}: {why}")
    if flags.dry_run:
        return None
    what = "Is the joint free, and" if alone else "Does the leg hang free,"
    if not confirm(f"{what} the power switch at hand?", yes=flags.yes):
        return Stopped("nothing was moved", declined=True)
    for name in modules:  # a person may take minutes to answer
        refuse_service(robot, name, flags.run_dir)
    name = f"{module}_{AXES[axis]}"
    shown = contextlib.nullcontext(console.print) if alone else _in_place(console)
    with open_drives(limited, modules, flags.run_dir) as drives, interrupts.kept(), shown as show:
        result = run_motion(
            drives, limited, module, plan, q_seen=q[module], interrupts=interrupts,
            progress=lambda sample: show(_line(sample, plan, name)),
        )  # fmt: skip
    for one in modules:
        # only to drives that say that they are idle: full limits are nothing for an armed one
        if one in result.not_idle:
            continue
        try:
            give_back(robot, one, flags.run_dir)
        except XrlError as error:
            console.print(
                marked(
                    "[yellow]{}: the drive still has the limits of this motion ({}): until it is "
                    "armed by its service or restarted, `xrl doctor` finds them wrong[/]",
                    one,
                    error,
                )
            )
    if result.trouble or result.not_idle:
        return Stopped(f"{name}: {result.trouble or 'the motion ended'}", result.not_idle)
    return Moved(result.samples, plan, q)


@contextlib.contextmanager
def open_drives(
    robot: RobotConfig, modules: Iterable[str], run_dir: Path
) -> Iterator[dict[str, Drive]]:
    """Have modules' drives, each of which nobody else has."""
    with contextlib.ExitStack() as stack:
        drives = {}
        for name in modules:
            drives[name] = open_drive(robot, name, run_dir)
            stack.callback(drives[name].close)
        yield drives


def give_back(robot: RobotConfig, module: str, run_dir: Path) -> None:
    """Set the limits of a module's drive, which must be idle and nobody's, to the robot file's."""
    if robot.joint_service.driver == "odrive_usb":
        _over_usb(robot, module, run_dir)
    else:
        _over_can(robot, module, run_dir)


def _over_can(robot: RobotConfig, module: str, run_dir: Path) -> None:
    wiring, drive = robot.module_named(module), robot.drive
    limits = (Command.SET_LIMITS, cansimple.pack_two_floats(drive.vel_limit, drive.current_lim))
    link = CanLink(bus_config(robot, wiring.bus, run_dir), wiring.node_ids)
    try:
        taken = link.connect()
        for _ in range(LIMITS_TIMES):
            link.receive(_APART_S)  # nothing is sent to a drive that is not heard
            taken = taken and link.send(messages_of(wiring.node_ids, (limits,)))
    finally:
        link.close()
    if not taken:
        raise DriveError(f"CAN bus {wiring.bus} takes no frames")


def _over_usb(robot: RobotConfig, module: str, run_dir: Path) -> None:
    serial, drive = robot.module_named(module).serial_number.upper(), robot.drive
    wanted: dict[str, Value] = {}
    for axis in drive_settings.AXES:
        wanted[f"{axis}.controller.config.vel_limit"] = drive.vel_limit
        wanted[f"{axis}.motor.config.current_lim"] = drive.current_lim
    with boards_on_usb(robot, run_dir, [module]) as found:
        if serial not in found.boards:
            raise DriveError(f"ODrive {serial}: {found.troubles.get(serial, 'not there')}")
        board = found.boards[serial]
        board.write(wanted)
        kept = board.read(wanted)
    if not all(equal(kept.get(name), value) for name, value in wanted.items()):
        raise DriveError(f"ODrive {serial}: it did not keep them")


@contextlib.contextmanager
def _in_place(console: Console) -> Iterator[Callable[[Text], None]]:
    with Live(console=console, refresh_per_second=4, transient=True) as shown:
        yield shown.update


def _line(sample: Sample, plan: AnyPlan, joint: str) -> Text:
    axis = plan.axis
    return Text(
        f"{joint} {sample.t_s:6.2f} of {plan.duration_s:.0f} s  asked {sample.q_ref[axis]:+.4f}, "
        f"is {sample.q[axis]:+.4f} rad, torque {sample.tau[axis]:+6.2f} N m"
    )
