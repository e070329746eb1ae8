"""What an ODrive's registers say of a module."""

from __future__ import annotations

import pytest

from services.joint.drivers.axes_status import AxesStatus
from services.joint.drivers.base import DriveStatus
from shared.can.cansimple import AxisError, AxisState

IDLE, CLOSED = AxisState.IDLE, AxisState.CLOSED_LOOP_CONTROL
NONE = (0,) * 8


@pytest.mark.parametrize(
    ("states", "status"),
    [
        ((IDLE, IDLE), DriveStatus.IDLE),
        ((CLOSED, IDLE), DriveStatus.IDLE),
        ((IDLE, CLOSED), DriveStatus.IDLE),
        ((CLOSED, CLOSED), DriveStatus.ARMED),
    ],
)
def test_a_module_is_armed_when_both_axes_are(states: tuple[int, int], status: DriveStatus) -> None:
    assert AxesStatus().judge(states, 0) is status


@pytest.mark.parametrize("left", [(IDLE, CLOSED), (CLOSED, IDLE), (IDLE, IDLE)])
def test_an_axis_that_left_closed_loop_without_an_error_is_an_error(
    left: tuple[int, int],
) -> None:
    axes = AxesStatus()
    axes.judge((CLOSED, CLOSED), 0)
    assert axes.judge(left, 0) is DriveStatus.ERROR
    assert axes.judge((CLOSED, CLOSED), 0) is DriveStatus.ARMED


def test_an_error_bit_is_an_error_in_any_state() -> None:
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
    registers = list(NONE)
    registers[first + register] = value
    assert AxesStatus.errors(registers, wanted_armed=True) == error


@pytest.mark.parametrize(("wanted_armed", "seen"), [(True, True), (False, False)])
def test_a_watchdog_that_ran_out_counts_only_where_the_drive_was_to_be_armed(
    wanted_armed: bool, seen: bool
) -> None:
    registers = [AxisError.WATCHDOG_TIMER_EXPIRED, *NONE[1:]]
    assert bool(AxesStatus.errors(registers, wanted_armed=wanted_armed)) == seen
