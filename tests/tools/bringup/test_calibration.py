"""Calibrating a board: done and saved whole, or as it was before; and what is refused."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from services.joint.differential import motor_from_joint
from services.simulator.drives.axis_settings import PHASE_INDUCTANCE, PHASE_RESISTANCE
from services.simulator.physics.plant import plant_from
from shared.can.cansimple import AxisState, EncoderError, Heartbeat
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.joints import MODULES
from tests.tools.bringup.bank_board import FIRST, BankBoard
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted
from tests.tools.bringup.hung_robot import HungRobot
from tools.bringup import calibration
from tools.bringup.boards import FoundBoards
from tools.bringup.calibration import BoardResult, Found, Procedure
from tools.bringup.can_monitor import BusTraffic, NodeTraffic
from tools.bringup.motion_runner import Interrupts
from tools.terminal import Console

AXES = ("axis0", "axis1")
MODULE = "knee_left"
IDLE = (AxisState.IDLE, AxisState.IDLE)


def run(board: BankBoard, at_s: float = 1e9, interrupts: Interrupts | None = None) -> BoardResult:
    """Calibrate both axes; a signal comes at a time of the course."""
    interrupts = interrupts or Interrupts()
    begun_s, told = board.clock(), list[tuple[str, str]]()

    def progress(axis: str, procedure: Procedure, _: float) -> None:
        told.append((axis, procedure.what))
        if board.clock() - begun_s > at_s:
            interrupts.number = signal.SIGINT

    result = calibration.calibrate_board(
        board, AXES, interrupts, progress, board.clock, board.pause
    )
    if not result.why:
        expected = [(axis, what) for axis in AXES for what in ("motor", "encoder")]
        assert list(dict.fromkeys(told)) == expected
    return result


def test_a_new_board_is_calibrated_marked_saved_and_ready_after_power_up() -> None:
    board = BankBoard()
    assert calibration.uncalibrated(board) == AXES
    before = board.table()
    assert before["axis0.config.enable_watchdog"] == 1.0, "USB does not feed it"
    result = run(board)
    assert result.why == ""
    for found in result.found.values():
        assert found == pytest.approx((PHASE_RESISTANCE, PHASE_INDUCTANCE, 1))
    board.restart()
    assert calibration.uncalibrated(board) == ()
    changed = {name.partition(".")[2] for name, v in board.table().items() if before[name] != v}
    assert changed == {
        "motor.config.pre_calibrated", "motor.config.phase_resistance",
        "encoder.config.pre_calibrated", "encoder.config.direction", "encoder.config.phase_offset",
    }  # fmt: skip
    board.write(dict.fromkeys([f"{axis}.config.enable_watchdog" for axis in AXES], False))
    board.clear_errors()
    board.write({f"{axis}.requested_state": 8 for axis in AXES})
    assert board.states() == (8, 8)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"motor__config__calibration_current": 30.0}, r"PHASE_RESISTANCE_OUT_OF_RANGE; check"),
        ({"motor__config__pole_pairs": 14}, r"0\.2.. turns instead.* 7 pole pairs: check"),
        ({"encoder__config__cpr": 8192}, r"0\.5.. turns instead of 0\.286.*: check .* and encoder"),
        ({"load": 2.0}, r"CPR_POLEPAIRS_MISMATCH; its encoder counted .*hang the leg"),
        ({"blocked": 1.0}, r"NO_RESPONSE; the encoder does not count.*blocked"),
        ({"broken": 1e6}, r"motor: error MOTOR_FAILED, .*three phase wires"),
    ],
)  # fmt: skip
def test_one_that_fails_says_why_and_what_to_do_and_leaves_the_board_as_it_was(
    settings: dict[str, float], says: str
) -> None:
    board = BankBoard(**{name: v for name, v in settings.items() if "__" in name})
    board.rotors.load[FIRST + 1] = settings.get("load", 0.0)
    board.rotors.blocked = {FIRST + 1} if "blocked" in settings else set()
    board.bank.calibration.resistance[FIRST + 1] = settings.get("broken", 0.1)
    before = board.table()
    result = run(board)
    assert not result.not_idle
    first_fails = any("__" in name for name in settings)
    assert result.why.startswith("axis0" if first_fails else "axis1")
    with pytest.raises(AssertionError, match=says):
        raise AssertionError(result.why)
    assert board.states() == IDLE
    assert board.table() == before, "nothing is half saved"
    assert calibration.uncalibrated(board) == AXES


@pytest.mark.parametrize(
    "at_s",
    [3.0, 5.8, 7.5, *(pytest.param(s, marks=pytest.mark.wide) for s in (8.4, 9.4, 12.0)), 18.0],
)
def test_ctrl_c_idles_the_axis_and_leaves_the_board_as_it_was(at_s: float) -> None:
    """A drive that is told to stop counts some halves as calibrated (docs/drives.md#traps)."""
    board = BankBoard()
    before = board.table()
    result = run(board, at_s)
    assert "stopped by SIGINT" in result.why
    assert not result.not_idle
    assert board.clock() < at_s + 6.0
    assert board.states() == IDLE
    assert board.table() == before
    assert calibration.uncalibrated(board) == AXES
    assert board.restarts == 2


def test_an_axis_that_does_not_become_idle_is_told_and_its_board_not_restarted() -> None:
    board = BankBoard()
    board.deaf = True
    assert run(board, 3.0).not_idle
    assert board.restarts == 1


def test_a_calibration_that_somebody_else_breaks_off_is_not_taken_for_one() -> None:
    """In the motor's second part the firmware calls it done."""
    board = BankBoard()
    steps = board.pause

    def pause(seconds: float) -> None:
        steps(seconds)
        state = board.bank.state[FIRST]
        if state == AxisState.MOTOR_CALIBRATION and board.clock() - begun_s > 5.9:
            board.bank.request_state(FIRST, AxisState.IDLE)

    begun_s = board.clock()
    nothing: Any = lambda *_: None  # noqa: E731
    result = calibration.calibrate_board(board, AXES, Interrupts(), nothing, board.clock, pause)
    assert "without an error: another program commands the axis" in result.why
    assert calibration.uncalibrated(board) == AXES


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"encoder__config__mode": 0}, r"encoder\.config\.mode is 0: not an absolute encoder"),
        ({"motor__config__current_lim": 6.0}, r"calibration_current is 15 A; .*at most 14 A"),
        ({"motor__config__calibration_current": 0.0}, "above 0"),
        ({"motor__config__pole_pairs": 0}, r"would turn by inf turns"),
        ({"volts": 3.0}, r"its supply is at 3\.0 V"),
        ({"load": 3.0}, "its motors move on their own"),
    ],
)
def test_a_board_that_is_not_set_up_or_does_not_stand_still_is_refused(
    settings: dict[str, float], says: str
) -> None:
    board = BankBoard(**{name: v for name, v in settings.items() if "__" in name})
    board.bank.supply(FIRST >> 1, settings.get("volts", 48.0))
    if "load" in settings:  # a pendulum that was let go
        board.rotors.load[:], board.rotors.FRICTION = settings["load"], 1e-5
        board.rotors.pos = board.rotors.pos + 0.5
    before = board.table()
    with pytest.raises(DriveError, match=says):
        calibration.refuse_unfit(MODULE, board, AXES, board.pause)
    assert board.table() == before


