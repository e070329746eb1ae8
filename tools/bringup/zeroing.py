"""Write a joint's position to its drive (check, write, read back), and watch legs swing.

Positions are in the drive's own count; `services.joint.drivers.wired_drive` says why a motor at
q = 0 reads a mark instead of 0. The functions need drives opened without the mark
(`zero_record.drives_of`): with it, an armed drive without a zero would be reported only as
unzeroed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import numpy as np

from services.joint.differential import joint_from_motor, motor_from_joint
from services.joint.drivers.base import Drive
from services.joint.drivers.wired_drive import MotorFrame
from shared.bus.messages import LOST_DRIVE, DriveStatus, Pair
from shared.can.cansimple import AxisError
from shared.clock import NS_PER_S, now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import kind_of
from tools.bringup.hanging_leg import not_swung
from tools.bringup.motion_runner import NO_ANSWER, STILL, STILL_FOR_S, await_reading

LOOK_S: Final = 0.3
"""Time for which a joint is observed, s."""
STILL_RATE: Final = 0.05
"""Maximum rate of a joint at rest, rad/s; one count of both encoders in 1 ms is 0.02 rad/s."""
MOVED_MAX: Final = 0.005
"""Maximum motion of a joint at rest in `LOOK_S`, rad."""
WITHIN: Final = 0.002
"""Maximum difference between written position and position read back, rad."""
HELD_WITHIN: Final = 0.03
"""`WITHIN` for a drive that a joint service has armed meanwhile: the joint sags a little."""
TAKEN_S: Final = 0.1
"""Time after a write during which samples may be older than the write, s."""
SET_S: Final = 0.5
"""Timeout for a correct position after one write, s; frames may be lost, so writes are repeated."""
SETTLED_S: Final = 0.1
"""Time for which the drive is read before a write, s."""
ATTEMPTS: Final = 4
_READ_S: Final = 0.05

HOW: Final = (
    "push the foot of each leg forward and to its right, so that knee and hip move, and let go: "
    "the leg must swing back past its rest position on its own, and come to rest"
)
WAIT_S: Final = 180.0
PROGRESS_S: Final = 1.0
_SWING_READ_S: Final = 0.005

Swing = tuple[Pair, Pair]
"""Lowest and highest (phi, theta), relative to the joint's rest position, rad."""


class Back(NamedTuple):
    """Position read back from a drive."""

    q: Pair
    """(phi, theta), rad."""
    armed: bool
    """True if a joint service has armed the drive: no position must be written to it again."""


class DriveLook(NamedTuple):
    """Summary of a drive's samples over `LOOK_S`."""

    status: DriveStatus
    """Status regardless of the zero: ARMED if the drive is in closed loop."""
    zeroed: bool
    q: Pair
    """(phi, theta) by the drive's zero, rad; meaningless for an unzeroed drive."""
    speed: float
    """Maximum speed of the joint, rad/s."""
    moved: float
    """Maximum distance from the first sample, rad."""
    error: int
    """`AxisError` bits of both axes."""
    angles: Pair | None = None
    """Encoder angles within the turn, turns; None if the drive does not report them."""
    q_there: Pair = (0.0, 0.0)
    """`q` at the time of `angles`: even a joint at rest may creep."""

    @property
    def is_moving(self) -> bool:
        """True if the joint moved while it was observed."""
        return self.speed > STILL_RATE or self.moved > MOVED_MAX


SILENT: Final = DriveLook(
    DriveStatus.LOST, zeroed=False, q=(0.0, 0.0), speed=0.0, moved=0.0, error=0
)


def look(drive: Drive, robot: RobotConfig) -> DriveLook:
    """Observe a drive in its own count for `LOOK_S`, once it answers."""
    reading = await_reading(drive)
    if reading is None:
        return SILENT
    gear_ratio = robot.joint.gear_ratio
    first = newest = reading
    speed, moved, errors = 0.0, 0.0, reading.error
    there = None
    begun = time.monotonic()
    while time.monotonic() - begun < LOOK_S:
        reading = drive.read(_READ_S)
        if reading is None:
            continue
        newest = reading
        if reading.encoder_zero is not None:
            there = reading
        errors |= reading.error
        speed = max(speed, *map(abs, joint_from_motor(reading.vel_turns, gear_ratio)))
        (a1, a2), (b1, b2) = reading.pos_turns, first.pos_turns
        moved = max(moved, *map(abs, joint_from_motor((a1 - b1, a2 - b2), gear_ratio)))
    frame = MotorFrame(robot.drive.zero_mark_turns)
    counted = frame.from_drive(newest)
    q = joint_from_motor(counted.pos_turns, gear_ratio)
    zeroed = counted.status is not DriveStatus.UNZEROED
    seen = DriveLook(newest.status, zeroed=zeroed, q=q, speed=speed, moved=moved, error=errors)
    if there is None:
        return seen
    q_there = joint_from_motor(frame.from_drive(there).pos_turns, gear_ratio)
    return seen._replace(angles=there.angles, q_there=q_there)


