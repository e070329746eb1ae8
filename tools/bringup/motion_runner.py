"""Run a motion: check, ask, arm, hold some modules, move one, and always idle all.

A drive keeps the small limits of a motion until a service arms it or it restarts. Until then, `xrl
doctor` would report them as wrong, and `xrl drive configure --apply` would restart the board and
lose its zero. So the limits are restored at the end.
"""

from __future__ import annotations

import contextlib
import math
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Final, Generic, NamedTuple

from rich.live import Live
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive, DriveReading
from services.joint.drivers.can_link import CanLink
from services.joint.drivers.odrive_frames import packet_of
from shared.bus.messages import LOST_DRIVE, DriveStatus, Pair
from shared.can import cansimple, drive_settings
from shared.can.cansimple import Command
from shared.clock import NS_PER_S, now_ns
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
    GuardedMotion,
    MotionPlan,
    Sample,
    Stay,
    limit_drives,
    why_out_of_reach,
    why_strayed,
    within_stops,
)
from tools.flags import MotionFlags
from tools.terminal import Console, marked

ANSWER_S: Final = 3.0
"""Timeout for a drive's first answer, s; it needs the link and a heartbeat of both axes."""
NO_ANSWER: Final = "its drive does not answer; check its power and its bus (`xrl doctor`)"
ARM_TRIES: Final = 3
ARM_S: Final = 0.7
"""Timeout for entering closed loop after each attempt, s."""
IDLE_TRIES: Final = 10
IDLE_AT_LEAST: Final = 3
"""Minimum number of idle commands, because one axis may miss a command unnoticed."""
IDLE_S: Final = 0.2
"""Time to wait for heartbeats after each command, s."""
NOT_IDLE: Final = (
    "the drive does not report that it is idle, so it may still hold; CUT ITS POWER before anybody "
    "touches the joint"
)
READ_S: Final = 0.02
PROGRESS_S: Final = 0.25
OVERTIME_S: Final = 5.0
"""Maximum time beyond a plan's duration, s; if exceeded, samples arrive too rarely."""
STILL: Final = 0.004
"""Maximum motion of a leg at rest in `STILL_FOR_S`, rad; an idle drive may report no rate."""
STILL_FOR_S: Final = 1.5
"""Time for which a leg must rest, s: more than half a swing."""
STILL_WAIT_S: Final = 60.0

Clock = Callable[[], int]
Progress = Callable[[Sample], None]

LIFTED: Final = 0.2
"""Extra height of the hanging emulated robot, so that its feet are clear of the floor, m."""
LIMITS_TIMES: Final = 3
"""Number of times that limits are sent: a frame may be lost, and firmware 0.5 cannot report
limits over CAN."""
_APART_S: Final = 0.02


class MotionResult(NamedTuple):
    """Result of a motion."""

    samples: list[Sample]
    trouble: str
    """Reason why it was stopped, or ""."""
    not_idle: tuple[str, ...]
    """Modules whose drives do not report that they are idle."""


class Interrupts:
    """Signals that request a stop; deferred until the drives are idle.

    Attributes:
        number: the first signal that arrived, or 0.
    """

    def __init__(self) -> None:
        self.number = 0

    @property
    def words(self) -> str:
        """Reason for stopping a motion, or "" without a signal."""
        return f"stopped by {signal.Signals(self.number).name}" if self.number else ""

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Defer signals inside the block."""
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = {number: signal.signal(number, self._keep) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _keep(self, number: int, _frame: FrameType | None) -> None:
        self.number = self.number or number


def await_reading(drive: Drive, clock: Clock = now_ns) -> DriveReading | None:
    """Return a drive's first valid reading, or None if the drive does not answer."""
    until = clock() + _ns(ANSWER_S)
    reading = drive.read(READ_S)
    while reading is None or reading.status in LOST_DRIVE:
        if clock() > until:
            return None
        reading = drive.read(READ_S)
    return reading


def _idle_reading(drive: Drive, clock: Clock = now_ns) -> DriveReading:
    """Return the first reading of a drive, which must be idle and zeroed."""
    reading = await_reading(drive, clock)
    if reading is None:
        raise DriveError(NO_ANSWER)
    if reading.status is DriveStatus.UNZEROED:
        raise DriveError("its drive does not know where the joint is; run `xrl drive zero` first")
    if reading.status is DriveStatus.ARMED:
        raise DriveError("its drive is armed (closed loop) by another program; make it idle first")
    return reading


