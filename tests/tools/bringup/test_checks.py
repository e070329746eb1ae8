"""What the doctor says of boards, buses and sensors: one base of claims, one row for each fault."""

from __future__ import annotations

import errno
import io
import math
import os
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from shared.can.cansimple import AxisError, AxisState, Heartbeat, MotorError
from shared.can.cansimple_06 import Version
from shared.can.drive_settings import AXES, of_module
from shared.can.sensor_frames import ImuSample
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from shared.joints import MODULES
from tests.tools.bringup.board_in_memory import as_wanted, healthy, with_driver
from tools.bringup import can_monitor, check_board
from tools.bringup.boards import Value
from tools.bringup.can_monitor import BusTraffic, NodeTraffic, SensorTraffic
from tools.bringup.findings import (
    Finding,
    FindingKind,
    Report,
    merged,
    ok,
    report_of,
    show,
    verdict_line,
    warning,
    wrong,
)
from tools.terminal import Console

OK = FindingKind.OK
MODULE, NODES = "knee_left", (8, 9)
AXIS0, AXIS1 = f"{MODULE}.axis0", f"{MODULE}.axis1"
FITTED, ARMED = "config.enable_brake_resistor", "brake_resistor_armed"
VOLTS, DEGREES = "vbus_voltage", "axis1.motor.fet_thermistor.temperature"
PRE_CALIBRATED = "encoder.config.pre_calibrated"
DIRECTION = "encoder.config.direction"
POLES, POLES_NAME = "axis0.motor.config.pole_pairs", "motor.config.pole_pairs"
OHM, PHASE = "axis1.motor.config.phase_resistance", "motor.config.phase_resistance"
IDLE = Heartbeat(0, AxisState.IDLE, False, False, False, True)
FAILED = IDLE._replace(motor_failed=True)
Rows = Callable[[RobotConfig], list[Finding]]
Changes = dict[str, dict[str, Value]]


def bad(rows: list[Finding]) -> list[str]:
    """Return "subject: matter: verdict" of the rows that are not ok."""
    return sorted(f"{row.subject}: {row.what}: {row.verdict}" for row in rows if row.verdict != OK)


# ---- how the rows of each subject come about


def board(change: dict[str, Value], *, lacks: str = "", driver: str = "odrive_can") -> Rows:
    """Return the rows of a board as wanted, but for a change, and a setting that it lacks."""
    values = as_wanted() | healthy() | change
    values.pop(lacks, None)
    return lambda robot: [
        *check_board.settings_rows(MODULE, of_module(robot, MODULE), values),
        *check_board.direction_rows(MODULE, values, with_driver(robot, driver)),
        *check_board.error_rows(MODULE, values),
        *check_board.condition_rows(MODULE, values, (8.0, 59.92), services_up=False),
    ]


def counts(direction: int, driver: str, *, calibrated: bool = True) -> Rows:
    """Return the rows of a board whose second axis counts its currents this way."""
    change = {f"axis1.{DIRECTION}": direction, "axis1.encoder.is_ready": calibrated}
    rows = board(change, driver=driver)
    return lambda robot: [row for row in rows(robot) if row.what == DIRECTION]


def state(number: int, *, services_up: bool) -> Rows:
    return lambda _: [check_board.state_row(MODULE, number, services_up=services_up)]


def firmware(*version: int) -> Rows:
    return lambda _: [check_board.firmware_row(MODULE, version)]  # type: ignore[arg-type]


def position(phi: float, theta: float, mark: float = 64.0) -> Rows:
    """Return the rows of a zeroed joint at these angles, rad."""

    def rows(robot: RobotConfig) -> list[Finding]:
        per_rad = robot.joint.gear_ratio / math.tau
        turns = (mark + (theta + phi) * per_rad, mark + (theta - phi) * per_rad)
        drive = msgspec.structs.replace(robot.drive, zero_mark_turns=mark)
        marked = msgspec.structs.replace(robot, drive=drive)
        return check_board.position_rows(MODULE, turns, marked)

    return rows


