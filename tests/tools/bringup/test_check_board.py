"""What the doctor says of a board, by what the board says of itself."""

from __future__ import annotations

import math

import msgspec
import pytest

from shared.can.cansimple import AxisError, AxisState, MotorError
from shared.can.drive_settings import of_module
from shared.config.robot_config import RobotConfig
from tests.tools.bringup.board_in_memory import as_wanted, healthy, with_driver
from tests.tools.bringup.verdicts import OK, WARNING, WRONG, bad
from tools.bringup import check_board
from tools.bringup.boards import Value
from tools.bringup.findings import Finding, FindingKind

MODULE = "knee_left"
AXIS0, AXIS1 = f"{MODULE}.axis0", f"{MODULE}.axis1"
FITTED, ARMED = "config.enable_brake_resistor", "brake_resistor_armed"
VOLTS, DEGREES = "vbus_voltage", "axis1.motor.fet_thermistor.temperature"
PRE_CALIBRATED = "axis1.encoder.config.pre_calibrated"
DIRECTION = "encoder.config.direction"


def rows_of(
    robot: RobotConfig, change: dict[str, Value], *, lacks: str = "", driver: str = "odrive_can"
) -> list[Finding]:
    """Return all rows of a board as wanted, but for a change, and a setting that it lacks."""
    values = as_wanted() | healthy() | change
    values.pop(lacks, None)
    return [
        *check_board.settings_rows(MODULE, of_module(robot, MODULE), values),
        *check_board.direction_rows(MODULE, values, with_driver(robot, driver)),
        *check_board.error_rows(MODULE, values),
        *check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False),
    ]


CASES: dict[str, tuple[dict[str, Value], list[str]]] = {
    "a board as wanted": ({}, []),
    "each wrong setting has its own row": (
        {"axis0.controller.config.vel_limit": 2.0, "axis1.config.can.encoder_rate_ms": 10,
         "config.dc_max_negative_current": -0.01},
        [f"{MODULE}: config.dc_max_negative_current: wrong",
         f"{AXIS0}: controller.config.vel_limit: wrong",
         f"{AXIS1}: config.can.encoder_rate_ms: wrong"],
    ),
    "a missing calibration": (
        {PRE_CALIBRATED: False}, [f"{AXIS1}: encoder.config.pre_calibrated: wrong"]
    ),
    "an error in whichever register": (
        {"axis0.motor.error": 1 << 3, "axis1.controller.error": 1, "error": 4},
        [f"{MODULE}: error: wrong", f"{AXIS0}: motor.error: wrong",
         f"{AXIS1}: controller.error: wrong"],
    ),
    "a watchdog that ran out in idle": (
        {"axis0.error": int(AxisError.WATCHDOG_TIMER_EXPIRED)}, []
    ),
    "no supply": ({VOLTS: 0.3}, [f"{MODULE}: supply: wrong"]),
    "a supply at the lower trip level": ({VOLTS: 8.0}, [f"{MODULE}: supply: wrong"]),
    "a supply above it": ({VOLTS: 8.1}, []),
    "a supply with room above": ({VOLTS: 56.0}, []),
    "a supply without": ({VOLTS: 57.5}, [f"{MODULE}: supply: warning"]),
    "a supply at the upper trip level": ({VOLTS: 60.0}, [f"{MODULE}: supply: wrong"]),
    "a cool output stage": ({DEGREES: 25.0}, []),
    "a hot one": ({DEGREES: 85.0}, [f"{AXIS1}: temperature: warning"]),
    "a broken thermistor": ({DEGREES: -60.0}, [f"{AXIS1}: temperature: warning"]),
    "a thermistor that is none": ({DEGREES: math.nan}, [f"{AXIS1}: temperature: warning"]),
    "an armed resistor": ({FITTED: True, ARMED: True}, []),
    "no resistor": ({FITTED: False, ARMED: False}, []),
    "a disarmed resistor": ({FITTED: True, ARMED: False}, [f"{MODULE}: brake resistor: wrong"]),
    "a raw motor": ({"axis1.motor.is_calibrated": False}, [f"{AXIS1}: calibrated: wrong"]),
    "a raw encoder": ({"axis1.encoder.is_ready": False}, [f"{AXIS1}: calibrated: wrong"]),
}  # fmt: skip
"""What a board says otherwise than one as wanted, and the rows that follow."""


@pytest.mark.parametrize(("change", "expected"), CASES.values(), ids=CASES.keys())
def test_what_is_not_right_with_a_board_is_named(
    robot: RobotConfig, change: dict[str, Value], expected: list[str]
) -> None:
    assert sorted(bad(rows_of(robot, change))) == sorted(expected)


def test_settings_as_wanted_are_one_row(robot: RobotConfig) -> None:
    (row,) = check_board.settings_rows(MODULE, of_module(robot, MODULE), as_wanted())
    assert row.found == f"{len(of_module(robot, MODULE))} as wanted"