def hanging_angles(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    interrupts: Interrupts,
    clock: Clock = now_ns,
    *,
    until_still: bool = True,
) -> dict[str, Pair] | None:
    """Return the modules' angles (phi, theta), rad, or None if interrupted.

    With `until_still`, they are returned once the modules rest.
    """
    begin = still_since = clock()
    rest: dict[str, Pair] = {}
    while True:
        q = {}
        for name, drive in drives.items():
            try:
                reading = _idle_reading(drive, clock)
            except DriveError as error:
                raise DriveError(f"{name}: {error}") from None
            phi, theta = q[name] = joint_from_motor(reading.pos_turns, robot.joint.gear_ratio)
            at = rest.get(name, (math.inf, math.inf))
            if max(abs(phi - at[0]), abs(theta - at[1])) > STILL:
                rest, still_since = {}, clock()
        rest = rest or q
        if interrupts.number:
            return None
        if not until_still or clock() - still_since > _ns(STILL_FOR_S):
            return q
        if clock() - begin > _ns(STILL_WAIT_S):
            raise DriveError("the leg swings: hold it still, and try again")


def run_motion(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    module: str,
    plan: AnyPlan,
    *,
    q_seen: Pair,
    interrupts: Interrupts,
    progress: Progress,
    clock: Clock = now_ns,
) -> MotionResult:
    """Move one module, hold the others where they are, and always idle all.

    The motion stops if a held module moves or its drive faults.

    Args:
        drives: idle drives, opened with the limits of `limit_drives`.
        robot: result of `limit_drives`.
        module: module to move.
        plan: motion of this module.
        q_seen: angles of this module when the person agreed, rad.
        interrupts: read in every cycle.
        progress: receives a sample every `PROGRESS_S`.
        clock: monotonic, ns.
    """
    hold = MotionPlan(0, Stay(), plan.torque_limit)
    modules = {
        name: _GuardedModule(name, drive, robot, plan if name == module else hold, clock)
        for name, drive in drives.items()
    }
    moved = modules.pop(module)
    held = list(modules.values())
    try:
        trouble = ""
        for one in held:
            if not trouble and (why := one.arm(interrupts)):
                trouble = f"{one.name}: {why}"
        trouble = trouble or moved.arm(interrupts, q_seen)
        if not trouble:
            trouble = _follow(moved, held, interrupts, progress)
    except BaseException as error:
        if left := _idle_all([moved, *held]):
            error.add_note(f"{', '.join(left)}: {NOT_IDLE}")
        raise
    return MotionResult(moved.samples, trouble, _idle_all([moved, *held]))


class _GuardedModule:
    """One drive and its law. As in a joint service, every cycle sends a target."""

    def __init__(
        self, name: str, drive: Drive, robot: RobotConfig, plan: AnyPlan, clock: Clock
    ) -> None:
        self.name, self.drive, self.plan, self.clock = name, drive, plan, clock
        self._robot = robot
        self.law: GuardedMotion | None = None

    @property
    def samples(self) -> list[Sample]:
        return [] if self.law is None else self.law.samples

    def arm(self, interrupts: Interrupts, q_seen: Pair | None = None) -> str:
        """Arm the drive; return why it must not move, or "".

        Without `q_seen` the module is held where it is, even outside its limits.
        """
        reading = arm(self.drive, interrupts, self.clock)
        if isinstance(reading, str):
            return reading
        q = joint_from_motor(reading.pos_turns, self._robot.joint.gear_ratio)
        if q_seen is not None:
            why = why_strayed(q, q_seen)
            why = why or why_out_of_reach(self._robot, self.name, self.plan, q)
            if why:
                return why
        self.law = GuardedMotion(self._robot, self.name, self.plan, q, self.clock())
        return self.step(reading) if q_seen is None else ""

    def step(self, reading: DriveReading | None) -> str:
        """Pass a sample to the law; return why the motion must stop, or ""."""
        assert self.law is not None  # noqa: S101 - `arm` set it
        target = self.law.step(self.clock(), reading)
        if target is not None:
            self.drive.write(target)
        return self.law.trouble


