"""`xrl drive zero`: against a drive that the test plays, and the verb on the emulated robot."""

from __future__ import annotations

import io
import math
import re
from functools import partial
from pathlib import Path

import msgspec
import pytest

from services.joint.differential import joint_from_motor, motor_from_joint
from services.joint.drivers.base import DriveReading
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisError
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tests.tools.bringup.board_in_memory import with_driver
from tools.bringup import drive_access, zeroing
from tools.bringup.motion_runner import await_reading
from tools.bringup.zeroing import Back, DriveLook, is_right, look, refusal, why_outside, zero
from tools.fleet.supervise import SupervisedFleet
from tools.verbs.drive import zero as verb
from tools.verbs.drive.zero import stand_angles

MODULE = "knee_left"
MARK = 64.0
N = 17.5
STILL = DriveLook(DriveStatus.IDLE, zeroed=True, q=(0.0, -1.0), speed=0.0, moved=0.0, error=0)


class VirtualTime:
    """Moves on while a drive is read."""

    now_s = 1.0

    def monotonic(self) -> float:
        return self.now_s

    def now_ns(self) -> int:
        return round(self.now_s * NS_PER_S)


TIME = VirtualTime()


class PlayedDrive:
    """A drive as it counts itself; each reading says what the test wants.

    It has no `write`, `arm` or `idle`: a zero moves nothing and changes no state.

    Attributes:
        pos: turns of both motors.
        vel: turn/s of both motors.
        creep: turns that the motors go on at each reading.
        deaf: so many more positions told are lost on the way.
    """

    def __init__(self) -> None:
        self.pos: Pair = (0.3, 0.6)
        self.vel: Pair = (0.0, 0.0)
        self.status = DriveStatus.IDLE
        self.error = self.deaf = self.told = 0
        self.creep = 0.0

    def read(self, timeout_s: float) -> DriveReading | None:
        if self.status is DriveStatus.LOST:
            TIME.now_s += timeout_s
            return None
        TIME.now_s += 0.001
        self.pos = (self.pos[0] + self.creep, self.pos[1] + self.creep)
        return DriveReading(TIME.now_ns(), self.pos, self.vel, self.status, self.error)

    def set_position(self, turns: Pair) -> None:
        self.told += 1
        if self.deaf > 0:
            self.deaf -= 1
        else:
            self.pos = turns


@pytest.fixture(autouse=True)
def virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zeroing, "time", TIME)
    monkeypatch.setattr(zeroing, "now_ns", TIME.now_ns)
    monkeypatch.setattr(zeroing, "await_reading", partial(await_reading, clock=TIME.now_ns))


def test_motors_are_set_to_the_mark_and_the_joints_angles_there(
    robot: RobotConfig,
) -> None:
    drive = PlayedDrive()
    back = zero(drive, (0.05, -0.8), robot)
    assert is_right(back, (0.05, -0.8))
    m1, m2 = motor_from_joint((0.05, -0.8), robot.joint.gear_ratio)
    mark = robot.drive.zero_mark_turns
    assert drive.pos == pytest.approx((mark + m1, mark + m2))
    assert drive.told == 1


def test_a_lost_frame_is_sent_again(robot: RobotConfig) -> None:
    drive = PlayedDrive()
    drive.deaf = 2
    assert is_right(zero(drive, (0.0, -1.0), robot), (0.0, -1.0))
    assert drive.told == 3


def test_a_drive_that_keeps_its_position_is_not_reported_zeroed(robot: RobotConfig) -> None:
    drive = PlayedDrive()
    drive.deaf = 100
    back = zero(drive, (0.0, -1.0), robot)
    assert back is not None
    assert not is_right(back, (0.0, -1.0))
    assert not is_right(None, (0.0, -1.0))
    off = (0.0, -1.0 + 1.01 * zeroing.WITHIN)
    assert not is_right(Back(off, armed=False), (0.0, -1.0))
    assert is_right(Back(off, armed=True), (0.0, -1.0)), "held by its service, it sags"


def test_a_sample_of_the_time_before_is_no_proof(robot: RobotConfig) -> None:
    """It may be so near to what was told that it seems to be right."""

    class Late(PlayedDrive):
        def read(self, timeout_s: float) -> DriveReading | None:
            reading = super().read(timeout_s)
            return None if reading is None else msgspec.structs.replace(reading, t_ns=1)

    assert zero(Late(), (0.0, -1.0), robot) is None


