"""Calibration of the emulated axes: what each has, and the sequences that calibrate.

The shaft is not turned here. An encoder's calibration fails if the shaft moves by itself, as under
a load: the firmware finds that it did not follow.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from services.simulator.drives.axis_faults import AxisErrors
from services.simulator.drives.axis_settings import Settings
from shared.can.cansimple import AxisError, AxisState, EncoderError
from shared.joints import N_JOINTS

SLIP: Final = 0.05
"""turn; a shaft that moves further by itself fails the encoder's calibration."""
MOTOR_S: Final = 3.0
ENCODER_S: Final = 8.0

SEQUENCES: Final = {
    AxisState.FULL_CALIBRATION_SEQUENCE: (
        AxisState.MOTOR_CALIBRATION,
        AxisState.ENCODER_OFFSET_CALIBRATION,
    ),
    AxisState.MOTOR_CALIBRATION: (AxisState.MOTOR_CALIBRATION,),
    AxisState.ENCODER_OFFSET_CALIBRATION: (AxisState.ENCODER_OFFSET_CALIBRATION,),
}
"""The states that each request runs through."""


class _Task(NamedTuple):
    """What an axis is at, since when it may end, and what comes after."""

    state: AxisState
    until_s: float
    start_turns: float
    rest: tuple[AxisState, ...]


class Calibration:
    """Which axes are calibrated, and which are at it."""

    def __init__(self, settings: Settings) -> None:
        """Start with what is `pre_calibrated`."""
        self._settings = settings
        self.motor = [False] * N_JOINTS
        """`motor.is_calibrated`"""
        self.encoder = [False] * N_JOINTS
        """`encoder.is_ready`"""
        self.running: dict[int, _Task] = {}
        for axis in range(N_JOINTS):
            self.restart(axis)

    def restart(self, axis: int) -> None:
        """Reset an axis's calibration to what its settings keep."""
        column = self._settings.axis
        self.motor[axis] = bool(column("motor.config.pre_calibrated")[axis])
        self.encoder[axis] = bool(column("encoder.config.pre_calibrated")[axis])
        self.stop(axis)

    def stop(self, axis: int) -> None:
        """Break off what an axis is at."""
        self.running.pop(axis, None)

    def ready(self, axis: int) -> bool:
        """Return True if closed loop may be entered."""
        return self.motor[axis] and self.encoder[axis]

    def begin(
        self, axis: int, states: tuple[AxisState, ...], now_s: float, turns: float
    ) -> AxisState | AxisErrors:
        """Begin the first of the states; return it, IDLE if there is none, or why not."""
        self.stop(axis)
        if not states:
            return AxisState.IDLE
        state, *rest = states
        of_encoder = state == AxisState.ENCODER_OFFSET_CALIBRATION
        if of_encoder and not self.motor[axis]:
            return AxisErrors(AxisError.INVALID_STATE)
        duration_s = ENCODER_S if of_encoder else MOTOR_S
        self.running[axis] = _Task(state, now_s + duration_s, turns, tuple(rest))
        return state

    def advance(self, axis: int, now_s: float, turns: float) -> AxisState | AxisErrors:
        """Go on with what an axis is at; return its state, or why it failed."""
        task = self.running[axis]
        of_encoder = task.state == AxisState.ENCODER_OFFSET_CALIBRATION
        if of_encoder and abs(turns - task.start_turns) > SLIP:
            failed = AxisError.ENCODER_FAILED
            return AxisErrors(failed, encoder=EncoderError.CPR_POLEPAIRS_MISMATCH)
        if now_s < task.until_s:
            return task.state
        (self.encoder if of_encoder else self.motor)[axis] = True
        return self.begin(axis, task.rest, now_s, turns)
