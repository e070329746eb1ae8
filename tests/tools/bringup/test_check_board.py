"""What the doctor says of a board, by what the board says of itself."""

from __future__ import annotations

import msgspec
import pytest

from shared.can.cansimple import AxisError, AxisState, MotorError
from shared.can.drive_settings import of_module
from shared.config.robot_config import RobotConfig
from tests.tools.bringup.board_in_memory import as_wanted, healthy
from tools.bringup import check_board
from tools.bringup.boards import Value
from tools.bringup.rows import Finding, FindingKind

MODULE = "knee_left"


def bad(rows: list[Finding]) -> list[tuple[str, str, FindingKind]]:
    return [(row.subject, row.what, row.verdict) for row in rows if row.verdict != FindingKind.OK]


def settings_rows(robot: RobotConfig, **changes: Value) -> list[Finding]:
    return check_board.settings_rows(MODULE, of_module(robot, MODULE), as_wanted() | changes)


def test_settings_as_wanted_are_one_row(robot: RobotConfig) -> None:
    (row,) = settings_rows(robot)
    assert row.verdict is FindingKind.OK
    assert row.found == f"{len(of_module(robot, MODULE))} as wanted"


def test_each_wrong_setting_has_its_own_row_with_both_values_and_the_command(
    robot: RobotConfig,
) -> None:
    changes: dict[str, Value] = {
        "axis0.controller.config.vel_limit": 2.0,
        "axis1.config.can.encoder_rate_ms": 10,
        "config.dc_max_negative_current": -0.01,
    }
    rows = settings_rows(robot, **changes)
    assert sorted(bad(rows)) == [
        (MODULE, "config.dc_max_negative_current", FindingKind.WRONG),
        (f"{MODULE}.axis0", "controller.config.vel_limit", FindingKind.WRONG),
        (f"{MODULE}.axis1", "config.can.encoder_rate_ms", FindingKind.WRONG),
    ]
    row = next(row for row in rows if row.what.endswith("vel_limit"))
    assert (row.found, row.wanted) == ("2", "60")
    assert "xrl drive configure --apply --module knee_left" in row.fix
    assert "OVERSPEED" in row.why


def test_a_setting_that_this_firmware_does_not_have_is_a_warning(robot: RobotConfig) -> None:
    values = as_wanted()
    del values["axis0.config.can.heartbeat_rate_ms"]
    rows = check_board.settings_rows(MODULE, of_module(robot, MODULE), values)
    assert bad(rows) == [(f"{MODULE}.axis0", "config.can.heartbeat_rate_ms", FindingKind.WARNING)]


def test_a_missing_calibration_is_not_a_matter_of_writing_settings(robot: RobotConfig) -> None:
    rows = settings_rows(robot, **{"axis1.encoder.config.pre_calibrated": False})
    (row,) = [row for row in rows if row.verdict is FindingKind.WRONG]
    assert "CALIBRATION" in row.fix


@pytest.mark.parametrize(
    ("firmware", "verdict"),
    [
        ((0, 5, 6), FindingKind.OK),
        ((0, 5, 4), FindingKind.WARNING),
        ((0, 5, 1), FindingKind.WRONG),
        ((0, 6, 10), FindingKind.WRONG),
        ((0, 4, 12), FindingKind.WRONG),
    ],
)
def test_the_firmware_is_judged_by_whether_its_settings_are_known(
    firmware: tuple[int, int, int], verdict: FindingKind
) -> None:
    assert check_board.firmware_row(MODULE, firmware).verdict is verdict


@pytest.mark.parametrize(
    ("driver", "direction", "calibrated", "verdicts"),
    [
        ("odrive_can", 1, True, [FindingKind.OK]),
        ("odrive_can", -1, True, [FindingKind.WRONG]),
        ("odrive_can", 0, True, [FindingKind.WRONG]),
        ("odrive_can", -1, False, []),
        ("odrive_usb", 1, True, [FindingKind.OK]),
        ("odrive_usb", -1, True, [FindingKind.OK]),
        ("odrive_usb", 0, True, [FindingKind.WRONG]),
    ],
)
def test_over_can_currents_must_count_as_the_encoders_do(
    robot: RobotConfig, driver: str, direction: int, calibrated: bool, verdicts: list[FindingKind]
) -> None:
    service = msgspec.structs.replace(robot.joint_service, driver=driver)
    values = healthy() | {
        "axis1.encoder.config.direction": direction,
        "axis1.encoder.is_ready": calibrated,
    }
    rows = check_board.direction_rows(
        MODULE, values, msgspec.structs.replace(robot, joint_service=service)
    )
    assert [(row.subject, row.verdict) for row in rows] == [
        (f"{MODULE}.axis1", verdict) for verdict in verdicts
    ]
    if verdicts == [FindingKind.WRONG]:
        assert ("two of the motor's phases" in rows[0].fix) == (direction == -1)
        assert "configure" not in rows[0].fix


