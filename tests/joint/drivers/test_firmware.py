"""What a drive's registers and heartbeats say of a module, in either dialect of CANSimple."""

from __future__ import annotations

import pytest

from services.joint.drivers.firmware import (
    OTHER_ERROR,
    UNANSWERED,
    AxesReport,
    Dialect,
    dialect_of,
    errors_from_06,
    judged,
)
from services.joint.drivers.odrive_v3 import AxesStatus
from shared.bus.messages import DriveStatus
from shared.can import cansimple, cansimple_06
from shared.can.cansimple import AxisError, AxisState, Heartbeat
from shared.can.cansimple_06 import DriveError06, Heartbeat06, ProcedureResult

CLOSED, IDLE = AxisState.CLOSED_LOOP_CONTROL, AxisState.IDLE


def old(state: int, error: int = 0, *, motor: bool = False, done: bool = True) -> bytes:
    """Return a heartbeat of 0.5."""
    heartbeat = Heartbeat(error, state, motor, False, False, trajectory_done=done)
    return cansimple.pack_heartbeat(heartbeat)


def new(
    state: int, error: int = 0, result: int = ProcedureResult.SUCCESS, *, done: bool = True
) -> bytes:
    """Return a heartbeat of 0.6."""
    return cansimple_06.pack_heartbeat(Heartbeat06(error, state, result, trajectory_done=done))


def report_of(*pairs: tuple[int, bytes], armed: bool = False) -> AxesReport:
    report = AxesReport()
    report.requested(armed=armed)
    for axis, heartbeat in pairs:
        report.receive(axis, heartbeat)
    return report


@pytest.mark.parametrize(
    ("heartbeat", "dialect"),
    [
        (old(IDLE), "0.5"),
        (old(CLOSED), "0.5"),
        (old(IDLE, motor=True), "0.5"),
        (old(IDLE, done=False), ""),
        (old(IDLE, motor=True, done=False), ""),
        (new(IDLE), ""),
        (new(CLOSED, result=ProcedureResult.BUSY), ""),
        (new(IDLE, result=ProcedureResult.DISARMED), "0.6"),
        (new(IDLE, result=ProcedureResult.NOT_CALIBRATED, done=False), "0.6"),
    ],
)
def test_a_heartbeat_only_one_dialect_can_send_shows_it(heartbeat: bytes, dialect: Dialect) -> None:
    assert dialect_of(heartbeat) == dialect


def test_a_version_is_an_answer_of_0_6_and_no_reply_to_many_requests_counts_as_0_5() -> None:
    report = report_of((0, new(IDLE)))
    assert report.dialect == ""
    report.receive_version()
    assert report.dialect == "0.6"
    report = AxesReport()
    for _ in range(UNANSWERED):
        report.receive(0, old(IDLE, done=False))
        assert report.dialect == ""
    report.receive(1, old(IDLE, done=False))
    assert report.dialect == "0.5"


def test_0_6_taken_for_0_5_looks_like_an_error_until_its_answer_comes() -> None:
    report = AxesReport()
    busy = new(CLOSED, result=ProcedureResult.BUSY)
    for _ in range(UNANSWERED):
        for axis in (0, 1):
            report.receive(axis, busy)
    assert (report.dialect, report.status) == ("0.5", DriveStatus.ERROR)
    report.receive_version()  # and what was heard is judged again
    assert (report.dialect, report.status) == ("0.6", DriveStatus.ARMED)


def test_what_is_forgotten_is_found_out_anew() -> None:
    report = report_of((0, old(IDLE)), (1, old(IDLE)))
    report.forget()
    assert (report.dialect, report.status) == ("", DriveStatus.LOST)
    for axis in (0, 1):
        report.receive(axis, new(IDLE, DriveError06.DRV_FAULT, ProcedureResult.DISARMED))
    assert (report.dialect, report.status) == ("0.6", DriveStatus.ERROR)


@pytest.mark.parametrize("bit", range(32))
def test_no_error_of_0_6_looks_like_none(bit: int) -> None:
    assert errors_from_06(1 << bit) != 0
    report = report_of(
        (0, new(IDLE, 1 << bit, ProcedureResult.DISARMED)), (1, new(IDLE)), armed=True
    )
    assert report.dialect == "0.6"
    assert report.status is DriveStatus.ERROR
    assert report.errors != 0


def test_every_named_error_of_0_6_has_one_of_0_5() -> None:
    assert (errors_from_06(0), errors_from_06(0x8000_0000)) == (0, OTHER_ERROR)
    assert all(errors_from_06(error) < OTHER_ERROR for error in DriveError06)