def boards(changes: Changes) -> Changes:
    own = {POLES: 7, VOLTS: 48.0}
    return {
        module: as_wanted() | healthy() | own | {OHM: 0.1 + 0.001 * i} | changes.get(module, {})
        for i, module in enumerate(MODULES)
    }


def alike(changes: Changes) -> Rows:
    return lambda _: check_board.alike_rows(boards(changes))


def times(period_s: float, n: int = 40) -> list[float]:
    return [period_s * i for i in range(n)]


def axis(heartbeat: Heartbeat = IDLE, encoder_s: float = 0.002, **more: Any) -> NodeTraffic:
    given: dict[str, Any] = {"estimates_s": times(encoder_s), "pos_turns": 64.0, **more}
    return NodeTraffic(heartbeat, times(0.02, 10), **given)


def twice(apart_s: float) -> NodeTraffic:
    both = sorted(t + late for t in times(0.02, 25) for late in (0.0, apart_s))
    # the first and the last gap are long ones: so is then the median of 1 and 19 ms
    return NodeTraffic(IDLE, both[1:-1], times(0.002), pos_turns=64.0)


def traffic(**changes: NodeTraffic) -> BusTraffic:
    nodes = {8: axis(), 9: axis()} | {int(name[4:]): node for name, node in changes.items()}
    return BusTraffic(seconds=0.5, frames=600, nodes=nodes)


def bus(heard: BusTraffic) -> Rows:
    return lambda robot: can_monitor.drive_rows(robot, MODULE, heard, services_up=False)


def closed(interface: str, trouble: str) -> Rows:
    """Return the row of a bus that cannot be opened."""

    def rows(robot: RobotConfig) -> list[Finding]:
        can = {name: CanConfig(interface=interface, channel="can7") for name in robot.can}
        return bus(BusTraffic(trouble=trouble))(msgspec.structs.replace(robot, can=can))

    return rows


def cells(rate_hz: float = 250.0, force: float = 20.0, malformed: int = 0) -> Rows:
    sample = (force, 0.0, 0.0, 0.0, 0.0, -force)
    heard = SensorTraffic([sample] * 50, times(1.0 / rate_hz, 50))
    whole = BusTraffic(seconds=50 / rate_hz, cells=heard, malformed=malformed)
    return lambda robot: can_monitor.harness_rows(robot, whole)


def imu(*, valid: bool = True, period_s: float = 0.01) -> Rows:
    sample = ImuSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), valid)
    heard = BusTraffic(frames=150, imu=SensorTraffic([sample] * 50, times(period_s, 50)))
    return lambda robot: can_monitor.imu_rows(robot, heard)


def no_sensor(judge: Callable[[RobotConfig, BusTraffic], list[Finding]], **heard: Any) -> Rows:
    return lambda robot: judge(robot, BusTraffic(**heard))


NEW = axis(FAILED, version=Version(2, (4, 4, 58), (0, 6, 10), 0))
STRANGERS = BusTraffic(nodes={8: NodeTraffic(), 9: NodeTraffic(), 0: axis(), 1: axis()})
NO_CAN = f"[Errno {errno.EAFNOSUPPORT}] {os.strerror(errno.EAFNOSUPPORT)}"
HARNESS, IMU = can_monitor.harness_rows, can_monitor.imu_rows
OWN: Changes = {
    module: {
        "axis0.config.can.node_id": 2 * i, "axis0.encoder.config.phase_offset": 1000 * i,
        "axis0.controller.config.vel_gain": 0.1 * i, "axis0.encoder.pos_estimate": 64.0 + i,
    }
    for i, module in enumerate(MODULES)
}  # fmt: skip