def test_every_error_register_is_named_whichever_it_is_in() -> None:
    values = healthy() | {
        "axis0.motor.error": int(MotorError.DRV_FAULT) | 1 << 40,
        "axis1.controller.error": 1,
        "error": 4,
    }
    rows = check_board.error_rows(MODULE, values)
    found = {(row.subject, row.what): row.found for row in rows}
    assert found == {
        (MODULE, "error"): "DC_BUS_OVER_VOLTAGE",
        (f"{MODULE}.axis0", "motor.error"): "DRV_FAULT 0x10000000000",
        (f"{MODULE}.axis1", "controller.error"): "OVERSPEED",
    }
    assert {row.verdict for row in rows} == {FindingKind.WRONG}


def test_a_watchdog_that_ran_out_in_idle_is_no_fault() -> None:
    values = healthy() | {"axis0.error": int(AxisError.WATCHDOG_TIMER_EXPIRED)}
    assert bad(check_board.error_rows(MODULE, values)) == []


@pytest.mark.parametrize(
    ("volts", "verdict"),
    [
        (0.3, FindingKind.WRONG),
        (8.0, FindingKind.WRONG),
        (8.1, FindingKind.OK),
        (56.0, FindingKind.OK),
        (57.5, FindingKind.WARNING),
        (60.0, FindingKind.WRONG),
    ],
)
def test_the_supply_is_between_the_boards_own_trip_levels(
    volts: float, verdict: FindingKind
) -> None:
    values = healthy() | {"vbus_voltage": volts}
    rows = check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False)
    assert next(row for row in rows if row.what == "supply").verdict is verdict


@pytest.mark.parametrize(
    ("celsius", "verdict"),
    [(25.0, FindingKind.OK), (85.0, FindingKind.WARNING), (-60.0, FindingKind.WARNING),
     (float("nan"), FindingKind.WARNING)],
)  # fmt: skip
def test_a_hot_output_stage_or_a_broken_thermistor_is_named(
    celsius: float, verdict: FindingKind
) -> None:
    values = healthy() | {"axis1.motor.fet_thermistor.temperature": celsius}
    rows = check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False)
    (row,) = [row for row in rows if row.what == "temperature"]
    assert (row.subject, row.verdict) == (f"{MODULE}.axis1", verdict)


@pytest.mark.parametrize(
    ("enabled", "armed", "expected"),
    [(True, True, [FindingKind.OK]), (True, False, [FindingKind.WRONG]), (False, False, [])],
)
def test_a_brake_resistor_that_is_fitted_must_be_armed(
    enabled: bool, armed: bool, expected: list[FindingKind]
) -> None:
    values = healthy() | {
        "config.enable_brake_resistor": enabled,
        "brake_resistor_armed": armed,
    }
    rows = check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False)
    assert [row.verdict for row in rows if row.what == "brake resistor"] == expected


@pytest.mark.parametrize("part", ["motor.is_calibrated", "encoder.is_ready"])
def test_an_axis_that_is_not_calibrated_is_wrong(part: str) -> None:
    values = healthy() | {f"axis1.{part}": False}
    rows = check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False)
    assert bad(rows) == [(f"{MODULE}.axis1", "calibrated", FindingKind.WRONG)]


@pytest.mark.parametrize(
    ("state", "services_up", "verdict"),
    [
        (AxisState.IDLE, False, FindingKind.OK),
        (AxisState.IDLE, True, FindingKind.OK),
        (AxisState.CLOSED_LOOP_CONTROL, True, FindingKind.OK),
        (AxisState.CLOSED_LOOP_CONTROL, False, FindingKind.WARNING),
        (AxisState.MOTOR_CALIBRATION, True, FindingKind.WARNING),
        (99, False, FindingKind.WARNING),
    ],
)
def test_an_armed_axis_is_right_only_where_a_service_has_it(
    state: int, services_up: bool, verdict: FindingKind
) -> None:
    assert check_board.state_row(MODULE, state, services_up=services_up).verdict is verdict


def test_a_motor_that_counts_from_power_up_has_no_zero_and_no_angle(robot: RobotConfig) -> None:
    (row,) = check_board.position_rows(MODULE, (64.0, 0.7), robot)
    assert (row.what, row.verdict) == ("zero", FindingKind.WRONG)
    assert "xrl drive zero knee_left" in row.fix


def test_without_a_mark_any_position_counts(robot: RobotConfig) -> None:
    drive = msgspec.structs.replace(robot.drive, zero_mark_turns=0.0)
    plain = msgspec.structs.replace(robot, drive=drive)
    theta_turns = -1.0 * robot.joint.gear_ratio / 6.283185307179586
    assert bad(check_board.position_rows(MODULE, (theta_turns, theta_turns), plain)) == []


@pytest.mark.parametrize(
    ("phi", "theta", "wrong"), [(0.0, -1.0, []), (0.0, 0.0, ["theta"]), (0.7, -1.0, ["phi"])]
)
def test_an_angle_outside_of_its_limits_is_named(
    robot: RobotConfig, phi: float, theta: float, wrong: list[str]
) -> None:
    per_rad = robot.joint.gear_ratio / 6.283185307179586
    mark = robot.drive.zero_mark_turns
    turns = (mark + (theta + phi) * per_rad, mark + (theta - phi) * per_rad)
    rows = check_board.position_rows(MODULE, turns, robot)
    assert [row.subject for row in rows if row.verdict is FindingKind.WRONG] == [
        f"{MODULE}.{axis}" for axis in wrong
    ]