def test_the_watchdog_has_its_own_bit_in_each_dialect_and_the_other_one_is_something_else() -> None:
    """Before anything was written, and armed is wanted, it is no error."""
    watchdog = AxisError.WATCHDOG_TIMER_EXPIRED
    found = new(IDLE, 0x0100_0000, ProcedureResult.DISARMED)
    for dialect, heartbeat in (("0.5", old(IDLE, 0x800)), ("0.6", found)):
        assert judged(dialect, heartbeat, wanted_armed=True)[1] & watchdog
        assert judged(dialect, heartbeat, wanted_armed=False) == (IDLE, 0)
    assert judged("0.5", old(IDLE, 0x800), wanted_armed=True) == (IDLE, watchdog)
    assert judged("0.6", new(IDLE, 0x0100_0000), wanted_armed=True) == (IDLE, watchdog)
    wrong = judged("0.6", new(IDLE, 0x800), wanted_armed=True)
    assert wrong == (IDLE, AxisError.MOTOR_FAILED)
    assert judged("0.5", old(IDLE, 0x0100_0000), wanted_armed=True)[1] != watchdog


def test_while_the_dialect_is_not_known_the_state_is_believed_and_any_error_is_one() -> None:
    """It has no name; a failed motor of 0.5 is one."""
    for error in (0x800, 0x0100_0000, 0x40, 1 << 31):
        for state in (IDLE, CLOSED):
            heartbeat = new(state, error)
            assert dialect_of(heartbeat) == ""
            assert judged("", heartbeat, wanted_armed=False) == (state, OTHER_ERROR)
    busy = new(CLOSED, result=ProcedureResult.BUSY)
    report = report_of((0, busy), (1, busy))
    assert (report.dialect, report.status, report.errors) == ("", DriveStatus.ARMED, 0)
    failed = old(IDLE, motor=True, done=False)
    assert report_of((0, failed), (1, old(IDLE, done=False))).status is DriveStatus.ERROR


@pytest.mark.parametrize("result", [ProcedureResult.NOT_CALIBRATED, ProcedureResult.INVALID_STATE])
def test_closed_loop_refused_by_0_6_is_an_error_if_asked_for(result: ProcedureResult) -> None:
    refused = new(IDLE, result=result)
    assert judged("0.6", refused, wanted_armed=True) == (IDLE, AxisError.INVALID_STATE)
    assert judged("0.6", refused, wanted_armed=False) == (IDLE, 0)


@pytest.mark.parametrize(
    ("closed", "left"),
    [
        (old(CLOSED), old(IDLE)),
        (old(CLOSED), old(AxisState.UNDEFINED)),
        (new(CLOSED, result=ProcedureResult.BUSY), new(IDLE)),
        (new(CLOSED, result=ProcedureResult.BUSY), new(AxisState.UNDEFINED)),
    ],
)
def test_leaving_closed_loop_without_an_error_is_one(closed: bytes, left: bytes) -> None:
    report = report_of((0, closed), (1, closed))
    statuses = [report.status]
    report.receive(1, left)
    statuses.append(report.status)
    assert statuses == [DriveStatus.ARMED, DriveStatus.ERROR]


# ---- what an ODrive's registers say


def test_a_module_is_armed_when_both_axes_are_without_an_error() -> None:
    for states in ((IDLE, IDLE), (CLOSED, IDLE), (IDLE, CLOSED), (CLOSED, CLOSED)):
        armed = states == (CLOSED, CLOSED)
        assert AxesStatus().judge(states, 0) is (DriveStatus.ARMED if armed else DriveStatus.IDLE)
    assert AxesStatus().judge((CLOSED, CLOSED), 1) is DriveStatus.ERROR


@pytest.mark.parametrize("first", [0, 4])
@pytest.mark.parametrize(
    ("register", "value", "error"),
    [
        (0, AxisError.OVER_TEMP, AxisError.OVER_TEMP),
        (1, 0x8, AxisError.MOTOR_FAILED),
        (1, 1 << 40, AxisError.MOTOR_FAILED),
        (2, 0x4, AxisError.ENCODER_FAILED),
        (3, 0x1, AxisError.CONTROLLER_FAILED),
    ],
)
def test_every_register_of_either_axis_shows(
    first: int, register: int, value: int, error: int
) -> None:
    registers = [0] * 8
    registers[first + register] = value
    assert AxesStatus.errors(registers, wanted_armed=True) == error
    registers = [AxisError.WATCHDOG_TIMER_EXPIRED, *[0] * 7]
    assert AxesStatus.errors(registers, wanted_armed=True)
    assert not AxesStatus.errors(registers, wanted_armed=False), "only where armed is wanted"