def test_a_drive_that_its_service_armed_meanwhile_is_not_written_again(robot: RobotConfig) -> None:
    drive = PlayedDrive()
    drive.deaf, drive.status = 100, DriveStatus.ARMED
    assert zero(drive, (0.0, -1.0), robot) is not None
    assert drive.told == 1


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ARMED])
@pytest.mark.parametrize(
    ("turns", "zeroed"),
    [((MARK + 1.0, MARK - 2.0), True), ((0.2, 0.9), False), ((MARK, 0.4), False)],
)
def test_a_drive_that_lost_its_power_is_known_armed_or_not(
    robot: RobotConfig, turns: Pair, zeroed: bool, status: DriveStatus
) -> None:
    drive = PlayedDrive()
    drive.pos, drive.status = turns, status
    seen = look(drive, robot)
    assert (seen.status, seen.zeroed) == (status, zeroed)
    if zeroed:
        assert seen.q == pytest.approx(joint_from_motor((1.0, -2.0), N))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "^$"),
        ({"speed": 0.049, "moved": 0.0049}, "^$"),
        ({"speed": 0.051}, "the joint moves: 0.05 rad/s"),
        ({"moved": 0.0051}, "the joint moves.*hold it still"),
        ({"status": DriveStatus.LOST}, "does not answer"),
        ({"status": DriveStatus.ARMED}, "armed"),
        ({"status": DriveStatus.ERROR, "error": int(AxisError.WATCHDOG_TIMER_EXPIRED)}, "^$"),
        ({"status": DriveStatus.ERROR, "error": int(AxisError.ENCODER_FAILED)}, "encoder error"),
        ({"zeroed": False}, "^$"),
    ],
)
def test_only_a_joint_that_is_still_and_a_drive_that_is_idle_are_zeroed(
    change: dict[str, object], words: str
) -> None:
    assert re.search(words, refusal(STILL._replace(**change)))  # type: ignore[arg-type]


def test_motion_is_seen_by_the_rate_and_by_the_way(robot: RobotConfig) -> None:
    drive = PlayedDrive()
    drive.vel = (1.0, 1.0)
    assert look(drive, robot).speed == pytest.approx(joint_from_motor((1.0, 1.0), N)[1])
    drive = PlayedDrive()
    drive.creep = 0.01
    assert look(drive, robot).moved > 0.005
    drive.status = DriveStatus.LOST
    assert look(drive, robot).status is DriveStatus.LOST


@pytest.mark.parametrize(
    ("q", "inside"),
    [
        ((0.0, -0.5), True),
        ((0.6, -3.0), True),
        ((0.601, -0.5), False),
        ((0.0, -0.199), False),
        ((math.nan, -0.5), False),
    ],
)
def test_angles_outside_of_the_limits_are_refused(
    robot: RobotConfig, q: Pair, inside: bool
) -> None:
    assert (why_outside(robot, MODULE, q) == "") == inside


@pytest.mark.parametrize("height", [0.9, 1.188])
def test_a_stand_is_at_its_height_level_and_inside_the_limits(
    robot: RobotConfig, height: float
) -> None:
    """By the plain geometry of a leg in its plane, not by the planner's kinematics."""
    stand = stand_angles(robot, height)
    lengths = robot.geometry
    for side in ("right", "left"):
        q = {kind: stand.q[f"{kind}_{side}"] for kind in ("ankle", "knee", "hip")}
        assert sum(theta for _, theta in q.values()) == pytest.approx(0.0, abs=5e-3)
        shin = q["ankle"][1]
        thigh = shin + q["knee"][1]
        reach = lengths.l2 * math.cos(shin) + lengths.l1 * math.cos(thigh)
        span = (lengths.w_hip - lengths.w_base) / 2.0
        assert math.hypot(height, span) == pytest.approx(reach, abs=2e-3)
        forward = lengths.l2 * math.sin(shin) + lengths.l1 * math.sin(thigh)
        assert stand.hips_forward == pytest.approx(forward, abs=2e-3)
    for module, q_module in stand.q.items():
        assert why_outside(robot, module, q_module) == ""


def test_over_usb_the_services_must_be_down(robot: RobotConfig, tmp_path: Path) -> None:
    usb = with_driver(robot, "odrive_usb")
    with pytest.raises(FleetError, match=r"holds the drive's USB.*xrl down"):
        verb.refuse_services(usb, {MODULE: SupervisedFleet(tmp_path)})
    verb.refuse_services(usb, {MODULE: None})


def test_without_a_terminal_yes_must_be_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y"))
    with pytest.raises(FleetError, match="--yes"):
        drive_access.confirm("sure?", yes=False)
    assert drive_access.confirm("sure?", yes=True)
