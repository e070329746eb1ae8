"""Writes a joint's position to its drive (look, judge, write, read back), and watches legs swing.

Positions here are in the drive's own count; `services.joint.drivers.wired_drive` says why a motor
at q = 0 gets a mark and not 0. The functions take a `Drive` without that wrapper: behind the mark
an armed drive that lost its zero would only look unzeroed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

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
"""A joint is watched for so long before it is taken to be still."""
STILL_RATE: Final = 0.05
"""rad/s; an encoder count in a millisecond is 0.02 rad/s at the joint."""
MOVED_MAX: Final = 0.005
"""rad in `LOOK_S`."""
WITHIN: Final = 0.002
"""rad; largest difference between the position read back and the one written."""
HELD_WITHIN: Final = 0.03
"""rad; the same where its joint service has armed it meanwhile: the joint sags a little."""
TAKEN_S: Final = 0.1
"""s; samples this soon after a write may be older than it."""
SET_S: Final = 0.5
"""Time for one attempt to read back right; frames may get lost, so there are some."""
SETTLED_S: Final = 0.1
"""s of reading before a position is written."""
ATTEMPTS: Final = 4
_READ_S: Final = 0.05


HOW: Final = (
    "push the foot of each leg forward and to its right, so that knee and hip move, and let go: "
    "it has to swing back past where it rests by itself, and to come to rest"
)
WAIT_S: Final = 180.0
PROGRESS_S: Final = 1.0
_SWING_READ_S: Final = 0.005

Swing = tuple[Pair, Pair]
"""Lowest and highest (phi, theta), from where the joint rests, rad."""


class Back(NamedTuple):
    """Position read back."""

    q: Pair
    """(phi, theta), rad."""
    armed: bool
    """Its joint service has armed it: it is not written again."""


class DriveLook(NamedTuple):
    """A drive's samples over a moment."""

    status: DriveStatus
    """As the drive is, its zero not considered: ARMED if it is in closed loop."""
    zeroed: bool
    q: Pair
    """(phi, theta) by the zero it has, rad; means nothing if it has none."""
    speed: float
    """Largest of the joint, rad/s."""
    moved: float
    """Largest way from the first sample to another, rad."""
    error: int
    """`AxisError` bits of both axes."""
    angles: Pair | None = None
    """Its encoders' angles within the turn, turns; None: the drive does not tell."""
    q_there: Pair = (0.0, 0.0)
    """`q` when the encoders were at these angles: a joint that is still may creep."""

    @property
    def is_moving(self) -> bool:
        """True if it moved while it was watched."""
        return self.speed > STILL_RATE or self.moved > MOVED_MAX


SILENT: Final = DriveLook(
    DriveStatus.LOST, zeroed=False, q=(0.0, 0.0), speed=0.0, moved=0.0, error=0
)


def look(drive: Drive, robot: RobotConfig) -> DriveLook:
    """Observe a drive, in its own count, for `LOOK_S`, once it answers."""
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
    """Return why a drive cannot be zeroed now; "" if it can."""
    if seen.status in LOST_DRIVE:
        return NO_ANSWER
    if seen.status is DriveStatus.ARMED:
        return "its drive is armed (closed loop); make it idle first"
    if seen.error & AxisError.ENCODER_FAILED:
        return "its drive reports an encoder error; repair that first (`xrl doctor`)"
    if seen.is_moving:
        return (
            f"it moves: {seen.speed:.2f} rad/s, {seen.moved:.3f} rad in {LOOK_S:g} s; "
            "hold it still, and try again"
        )
    return ""


def why_outside(robot: RobotConfig, module: str, q: Pair) -> str:
    """Return which angle of (phi, theta), rad, is outside of a module's limits; "" if none."""
    limit = getattr(robot.limits, kind_of(module))
    for axis, angle, (low, high) in zip(("phi", "theta"), q, (limit.phi, limit.theta), strict=True):
        if not low <= angle <= high:  # so that a NaN is outside
            return f"{axis} {angle:g} rad is outside of {low:g} .. {high:g} rad: {limit.why}"
    return ""


def zero(drive: Drive, q: Pair, robot: RobotConfig) -> Back | None:
    """Write both motors' positions for joint angles q, rad, to an idle drive in its own count.

    Returns:
        The position read back, right or not (`is_right`); None if none came.
    """
    mark, gear_ratio = robot.drive.zero_mark_turns, robot.joint.gear_ratio
    m1, m2 = motor_from_joint(q, gear_ratio)
    back: Back | None = None
    for _ in range(ATTEMPTS):
        # what came while others were looked at is read out: a bus whose own frames wait takes none
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
    """Return True if the position read back is the one written."""
    if back is None:
        return False
    within = HELD_WITHIN if back.armed else WITHIN
    return all(abs(a - b) <= within for a, b in zip(back.q, q, strict=True))


class _Track(NamedTuple):
    """Where a joint has been, by the drive's own count, rad."""

    now: Pair
    low: Pair
    high: Pair
    still_at: Pair
    still_since: float

    def moved_to(self, q: Pair, now_s: float) -> _Track:
        """Return the track with another position."""
        low = (min(q[0], self.low[0]), min(q[1], self.low[1]))
        high = (max(q[0], self.high[0]), max(q[1], self.high[1]))
        if max(abs(q[0] - self.still_at[0]), abs(q[1] - self.still_at[1])) > STILL:
            return _Track(q, low, high, q, now_s)
        return _Track(q, low, high, self.still_at, self.still_since)

    @property
    def swing(self) -> Swing:
        """What came of it, from where it is now."""
        (a, b), (low_a, low_b), (high_a, high_b) = self.now, self.low, self.high
        return (low_a - a, low_b - b), (high_a - a, high_b - b)


def watch(
    drives: Mapping[str, Drive],
    gear_ratio: float,
    progress: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Swing]:
    """Return how knees and hips have swung once all have and rest again, or after `WAIT_S`.

    Args:
        drives: by module, idle, in their own counts.
        gear_ratio: N of the differential.
        progress: takes what is missing, once a second.
        clock: s.

    Raises:
        DriveError: a drive has gone silent or is armed.
    """
    tracks: dict[str, _Track] = {}
    begun, told = clock(), clock()
    while clock() - begun < WAIT_S:
        for module, drive in drives.items():
            reading = drive.read(_SWING_READ_S)
            if reading is None:
                continue
            if reading.status in (DriveStatus.LOST, DriveStatus.ARMED):
                raise DriveError(f"{module}: {reading.status.name} while its leg swings")
            q, now = joint_from_motor(reading.pos_turns, gear_ratio), clock()
            track = tracks.get(module) or _Track(q, q, q, q, now)
            tracks[module] = track.moved_to(q, now)
        missing = _missing(tracks, clock())
        if len(tracks) == len(drives) and not missing:
            break
        if clock() - told > PROGRESS_S and missing:
            told = clock()
            progress("; ".join(missing))
    return {module: track.swing for module, track in tracks.items()}


def _missing(tracks: Mapping[str, _Track], now_s: float) -> list[str]:
    """Return which joints have not swung yet, or do not rest."""
    found = []
    for module, track in tracks.items():
        side = not_swung(track.swing, knee=kind_of(module) == "knee")
        if side:
            found.append(f"{module}: {side}")
        elif now_s - track.still_since < STILL_FOR_S:
            found.append(f"{module}: not at rest")
    return found
