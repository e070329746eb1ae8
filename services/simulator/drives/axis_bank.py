"""Twelve emulated ODrive axes: state machine, watchdogs, checks and errors (docs/drives.md).

It emulates firmware 0.5.6 with its traps. OVERSPEED disarms in torque mode too. A disarmed axis
floats while its sibling keeps its torque. The watchdog runs in IDLE too. Re-arming does not zero
`input_torque`. Setting position mode moves `input_pos` to the motor's position. An axis can disarm
with `axis_error` 0. An axis whose encoder fails stays armed for 51 ms and misses the turns
made meanwhile. A restart restores the saved settings.

Pure: no clock, no I/O. Axes 2i and 2i + 1 are axis0 and axis1 of module i, one ODrive.
Units at the motor: turns, turn/s, N m, A.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_calibration import SEQUENCES, Calibration
from services.simulator.drives.axis_control import AxisControl
from services.simulator.drives.axis_encoders import AxisEncoders
from services.simulator.drives.axis_faults import (
    AXIS_NAMES,
    BUS_FAULTS,
    FAULTS,
    SHARED_FAULTS,
    AxisErrors,
    Conditions,
    controller_fault,
    in_idle,
)
from services.simulator.drives.axis_heat import AxisHeat, Heat
from services.simulator.drives.axis_settings import configured
from services.simulator.drives.axis_watches import Spinout, Watchdogs
from services.simulator.drives.dc_bus import DEAD_VOLTAGE, DcBus
from shared.bus.messages import Pair
from shared.can.cansimple import (
    AxisError,
    AxisState,
    ControllerError,
    Heartbeat,
    InputMode,
)
from shared.config.sections import DriveConfig
from shared.exceptions import DriveError
from shared.joints import N_JOINTS

__all__ = ["AXIS_NAMES", "FAULTS", "AxisBank", "AxisErrors"]

Vector = NDArray[np.float64]

REFUSED_S: Final = 1e-3
"""Time in closed loop without torque for an axis with an error or without a phase, s."""
REARM_S: Final = 0.25e-3
"""Gap in the torque of an armed axis when closed loop is requested again, s."""
_EARLY_S: Final = 1e-6


class AxisBank:
    """State of all axes; every array is indexed by axis, shape (12,).

    The arrays without an underscore may be read at any time. `input_pos`, `input_vel`,
    `input_torque`, the gains and the limits may also be written between steps; other settings
    are set by name in `settings`. Only the methods change modes, states and errors.
    """

    def __init__(
        self,
        drive: DriveConfig,
        *,
        encoder_counts_per_turn: int,
        watchdog: bool = True,
        motor_signs: Sequence[int] = (1,) * N_JOINTS,
        heat: Heat | None = None,
    ) -> None:
        """Power the drives up, calibrated, zeroed (`drive.zero_mark_turns`), in IDLE.

        Args:
            drive: the robot file's `[drive]`.
            encoder_counts_per_turn: counts per turn of the encoders.
            watchdog: True if the drives' watchdogs run.
            motor_signs: sign of each motor's count and of its zero mark.
            heat: thermal model; None for the default.
        """
        self.settings = configured(
            drive, encoder_counts_per_turn=encoder_counts_per_turn, watchdog=watchdog
        )
        n = N_JOINTS
        self._encoders = encoders = AxisEncoders(self.settings, encoder_counts_per_turn)
        self._control = control = AxisControl(self.settings, encoders)
        mark = round(drive.zero_mark_turns * encoder_counts_per_turn)
        self.counts_from = encoders.counts_from
        self.counts_from[:] = mark * np.array(motor_signs)
        law, column = control.results, self.settings.axis
        self.bus = DcBus(self.settings, law.power, law.mechanical)
        self.state = [AxisState.IDLE] * n
        self.faults = [AxisErrors()] * n
        self.control_mode = column("controller.config.control_mode")
        self.input_pos, self.input_vel = control.input_pos, control.input_vel
        self.input_torque, self.torque = control.input_torque, law.torque
        self.pos_gain = column("controller.config.pos_gain")
        self.vel_gain = column("controller.config.vel_gain")
        self.vel_integrator_gain = column("controller.config.vel_integrator_gain")
        self.vel_limit = column("controller.config.vel_limit")
        self.current_lim = column("motor.config.current_lim")
        self.pos_estimate, self.vel_estimate = encoders.pos_estimate, encoders.vel_estimate
        self.encoder_turns, self.connected = encoders.turns, control.connected
        self.encoder_mount = encoders.mount
        self.encoder_count, self.encoder_angle = encoders.counted, encoders.angle
        self._shaft, self._last_torque = np.zeros((2, n))
        self.now_s = -math.inf
        self.calibration = Calibration(self.settings, encoders, drive.torque_constant)
        self.heat = AxisHeat(self.settings, control, heat or Heat())
        self.conditions = Conditions(self.heat, encoders)
        self._watchdogs = Watchdogs(self.settings)
        self._spinout = Spinout(self.settings)
        self._requested: dict[int, int] = {}
        self._refused_s: dict[int, float] = {}  # end of the reported closed loop
        self._rearmed: set[int] = set()

    @property
    def regulates(self) -> bool:
        """True if any axis regulates or calibrates, and so must step with the world."""
        return bool(self.calibration.running) or self._control.regulates()

    def step(self, now_s: float, pos_turns: Vector, vel_turns: Vector) -> Vector:
        """Advance to `now_s`; return the motor torques for true motor positions and velocities.

        The first call sets the clock, feeds the watchdogs and starts the estimators at
        the true values. The next step overwrites the returned array.
        """
        control = self._control
        if self.now_s == -math.inf:
            self.now_s = now_s
            for axis in range(N_JOINTS):
                self._watchdogs.feed(axis, now_s)
            self._encoders.start(pos_turns, vel_turns)
            control.start(vel_turns)
        else:
            dt_s = now_s - self.now_s
            self.now_s = now_s
            if dt_s > 0.0:
                self._encoders.estimate(dt_s, pos_turns)
                self.heat.advance(dt_s)
        if self._refused_s or self._spinout.watched:
            self._end_closed_loops()
        if self.calibration.running or not self.conditions.all_well:
            self._apply_conditions()
        for axis in self._watchdogs.expired(now_s):
            self._fail(axis, FAULTS["WATCHDOG"])
        control.turn(vel_turns)
        beyond, least, most = control.control()
        if beyond:
            for axis, name in control.failing():
                self._fail(axis, FAULTS[name])
            _, least, most = control.control()
        control.integrate()
        for axis in self.calibration.running:
            pos, vel = float(pos_turns[axis]), float(vel_turns[axis])
            self.torque[axis] = self.calibration.torque(axis, pos, vel)
        for drive, why in self.bus.check(least, most).items():
            for axis in _both(2 * drive):
                self._fail(axis, BUS_FAULTS[why])
        return self._at_shafts() if self._encoders.odd or self._rearmed else self.torque

    # ---- requests of a front

    def feed(self, *axes: int) -> None:
        """Feed the watchdogs of axes, as any CAN frame to an axis does."""
        for axis in axes:
            self._watchdogs.feed(axis, self.now_s)

    def request_state(self, axis: int, state: int) -> None:
        """Request a state: IDLE, CLOSED_LOOP_CONTROL or a calibration; only its low byte counts.

        With an axis error, or without the encoder's calibration, closed loop lasts for 1 ms without
        torque. Three requests set INVALID_STATE and lead to IDLE: closed loop without the motor's
        calibration or the encoder's direction, an encoder's calibration before its motor's, and any
        other state. An axis that is still booting executes the request once it runs.
        """
        drive, state = axis >> 1, state & 0xFF
        if state == AxisState.UNDEFINED:
            return
        if drive in self.conditions.starting:
            if drive not in self.conditions.down:
                self._requested[axis] = state
            return
        fault = self.faults[axis]
        broken_off = self.calibration.stop(axis, requested=True)
        fault = fault._replace(axis=fault.axis & ~AxisError.INVALID_STATE).with_(broken_off)
        self.faults[axis] = fault
        if state == AxisState.IDLE:
            self._disarm(axis)
        elif state == AxisState.CLOSED_LOOP_CONTROL:
            if self.calibration.refuses(axis):
                self._fail(axis, AxisErrors(AxisError.INVALID_STATE))
            else:
                self._arm(axis)
        elif state in SEQUENCES:
            self._disarm(axis)
            states = SEQUENCES[AxisState(state)]
            latched = fault.axis != 0
            outcome = self.calibration.begin(axis, states, self.now_s, latched=latched)
            self._become(axis, outcome)
        else:
            self._fail(axis, AxisErrors(AxisError.INVALID_STATE))

    def set_modes(self, axis: int, control_mode: int, input_mode: int) -> None:
        """Set the controller's modes; an input mode other than PASSTHROUGH is an error.

        Position mode sets `input_pos` to the motor's position, even if it was already active.
        """
        control_mode, input_mode = control_mode & 0xFF, input_mode & 0xFF
        if input_mode != InputMode.PASSTHROUGH or control_mode not in (1, 2, 3):
            self._fail(axis, controller_fault(ControllerError.INVALID_INPUT_MODE))
            return
        below = f"axis{axis & 1}.controller.config"
        self.settings.set(axis >> 1, f"{below}.control_mode", control_mode)
        self.settings.set(axis >> 1, f"{below}.input_mode", input_mode)
        self._control.hold_here(axis)

    def set_count(self, axis: int, count: float) -> None:
        """Set an axis's count at its present position; `input_pos` is unchanged."""
        self._encoders.set_count(axis, count)

    def clear_errors(self, axis: int) -> None:
        """Clear the errors of both axes of the ODrive, as the firmware does.

        A lasting cause (heat, DC bus) sets its error again at the next step. Missing encoder words
        do so only after 51 ms, because their filter is reset.
        """
        for each in _both(axis):
            self.faults[each] = AxisErrors()
            self._encoders.clear_errors(each)

    def set_error(self, axis: int, register: str, error: int) -> None:
        """Write an error register by its name in `AxisErrors`, as is possible over USB.

        An error in the `axis` register disarms the axis, as if it had occurred. The filter of
        missing encoder words, and the sibling, are unchanged.
        """
        self.faults[axis] = self.faults[axis]._replace(**{register: error})
        if self.faults[axis].axis:
            self._disarm(axis)

    def estop(self, axis: int) -> None:
        """Disarm one axis with ESTOP_REQUESTED; its sibling continues."""
        self._fail(axis, FAULTS["ESTOP"])

    def reboot(self, axis: int) -> None:
        """Restart the axis's ODrive.

        Both axes float, inputs become zero, errors are cleared, and the saved settings return. The
        ODrive is silent for `TALKS_S`, then answers in state 0. Until `BOOT_S` it stores the last
        requested state.
        """
        drive = axis >> 1
        for each in _both(axis):
            self._disarm(each)
            self.state[each] = AxisState.UNDEFINED
            self._requested.pop(each, None)
            self._spinout.armed(each)
            self.faults[each] = AxisErrors()
            self.input_pos[each] = self.input_vel[each] = self.input_torque[each] = 0.0
            self._control.connected[each] = self._last_torque[each] = 0.0
        self.settings.restore(drive)
        for each in _both(axis):
            self.calibration.restart(each)
            self._encoders.forget_turns(each)
            self._watchdogs.feed(each, self.now_s)
        self.conditions.boot(drive, self.now_s)

    def is_responding(self, axis: int) -> bool:
        """Return True if the axis's ODrive is powered, started and plugged in."""
        return axis not in self.conditions.silent

    def heartbeat(self, axis: int) -> Heartbeat:
        """Return the axis's heartbeat."""
        fault = self.faults[axis]
        return Heartbeat(
            fault.axis,
            self.state[axis],
            fault.motor != 0,
            fault.encoder != 0,
            fault.controller != 0,
            trajectory_done=True,
        )

    def currents(self, axis: int) -> Pair:
        """Return the requested and the measured current that an axis reports, A.

        Once an axis has been armed, its controller runs in IDLE too: the requested current still
        changes, while the measured one keeps its last value (firmware 0.5.6).
        """
        requested = measured = float(self.torque[axis])
        if not self._control.armed[axis] and axis not in self.calibration.running:
            requested = float(self._control.results.asked[axis] * self.connected[axis])
            measured = float(self._last_torque[axis])
        of = self.settings.current
        return of(axis, requested), of(axis, measured)

    # ---- faults and supply

    def inject(self, axis: str, error: str) -> None:
        """Inject a fault of `FAULTS` into an axis of `AXIS_NAMES`, both by name.

        Raises:
            DriveError: the axis or the fault is unknown.
        """
        if axis not in AXIS_NAMES:
            raise DriveError(f"unknown axis {axis!r}; use one of {', '.join(AXIS_NAMES)}")
        if error not in FAULTS:
            raise DriveError(f"unknown fault {error!r} for {axis}; use one of {', '.join(FAULTS)}")
        number = AXIS_NAMES.index(axis)
        for each in _both(number) if error in SHARED_FAULTS else (number,):
            self._fail(each, FAULTS[error])

    def supply(self, drive: int, volts: float) -> None:
        """Set an ODrive's supply, V: the drive is off below `DEAD_VOLTAGE`, and boots above it."""
        self.bus.supply[drive] = volts
        self.bus.changed()
        if volts < DEAD_VOLTAGE:
            self.reboot(2 * drive)
            self.conditions.power_off(drive)
        elif self.conditions.is_off(drive):
            self.conditions.boot(drive, self.now_s)
            for axis in _both(2 * drive):
                self._watchdogs.feed(axis, self.now_s)

    # ---- within a step

    def _apply_conditions(self) -> None:
        """Handle booting drives, lasting conditions and calibrations."""
        for drive in self.conditions.finish_boots(self.now_s):
            for axis in _both(2 * drive):
                self.state[axis] = AxisState.IDLE
                arms = self.settings.axis("config.startup_closed_loop_control")[axis] > 0.0
                by_itself = AxisState.CLOSED_LOOP_CONTROL if arms else AxisState.IDLE
                self.request_state(axis, self._requested.pop(axis, by_itself))
        for axis, fault in self.conditions.disarming():
            self._fail(axis, fault)
        self._check_odd_encoders()
        for axis in list(self.calibration.running):
            self._become(axis, self.calibration.advance(axis, self.now_s))

    def _check_odd_encoders(self) -> None:
        """Clear the error of an estimate that is valid again, and check speeds within the step."""
        for axis, odd in self._encoders.odd.items():
            fault = self.faults[axis]
            if fault.controller & ControllerError.INVALID_ESTIMATE and not odd.fails:
                valid = fault.controller & ~ControllerError.INVALID_ESTIMATE
                self.faults[axis] = fault._replace(controller=valid)
        for axis in self._encoders.overspeed():
            if self.connected[axis]:
                self._fail(axis, FAULTS["OVERSPEED"])

    def _end_closed_loops(self) -> None:
        """End refused closed loops when due, and check disarmed axes for a spinout."""
        for axis, until_s in list(self._refused_s.items()):
            if until_s <= self.now_s + _EARLY_S:
                del self._refused_s[axis]
                if self.state[axis] == AxisState.CLOSED_LOOP_CONTROL:
                    self._disarm(axis)
        asked = {axis: self._control.asked_power(axis) for axis in self._spinout.watched}
        for axis in self._spinout.check(self._encoders.dt_s, asked):
            self._spinout.armed(axis)
            self._fail(axis, FAULTS["SPINOUT"])

    def _at_shafts(self) -> Vector:
        """Return the torques at the shafts, reduced where the drive's rotor angle is wrong.

        An armed axis that is armed again gives no torque for `REARM_S`.
        """
        self._shaft[:] = self.torque
        self._encoders.commutate(self._shaft)
        dt_s = self._encoders.dt_s
        for axis in self._rearmed:
            self._shaft[axis] *= max(0.0, 1.0 - REARM_S / dt_s) if dt_s else 1.0
        self._rearmed.clear()
        return self._shaft

    def _become(self, axis: int, outcome: AxisState | AxisErrors) -> None:
        if isinstance(outcome, AxisErrors):
            self._fail(axis, outcome)
        else:
            self.state[axis] = outcome

    def _arm(self, axis: int) -> None:
        """Enter closed loop; as in the firmware, `input_torque` is unchanged.

        Without a phase, or with an error, the state lasts only for one sleep of the firmware's
        thread. The target still moves to the motor's position.
        """
        if self._control.armed[axis]:
            self._rearmed.add(axis)
        self._control.arm(axis)
        self._spinout.armed(axis)
        self._refused_s.pop(axis, None)
        self.state[axis] = AxisState.CLOSED_LOOP_CONTROL
        self.feed(axis)
        ready = self.calibration.encoder[axis]
        if self.faults[axis].axis or not ready:
            self._control.armed[axis] = 0.0
            self._refused_s[axis] = self.now_s + REFUSED_S
            if not ready:
                self.faults[axis] = self.faults[axis].with_(FAULTS["NO_PHASE"])

    def _disarm(self, axis: int) -> None:
        """Let the phases float."""
        if axis >> 1 not in self.conditions.starting:
            self.state[axis] = AxisState.IDLE
        if self._control.armed[axis]:
            _, last = self.bus.powers(axis)
            self._spinout.disarmed(axis, self._control.asked_power(axis), last)
            self._last_torque[axis] = self.torque[axis]
        self._control.armed[axis] = 0.0
        self.torque[axis] = 0.0

    def _fail(self, axis: int, fault: AxisErrors) -> None:
        """Latch a fault and disarm only this axis; no effect while its drive is down."""
        if axis >> 1 in self.conditions.down:
            return
        if not self._control.armed[axis]:
            fault = in_idle(fault, connected=self.connected[axis] > 0.0)
        broken_off = self.calibration.stop(axis)
        self.faults[axis] = self.faults[axis].with_(fault).with_(broken_off)
        self._disarm(axis)


def _both(axis: int) -> tuple[int, int]:
    first = axis & ~1
    return first, first + 1