def test_a_wrong_setting_has_both_values_the_command_and_the_reason(robot: RobotConfig) -> None:
    name = "controller.config.vel_limit"
    (row,) = [r for r in rows_of(robot, {f"axis0.{name}": 2.0}) if r.what == name]
    assert (row.found, row.wanted) == ("2", "60")
    assert "xrl drive configure --apply --module knee_left" in row.fix
    assert "OVERSPEED" in row.why


def test_a_setting_that_this_firmware_does_not_have_is_a_warning(robot: RobotConfig) -> None:
    name = "config.can.heartbeat_rate_ms"
    assert bad(rows_of(robot, {}, lacks=f"axis0.{name}")) == [f"{AXIS0}: {name}: warning"]


def test_a_missing_calibration_is_not_a_matter_of_writing_settings(robot: RobotConfig) -> None:
    rows = rows_of(robot, {PRE_CALIBRATED: False})
    assert all("--calibrate" in row.fix for row in rows if row.verdict is WRONG)


def test_an_error_is_named_as_its_firmware_names_it_and_unknown_bits_in_hex() -> None:
    registers = {"axis0.motor.error": int(MotorError.DRV_FAULT) | 1 << 40, "error": 4}
    rows = check_board.error_rows(MODULE, healthy() | registers)
    assert {row.found for row in rows} == {"DC_BUS_OVER_VOLTAGE", "DRV_FAULT 0x10000000000"}


@pytest.mark.parametrize(
    ("firmware", "verdict"),
    [
        ((0, 5, 6), OK), ((0, 5, 4), WARNING), ((0, 5, 1), WRONG), ((0, 6, 10), WRONG),
        ((0, 4, 12), WRONG),
    ],
)  # fmt: skip
def test_the_firmware_is_judged_by_whether_its_settings_are_known(
    firmware: tuple[int, int, int], verdict: FindingKind
) -> None:
    assert check_board.firmware_row(MODULE, firmware).verdict is verdict


@pytest.mark.parametrize(
    ("driver", "direction", "calibrated", "verdicts"),
    [
        ("odrive_can", 1, True, [OK]), ("odrive_can", -1, True, [WRONG]),
        ("odrive_can", 0, True, [WRONG]), ("odrive_can", -1, False, []),
        ("odrive_usb", 1, True, [OK]), ("odrive_usb", -1, True, [OK]),
        ("odrive_usb", 0, True, [WRONG]),
    ],
)  # fmt: skip
def test_over_can_currents_must_count_as_the_encoders_do(
    robot: RobotConfig, driver: str, direction: int, calibrated: bool, verdicts: list[FindingKind]
) -> None:
    change = {f"axis1.{DIRECTION}": direction, "axis1.encoder.is_ready": calibrated}
    rows = [row for row in rows_of(robot, change, driver=driver) if row.what == DIRECTION]
    assert [(row.subject, row.verdict) for row in rows] == [(AXIS1, one) for one in verdicts]
    if verdicts == [WRONG]:
        assert ("two of the motor's phases" in rows[0].fix) == (direction == -1)
        assert ("--calibrate" in rows[0].fix) == (direction == 0)


@pytest.mark.parametrize(
    ("state", "services_up", "verdict"),
    [
        (AxisState.IDLE, False, OK), (AxisState.IDLE, True, OK),
        (AxisState.CLOSED_LOOP_CONTROL, True, OK), (AxisState.CLOSED_LOOP_CONTROL, False, WARNING),
        (AxisState.MOTOR_CALIBRATION, True, WARNING), (99, False, WARNING),
    ],
)  # fmt: skip
def test_an_armed_axis_is_right_only_where_a_service_has_it(
    state: int, services_up: bool, verdict: FindingKind
) -> None:
    assert check_board.state_row(MODULE, state, services_up=services_up).verdict is verdict


def test_a_motor_that_counts_from_power_up_has_no_zero_and_no_angle(robot: RobotConfig) -> None:
    (row,) = check_board.position_rows(MODULE, (64.0, 0.7), robot)
    assert (row.what, row.verdict) == ("zero", WRONG)
    assert "xrl drive zero knee_left" in row.fix


@pytest.mark.parametrize(
    ("mark", "phi", "theta", "wrong"),
    [
        (64.0, 0.0, -1.0, []), (64.0, 0.0, 0.0, ["theta"]), (64.0, 0.7, -1.0, ["phi"]),
        pytest.param(0.0, 0.0, -1.0, [], id="without a mark any position counts"),
    ],
)  # fmt: skip
def test_an_angle_outside_of_its_limits_is_named(
    robot: RobotConfig, mark: float, phi: float, theta: float, wrong: list[str]
) -> None:
    drive = msgspec.structs.replace(robot.drive, zero_mark_turns=mark)
    per_rad = robot.joint.gear_ratio / math.tau
    turns = (mark + (theta + phi) * per_rad, mark + (theta - phi) * per_rad)
    marked = msgspec.structs.replace(robot, drive=drive)
    rows = check_board.position_rows(MODULE, turns, marked)
    assert bad(rows) == [f"{MODULE}.{axis}: angle: wrong" for axis in wrong]
