"""Every guard of the runner: on a drive on a bench, and on a leg that hangs, in virtual time."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from services.joint.drivers.base import DriveReading
from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import DriveStatus
from shared.can import cansimple
from shared.can.cansimple import AxisState, Command
from shared.can.unix_can import Frame, unpack_frames
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX
from tests.tools.bringup.bench_drive import MODULE, PLAN, START, BenchDrive, jog_by, move
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted, with_driver
from tests.tools.bringup.hung_robot import HungRobot
from tools.bringup import motion_runner
from tools.bringup.boards import FoundBoards
from tools.bringup.motion import APART_MAX, Sample, limit_drives, within_stops
from tools.bringup.motion_runner import Interrupts, MotionResult, hanging_angles
from tools.verbs.drive.jog import JogPlan, ThereAndBack, judge

ANKLE = "ankle_left"
HELD = JogPlan(0, ThereAndBack(0.02, 1.0, 1), 15.0)
"""With the leg's other modules held."""


@pytest.fixture
def limited(robot: RobotConfig) -> RobotConfig:
    return limit_drives(robot, PLAN)


@pytest.fixture
def drive(limited: RobotConfig) -> BenchDrive:
    return BenchDrive(limited)


@pytest.fixture
def hung(robot: RobotConfig) -> HungRobot:
    return HungRobot(robot, PlantConfig())


@pytest.mark.parametrize("plan", [PLAN, JogPlan(0, ThereAndBack(-0.08, 2.0, 1), 10.0)])
def test_a_free_joint_follows_and_comes_back_and_is_idle(
    drive: BenchDrive, limited: RobotConfig, plan: JogPlan
) -> None:
    seen: list[Sample] = []
    result = drive.run(limited, plan, progress=seen.append)
    assert (result.trouble, result.not_idle) == ("", ())
    assert all(row.good for row in judge(result.samples, plan))
    assert drive.q == pytest.approx(START, abs=0.01)
    assert drive.status is DriveStatus.IDLE
    assert drive.largest <= PLAN.torque_limit + 1e-9
    assert len(seen) > 8


FAULTS: dict[str, tuple[dict[str, object], JogPlan, str]] = {
    "a jammed joint": ({"jammed": True}, jog_by(0.12), "at the torque limit of 10 N m"),
    "motors that push the wrong way": ({"reversed": True}, PLAN, "apart|torque limit"),
    "a drive that disarms": ({"fails_at_s": 1.2}, PLAN, "the drive is ERROR"),
    "a drive that does not arm": ({"never_arms": True}, PLAN, "does not arm: IDLE"),
    "a drive that falls silent": ({"silent_at_s": 1.2}, PLAN, "no sample from the drive"),
    "a drive that stays armed": ({"deaf": True}, PLAN, "^$"),
    "samples that come too rarely": ({}, PLAN, "the drive's samples arrive too rarely"),
}


@pytest.mark.parametrize(("fault", "plan", "words"), FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_stops_it_within_the_torque_limit_and_the_drive_is_idled(
    drive: BenchDrive, limited: RobotConfig, monkeypatch: pytest.MonkeyPatch,
    fault: dict[str, object], plan: JogPlan, words: str,
) -> None:  # fmt: skip
    if not fault:
        monkeypatch.setattr(motion_runner, "OVERTIME_S", -4.0)
    for name, value in fault.items():
        setattr(drive, name, value)
    result = drive.run(limited, plan)
    assert re.search(words, result.trouble)
    assert drive.largest <= PLAN.torque_limit + 1e-9
    assert drive.idles >= 3
    # a silent drive proves nothing
    assert bool(result.not_idle) == bool({"silent_at_s", "deaf"} & set(fault))
    for sample in result.samples:
        assert max(abs(a - b) for a, b in zip(sample.q, START, strict=True)) < 1.5 * APART_MAX


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (DriveStatus.UNZEROED, "does not know where the joint is; run `xrl drive zero`"),
        (DriveStatus.ARMED, "armed .closed loop. by another program"),
        (DriveStatus.LOST, "does not answer"),
    ],
)
def test_a_drive_that_is_somebodys_or_has_no_zero_is_not_looked_at_further(
    drive: BenchDrive, robot: RobotConfig, status: DriveStatus, words: str
) -> None:
    drive.status = status
    with pytest.raises(DriveError, match=f"{MODULE}: .*{words}"):
        hanging_angles({MODULE: drive}, robot, Interrupts(), drive.clock)
    assert drive.largest == 0.0