def boards() -> dict[str, BoardInMemory]:
    """Return all six boards, zeroed at q = 0."""
    made = {module: BoardInMemory(as_wanted()) for module in MODULES}
    for n, board in enumerate(made.values()):
        board.serial_number = f"3A000000000{n + 1}"
    return made


def refusal(robot: RobotConfig, made: dict[str, BoardInMemory], module: str, run_dir: Path) -> str:
    """Return why a robot with these boards on USB is not calibrated at a module; "" if it is."""
    found = FoundBoards({b.serial_number: b for b in made.values()}, {}, ())
    try:
        calibration.refuse_standing(robot, run_dir, found, {module: AXES})
    except DriveError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("state", [AxisState.CLOSED_LOOP_CONTROL, AxisState.IDLE, None])
@pytest.mark.parametrize("on_usb", [True, False])
def test_a_robot_one_of_whose_drives_is_armed_is_refused_by_usb_or_by_can(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_usb: bool,
    state: int | None,
) -> None:  # fmt: skip
    made = boards()
    if on_usb:
        made[MODULE].readings["axis1.current_state"] = int(state or 0)
    else:
        del made[MODULE]
    beat = None if state is None else Heartbeat(0, state, *[False] * 3, trajectory_done=True)

    def listen(_: object, nodes: Sequence[int], **__: object) -> BusTraffic:
        return BusTraffic(nodes={node: NodeTraffic(heartbeat=beat) for node in nodes})

    monkeypatch.setattr(calibration.can_monitor, "listen", listen)
    armed = "knee_left is armed: the robot may be standing" in refusal(
        robot, made, "hip_right", tmp_path
    )
    assert armed == (state == AxisState.CLOSED_LOOP_CONTROL)