def refusal(seen: DriveLook) -> str:
    """Return why a drive cannot be zeroed now, or ""."""
    if seen.status in LOST_DRIVE:
        return NO_ANSWER
    if seen.status is DriveStatus.ARMED:
        return "its drive is armed (closed loop); make it idle first"
    if seen.error & AxisError.ENCODER_FAILED:
        return "its drive reports an encoder error; repair it first (see `xrl doctor`)"
    if seen.is_moving:
        return (
            f"the joint moves: {seen.speed:.2f} rad/s, {seen.moved:.3f} rad in {LOOK_S:g} s; "
            "hold it still, and try again"
        )
    return ""


def why_outside(robot: RobotConfig, module: str, q: Pair) -> str:
    """Return which of phi and theta, rad, is outside of a module's limits, or ""."""
    limit = getattr(robot.limits, kind_of(module))
    for axis, angle, (low, high) in zip(("phi", "theta"), q, (limit.phi, limit.theta), strict=True):
        if not low <= angle <= high:  # so that a NaN is outside
            return f"{axis} {angle:g} rad is outside of {low:g} to {high:g} rad: {limit.why}"
    return ""


def zero(drive: Drive, q: Pair, robot: RobotConfig) -> Back | None:
    """Write the motor positions for joint angles q, rad, to an idle drive in its own count.

    Returns:
        Position read back, correct or not (`is_right`); None if no sample arrived.
    """
    mark, gear_ratio = robot.drive.zero_mark_turns, robot.joint.gear_ratio
    m1, m2 = motor_from_joint(q, gear_ratio)
    back: Back | None = None
    for _ in range(ATTEMPTS):
        # empty the receive queue first: while frames wait there, the bus accepts none to send
        until = time.monotonic() + SETTLED_S
        while time.monotonic() < until:
            drive.read(_READ_S)
        drive.set_position((m1 + mark, m2 + mark))
        taken_ns = now_ns() + round(TAKEN_S * NS_PER_S)
        until = time.monotonic() + SET_S
        while time.monotonic() < until:
            reading = drive.read(_READ_S)
            if reading is None or reading.status in LOST_DRIVE or reading.t_ns < taken_ns:
                continue
            a, b = reading.pos_turns
            armed = reading.status is DriveStatus.ARMED
            back = Back(joint_from_motor((a - mark, b - mark), gear_ratio), armed)
            if armed or is_right(back, q):
                return back
    return back


def is_right(back: Back | None, q: Pair) -> bool:
    """Return True if the position read back is the written one."""
    if back is None:
        return False
    within = HELD_WITHIN if back.armed else WITHIN
    return all(abs(a - b) <= within for a, b in zip(back.q, q, strict=True))


class _Track:
    """Range of a joint's positions, rad."""

    def __init__(self, q: Pair, now_s: float) -> None:
        self._now = self._low = self._high = self._still_at = np.array(q)
        self.still_since = now_s

    def move_to(self, q: Pair, now_s: float) -> None:
        self._now = np.array(q)
        self._low, self._high = np.minimum(self._low, q), np.maximum(self._high, q)
        if np.abs(self._now - self._still_at).max() > STILL:
            self._still_at, self.still_since = self._now, now_s

    @property
    def swing(self) -> Swing:
        """Lowest and highest (phi, theta), relative to the present position."""
        low, high = (self._low - self._now).tolist(), (self._high - self._now).tolist()
        return (low[0], low[1]), (high[0], high[1])


def watch(
    drives: Mapping[str, Drive],
    gear_ratio: float,
    progress: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Swing]:
    """Wait until all knees and hips have swung and rest, or for `WAIT_S`; return their swings.

    Args:
        drives: idle drives by module, in their own counts.
        gear_ratio: gear ratio N of the differential.
        progress: receives the missing swings every `PROGRESS_S`.
        clock: s.

    Raises:
        DriveError: a drive is silent or armed.
    """
    tracks: dict[str, _Track] = {}
    begun, told = clock(), clock()
    while clock() - begun < WAIT_S:
        for module, drive in drives.items():
            reading = drive.read(_SWING_READ_S)
            if reading is None:
                continue
            if reading.status in (DriveStatus.LOST, DriveStatus.ARMED):
                raise DriveError(
                    f"{module}: its drive is {reading.status.name} while its leg swings; see "
                    "`xrl doctor`"
                )
            q, now = joint_from_motor(reading.pos_turns, gear_ratio), clock()
            tracks.setdefault(module, _Track(q, now)).move_to(q, now)
        missing = _missing(tracks, clock())
        if len(tracks) == len(drives) and not missing:
            break
        if clock() - told > PROGRESS_S and missing:
            told = clock()
            progress("; ".join(missing))
    return {module: track.swing for module, track in tracks.items()}


def _missing(tracks: Mapping[str, _Track], now_s: float) -> list[str]:
    """Return the joints that have not swung yet or do not rest."""
    found = []
    for module, track in tracks.items():
        side = not_swung(track.swing, knee=kind_of(module) == "knee")
        if side:
            found.append(f"{module}: {side}")
        elif now_s - track.still_since < STILL_FOR_S:
            found.append(f"{module}: not at rest")
    return found