def _follow(
    moved: _GuardedModule,
    held: Sequence[_GuardedModule],
    interrupts: Interrupts,
    progress: Progress,
) -> str:
    """Run all laws until the motion is done; return why it stopped early, or ""."""
    law, report_at_s, trouble = moved.law, 0.0, ""
    assert law is not None  # noqa: S101 - it is armed
    give_up_ns = moved.clock() + _ns(moved.plan.duration_s + OVERTIME_S)
    while not law.done and not trouble:
        reading = moved.drive.read(READ_S)
        if interrupts.number:
            return interrupts.words
        trouble = moved.step(reading)
        for one in held:
            if (other := one.step(one.drive.read(0.0))) and not trouble:
                trouble = f"{one.name}: {other}"
        if moved.clock() > give_up_ns:
            return "it took too long: the drive's samples arrive too rarely"
        if law.samples and law.samples[-1].t_s >= report_at_s:
            report_at_s = law.samples[-1].t_s + PROGRESS_S
            progress(law.samples[-1])
    return trouble


def arm(drive: Drive, interrupts: Interrupts, clock: Clock) -> DriveReading | str:
    """Arm a drive; return its first armed reading, or why it did not arm."""
    reading: DriveReading | None = None
    for _ in range(ARM_TRIES):
        if interrupts.number:
            return interrupts.words
        drive.arm(onboard=True)
        until = clock() + _ns(ARM_S)
        while clock() < until:
            reading = drive.read(READ_S) or reading
            if interrupts.number:
                return interrupts.words
            if reading is not None and reading.status is DriveStatus.ARMED:
                return reading
            if reading is not None and reading.status is DriveStatus.ERROR:
                break
    if reading is None:
        return "the drive sends no samples"
    return f"it does not arm: {reading.status.name}, error 0x{reading.error:x} (`xrl doctor`)"


def _idle_all(modules: Sequence[_GuardedModule]) -> tuple[str, ...]:
    """Idle all drives, even if one raises; return the modules that are not idle."""
    left: list[str] = []

    def release(one: _GuardedModule) -> None:
        if not idle(one.drive, one.clock):
            left.append(one.name)

    with contextlib.ExitStack() as stack:
        for one in reversed(modules):
            stack.callback(release, one)
    return tuple(left)


def idle(drive: Drive, clock: Clock) -> bool:
    """Idle both axes; return False if the drive does not report that it is idle."""
    for attempt in range(1, IDLE_TRIES + 1):
        drive.idle()
        until = clock() + _ns(IDLE_S)
        is_idle = False
        while clock() < until:
            reading = drive.read(READ_S)
            if reading is not None:
                # an unzeroed drive may be armed
                is_idle = reading.status in (DriveStatus.IDLE, DriveStatus.ERROR)
        if is_idle and attempt >= IDLE_AT_LEAST:
            return True
    return False


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


class Moved(NamedTuple, Generic[C]):
    """Result of a completed plan."""

    samples: list[Sample]
    plan: MotionPlan[C]
    q: dict[str, Pair]
    """Angles of the modules before the motion, (phi, theta), rad."""


class Stopped(NamedTuple):
    """Result of a motion that was not completed or not started."""

    why: str
    not_idle: tuple[str, ...] = ()
    """Modules whose drives do not report that they are idle."""
    declined: bool = False
    """True if the person declined."""


def tell_stopped(stopped: Stopped, console: Console) -> int:
    """Print why a motion stopped, then any danger; return the exit code."""
    if stopped.declined:
        console.print(stopped.why)
        return DECLINED_EXIT_CODE
    console.print(marked("[bold red]STOPPED[/]: {}", stopped.why))
    for module in stopped.not_idle:
        console.print(marked("[bold red]{}: {}[/]", module, NOT_IDLE))
    return FAULT_EXIT_CODE


def exit_if_interrupted(interrupts: Interrupts) -> None:
    """If a signal arrived, exit with the shell's code for it."""
    if interrupts.number:
        sys.exit(128 + interrupts.number)