CASES: dict[str, tuple[Rows, list[str], tuple[str, ...]]] = {
    # a board: settings, calibration, errors, supply
    "a board as wanted": (board({}), [], ()),
    "each wrong setting has its own row": (
        board({"axis0.controller.config.vel_limit": 2.0, "axis1.config.can.encoder_rate_ms": 10,
               "config.dc_max_negative_current": -0.01}),
        [f"{MODULE}: config.dc_max_negative_current: wrong",
         f"{AXIS0}: controller.config.vel_limit: wrong",
         f"{AXIS1}: config.can.encoder_rate_ms: wrong"],
        ("'2'", "'60'", "xrl drive configure --apply --module knee_left", "OVERSPEED"),
    ),
    "a setting that this firmware lacks": (
        board({}, lacks="axis0.config.can.heartbeat_rate_ms"),
        [f"{AXIS0}: config.can.heartbeat_rate_ms: warning"], ("firmware",),
    ),
    "a missing calibration is no setting to write": (
        board({f"axis1.{PRE_CALIBRATED}": False}),
        [f"{AXIS1}: {PRE_CALIBRATED}: wrong"], ("--calibrate",),
    ),
    "an error in whichever register, unknown bits in hex": (
        board({"axis0.motor.error": int(MotorError.DRV_FAULT) | 1 << 40,
               "axis1.controller.error": 1, "error": 4}),
        [f"{MODULE}: error: wrong", f"{AXIS0}: motor.error: wrong",
         f"{AXIS1}: controller.error: wrong"],
        ("DC_BUS_OVER_VOLTAGE", "DRV_FAULT 0x10000000000"),
    ),
    "a watchdog that ran out in idle": (
        board({"axis0.error": int(AxisError.WATCHDOG_TIMER_EXPIRED)}), [], ()
    ),
    "no supply": (board({VOLTS: 0.3}), [f"{MODULE}: supply: wrong"], ()),
    "a supply at the lower trip level": (board({VOLTS: 8.0}), [f"{MODULE}: supply: wrong"], ()),
    "a supply above it": (board({VOLTS: 8.1}), [], ()),
    "a supply with room above": (board({VOLTS: 56.0}), [], ()),
    "a supply without": (board({VOLTS: 57.5}), [f"{MODULE}: supply: warning"], ()),
    "a supply at the upper trip level": (board({VOLTS: 60.0}), [f"{MODULE}: supply: wrong"], ()),
    "a cool output stage": (board({DEGREES: 25.0}), [], ()),
    **{
        f"an output stage at {celsius} C": (
            board({DEGREES: celsius}), [f"{AXIS1}: temperature: warning"], ()
        )
        for celsius in (85.0, -60.0, math.nan)
    },
    "an armed resistor": (board({FITTED: True, ARMED: True}), [], ()),
    "no resistor": (board({FITTED: False, ARMED: False}), [], ()),
    "a disarmed resistor": (
        board({FITTED: True, ARMED: False}), [f"{MODULE}: brake resistor: wrong"], ()
    ),
    "a raw motor": (
        board({"axis1.motor.is_calibrated": False}), [f"{AXIS1}: calibrated: wrong"], ()
    ),
    "a raw encoder": (
        board({"axis1.encoder.is_ready": False}), [f"{AXIS1}: calibrated: wrong"], ()
    ),
    # which way currents count: CAN does not tell
    "currents as the encoder, CAN": (counts(1, "odrive_can"), [], ()),
    "currents against it, CAN": (
        counts(-1, "odrive_can"), [f"{AXIS1}: {DIRECTION}: wrong"], ("two of the motor's phases",)
    ),
    "no direction, CAN": (
        counts(0, "odrive_can"), [f"{AXIS1}: {DIRECTION}: wrong"], ("--calibrate",)
    ),
    "not calibrated, CAN": (counts(-1, "odrive_can", calibrated=False), [], ()),
    "currents against it, USB": (counts(-1, "odrive_usb"), [], ()),
    "no direction, USB": (counts(0, "odrive_usb"), [f"{AXIS1}: {DIRECTION}: wrong"], ()),
    # states and firmware
    "idle": (state(AxisState.IDLE, services_up=False), [], ()),
    "armed by its service": (state(AxisState.CLOSED_LOOP_CONTROL, services_up=True), [], ()),
    "armed by nobody": (
        state(AxisState.CLOSED_LOOP_CONTROL, services_up=False), [f"{MODULE}: state: warning"], ()
    ),
    "calibrating beside a service": (
        state(AxisState.MOTOR_CALIBRATION, services_up=True), [f"{MODULE}: state: warning"], ()
    ),
    "a state that is not known": (state(99, services_up=False), [f"{MODULE}: state: warning"], ()),
    "firmware 0.5.6": (firmware(0, 5, 6), [], ()),
    "firmware 0.5.4": (firmware(0, 5, 4), [f"{MODULE}: firmware: warning"], ()),
    **{
        f"firmware {version}": (firmware(*version), [f"{MODULE}: firmware: wrong"], ())
        for version in ((0, 5, 1), (0, 6, 10), (0, 4, 12))
    },
    # where the joint is
    "inside its limits": (position(0.0, -1.0), [], ()),
    "theta outside": (position(0.0, 0.0), [f"{MODULE}.theta: angle: wrong"], ()),
    "phi outside": (position(0.7, -1.0), [f"{MODULE}.phi: angle: wrong"], ()),
    "without a mark any position counts": (position(0.0, -1.0, mark=0.0), [], ()),
    "a motor that counts from power-up": (
        lambda robot: check_board.position_rows(MODULE, (64.0, 0.7), robot),
        [f"{MODULE}: zero: wrong"], ("xrl drive zero knee_left",),
    ),
    # boards beside each other
    "six boards alike": (alike({}), [], ()),
    "the one that differs": (
        alike({"knee_left": {POLES: 20}}), [f"{AXIS0}: {POLES_NAME}: warning"],
        ("'20'", "7, as 5 others"),
    ),
    "half against half": (alike({module: {POLES: 20} for module in MODULES[:3]}), [], ()),
    "what belongs to one board": (alike(OWN), [], ()),
    "a phase within its tolerance": (alike({"ankle_left": {OHM: 0.125}}), [], ()),
    "a loose phase": (alike({MODULE: {OHM: 0.2}}), [f"{AXIS1}: {PHASE}: warning"], ()),
    "another motor": (alike({MODULE: {OHM: 0.05}}), [f"{AXIS1}: {PHASE}: warning"], ()),
    "no resistance": (alike({MODULE: {OHM: 0.0}}), [f"{AXIS1}: {PHASE}: wrong"], ()),
    "one not calibrated yet": (
        alike({MODULE: {OHM: 0.0, "axis1.motor.is_calibrated": False}}), [], ()
    ),
    "a bad plug": (alike({MODULE: {VOLTS: 46.5}}), [f"{MODULE}: supply: warning"], ()),
    # a bus
    "both axes at their periods": (bus(traffic()), [], ()),
    "an encoder at its factory period": (
        bus(traffic(node8=axis(encoder_s=0.01))), [f"{AXIS0}: encoder frames: warning"],
        ("10.0 ms", "2 ms", "encoder_rate_ms"),
    ),
    "no encoder frames": (
        bus(traffic(node9=axis(estimates_s=[]))), [f"{AXIS1}: encoder frames: wrong"], ()
    ),
    "no heartbeat": (bus(traffic(node9=NodeTraffic())), [f"{AXIS1}: heartbeat: wrong"], ()),
    "others on a silent bus": (
        bus(STRANGERS), [f"{MODULE}: heartbeats: wrong"],
        ("heartbeats come from other nodes (0, 1)",)
    ),
    "a failed motor though the axis error is 0": (
        bus(traffic(node8=axis(FAILED))), [f"{AXIS0}: errors: wrong"], ("MOTOR_FAILED",)
    ),
    "firmware 0.6, whose heartbeats are not taken for errors": (
        bus(traffic(node8=NEW)), [f"{AXIS0}: firmware: warning"], ()
    ),
    **{
        f"two axes under one node id, {apart_s} s apart": (
            bus(traffic(node8=twice(apart_s))), [f"{AXIS0}: heartbeat: warning"],
            ("the same node id",),
        )
        for apart_s in (0.001, 0.005, 0.010)
    },
    "a simulator's bus that is not there": (
        closed("xrl_unix", "no such device"), [f"{MODULE}: CAN bus: wrong"], ("simulator",)
    ),
    "an interface that is not there": (
        closed("socketcan", "no such device"), [f"{MODULE}: CAN bus: wrong"],
        ("ip link set can7 up",),
    ),
    "a kernel without CAN": (
        closed("socketcan", NO_CAN), [f"{MODULE}: CAN bus: wrong"], ("modprobe can_raw",)
    ),
    # load cells and IMU: rate, range, their own flags
    "load cells": (cells(), [], ()),
    "slow load cells": (cells(rate_hz=100.0), ["harness: load cells: warning"], ()),
    "a cell at its end": (cells(force=1500.0), ["harness: largest force: wrong"], ()),
    "a cell that is none": (cells(force=math.nan), ["harness: largest force: wrong"], ()),
    "cells out of order": (cells(malformed=3), ["harness: frames out of order: warning"], ("3",)),
    "no load cells": (
        no_sensor(HARNESS, seconds=0.5, frames=3), ["harness: load cells: wrong"], ()
    ),
    "no bus of the harness": (no_sensor(HARNESS, trouble="gone"), ["harness: CAN bus: wrong"], ()),
    "an IMU": (imu(), [], ()),
    "a slow IMU": (imu(period_s=0.02), ["IMU: samples: warning"], ()),
    "an IMU that has not settled": (imu(valid=False), ["IMU: orientation valid: wrong"], ()),
    "no IMU": (no_sensor(IMU, frames=7), ["IMU: samples: wrong"], ()),
    "no bus of the IMU": (no_sensor(IMU, trouble="no such device"), ["IMU: CAN bus: wrong"], ()),
}  # fmt: skip
"""Of each fault the rows that are not ok, and words that they must say."""


