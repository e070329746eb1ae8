"""A jog on a drive: arm, move, and idle both axes whatever happens."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final, NamedTuple

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive, DriveReading, DriveStatus
from shared.bus.messages import Pair
from shared.clock import NS_PER_S, now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tools.bringup.jogging import STRAYED_MAX, Jog, MotionPlan, Sample, outside

ANSWER_S: Final = 3.0
"""Longest wait for a drive's first words."""
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

Clock = Callable[[], int]
Progress = Callable[[Sample], None]
Watch = Callable[[], str]


def nothing() -> str:
    """Watch nothing."""
    return ""


class JogResult(NamedTuple):
    """How a jog ended."""

    samples: list[Sample]
    trouble: str
    """Why it was stopped; "" if it came to its end."""
    is_idle: bool
    """The drive says so."""


class Interrupts:
    """Signals that ask to stop, kept until the drive is idle.

    Attributes:
        number: of the first that came; 0: none.
    """

    def __init__(self) -> None:
        self.number = 0

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


def first_reading(drive: Drive, clock: Clock = now_ns) -> DriveReading:
    """Return a drive's first reading that is not LOST.

    Raises:
        DriveError: none comes, it has no zero, or somebody has armed it.
    """
    until = clock() + round(ANSWER_S * NS_PER_S)
    reading = drive.read(READ_S)
    while reading is None or reading.status is DriveStatus.LOST:
        if clock() > until:
            raise DriveError(
                "its drive does not answer; look at its power and its bus (`xrl doctor`)"
            )
        reading = drive.read(READ_S)
    if reading.status is DriveStatus.UNZEROED:
        raise DriveError("its drive does not know where the joint is; `xrl drive zero` first")
    if reading.status is DriveStatus.ARMED:
        raise DriveError("its drive is armed (closed loop) by somebody else; make it idle first")
    return reading


def jog_drive(
    drive: Drive,
    robot: RobotConfig,
    module: str,
    plan: MotionPlan,
    *,
    q_seen: Pair,
    interrupts: Interrupts,
    progress: Progress,
    clock: Clock = now_ns,
    watch: Watch = nothing,
) -> JogResult:
    """Arm a drive, move its joint as planned, and idle it, whatever happens.

    Args:
        drive: idle, opened with the limits of `gentle`.
        robot: as `gentle` made it.
        module: its name.
        plan: the motion.
        q_seen: joint angles when the person agreed, rad.
        interrupts: read in every cycle.
        progress: receives a sample now and then.
        clock: monotonic, ns.
        watch: called in every cycle; returns why the motion must stop, "" if it need not.
    """
    samples: list[Sample] = []
    try:
        reading = arm(drive, interrupts, clock)
        if isinstance(reading, str):
            trouble = reading
        else:
            q = joint_from_motor(reading.pos_turns, robot.joint.gear_ratio)
            trouble = _strayed(q, q_seen) or outside(robot, module, plan, q)
            if not trouble:
                jog = Jog(robot, module, plan, q, clock())
                samples = jog.samples
                give_up_ns = clock() + _ns(plan.duration_s + 5.0)
                _move(drive, jog, interrupts, progress, clock, give_up_ns, watch)
                trouble = jog.trouble
    except BaseException as error:
        if not idle(drive, clock):
            error.add_note(NOT_IDLE)
        raise
    return JogResult(samples, trouble, idle(drive, clock))


def _strayed(q: Pair, q_seen: Pair) -> str:
    """Return what to say of a joint that is elsewhere than it was seen; "" if it is not."""
    strayed = max(abs(q[0] - q_seen[0]), abs(q[1] - q_seen[1]))
    if strayed <= STRAYED_MAX:
        return ""
    return f"the joint has moved by {strayed:.3f} rad before it was armed"


def _move(
    drive: Drive,
    jog: Jog,
    interrupts: Interrupts,
    progress: Progress,
    clock: Clock,
    give_up_ns: int,
    watch: Watch,
) -> None:
    """Run the jog until it is done, in trouble, or interrupted."""
    report_at_s = 0.0
    while not jog.done and not jog.trouble:
        reading = drive.read(READ_S)
        now = clock()
        if interrupts.number:
            jog.trouble = f"stopped by {signal.Signals(interrupts.number).name}"
            return
        target = jog.step(now, reading)
        if target is not None:
            drive.write(target)
        jog.trouble = jog.trouble or watch()
        if now > give_up_ns:
            jog.trouble = "it took too long: the drive's samples come too seldom"
        elif jog.samples and jog.samples[-1].t_s >= report_at_s:
            report_at_s = jog.samples[-1].t_s + PROGRESS_S
            progress(jog.samples[-1])


def arm(drive: Drive, interrupts: Interrupts, clock: Clock) -> DriveReading | str:
    """Arm a drive; return its first armed reading, or why there is none."""
    reading: DriveReading | None = None
    for _ in range(ARM_TRIES):
        drive.arm(onboard=True)
        until = clock() + _ns(ARM_S)
        while clock() < until:
            reading = drive.read(READ_S) or reading
            if interrupts.number:
                return f"stopped by {signal.Signals(interrupts.number).name}"
            if reading is not None and reading.status is DriveStatus.ARMED:
                return reading
            if reading is not None and reading.status is DriveStatus.ERROR:
                break
    if reading is None:
        return "the drive has gone silent"
    return f"it does not arm: {reading.status.name}, error 0x{reading.error:x} (`xrl doctor`)"


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