@pytest.mark.parametrize(("theta", "refused"), [(0.85, True), (-0.05, False), (None, False)])
def test_a_limp_leg_that_rests_on_something_is_refused_where_it_knows_its_angles(
    robot: RobotConfig, tmp_path: Path, theta: float | None, refused: bool
) -> None:
    made = boards()
    signs = robot.module_named("hip_left").motor_signs
    at = motor_from_joint((0.0, theta or 0.0), robot.joint.gear_ratio)
    for axis, sign, turns in zip(AXES, signs, at, strict=True):
        count = 0.3 if theta is None else sign * (turns + robot.drive.zero_mark_turns)
        made["hip_left"].readings[f"{axis}.encoder.pos_estimate"] = count
    why = refusal(robot, made, "hip_left", tmp_path)
    assert ("hip_left is limp at theta 0.85 rad" in why) == refused
    assert ("rests on something" in why) == refused
    assert refusal(robot, made, "hip_right", tmp_path) == ""


def test_whoever_says_no_has_nothing_calibrated(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = BankBoard()
    monkeypatch.setattr(calibration.drive_access, "confirm", lambda *_, **__: False)
    monkeypatch.setattr(calibration, "_await_still", lambda *_: "")
    code = calibration.calibrate(
        Console(quiet=True), robot, {MODULE: (board, AXES)}, Interrupts(),
        yes=False, check=lambda: None,
    )  # fmt: skip
    assert (code, board.restarts) == (DECLINED_EXIT_CODE, 0)


def test_a_board_that_is_unplugged_meanwhile_does_not_stop_the_others(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = BankBoard(), BankBoard()
    monkeypatch.setattr(calibration, "_await_still", lambda *_: "")

    def calibrate(board: BankBoard, *_: object) -> BoardResult:
        if board is first:
            raise DriveError("ODrive 3A: read: no answer")
        return BoardResult({"axis0": Found(0.1, 4e-5, -1)})

    monkeypatch.setattr(calibration, "calibrate_board", calibrate)
    code = calibration.calibrate(
        Console(), robot, {MODULE: (first, AXES), "hip_left": (second, AXES)}, Interrupts(),
        yes=True, check=lambda: None,
    )  # fmt: skip
    said = " ".join(capsys.readouterr().out.split())
    assert code == FAULT_EXIT_CODE
    assert "knee_left: ODrive 3A: read: no answer" in said
    assert "then switch its supply off and on" in said
    assert "unzeroed: hip_left; next, run `xrl drive zero" in said
    assert "direction is -1: swap two of the motor's phases" in said
    assert said.endswith("not calibrated: knee_left")


@pytest.mark.parametrize(
    "axes",
    [
        {2: (10.0, EncoderError.CPR_POLEPAIRS_MISMATCH), 6: (15.0, EncoderError.NONE)},
        pytest.param({2: (15.0, EncoderError.NONE)}, marks=pytest.mark.wide),
        pytest.param({4: (15.0, EncoderError.NONE)}, marks=pytest.mark.wide),
    ],
    ids=["knee on its stop, 10 A; light foot, 15 A", "knee, 15 A", "hip, 15 A"],
)
def test_a_hanging_leg_of_the_realistic_robot_wants_more_current_than_as_shipped(
    robot: RobotConfig, axes: dict[int, tuple[float, EncoderError]]
) -> None:
    hung = HungRobot(robot, plant_from(["realistic"]))
    bank = hung.bank
    for axis, (amperes, _) in axes.items():
        name = f"axis{axis % 2}.motor.config.calibration_current"
        bank.settings.set(axis // 2, name, amperes)
        bank.request_state(axis, AxisState.ENCODER_OFFSET_CALIBRATION)
    hung.wait(9.1)
    for axis, (_, error) in axes.items():
        assert (bank.state[axis], bank.faults[axis].encoder) == (AxisState.IDLE, error)
        assert bank.settings.axis("encoder.config.direction")[axis] == 1.0
