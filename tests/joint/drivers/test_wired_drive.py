"""The joint's zero on its motors: the mark, what is known by it, and read-only drives."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.drivers.base import Drive, DriveReading, MotorTarget
from services.joint.drivers.wired_drive import MotorFrame, Signs, WiredDrive
from shared.bus.messages import DriveStatus, Pair

MARK = 64.0

TARGET = MotorTarget((0.5, -1.5), (1.0, 2.0), (0.1, 0.2), (20.0, 20.0), (0.3, 0.3))


class Recorder:
    """A drive that reads what it is told to, and keeps what it is sent."""

    def __init__(self) -> None:
        self.reading: DriveReading | None = None
        self.sent: list[object] = []
        self.write_torque = self.write = self.set_position = self.sent.append

    def read(self, _timeout_s: float) -> DriveReading | None:
        return self.reading

    def arm(self, *, onboard: bool) -> None:
        self.sent.append(("arm", onboard))

    def clear_errors(self) -> None:
        self.sent.append("clear_errors")

    def idle(self) -> None:
        self.sent.append("idle")

    def close(self) -> None:
        self.sent.append("close")


def at(pos: Pair, status: DriveStatus = DriveStatus.ARMED) -> DriveReading:
    return DriveReading(7, pos, (0.5, -0.5), status, 0x40, (0.1, 0.2))


@pytest.fixture
def inner() -> Recorder:
    return Recorder()


@pytest.mark.parametrize(
    ("pos", "signs"),
    [
        ((0.0, MARK), (1, 1)), ((MARK, 0.97), (1, 1)), ((31.9, MARK), (1, 1)),
        ((MARK, 96.1), (1, 1)), ((0.97, 0.5), (-1, 1)), ((0.97, 0.5), (-1, -1)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("status", ["IDLE", "ARMED", "ERROR", "LOST"])
def test_a_count_far_from_the_mark_is_no_zero(
    inner: Recorder, pos: Pair, signs: Signs, status: str
) -> None:
    """A lost drive is lost wherever it was; without a mark any drive is taken for zeroed."""
    wired = WiredDrive(inner, MotorFrame(MARK, signs))
    assert wired.read(0.0) is None, "silence stays silence"
    inner.reading = at(pos, DriveStatus[status])
    found = wired.read(0.0)
    assert found is not None
    assert found.status.name == ("LOST" if status == "LOST" else "UNZEROED")
    assert WiredDrive(inner, MotorFrame(0.0)).read(0.0) == inner.reading


@pytest.mark.parametrize("read_only", [True, False])
def test_every_order_goes_through_to_a_drive_that_is_not_read_only(
    inner: Recorder, read_only: bool
) -> None:
    drive = WiredDrive(inner, MotorFrame(), read_only=read_only)
    drive.write_torque((0.1, 0.2))
    drive.write(TARGET)
    drive.arm(onboard=True)
    drive.clear_errors()
    drive.idle()
    drive.set_position((0.5, 0.25))
    drive.close()
    orders = [(0.1, 0.2), TARGET, ("arm", True), "clear_errors", "idle", (0.5, 0.25)]
    assert inner.sent == [*([] if read_only else orders), "close"]


@pytest.mark.parametrize("status", DriveStatus)
def test_a_read_only_drive_hides_a_foreign_arming(inner: Recorder, status: DriveStatus) -> None:
    inner.reading = at((1.0, 2.0), status)
    reading = WiredDrive(inner, MotorFrame(), read_only=True).read(0.0)
    assert reading is not None
    assert (reading.pos_turns, reading.vel_turns, reading.error) == ((1.0, 2.0), (0.5, -0.5), 0x40)
    armed = status is DriveStatus.ARMED
    assert reading.status is (DriveStatus.IDLE if armed else status)


@given(
    pos=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    signs=st.tuples(st.sampled_from([1, -1]), st.sampled_from([1, -1])),
)
def test_a_motor_that_counts_down_is_the_same_joint(pos: Pair, signs: tuple[int, int]) -> None:
    """What is told, armed and written through the signs comes back through them."""
    inner = Recorder()
    drive: Drive = WiredDrive(inner, MotorFrame(MARK, signs))
    drive.set_position(pos)
    target = inner.sent.pop()
    assert target == (signs[0] * (pos[0] + MARK), signs[1] * (pos[1] + MARK))
    inner.reading = at(target)  # type: ignore[arg-type]
    vel, torque = (signs[0] * 0.5, signs[1] * -0.5), (signs[0] * 0.1, signs[1] * 0.2)
    expected = DriveReading(7, pytest.approx(pos, abs=1e-6), vel, DriveStatus.ARMED, 0x40, torque)
    assert drive.read(0.0) == expected
    drive.write(TARGET)
    drive.write_torque((0.1, 0.2))
    sent, torque = inner.sent
    assert isinstance(sent, MotorTarget)
    assert sent.pos_turns == (signs[0] * (MARK + 0.5), signs[1] * (MARK - 1.5))
    assert (sent.vel_turns, sent.torque) == (
        (signs[0] * 1.0, signs[1] * 2.0),
        (signs[0] * 0.1, signs[1] * 0.2),
    )
    assert (sent.pos_gain, sent.vel_gain) == (TARGET.pos_gain, TARGET.vel_gain)
    assert torque == sent.torque


def test_numpy_scalars_of_a_driver_become_numbers_of_python(inner: Recorder) -> None:
    pair = (np.float32(0.5), np.float32(-0.25))
    inner.reading = DriveReading(
        np.int64(7), pair, pair, DriveStatus.ARMED, np.uint32(0x40), pair, pair, pair, pair,
        np.float64(48.0),
    )  # type: ignore[arg-type]  # fmt: skip
    reading = WiredDrive(inner, MotorFrame()).read(0.0)
    assert reading is not None
    for value in msgspec.structs.astuple(reading):
        for number in value if isinstance(value, tuple) else (value,):
            assert type(number) in (int, float, DriveStatus), value
