"""Where a joint's zero is on its motors, and how a motor that has lost it is known.

The encoders sit on the motors and count turns; what a count means at the joint is lost with the
power. So a joint is zeroed by telling the drive its position (`xrl zero`), and not by an
offset kept in a file: the drive then forgets it when it must not be believed any more. A motor
at q = 0 is told `mark_turns`, far from what a drive counts that has just got power (within a turn
of 0) or says before it knows (0): such a drive is `UNZEROED`, is never armed, and one that was
armed is in FAULT in the same cycle. A lost encoder is not known by it: it goes on saying what it
said last, and the drive's error tells.
"""

from __future__ import annotations

from services.joint.drivers.base import Drive, DriveReading, DriveStatus, MotorTarget
from shared.messages import Pair


def from_zero(reading: DriveReading, mark_turns: float) -> DriveReading:
    """Return a reading with the motors' positions counted from the joint's zero.

    Args:
        reading: as the drive has it.
        mark_turns: what a motor reads at q = 0; 0: any drive is taken for zeroed.
    """
    if mark_turns == 0.0:
        return reading
    a, b = reading.pos_turns[0] - mark_turns, reading.pos_turns[1] - mark_turns
    status = reading.status
    half = 0.5 * mark_turns
    if status is not DriveStatus.LOST and not (-half < a < half and -half < b < half):
        status = DriveStatus.UNZEROED
    return DriveReading(
        reading.t_ns, (a, b), reading.vel_turns, status, reading.error, reading.torque
    )


def to_drive(target: MotorTarget, mark_turns: float) -> MotorTarget:
    """Return a target with the motors' positions as the drive counts them."""
    a, b = target.pos_turns
    return MotorTarget(
        (a + mark_turns, b + mark_turns),
        target.vel_turns,
        target.torque,
        target.pos_gain,
        target.vel_gain,
    )


class Zeroed:
    """A drive whose positions are counted from the joint's zero; implements `Drive`."""

    def __init__(self, drive: Drive, mark_turns: float) -> None:
        """Take what a motor of this drive reads at q = 0, turns."""
        self._drive = drive
        self._mark_turns = mark_turns

    def read(self, timeout_s: float) -> DriveReading | None:
        """See `Drive.read`; the status is UNZEROED where a position means nothing."""
        reading = self._drive.read(timeout_s)
        return None if reading is None else from_zero(reading, self._mark_turns)

    def write_torque(self, torque: Pair) -> None:
        """See `Drive.write_torque`."""
        self._drive.write_torque(torque)

    def write(self, target: MotorTarget) -> None:
        """See `Drive.write`."""
        self._drive.write(to_drive(target, self._mark_turns))

    def arm(self, *, onboard: bool) -> None:
        """See `Drive.arm`."""
        self._drive.arm(onboard=onboard)

    def idle(self) -> None:
        """See `Drive.idle`."""
        self._drive.idle()

    def set_position(self, turns: Pair) -> None:
        """Tell both motors where they are from the joint's zero, turns: this zeroes them."""
        self._drive.set_position((turns[0] + self._mark_turns, turns[1] + self._mark_turns))

    def close(self) -> None:
        """See `Drive.close`."""
        self._drive.close()