@pytest.mark.parametrize(("rows_of", "expected", "words"), CASES.values(), ids=CASES.keys())
def test_what_is_not_right_is_named_and_nothing_else(
    robot: RobotConfig, rows_of: Rows, expected: list[str], words: tuple[str, ...]
) -> None:
    rows = rows_of(robot)
    assert bad(rows) == sorted(expected)
    told = " ".join(str(row) for row in rows if row.verdict != OK)
    assert [word for word in words if word not in told] == []
    assert all(row.fix for row in rows if row.verdict != OK)


def test_what_is_right_is_few_rows_and_two_boards_prove_nothing(robot: RobotConfig) -> None:
    (row,) = check_board.settings_rows(MODULE, of_module(robot, MODULE), as_wanted())
    assert row.found == f"{len(of_module(robot, MODULE))} as wanted"
    (row,) = check_board.alike_rows(boards({}))
    assert (row.verdict, row.subject) == (OK, "all 6")
    assert check_board.alike_rows(dict(list(boards({}).items())[:2])) == []
    six = boards({})
    del six["hip_right"][POLES]
    assert bad(check_board.alike_rows(six)) == [f"hip_right.axis0: {POLES_NAME}: warning"]
    assert len(bus(traffic())(robot)) == 8


@pytest.mark.parametrize(
    ("answered", "turns"),
    [({}, None), ({"shadow_count": 64 * 16384}, 64.0), ({"version": NEW.version}, 0.0)],
    ids=["nothing", "a count", "firmware 0.6"],
)
def test_an_estimate_of_0_is_believed_of_new_firmware_only(
    robot: RobotConfig, answered: dict[str, Any], turns: float | None
) -> None:
    """On a full machine the count's answer came too late, and a zero was called lost."""
    heard = traffic(axis9=NodeTraffic(IDLE, pos_turns=0.0, **answered))
    found = can_monitor.positions(robot, MODULE, heard)
    assert found == (None if turns is None else (64.0, turns))


