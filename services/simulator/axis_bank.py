"""Twelve emulated ODrive axes as arrays: the firmware's law, limits and traps.

Firmware 0.5.6 as design section 5 has it; the traps are kept on purpose: OVERSPEED disarms
in torque mode too, a disarmed axis floats while its sibling keeps its torque, the watchdog
runs in IDLE as well, re-arming does not zero `input_torque`, and OVERSPEED leaves
`axis_error` at 0 (it shows in the motor's and the controller's error).

Pure: no clock, no I/O. Axes 2i and 2i + 1 are axis0 and axis1 of module i, one ODrive.
Units at the motor: turns, turn/s, N m, A. The firmware runs its loop at 8 kHz; here it is
evaluated once a step, with filters discretised exactly for the step's length.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.cansimple import (
    AxisError,
    AxisState,
    ControllerError,
    ControlMode,
    EncoderError,
    Heartbeat,
    InputMode,
    MotorError,
)
from shared.config_sections import DriveConfig
from shared.exceptions import DriveError
from shared.joints import MODULES, N_JOINTS

Vector = NDArray[np.float64]

AXIS_NAMES: Final = tuple(f"{module}.axis{index}" for module in MODULES for index in (0, 1))
"""The 12 axes by name, in order."""

PLL_BANDWIDTH: Final = 1000.0
"""rad/s, `encoder.config.bandwidth`."""
VEL_LIMIT_TOLERANCE: Final = 1.2
"""`controller.config.vel_limit_tolerance`: OVERSPEED beyond this many times vel_limit."""
POS_GAIN: Final = 20.0
VEL_GAIN: Final = 1.0 / 6.0
VEL_INTEGRATOR_GAIN: Final = 1.0 / 3.0
FIRMWARE_RATE_HZ: Final = 8000.0
INTEGRATOR_DECAY: Final = 0.99
"""Per firmware cycle in which the torque is limited."""


class Fault(NamedTuple):
    """What a fault leaves in the four error registers of an axis."""

    axis: int = 0
    motor: int = 0
    encoder: int = 0
    controller: int = 0


FAULTS: Final = {
    "DISARM": Fault(),
    "OVERSPEED": Fault(motor=MotorError.CONTROLLER_FAILED, controller=ControllerError.OVERSPEED),
    "SPINOUT": Fault(
        motor=MotorError.CONTROLLER_FAILED, controller=ControllerError.SPINOUT_DETECTED
    ),
    "DRV_FAULT": Fault(AxisError.MOTOR_FAILED, motor=MotorError.DRV_FAULT),
    "REGENERATION": Fault(AxisError.MOTOR_FAILED, motor=MotorError.I_BUS_OUT_OF_RANGE),
    "ENCODER": Fault(AxisError.ENCODER_FAILED, encoder=EncoderError.NO_RESPONSE),
    "OVER_TEMP": Fault(AxisError.OVER_TEMP),
    "WATCHDOG": Fault(AxisError.WATCHDOG_TIMER_EXPIRED),
    "ESTOP": Fault(AxisError.ESTOP_REQUESTED),
}
"""Faults by name, for `AxisBank.inject`. DISARM is the silent one: IDLE and no error at all."""


class AxisBank:
    """State of all axes; every array is indexed by axis, shape (12,).

    The arrays without an underscore may be read at any time. `input_pos`, `input_vel`,
    `input_torque`, the gains and the limits may also be written between steps; modes,
    states and errors change by the methods only.
    """

    def __init__(
        self, drive: DriveConfig, *, encoder_counts_per_turn: int, watchdog: bool = True
    ) -> None:
        n = N_JOINTS
        self.state = [AxisState.IDLE] * n
        self.faults = [Fault()] * n
        self.control_mode = np.full(n, int(ControlMode.POSITION))
        self.input_mode = np.full(n, int(InputMode.PASSTHROUGH))
        self.input_pos = np.zeros(n)
        self.input_vel = np.zeros(n)
        self.input_torque = np.zeros(n)
        self.pos_gain = np.full(n, POS_GAIN)
        self.vel_gain = np.full(n, VEL_GAIN)
        self.vel_integrator_gain = np.full(n, VEL_INTEGRATOR_GAIN)
        self.vel_limit = np.full(n, drive.vel_limit)
        self.current_lim = np.full(n, drive.current_lim)
        self.enable_torque_mode_vel_limit = True
        self.pos_estimate = np.zeros(n)
        self.vel_estimate = np.zeros(n)
        self.torque = np.zeros(n)
        self.torque_constant = drive.torque_constant
        self.encoder_counts_per_turn = encoder_counts_per_turn
        self.watchdog_timeout_s = drive.watchdog_timeout if watchdog else math.inf
        self._armed = np.zeros(n)  # 1.0 in closed loop: also the factor of the torque
        self._integrator = np.zeros(n)
        self._fed_s = [0.0] * n
        self._now_s = -math.inf
        self._dt_s = 0.0
        self._pll = np.eye(2)
        self._pll_error = np.zeros((2, n))  # of position and velocity
        self._slope = np.zeros(n)
        self._regulates = np.ones(n)  # 1.0 in velocity and in position mode
        self._positions = np.ones(n)  # 1.0 in position mode
        self._any_regulates = True
        self._any_in_torque_mode = False

    def step(self, now_s: float, pos_turns: Vector, vel_turns: Vector) -> Vector:
        """Advance to `now_s`: true motor position and velocity in, motor torque out.

        The first call sets the clock, feeds the watchdogs and starts the estimators at
        the true values. The array returned is overwritten by the next step.
        """
        if self._now_s == -math.inf:
            self._start(now_s, pos_turns, vel_turns)
        else:
            dt_s = now_s - self._now_s
            self._now_s = now_s
            if dt_s > 0.0:
                self._estimate(dt_s, pos_turns)
        self._check()
        self._control()
        return self.torque

    def _start(self, now_s: float, pos_turns: Vector, vel_turns: Vector) -> None:
        """Take over the true state, as after a long time at rest."""
        self._now_s = now_s
        self._fed_s = [now_s] * N_JOINTS
        self._quantise(pos_turns)
        self._slope[:] = vel_turns
        self.vel_estimate[:] = vel_turns

    def _quantise(self, pos_turns: Vector) -> None:
        """Write the encoder's whole counts, in turns, to `pos_estimate`."""
        counts = self.pos_estimate
        np.multiply(pos_turns, self.encoder_counts_per_turn, out=counts)
        np.floor(counts, out=counts)
        counts /= self.encoder_counts_per_turn

    def _estimate(self, dt_s: float, pos_turns: Vector) -> None:
        """Run the encoder's PLL over the step, exactly for counts that ramp within it.

        The errors e = (count - position, slope - velocity) follow
        e' = [[-2w, 1], [-w^2, 0]] e, a double pole at the bandwidth w.
        """
        if dt_s != self._dt_s:
            w = PLL_BANDWIDTH * dt_s
            self._dt_s = dt_s
            self._pll = math.exp(-w) * np.array([[1.0 - w, dt_s], [-w * PLL_BANDWIDTH, 1.0 + w]])
        slope = self.pos_estimate.copy()
        self._quantise(pos_turns)
        np.subtract(self.pos_estimate, slope, out=slope)
        slope /= dt_s
        error = self._pll_error
        error[1] += slope
        error[1] -= self._slope
        self._pll_error = error = self._pll @ error
        self._slope = slope
        np.subtract(slope, error[1], out=self.vel_estimate)

    def _check(self) -> None:
        """Disarm what has gone too fast or has not been fed."""
        too_fast = np.abs(self.vel_estimate) > VEL_LIMIT_TOLERANCE * self.vel_limit
        if too_fast.any():
            for axis in np.flatnonzero(too_fast * self._armed).tolist():
                self._fail(axis, FAULTS["OVERSPEED"])
        starved_s = self._now_s - self.watchdog_timeout_s
        if min(self._fed_s) < starved_s:
            for axis, fed_s in enumerate(self._fed_s):
                if fed_s < starved_s:
                    self._fail(axis, FAULTS["WATCHDOG"])

    def _control(self) -> None:
        """Write the firmware's law to `torque`, zero where an axis is not in closed loop."""
        torque = self.torque
        torque[:] = self.input_torque
        torque_lim = self.current_lim * self.torque_constant
        if self._any_in_torque_mode and self.enable_torque_mode_vel_limit:
            self._limit_torque_mode()
        if self._any_regulates:
            self._regulate(torque_lim)
        np.minimum(torque, torque_lim, out=torque)
        np.maximum(torque, -torque_lim, out=torque)
        torque *= self._armed

    def _limit_torque_mode(self) -> None:
        """Let no axis in torque mode be driven beyond its velocity limit.

        The firmware clamps to vel_gain * (+-vel_limit - vel); here both sides have
        vel_gain * vel added, and it is taken off again.
        """
        at_limit = self.vel_gain * self.vel_limit
        moving = self.vel_gain * self.vel_estimate
        limited = self.torque + moving
        np.minimum(limited, at_limit, out=limited)
        np.maximum(limited, -at_limit, out=limited)
        limited -= moving
        if self._any_regulates:
            np.copyto(self.torque, limited, where=self._regulates == 0.0)
        else:
            self.torque[:] = limited

    def _regulate(self, torque_lim: Vector) -> None:
        """Add the velocity loop, under it the position loop, where the mode has them."""
        vel_des = self.input_pos - self.pos_estimate
        vel_des *= self.pos_gain
        vel_des *= self._positions
        vel_des += self.input_vel
        np.minimum(vel_des, self.vel_limit, out=vel_des)
        np.maximum(vel_des, -self.vel_limit, out=vel_des)
        v_err = vel_des
        v_err -= self.vel_estimate
        v_err *= self._regulates
        self.torque += self.vel_gain * v_err
        self.torque += self._integrator
        limited = np.abs(self.torque) > torque_lim
        v_err *= self.vel_integrator_gain
        v_err *= self._dt_s
        if limited.any():
            decay = INTEGRATOR_DECAY ** (FIRMWARE_RATE_HZ * self._dt_s)
            self._integrator[limited] *= decay
            v_err[limited] = 0.0
        self._integrator += v_err

    def feed(self, axis: int) -> None:
        """Feed an axis's watchdog: any CAN frame to it does."""
        self._fed_s[axis] = self._now_s

    def request_state(self, axis: int, state: int) -> None:
        """Ask for a state. The drive is calibrated, so only IDLE and CLOSED_LOOP_CONTROL exist.

        Closed loop with any error present is refused: the axis stays IDLE. Anything else
        is INVALID_STATE and leads to IDLE.
        """
        fault = self.faults[axis]
        self.faults[axis] = fault = fault._replace(axis=fault.axis & ~AxisError.INVALID_STATE)
        if state == AxisState.IDLE:
            self._disarm(axis)
        elif state == AxisState.CLOSED_LOOP_CONTROL:
            if fault == Fault():
                self._arm(axis)
        elif state != AxisState.UNDEFINED:
            self._fail(axis, Fault(AxisError.INVALID_STATE))

    def set_modes(self, axis: int, control_mode: int, input_mode: int) -> None:
        """Set the controller's modes; only PASSTHROUGH is emulated, others are an error."""
        if input_mode != InputMode.PASSTHROUGH or control_mode not in (1, 2, 3):
            self._fail(axis, Fault(controller=ControllerError.INVALID_INPUT_MODE))
            return
        self.control_mode[axis] = control_mode
        self.input_mode[axis] = input_mode
        self._regulates[axis] = control_mode >= ControlMode.VELOCITY
        self._positions[axis] = control_mode >= ControlMode.POSITION
        self._any_regulates = bool(self._regulates.any())
        self._any_in_torque_mode = not self._regulates.all()
        self._integrator[axis] = 0.0

    def clear_errors(self, axis: int) -> None:
        """Clear all errors of the axis's ODrive: the firmware clears both axes."""
        for each in _both(axis):
            self.faults[each] = Fault()

    def estop(self, axis: int) -> None:
        """Disarm one axis with ESTOP_REQUESTED; its sibling goes on."""
        self._fail(axis, FAULTS["ESTOP"])

    def reboot(self, axis: int) -> None:
        """Restart the axis's ODrive: both axes IDLE, inputs zero, errors gone."""
        for each in _both(axis):
            self._disarm(each)
            self.faults[each] = Fault()
            self.input_pos[each] = self.input_vel[each] = self.input_torque[each] = 0.0
            self.feed(each)

    def inject(self, axis: str, error: str) -> None:
        """Fault an axis, by its name in `AXIS_NAMES` and the fault's name in `FAULTS`.

        Raises:
            DriveError: there is no such axis or fault.
        """
        if axis not in AXIS_NAMES:
            raise DriveError(f"no axis {axis!r}; there are {', '.join(AXIS_NAMES)}")
        if error not in FAULTS:
            raise DriveError(f"no fault {error!r} for {axis}; there are {', '.join(FAULTS)}")
        self._fail(AXIS_NAMES.index(axis), FAULTS[error])

    def heartbeat(self, axis: int) -> Heartbeat:
        """Return what the axis reports of itself."""
        fault = self.faults[axis]
        return Heartbeat(
            fault.axis,
            self.state[axis],
            fault.motor != 0,
            fault.encoder != 0,
            fault.controller != 0,
            trajectory_done=True,
        )

    def _arm(self, axis: int) -> None:
        """Enter closed loop; `input_torque` is left as it stands, as the firmware does."""
        if self.control_mode[axis] >= ControlMode.POSITION:
            self.input_pos[axis] = self.pos_estimate[axis]
        self._integrator[axis] = 0.0
        self.state[axis] = AxisState.CLOSED_LOOP_CONTROL
        self._armed[axis] = 1.0
        self.feed(axis)

    def _disarm(self, axis: int) -> None:
        """Let the phases float."""
        self.state[axis] = AxisState.IDLE
        self._armed[axis] = 0.0
        self.torque[axis] = 0.0

    def _fail(self, axis: int, fault: Fault) -> None:
        """Latch a fault and disarm this axis alone."""
        had = self.faults[axis]
        self.faults[axis] = Fault(*(old | new for old, new in zip(had, fault, strict=True)))
        self._disarm(axis)


def _both(axis: int) -> tuple[int, int]:
    """Return both axes of the ODrive that an axis belongs to."""
    first = axis & ~1
    return first, first + 1
