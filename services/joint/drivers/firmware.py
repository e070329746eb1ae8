"""Reports of an ODrive's two axes over CANSimple, for firmware 0.5 and 0.6. Pure.

Firmware 0.5 and 0.6 share setpoints, gains, limits, estimates and the axis state in byte 4 of a
heartbeat. They differ in the other bytes and in the error numbers. The firmware is detected, not
configured:

- 0.6 answers a request for its version (0x000); on 0.5, the same frame feeds the watchdog.
- Byte 7 of a heartbeat is reserved in 0.6; 0.5 sets its top bit while no trajectory runs.
- Byte 5 is a flag in 0.5 and a procedure result in 0.6, so a value above 1 shows 0.6.
- A drive that leaves `UNANSWERED` requests without an answer counts as 0.5. If it is 0.6 after all,
its heartbeats look like errors, and its next answer corrects that.

The opposite mistake would be dangerous: a byte 5 that means "busy" in 0.6 means in 0.5 that the
motor failed. So a drive counts as 0.6 only on evidence.
"""

from __future__ import annotations

from typing import Final, Literal

from shared.bus.messages import DriveStatus
from shared.can import cansimple, cansimple_06
from shared.can.cansimple import AxisError, AxisState
from shared.can.cansimple_06 import DriveError06, ProcedureResult

Dialect = Literal["", "0.5", "0.6"]
"""The firmware's generation; "" while it is not known."""

HEARTBEAT_BYTES: Final = 8
VERSION_BYTES: Final = 8
UNANSWERED: Final = 10
"""Number of unanswered version requests after which a drive counts as 0.5. One is sent for each
heartbeat that does not show the firmware; it is unlikely that all of them are lost."""

OTHER_ERROR: Final = 0x8000_0000
"""An error without a name in `AxisError`, or of a drive whose dialect is not known yet."""

_UNHEARD: Final = -1
_FINE: Final = (ProcedureResult.SUCCESS, ProcedureResult.BUSY, ProcedureResult.CANCELLED)

_FROM_06: Final[tuple[tuple[DriveError06, int], ...]] = (
    (DriveError06.INITIALIZING, AxisError.INVALID_STATE),
    (DriveError06.SYSTEM_LEVEL, AxisError.MOTOR_FAILED),
    (DriveError06.TIMING_ERROR, AxisError.MOTOR_FAILED),
    (DriveError06.MISSING_ESTIMATE, AxisError.ENCODER_FAILED),
    (DriveError06.BAD_CONFIG, AxisError.CONTROLLER_FAILED),
    (DriveError06.DRV_FAULT, AxisError.MOTOR_FAILED),
    (DriveError06.MISSING_INPUT, AxisError.CONTROLLER_FAILED),
    (DriveError06.DC_BUS_OVER_VOLTAGE, AxisError.MOTOR_FAILED),
    (DriveError06.DC_BUS_UNDER_VOLTAGE, AxisError.MOTOR_FAILED),
    (DriveError06.DC_BUS_OVER_CURRENT, AxisError.MOTOR_FAILED),
    (DriveError06.DC_BUS_OVER_REGEN_CURRENT, AxisError.MOTOR_FAILED),
    (DriveError06.CURRENT_LIMIT_VIOLATION, AxisError.MOTOR_FAILED),
    (DriveError06.MOTOR_OVER_TEMP, AxisError.OVER_TEMP),
    (DriveError06.INVERTER_OVER_TEMP, AxisError.OVER_TEMP),
    (DriveError06.VELOCITY_LIMIT_VIOLATION, AxisError.CONTROLLER_FAILED),
    (DriveError06.POSITION_LIMIT_VIOLATION, AxisError.CONTROLLER_FAILED),
    (DriveError06.REQUESTED_CURRENT_TOO_HIGH, AxisError.CONTROLLER_FAILED),
    (DriveError06.WATCHDOG_TIMER_EXPIRED, AxisError.WATCHDOG_TIMER_EXPIRED),
    (DriveError06.ESTOP_REQUESTED, AxisError.ESTOP_REQUESTED),
    (DriveError06.SPINOUT_DETECTED, AxisError.CONTROLLER_FAILED),
    (DriveError06.BRAKE_RESISTOR_DISARMED, AxisError.MOTOR_FAILED),
    (DriveError06.THERMISTOR_DISCONNECTED, AxisError.OVER_TEMP),
    (DriveError06.CALIBRATION_ERROR, AxisError.ENCODER_FAILED),
)
_NAMED_06: Final = sum(error for error, _ in _FROM_06)


def errors_from_06(errors: int) -> int:
    """Return 0.6's errors as `AxisError` bits; an error without a counterpart as `OTHER_ERROR`."""
    if not errors:
        return 0
    found = OTHER_ERROR if errors & ~_NAMED_06 else 0
    for error, axis_error in _FROM_06:
        if errors & error:
            found |= axis_error
    return int(found)