def test_an_interrupt_idles_the_drive_and_one_before_arms_none(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    interrupts, drive_read = Interrupts(), drive.read

    def read(timeout_s: float) -> DriveReading | None:
        if drive.now_ns > 2.5 * NS_PER_S and not interrupts.number:
            os.kill(os.getpid(), signal.SIGTERM)
        return drive_read(timeout_s)

    drive.read = read  # type: ignore[method-assign]
    with interrupts.kept():
        result = drive.run(limited, interrupts=interrupts)
    assert (result.trouble, result.not_idle) == ("stopped by SIGTERM", ())
    drive.arm = lambda **_: pytest.fail("armed")  # type: ignore[method-assign]
    assert drive.run(limited, interrupts=interrupts).trouble == "stopped by SIGTERM"


@pytest.mark.parametrize("deaf", [False, True])
def test_an_error_of_our_own_idles_the_drive_or_says_that_it_did_not(
    drive: BenchDrive, limited: RobotConfig, deaf: bool
) -> None:
    def broken(_sample: Sample) -> None:
        raise BrokenPipeError

    drive.deaf = deaf
    with pytest.raises(BrokenPipeError) as raised:
        drive.run(limited, progress=broken)
    assert (drive.status is DriveStatus.IDLE) != deaf
    notes = "".join(getattr(raised.value, "__notes__", []))
    assert ("CUT ITS POWER" in notes) == deaf


@pytest.mark.parametrize(
    ("q_seen", "plan", "words"),
    [
        ((START[0], START[1] + 0.06), PLAN, "moved by 0.060 rad"),
        (START, jog_by(2.0), "would go to 1.000"),
    ],
    ids=["moved after the question", "led out of its limits"],
)
def test_a_joint_that_may_not_move_from_where_it_is_armed_is_not_moved(
    drive: BenchDrive, limited: RobotConfig, q_seen: tuple[float, float], plan: JogPlan, words: str
) -> None:
    result = drive.run(limited, plan, q_seen=q_seen)
    assert words in result.trouble
    assert result.samples == []
    assert drive.largest == 0.0


def test_a_leg_that_swings_is_waited_for_but_not_for_ever(
    hung: HungRobot, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupts = Interrupts()
    hung.world.data.qvel[6:] = 0.5
    monkeypatch.setattr(motion_runner, "STILL_WAIT_S", 1.0)
    with pytest.raises(DriveError, match="swings"):
        hanging_angles(hung.leg(ANKLE), robot, interrupts, hung.clock)
    interrupts.number = 2
    assert hanging_angles(hung.leg(ANKLE), robot, interrupts, hung.clock) is None


def run_ankle(
    hung: HungRobot, robot: RobotConfig, at_third: Callable[[], None] = lambda: None
) -> tuple[MotionResult, int]:
    """Jog the ankle, its leg held, and do something at the third look; return all looks too."""
    seen: list[Sample] = []

    def progress(sample: Sample) -> None:
        seen.append(sample)
        if len(seen) == 3:
            at_third()

    leg, limited = hung.leg(ANKLE), limit_drives(within_stops(robot), HELD)
    q = hanging_angles(leg, robot, Interrupts(), hung.clock, until_still=False)
    assert q is not None
    return move(leg, limited, ANKLE, HELD, q[ANKLE], hung.clock, progress), len(seen)


def all_idle(hung: HungRobot) -> bool:
    readings = [drive.read(0.02) for drive in hung.leg(ANKLE).values()]
    return all(one is not None and one.status is not DriveStatus.ARMED for one in readings)


@pytest.mark.parametrize(
    ("spoiled", "disarms", "trouble", "not_idle"),
    [
        ({"hip_left": "never_arms"}, "", "hip_left: it does not arm", ()),
        ({}, "knee_left", "knee_left: the drive is IDLE", ()),
        ({}, "hip_left", "hip_left: the drive is IDLE", ()),
        ({"hip_left": "never_arms", "knee_left": "deaf"}, "", "hip_left", ("knee_left",)),
    ],
)
def test_a_held_module_that_fails_stops_the_motion_and_all_are_idled_or_named(
    hung: HungRobot, robot: RobotConfig, spoiled: dict[str, str], disarms: str, trouble: str,
    not_idle: tuple[str, ...],
) -> None:  # fmt: skip
    def disarm() -> None:
        for axis in (0, 1) if disarms else ():
            hung.bank.request_state(2 * MODULE_INDEX[disarms] + axis, AxisState.IDLE)

    for name, fault in spoiled.items():
        setattr(hung.drives[name], fault, True)
    result, looks = run_ankle(hung, robot, disarm)
    assert result.trouble.startswith(trouble)
    assert looks < 8
    assert result.not_idle == not_idle
    assert all_idle(hung) == (not_idle == ())


def test_a_held_modules_target_goes_out_in_every_cycle(hung: HungRobot, robot: RobotConfig) -> None:
    """A frame may be lost: the drive would be armed and hold nothing."""

    def lose_gains() -> None:
        hung.bank.pos_gain[:] = 0.0
        hung.bank.vel_gain[:] = 0.0

    result, _ = run_ankle(hung, robot, lose_gains)
    assert result.trouble == ""
    assert hung.bank.pos_gain[2 * MODULE_INDEX["knee_left"]] > 0.0


@pytest.mark.parametrize("in_idle", [False, True], ids=["while it moves", "while one is idled"])
def test_an_exception_leaves_no_other_drive_armed(
    hung: HungRobot, robot: RobotConfig, in_idle: bool
) -> None:
    def fail() -> None:
        raise OSError("a test")

    if in_idle:
        hung.drives["hip_left"].never_arms = True
        hung.drives[ANKLE].idle = fail  # type: ignore[method-assign]
    with pytest.raises(OSError, match="a test"):
        run_ankle(hung, robot, fail)
    assert all_idle(hung)


# ---- the limits of a motion are taken back

SERIAL, NOWHERE = "3A0000000005", Path("/nowhere")
SMALL = {"axis0.controller.config.vel_limit": 3.0, "axis1.motor.config.current_lim": 3.5}


class Link:
    """A CAN link that keeps what it is given."""

    def __init__(self) -> None:
        self.open = True
        self.sent: list[Frame] = []

    def connect(self) -> bool:
        return self.open

    def send(self, packet: bytes) -> bool:
        self.sent += unpack_frames(packet)
        return True

    def receive(self, _timeout_s: float) -> tuple[()]:
        return ()

    def close(self) -> None:
        self.open = False


def test_over_can_both_axes_get_the_robot_files_limits_more_than_once(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = Link()
    monkeypatch.setattr(motion_runner, "CanLink", lambda *_: link)
    motion_runner.give_back(robot, MODULE, NOWHERE)
    sent = [(can_id, cansimple.unpack_two_floats(data)) for can_id, data in link.sent]
    nodes = robot.module_named(MODULE).node_ids
    ids = [cansimple.arbitration_id(node, Command.SET_LIMITS) for node in nodes]
    assert sorted(can_id for can_id, _ in sent) == sorted(ids * motion_runner.LIMITS_TIMES)
    wanted = (robot.drive.vel_limit, robot.drive.current_lim)
    assert all(limits == pytest.approx(wanted) for _, limits in sent)
    assert not link.open
    with pytest.raises(DriveError, match="accepts no frames"):
        motion_runner.give_back(robot, MODULE, NOWHERE)


def test_over_usb_they_are_written_and_read_back(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    board, on_usb = BoardInMemory(as_wanted() | SMALL), with_driver(robot, "odrive_usb")
    found = FoundBoards({SERIAL: board}, {}, ())
    monkeypatch.setattr(motion_runner, "boards_on_usb", lambda *_: nullcontext(found))
    motion_runner.give_back(on_usb, MODULE, NOWHERE)
    assert board.now == as_wanted()
    assert board.saves == 0, "a board that saves restarts, and has lost its zero"
    board.now |= SMALL
    board.deaf.add("axis0.controller.config.vel_limit")
    with pytest.raises(DriveError, match="do not read back"):
        motion_runner.give_back(on_usb, MODULE, NOWHERE)
    found.boards.clear()
    with pytest.raises(DriveError, match=f"{SERIAL}: not connected"):
        motion_runner.give_back(on_usb, MODULE, NOWHERE)
