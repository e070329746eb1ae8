"""Calibration of the emulated axes: its state and its procedures (docs/drives.md).

It emulates `Motor::run_calibration` and `Encoder::run_offset_calibration` of firmware 0.5.6. The
drive turns a field, and the rotor follows as in a synchronous motor, with a torque proportional to
the current and to the sine of the electrical lag. A shaft that is blocked, or loaded beyond that
torque, does not follow, and the drive detects that by its encoder's count.

Emulated traps: an encoder's calibration discards the turns when it starts. A request for IDLE in
the second part of the motor's calibration, or on the encoder's way back, leaves the axis calibrated
from half a measurement. If the current is not reached, the resistance is NaN, and
`save_configuration` stores it. With a latched error, nothing is measured and no error is added.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from services.simulator.drives.axis_encoders import AxisEncoders
from services.simulator.drives.axis_faults import AxisErrors, encoder_fault, motor_fault
from services.simulator.drives.axis_settings import (
    DIRECTION,
    PHASE_INDUCTANCE,
    PHASE_RESISTANCE,
    POLE_PAIRS,
    Settings,
)
from shared.can.cansimple import AxisError, AxisState, EncoderError, MotorError
from shared.joints import N_JOINTS

RESISTANCE_S: Final = 3.0
INDUCTANCE_S: Final = 1.25
"""Durations of the two parts of the motor's calibration, s."""
LOCK_S: Final = 1.0
"""Duration of the first part of the encoder's calibration, s: the field stands still, and its
current rises in the first half."""
RESPONSE_COUNTS: Final = 8
"""An encoder that moves by at most this many counts on the way out has not responded."""
VOLTAGE_GAIN: Final = 1.0
"""Rate of the test voltage, V/s, per A of missing test current."""
LEAD_S: Final = 0.0015
"""Delay of a torque in the world, s: a step holds it, and the current loop lags. The real field's
torque follows the angle at once. The emulation extrapolates the angle by this time, because a late
torque would shake the rotor out of step."""
BRAKING: Final = 0.05
"""Fraction of short-circuit braking that a current loop of 1000 rad/s leaves for a rotor that
oscillates at 30 Hz."""
CURRENT_MARGIN: Final = 8.0
"""Excess over `current_lim` at which the drive disarms, A; the firmware's default."""

SEQUENCES: Final = {
    AxisState.FULL_CALIBRATION_SEQUENCE: (
        AxisState.MOTOR_CALIBRATION,
        AxisState.ENCODER_OFFSET_CALIBRATION,
    ),
    AxisState.MOTOR_CALIBRATION: (AxisState.MOTOR_CALIBRATION,),
    AxisState.ENCODER_OFFSET_CALIBRATION: (AxisState.ENCODER_OFFSET_CALIBRATION,),
}
"""The states that each request runs through."""

_MOTOR: Final = AxisState.MOTOR_CALIBRATION
_ENCODER: Final = AxisState.ENCODER_OFFSET_CALIBRATION
_NONE: Final = AxisErrors()


class _Task(msgspec.Struct):
    """Running calibration of an axis."""

    state: AxisState
    rest: tuple[AxisState, ...]
    begun_s: float
    stage: int = 0
    """Motor: resistance, inductance. Encoder: lock, way out, way back."""
    current: float = 0.0
    """Current of the field, A."""
    phase: float = 0.0
    """Angle of the field, electrical rad."""
    count: int = 0
    """Count of the encoder."""
    locked_count: int = 0
    total: int = 0
    """Sum of counts over the scan's samples."""
    samples: int = 0


