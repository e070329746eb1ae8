"""A module's drive in lockstep: driver and bus in one, directly on the emulated axes."""

from __future__ import annotations

from typing import Final

from services.joint.drive_manager import DriveAction, DriveCommand
from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.joint.drivers.wired_drive import MotorFrame, Signs
from services.simulator.drives.axis_bank import AxisBank
from shared.bus.messages import Pair
from shared.can.cansimple import AxisState, ControlMode, InputMode
from shared.clock import NS_PER_S
from shared.config.sections import DriveConfig

# Compared in each cycle: docs/contributing.md, The control path.
_NOTHING, _TORQUE = DriveCommand.NOTHING, DriveCommand.TORQUE
_LOST, _IDLE, _ARMED = DriveStatus.LOST, DriveStatus.IDLE, DriveStatus.ARMED
_CLOSED_LOOP: Final = AxisState.CLOSED_LOOP_CONTROL


class VirtualDrive:
    """One ODrive of the bank."""

    def __init__(
        self, bank: AxisBank, index: int, drive: DriveConfig, signs: Signs, now_ns: int
    ) -> None:
        """Take the drives, which of them (0 .. 5), its motors' signs, and virtual time."""
        self._bank = bank
        self._axes = (2 * index, 2 * index + 1)
        self._module = slice(2 * index, 2 * index + 2)
        self._drive = drive
        self._frame = MotorFrame(drive.zero_mark_turns, signs)
        self._lost_after_ns = round(drive.lost_after_s * NS_PER_S)
        self._sampled_ns = now_ns
        self._written = True
        """False: the service is new, and reads the torques of a drive that it finds armed."""

    def assume_heard(self, now_ns: int) -> None:
        """Take a virtual time for that of the drive's last sample."""
        self._sampled_ns = now_ns

    def start_service(self) -> None:
        """Start with a new service, which reads the torques that an armed drive carries."""
        self._written = False

    def read(self, now_ns: int) -> DriveReading | None:
        """Return what a driver would: None during a short silence, then LOST."""
        bank, (a, b) = self._bank, self._axes
        is_responding = bank.is_responding(a)
        if is_responding:
            self._sampled_ns = now_ns
        elif now_ns - self._sampled_ns <= self._lost_after_ns:
            return None
        armed = bank.state[a] == bank.state[b] == _CLOSED_LOOP
        status = _LOST
        if is_responding:
            status = _ARMED if armed else _IDLE
        errors = 0 if armed else bank.heartbeat(a).errors | bank.heartbeat(b).errors
        pos, vel = bank.pos_estimate, bank.vel_estimate
        reading = DriveReading(
            self._sampled_ns,
            (float(pos[a]), float(pos[b])),
            (float(vel[a]), float(vel[b])),
            status,
            int(errors),
            None if self._written else (float(bank.torque[a]), float(bank.torque[b])),
        )
        return self._frame.from_drive(reading)

    def carry_out(self, step: DriveAction, *, onboard: bool) -> None:
        """Carry out a cycle's action, if the drive receives it; each frame feeds its watchdog."""
        bank, (a, b) = self._bank, self._axes
        if step.command is _NOTHING or not bank.is_responding(a):
            return
        self._written = True
        if step.target is not None:
            self._aim(self._frame.target(step.target))
        elif step.command is _TORQUE:
            bank.input_torque[self._module] = self._frame.torque(step.torque)
        elif step.command is DriveCommand.ARM:
            self._arm(onboard=onboard)
        elif step.command is DriveCommand.CLEAR_ZERO:
            for axis in self._axes:
                bank.set_count(axis, 0.0)
        else:
            bank.input_torque[self._module] = 0.0
            for axis in self._axes:
                bank.request_state(axis, AxisState.IDLE)
        bank.feed(a)
        bank.feed(b)

    def _aim(self, target: MotorTarget) -> None:
        """Write a target; number by number, which costs a third of writing slices."""
        bank, (a, b) = self._bank, self._axes
        bank.input_pos[a], bank.input_pos[b] = target.pos_turns
        bank.input_vel[a], bank.input_vel[b] = target.vel_turns
        bank.input_torque[a], bank.input_torque[b] = target.torque
        bank.pos_gain[a], bank.pos_gain[b] = target.pos_gain
        bank.vel_gain[a], bank.vel_gain[b] = target.vel_gain

    def _arm(self, *, onboard: bool) -> None:
        """Apply the settings of the drivers' arming frames."""
        bank, module = self._bank, self._module
        for axis in self._axes:
            bank.clear_errors(axis)
            mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
            bank.set_modes(axis, mode, InputMode.PASSTHROUGH)
        bank.vel_limit[module] = self._drive.vel_limit
        bank.current_lim[module] = self._drive.current_lim
        zero: Pair = (0.0, 0.0)
        bank.input_torque[module] = zero
        if onboard:
            bank.pos_gain[module] = bank.vel_gain[module] = zero
        for axis in self._axes:
            bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