def refuse_services(robot: RobotConfig, modules: Sequence[str], run_dir: Path) -> None:
    """Raise FleetError if a joint service uses a drive in the legs of these modules."""
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
    """Check a leg, ask, and move a joint; return the result, or None for a dry run.

    Args:
        flags: flags of the command.
        robot: robot file.
        joint: module and axis.
        plan_of: prints and returns the plan for given angles (phi, theta), rad, of the modules.
        interrupts: deferred while drives may be armed.
        console: for questions and progress.
        alone: move only this module, within its limits. Otherwise wait until its leg hangs at rest,
            possibly on mechanical stops, and hold the leg's other modules.
    """
    module, axis = joint
    modules = (module,) if alone else leg_of(module)
    with (
        open_drives(robot, modules, flags.run_dir) as drives,
        interrupts.kept(),
        console.status("checking" if alone else "waiting until the leg hangs still"),
    ):
        q = hanging_angles(drives, robot, interrupts, until_still=not alone)
    if q is None:
        return Stopped("nothing was moved")
    plan = plan_of(q)
    bounded = robot if alone else within_stops(robot)
    limited = limit_drives(bounded, plan)
    if why := why_out_of_reach(bounded, module, plan, q[module]):
        raise DriveError(f"{module}: {why}")
    if flags.dry_run:
        return None
    what = "Is the joint free, and" if alone else "Does the leg hang free, and"
    if not confirm(f"{what} is the power switch in reach?", yes=flags.yes):
        return Stopped("nothing was moved", declined=True)
    for name in modules:  # a person may take minutes to answer
        refuse_service(robot, name, flags.run_dir)
    name = f"{module}_{AXES[axis]}"
    with (
        open_drives(limited, modules, flags.run_dir) as drives,
        interrupts.kept(),
        Live(console=console, refresh_per_second=4, transient=True) as live,
    ):
        show = console.print if alone else live.update
        result = run_motion(
            drives, limited, module, plan, q_seen=q[module], interrupts=interrupts,
            progress=lambda sample: show(_line(sample, plan, name)),
        )  # fmt: skip
    for one in modules:
        # skip drives that may be armed: they must not get full limits
        if one in result.not_idle:
            continue
        try:
            give_back(robot, one, flags.run_dir)
        except XrlError as error:
            words = (
                "[yellow]{}: the drive still has the limits of this motion ({}); `xrl doctor` "
                "reports them as wrong until its service arms the drive or the drive restarts[/]"
            )
            console.print(marked(words, one, error))
    if result.trouble or result.not_idle:
        return Stopped(f"{name}: {result.trouble or 'the motion ended'}", result.not_idle)
    return Moved(result.samples, plan, q)


@contextlib.contextmanager
def open_drives(
    robot: RobotConfig, modules: Iterable[str], run_dir: Path
) -> Iterator[dict[str, Drive]]:
    """Open the drives of modules; no other program may hold them."""
    with contextlib.ExitStack() as stack:
        drives = {}
        for name in modules:
            drives[name] = open_drive(robot, name, run_dir)
            stack.callback(drives[name].close)
        yield drives


def give_back(robot: RobotConfig, module: str, run_dir: Path) -> None:
    """Restore the limits of an idle drive to those of the robot file."""
    over_usb = robot.joint_service.driver == "odrive_usb"
    (_over_usb if over_usb else _over_can)(robot, module, run_dir)


def _over_can(robot: RobotConfig, module: str, run_dir: Path) -> None:
    wiring, drive = robot.module_named(module), robot.drive
    limits = (Command.SET_LIMITS, cansimple.pack_two_floats(drive.vel_limit, drive.current_lim))
    link = CanLink(bus_config(robot, wiring.bus, run_dir), wiring.node_ids)
    try:
        taken = link.connect()
        for _ in range(LIMITS_TIMES):
            link.receive(_APART_S)  # nothing is sent to a silent drive
            taken = taken and link.send(packet_of(wiring.node_ids, (limits,)))
    finally:
        link.close()
    if not taken:
        raise DriveError(f"CAN bus {wiring.bus} accepts no frames")


def _over_usb(robot: RobotConfig, module: str, run_dir: Path) -> None:
    serial, drive = robot.module_named(module).serial_number.upper(), robot.drive
    wanted: dict[str, Value] = {}
    for axis in drive_settings.AXES:
        wanted[f"{axis}.controller.config.vel_limit"] = drive.vel_limit
        wanted[f"{axis}.motor.config.current_lim"] = drive.current_lim
    with boards_on_usb(robot, run_dir, [module]) as found:
        if serial not in found.boards:
            raise DriveError(f"ODrive {serial}: {found.troubles.get(serial, 'not connected')}")
        board = found.boards[serial]
        board.write(wanted)
        kept = board.read(wanted)
    if not all(equal(kept.get(name), value) for name, value in wanted.items()):
        raise DriveError(
            f"ODrive {serial}: vel_limit and current_lim were written but do not read back; cycle "
            "the power, or let a service arm the drive"
        )


def _line(sample: Sample, plan: AnyPlan, joint: str) -> Text:
    axis = plan.axis
    return Text(
        f"{joint} {sample.t_s:6.2f} of {plan.duration_s:.0f} s  reference "
        f"{sample.q_ref[axis]:+.4f}, actual {sample.q[axis]:+.4f} rad, "
        f"torque {sample.tau[axis]:+6.2f} N m"
    )
