"""The one runner of motions: arm drives, hold some, move one, and idle all, whatever happens."""

from __future__ import annotations

import contextlib
import math
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FrameType
from typing import Final, NamedTuple

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive, DriveReading, DriveStatus
from shared.bus.messages import LOST_DRIVE, Pair
from shared.clock import NS_PER_S, now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tools.bringup.motion import (
    AnyPlan,
    GuardedMotion,
    MotionPlan,
    Sample,
    Stay,
    why_out_of_reach,
    why_strayed,
)

ANSWER_S: Final = 3.0
"""Longest wait for a drive's first words: its link, and a heartbeat of both axes."""
NO_ANSWER: Final = "its drive does not answer; look at its power and its bus (`xrl doctor`)"
ARM_TRIES: Final = 3
ARM_S: Final = 0.7
"""Wait for closed loop after each attempt."""
IDLE_TRIES: Final = 10
IDLE_AT_LEAST: Final = 3
"""Times that idle is said in any case: `Drive` does not tell of one axis that missed it."""
IDLE_S: Final = 0.2
"""Wait for heartbeats after each time."""
NOT_IDLE: Final = (
    "the drive does not say that it is idle: it may still hold; CUT ITS POWER before anybody "
    "touches the joint"
)
READ_S: Final = 0.02
PROGRESS_S: Final = 0.25
OVERTIME_S: Final = 5.0
"""Beyond a plan's duration; then the drive's samples come too seldom."""
STILL: Final = 0.004
"""rad that a leg which hangs still moves in `STILL_FOR_S`; an idle drive may report no rate."""
STILL_FOR_S: Final = 1.5
"""More than half a swing of the leg."""
STILL_WAIT_S: Final = 60.0

Clock = Callable[[], int]
Progress = Callable[[Sample], None]


class MotionResult(NamedTuple):
    """How a motion ended."""

    samples: list[Sample]
    trouble: str
    """Why it was stopped; "" if it came to its end."""
    not_idle: tuple[str, ...]
    """Modules whose drives do not say that they are idle."""


class Interrupts:
    """Signals that ask to stop, kept until the drives are idle.

    Attributes:
        number: of the first that came; 0: none.
    """

    def __init__(self) -> None:
        self.number = 0

    @property
    def words(self) -> str:
        """Why they stop a motion; "" if none came."""
        return f"stopped by {signal.Signals(self.number).name}" if self.number else ""

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Keep them while in here."""
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
    """Return a drive's first reading that is not of a lost one; None if it does not answer."""
    until = clock() + _ns(ANSWER_S)
    reading = drive.read(READ_S)
    while reading is None or reading.status in LOST_DRIVE:
        if clock() > until:
            return None
        reading = drive.read(READ_S)
    return reading


def idle_reading(drive: Drive, clock: Clock = now_ns) -> DriveReading:
    """Return the first reading of a drive that is nobody's and has its zero."""
    reading = await_reading(drive, clock)
    if reading is None:
        raise DriveError(NO_ANSWER)
    if reading.status is DriveStatus.UNZEROED:
        raise DriveError("its drive does not know where the joint is; `xrl drive zero` first")
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
    """Return where modules are, (phi, theta), rad, once they hang still; None if interrupted."""
    begin = still_since = clock()
    rest: dict[str, Pair] = {}
    while True:
        q = {}
        for name, drive in drives.items():
            try:
                reading = idle_reading(drive, clock)
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
    """Hold all modules but one where they are, move that one, and idle all, whatever happens.

    A held module that moves, or whose drive faults, stops the motion.

    Args:
        drives: idle, opened with the limits of `limit_drives`.
        robot: as `limit_drives` made it.
        module: that is moved.
        plan: its motion.
        q_seen: its angles when the person agreed, rad.
        interrupts: read in every cycle.
        progress: receives a sample now and then.
        clock: monotonic, ns.
    """
    moved = _GuardedModule(module, drives[module], robot, plan, clock)
    hold = MotionPlan(0, Stay(), plan.torque_limit)
    held = [
        _GuardedModule(name, drive, robot, hold, clock)
        for name, drive in drives.items()
        if name != module
    ]
    try:
        trouble = _hold(held, interrupts) or moved.arm(interrupts, q_seen)
        if not trouble:
            trouble = _follow(moved, held, interrupts, progress)
    except BaseException as error:
        if left := _idle_all([moved, *held]):
            error.add_note(f"{', '.join(left)}: {NOT_IDLE}")
        raise
    return MotionResult(moved.samples, trouble, _idle_all([moved, *held]))


class _GuardedModule:
    """One drive and the law that it follows; its target goes out in every cycle, as a service's."""

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
        """Arm it; return why it may not move from where it is, "" if it may.

        Held modules stay where they are, inside their limits or not.
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
        """Let the law answer a sample; return what speaks against going on."""
        assert self.law is not None  # noqa: S101 - `arm` came first
        target = self.law.step(self.clock(), reading)
        if target is not None:
            self.drive.write(target)
        return self.law.trouble


def _hold(held: Sequence[_GuardedModule], interrupts: Interrupts) -> str:
    for one in held:
        if trouble := one.arm(interrupts):
            return f"{one.name}: {trouble}"
    return ""


def _follow(
    moved: _GuardedModule,
    held: Sequence[_GuardedModule],
    interrupts: Interrupts,
    progress: Progress,
) -> str:
    """Run all laws until the motion is done; return why it was stopped before."""
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
            return "it took too long: the drive's samples come too rarely"
        if law.samples and law.samples[-1].t_s >= report_at_s:
            report_at_s = law.samples[-1].t_s + PROGRESS_S
            progress(law.samples[-1])
    return trouble


def arm(drive: Drive, interrupts: Interrupts, clock: Clock) -> DriveReading | str:
    """Arm a drive; return its first armed reading, or why there is none."""
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
        return "the drive has gone silent"
    return f"it does not arm: {reading.status.name}, error 0x{reading.error:x} (`xrl doctor`)"


def _idle_all(modules: Sequence[_GuardedModule]) -> tuple[str, ...]:
    """Idle all drives, even if one of them raises; return who does not say that it is idle."""
    if not modules:
        return ()
    one, *others = modules
    left: tuple[str, ...] = ()
    try:
        left = () if idle(one.drive, one.clock) else (one.name,)
    finally:
        left += _idle_all(others)
    return left


def idle(drive: Drive, clock: Clock) -> bool:
    """Idle both axes and wait until the drive says so; return False if it does not."""
    for attempt in range(1, IDLE_TRIES + 1):
        drive.idle()
        until = clock() + _ns(IDLE_S)
        is_idle = False
        while clock() < until:
            reading = drive.read(READ_S)
            if reading is not None:
                # one that is unzeroed may be armed all the same
                is_idle = reading.status in (DriveStatus.IDLE, DriveStatus.ERROR)
        if is_idle and attempt >= IDLE_AT_LEAST:
            return True
    return False


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
