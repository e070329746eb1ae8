"""Status of a module from the registers of its ODrive's two axes. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from services.joint.drivers.base import DriveStatus
from shared.can.cansimple import AxisError, AxisState, Heartbeat


class AxesStatus:
    """Judges both axes, and remembers which were armed: one that left closed loop is an error."""

    def __init__(self) -> None:
        """Begin after a request to arm or idle: neither axis has been armed since."""
        self._was_armed = [False, False]

    def judge(self, states: Sequence[int], errors: int) -> DriveStatus:
        """Return the status by `current_state` of both axes and `errors`.

        An axis that left closed loop is an error even without an error bit: OVERSPEED
        leaves `axis.error` at 0.
        """
        closed = [state == AxisState.CLOSED_LOOP_CONTROL for state in states]
        both = list(zip(self._was_armed, closed, strict=True))
        self._was_armed = [was or now for was, now in both]
        if errors or any(was and not now for was, now in both):
            return DriveStatus.ERROR
        return DriveStatus.ARMED if all(closed) else DriveStatus.IDLE

    @staticmethod
    def errors(registers: Sequence[int], *, wanted_armed: bool) -> int:
        """Return `AxisError` bits of (axis, motor, encoder, controller) of axis0, then axis1.

        A watchdog that ran out in IDLE only shows that nothing was written yet, and is no error.
        """
        errors = 0
        for i in (0, 4):
            axis, motor, encoder, controller = registers[i : i + 4]
            errors |= Heartbeat(
                axis, 0, motor != 0, encoder != 0, controller != 0, trajectory_done=True
            ).errors
        return int(errors if wanted_armed else errors & ~AxisError.WATCHDOG_TIMER_EXPIRED)