# ---- rows put together, one line for all, nothing lost on a narrow terminal

ALL_AXES = [f"{module}.{axis}" for module in MODULES for axis in AXES]
FINE = [ok(f"m{i}", "supply", f"{volts:.1f} V", "8 to 60 V") for i, volts in enumerate((9.5, 48.0))]
NOTED = warning("robot file", "assumed", "14 [assumed]", "none", "measure them")


def trap(subject: str, what: str = "controller.config.vel_limit", wanted: str = "60") -> Finding:
    fix = f"`xrl drive configure --apply --module {subject.partition('.')[0]}`"
    return wrong(subject, what, "2", wanted, fix, "it disarms")


TRAP = trap("knee_left.axis0")
MANY = [trap(f"bus{i}", "speed") for i in range(8)]


def printed(rows: list[Finding], width: int = 80, *, verbose: bool = False) -> str:
    text = io.StringIO()
    show(Console(file=text, width=width), {"drives": rows}, verbose=verbose)
    return " ".join(text.getvalue().split())


@pytest.mark.parametrize(
    ("rows", "subjects", "fix"),
    [
        pytest.param([trap(axis) for axis in ALL_AXES], ["all 12"], "--apply`",
                     id="all twelve axes: one command for all"),
        pytest.param([trap("hip_left.axis0"), trap("knee_left.axis0"), trap("knee_left.axis1")],
                     ["hip_left.axis0", "knee_left, both"], "--module knee_left`",
                     id="both axes of one board: its command"),
        pytest.param([trap(module, "can.config.baud_rate") for module in MODULES], ["all 6"],
                     "--apply`", id="all six boards"),
        pytest.param([trap(module) for module in MODULES[:5]], list(MODULES[:5]),
                     f"--module {MODULES[4]}`", id="five are not all"),
        pytest.param([trap(axis, wanted=axis.partition(".")[0]) for axis in ALL_AXES],
                     [f"{module}, both" for module in MODULES], f"--module {MODULES[5]}`",
                     id="values wanted of one module only are not put together"),
    ],
)  # fmt: skip
def test_rows_of_one_matter_are_as_few_as_can_stand_for_it(
    rows: list[Finding], subjects: list[str], fix: str
) -> None:
    assert [row.subject for row in merged(rows)] == subjects
    assert merged(rows)[-1].fix.endswith(fix)
    assert len(report_of({"drives": rows}).groups["drives"]) == len(rows), "machines get every row"
    row, *others = merged([*FINE, TRAP, NOTED])
    assert (row.subject, row.found, row.wanted) == ("all 2", "9.5 V .. 48.0 V", "8 to 60 V")
    assert others == [TRAP, NOTED]


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        (FINE, "all ok"),
        ([*FINE, NOTED], "nothing wrong; 1 warning: robot file assumed"),
        ([TRAP], "1 wrong: knee_left.axis0 vel_limit"),
        ([TRAP, NOTED], "1 wrong: knee_left.axis0 vel_limit; 1 warning: robot file assumed"),
        (MANY, "8 wrong: " + ", ".join(f"bus{i} speed" for i in range(6)) + " and 2 more"),
        ([trap(axis) for axis in ALL_AXES], "12 wrong: all 12 vel_limit"),
    ],
)
def test_the_last_line_is_the_answer(rows: list[Finding], line: str) -> None:
    assert verdict_line({"drives": rows}) == line
    assert printed(rows).endswith(line)