class Calibration:
    """Calibration state of all axes.

    Attributes:
        motor: `motor.is_calibrated` of each axis.
        encoder: `encoder.is_ready` of each axis.
        running: running calibrations, by axis.
        response: counts by which each encoder moved on its last way out; 0 before the first.
        resistance: true phase resistance of each motor, ohm; large for a broken wire.
    """

    def __init__(self, settings: Settings, encoders: AxisEncoders, torque_constant: float) -> None:
        """Start from the `pre_calibrated` settings; `torque_constant` is the motors', N m/A."""
        self._settings, self._encoders = settings, encoders
        self._torque_constant = torque_constant
        self.motor = [False] * N_JOINTS
        self.encoder = [False] * N_JOINTS
        self.running: dict[int, _Task] = {}
        self.response = [0.0] * N_JOINTS
        self.resistance = np.full(N_JOINTS, PHASE_RESISTANCE)
        for axis in range(N_JOINTS):
            self.restart(axis)

    def restart(self, axis: int) -> None:
        """Reset an axis's calibration to its `pre_calibrated` settings."""
        self.running.pop(axis, None)
        self.response[axis] = 0.0
        self.motor[axis] = self._setting(axis, "motor.config.pre_calibrated") > 0.0
        self.encoder[axis] = self._setting(axis, "encoder.config.pre_calibrated") > 0.0

    def take_mark(self, axis: int, name: str) -> None:
        """Apply a written `pre_calibrated`: a motor accepts it, an encoder only if it is ready.

        `name` is the setting's name below the axis.
        """
        if name == "motor.config.pre_calibrated":
            self.motor[axis] = self.motor[axis] or self._setting(axis, name) > 0.0
        elif not self.encoder[axis]:
            self._settings.find(axis, name, 0.0)

    def ready(self, axis: int) -> bool:
        """Return True if closed loop may be entered."""
        return self.motor[axis] and self.encoder[axis]

    def refuses(self, axis: int) -> bool:
        """Return True if closed loop is refused; without a ready encoder it starts, then ends."""
        return not self.motor[axis] or self._setting(axis, "encoder.config.direction") == 0.0

    def begin(
        self, axis: int, states: tuple[AxisState, ...], now_s: float, *, latched: bool = False
    ) -> AxisState | AxisErrors:
        """Start the first of the states; return it, IDLE if there are none, or the errors.

        A `latched` error disarms the axis in the first cycle.
        """
        if not states:
            return AxisState.IDLE
        state, *rest = states
        if state == _ENCODER and not self.motor[axis]:
            return AxisErrors(AxisError.INVALID_STATE)
        if state == _ENCODER:
            self._encoders.wrap_turns(axis)
        if latched:
            if state == _MOTOR:
                self._settings.find(axis, "motor.config.phase_resistance", 0.0)
            return AxisState.IDLE
        count = self._encoders.counted(axis)
        self.running[axis] = _Task(state, tuple(rest), now_s, count=count, locked_count=count)
        return state

    def advance(self, axis: int, now_s: float) -> AxisState | AxisErrors:
        """Advance an axis's calibration; return its state, or its errors."""
        task = self.running[axis]
        procedure = self._measure if task.state == _MOTOR else self._scan
        outcome = procedure(axis, task, now_s - task.begun_s)
        if outcome is None:
            return task.state
        del self.running[axis]
        return self.begin(axis, task.rest, now_s) if outcome == _NONE else outcome

    def stop(self, axis: int, *, requested: bool = False) -> AxisErrors:
        """Abort an axis's calibration; return the errors that the firmware reports for it.

        `requested` is True for a request for another state, False if the axis was disarmed.
        """
        task = self.running.pop(axis, None)
        if task is None:
            return _NONE
        if task.state == _MOTOR:
            if task.stage > 0:
                self._settings.find(axis, "motor.config.phase_inductance", PHASE_INDUCTANCE)
                self.motor[axis] = self.motor[axis] or requested
                return _NONE
            self._keep_resistance(axis, task)
            if requested:  # the inductance is not measured at all
                self._settings.find(axis, "motor.config.phase_inductance", math.nan)
                return AxisErrors(motor=MotorError.PHASE_INDUCTANCE_OUT_OF_RANGE)
            return _NONE
        if task.stage == 1 and (error := self._judge(axis, task)) != _NONE:
            return error
        if task.stage > 0 and requested:
            self._keep_offset(axis, task)
        return _NONE

    def torque(self, axis: int, pos_turns: float, vel_turns: float) -> float:
        """Return the torque on the shaft of an axis that calibrates, N m.

        The motor's calibration sets voltages, so its windings brake the rotor as if they were
        short-circuited. The encoder's calibration sets currents, whose loop reduces the braking to
        `BRAKING`. `pos_turns` and `vel_turns`, turn/s, are the rotor's true position and speed.
        """
        task, constant = self.running[axis], self._torque_constant
        ahead = pos_turns + LEAD_S * vel_turns
        rotor = 2.0 * math.pi * POLE_PAIRS * DIRECTION * ahead
        torque = DIRECTION * constant * task.current * math.sin(task.phase - rotor)
        braking = constant**2 / (1.5 * self.resistance[axis])
        braking *= 1.0 if task.state == _MOTOR else BRAKING
        return float(torque - braking * 2.0 * math.pi * vel_turns)

    # ---- procedures: they return None while running, then errors, or `_NONE` after success

    def _measure(self, axis: int, task: _Task, elapsed_s: float) -> AxisErrors | None:
        """Raise a direct current to its setpoint, then oscillate the current."""
        if task.stage == 0:
            ohm = float(self.resistance[axis])
            asked = self._setting(axis, "motor.config.calibration_current")
            task.current = -asked * math.expm1(-elapsed_s * VOLTAGE_GAIN / ohm)
            if error := self._too_much(axis, task.current):
                self._keep_resistance(axis, task)
                return error
            if ohm * task.current > self._setting(
                axis, "motor.config.resistance_calib_max_voltage"
            ):
                self._settings.find(axis, "motor.config.phase_resistance", math.nan)
                return motor_fault(MotorError.PHASE_RESISTANCE_OUT_OF_RANGE)
            if elapsed_s >= RESISTANCE_S:
                self._keep_resistance(axis, task)
                task.stage, task.current = 1, 0.0  # the oscillation has no torque
        elif elapsed_s >= RESISTANCE_S + INDUCTANCE_S:
            self._settings.find(axis, "motor.config.phase_inductance", PHASE_INDUCTANCE)
            self.motor[axis] = True
            return _NONE
        return None

    def _scan(self, axis: int, task: _Task, elapsed_s: float) -> AxisErrors | None:
        """Lock the rotor, turn it some electrical turns out, and back."""
        asked = self._setting(axis, "motor.config.calibration_current")
        task.current = asked * min(1.0, 2.0 * elapsed_s / LOCK_S)
        if error := self._too_much(axis, task.current):
            return error
        distance = self._setting(axis, "encoder.config.calib_scan_distance")
        rate = self._setting(axis, "encoder.config.calib_scan_omega")
        scanned = max(0.0, rate * (elapsed_s - LOCK_S))
        task.phase = -0.5 * distance + distance - abs(distance - min(scanned, 2.0 * distance))
        task.count = self._encoders.counted(axis)
        if task.stage == 0 and elapsed_s >= LOCK_S:
            task.stage, task.locked_count = 1, task.count
        elif task.stage == 1 and scanned >= distance:
            if (error := self._judge(axis, task)) != _NONE:
                return error
            task.stage = 2
        if task.stage > 0:
            task.total += task.count
            task.samples += 1
        if task.stage == 2 and scanned >= 2.0 * distance:
            self._keep_offset(axis, task)
            return _NONE
        return None

    def _judge(self, axis: int, task: _Task) -> AxisErrors:
        """Check the way out by the encoder's count, and find the direction."""
        response = task.count - task.locked_count
        if abs(response) <= RESPONSE_COUNTS:
            return encoder_fault(EncoderError.NO_RESPONSE)
        self._settings.find(axis, "encoder.config.direction", math.copysign(1.0, response))
        turns = self._setting(axis, "encoder.config.calib_scan_distance") / (
            2.0 * math.pi * self._setting(axis, "motor.config.pole_pairs")
        )
        expected = turns * self._setting(axis, "encoder.config.cpr")
        self.response[axis] = float(abs(response))
        within = self._setting(axis, "encoder.config.calib_range")
        if abs(abs(response) - expected) > within * expected:
            return encoder_fault(EncoderError.CPR_POLEPAIRS_MISMATCH)
        return _NONE

    def _too_much(self, axis: int, current: float) -> AxisErrors | None:
        if current <= self._setting(axis, "motor.config.current_lim") + CURRENT_MARGIN:
            return None
        return motor_fault(MotorError.CURRENT_LIMIT_VIOLATION)

    def _keep_resistance(self, axis: int, task: _Task) -> None:
        """Store the present voltage over the requested current, even if that is not reached."""
        volts = float(self.resistance[axis]) * task.current
        asked = self._setting(axis, "motor.config.calibration_current")
        self._settings.find(axis, "motor.config.phase_resistance", volts / asked)

    def _keep_offset(self, axis: int, task: _Task) -> None:
        """Store the scan's mean count as the electrical zero; the encoder is then ready."""
        mean = task.total // max(task.samples, 1)
        self._settings.find(axis, "encoder.config.phase_offset", float(mean))
        self.encoder[axis] = True

    def _setting(self, axis: int, name: str) -> float:
        return float(self._settings.axis(name)[axis])