def dialect_of(heartbeat: bytes) -> Dialect:
    """Return the dialect of a heartbeat; "" if either firmware could have sent it."""
    if heartbeat[7]:
        return "0.5"
    return "0.6" if heartbeat[5] > 1 else ""


def judged(dialect: Dialect, heartbeat: bytes, *, wanted_armed: bool) -> tuple[int, int]:
    """Return an axis's state and its errors, `AxisError` bits and `OTHER_ERROR`.

    If an axis is outside closed loop and was not requested to enter it, an expired watchdog is no
    error: nothing has been written yet. While the dialect is unknown, every possible error counts.

    Args:
        dialect: the firmware's generation.
        heartbeat: its eight bytes.
        wanted_armed: True if closed loop was requested, and IDLE has not been since.
    """
    state = heartbeat[4]
    closed = state == AxisState.CLOSED_LOOP_CONTROL
    if dialect == "":
        # In closed loop, bytes 5 and 6 are not errors in either: an axis with an error disarms.
        suspect = any(heartbeat[:4]) or (not closed and any(heartbeat[5:]))
        return state, OTHER_ERROR if suspect else 0
    if dialect == "0.5":
        errors = int(cansimple.unpack_heartbeat(heartbeat).errors)
    else:
        fields = cansimple_06.unpack_heartbeat(heartbeat)
        errors = errors_from_06(fields.axis_error)
        if wanted_armed and not closed and fields.procedure_result not in _FINE:
            errors |= AxisError.INVALID_STATE  # requested, and refused or ended
    if not closed and not wanted_armed:
        errors &= ~AxisError.WATCHDOG_TIMER_EXPIRED
    return state, int(errors)


class AxesReport:
    """Reports of both axes, and the module's status from them.

    An axis that was armed and is no longer in closed loop is an error even without an error
    bit, in either dialect. Both axes of an ODrive have the same firmware.

    Attributes:
        dialect: "" until it is known.
        status: from the last heartbeats.
    """

    def __init__(self) -> None:
        self.dialect: Dialect = ""
        self.status = DriveStatus.LOST
        self._wanted_armed = False
        self._unanswered = 0
        self._heartbeats: list[bytes | None] = [None, None]
        self._states = [_UNHEARD, _UNHEARD]
        self._errors = [0, 0]
        self._was_armed = [False, False]

    @property
    def errors(self) -> int:
        """Errors of both axes, or-ed: `AxisError` bits and `OTHER_ERROR`."""
        return self._errors[0] | self._errors[1]

    def forget(self) -> None:
        """Forget both axes' reports, because the drive may be another one."""
        self.dialect = ""
        self._unanswered = 0
        self._discard_reports()
        self.status = DriveStatus.LOST

    def requested(self, *, armed: bool) -> None:
        """Start over: closed loop or IDLE was requested, and heartbeats will show the outcome."""
        self._wanted_armed = armed
        self._discard_reports()
        self._errors = [0, 0]
        self._was_armed = [False, False]
        self.status = DriveStatus.IDLE

    def receive(self, axis: int, heartbeat: bytes) -> None:
        """Process a heartbeat of axis 0 or 1, and update the status."""
        self._heartbeats[axis] = heartbeat
        if self.dialect == "":
            self._unanswered += 1
            found = dialect_of(heartbeat)
            if found == "" and self._unanswered > UNANSWERED:
                found = "0.5"
            if found:
                self._learn(found)
                return
        self._take(axis, heartbeat)
        self._judge()

    def receive_version(self) -> None:
        """Process an answer to 0x000, and judge earlier heartbeats again if needed."""
        if self.dialect != "0.6":
            self._learn("0.6")

    def _learn(self, dialect: Dialect) -> None:
        self.dialect = dialect
        for axis, heartbeat in enumerate(self._heartbeats):
            if heartbeat is not None:
                self._take(axis, heartbeat)
        self._judge()

    def _take(self, axis: int, heartbeat: bytes) -> None:
        state, errors = judged(self.dialect, heartbeat, wanted_armed=self._wanted_armed)
        self._states[axis], self._errors[axis] = state, errors
        self._was_armed[axis] |= state == AxisState.CLOSED_LOOP_CONTROL

    def _judge(self) -> None:
        states = self._states
        left = any(
            was and state not in (AxisState.CLOSED_LOOP_CONTROL, _UNHEARD)
            for was, state in zip(self._was_armed, states, strict=True)
        )
        if left or any(self._errors):
            self.status = DriveStatus.ERROR
        elif _UNHEARD not in states:
            closed = all(state == AxisState.CLOSED_LOOP_CONTROL for state in states)
            self.status = DriveStatus.ARMED if closed else DriveStatus.IDLE

    def _discard_reports(self) -> None:
        self._heartbeats = [None, None]
        self._states = [_UNHEARD, _UNHEARD]