@pytest.mark.parametrize("width", [80, 109, 110, 120])
def test_name_values_reason_and_command_are_printed_whatever_the_width(width: int) -> None:
    text = printed([TRAP, NOTED], width)
    for words in ("knee_left.axis0", "vel_limit", "it disarms", "wrong", "warning", "14 [assumed]"):
        assert words in text
    assert "xrl drive configure" in text
    shared = printed([wrong(f"can{i}", "interface", "none", "up", "plug it in") for i in range(3)])
    assert shared.count("plug it in") == 1
    fine = printed(FINE, width, verbose=True)
    assert ("m0" in fine, "m1" in fine, "all 2" in fine) == (True, True, False)


def test_in_a_pipe_a_note_is_not_padded_to_its_width() -> None:
    """`xrl doctor | cat` wrote lines of 10 000 columns."""
    text = io.StringIO()
    show(Console(file=text), {"drives": [TRAP]}, verbose=False)
    assert max(map(len, text.getvalue().splitlines())) < 200


def test_the_report_counts_and_reads_back_from_its_json() -> None:
    report = report_of({"drives": [*FINE, TRAP, NOTED]})
    assert (report.ok, report.wrong, report.warnings) == (False, 1, 1)
    assert msgspec.json.decode(msgspec.json.encode(report), type=Report) == report
    assert report_of({"drives": [*FINE, NOTED]}).ok
