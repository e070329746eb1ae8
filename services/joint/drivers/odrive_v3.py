"""Properties of an ODrive v3 that the USB driver uses, and the meaning of its registers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

from services.joint.drivers.base import MotorTarget, real_readings
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisError, AxisState, ControlMode, Heartbeat, InputMode
from shared.exceptions import DriveError

ARM_SETTINGS: Final = (
    "controller.config.control_mode",
    "controller.config.input_mode",
    "controller.config.vel_limit",
    "motor.config.current_lim",
    "controller.config.vel_integrator_gain",
    "controller.config.pos_gain",
    "controller.config.vel_gain",
    "controller.input_vel",
    "controller.input_torque",
)
"""Written to each axis before it is armed, in this order."""
IDLE_SETTINGS: Final = ("controller.input_torque", "requested_state")
_AXES = ("axis0", "axis1")
_DIRECTION = "encoder.config.direction"
_COUNTS = ("encoder.shadow_count", "encoder.count_in_cpr", "encoder.config.cpr")
_THERMISTORS = ("motor.fet_thermistor.temperature", "motor.motor_thermistor.temperature")


class AxesStatus:
    """Status of both axes; an armed axis that left closed loop is an error."""

    def __init__(self) -> None:
        """Start after a request to arm or idle: neither axis has been armed since."""
        self._was_armed = [False, False]

    def judge(self, states: Sequence[int], errors: int) -> DriveStatus:
        """Return the status from `current_state` of both axes and `errors`.

        An axis that left closed loop is an error even without an error bit: up to firmware 0.5.4,
        OVERSPEED leaves `axis.error` at 0.
        """
        closed = [state == AxisState.CLOSED_LOOP_CONTROL for state in states]
        both = list(zip(self._was_armed, closed, strict=True))
        self._was_armed = [was or now for was, now in both]
        if errors or any(was and not now for was, now in both):
            return DriveStatus.ERROR
        return DriveStatus.ARMED if all(closed) else DriveStatus.IDLE

    @staticmethod
    def errors(registers: Sequence[int], *, wanted_armed: bool) -> int:
        """Return the `AxisError` bits of both axes, or-ed.

        `registers` are those of axis, motor, encoder and controller of axis0, then of axis1. Unless
        `wanted_armed`, an expired watchdog is no error: nothing has been written yet.
        """
        errors = 0
        for i in (0, 4):
            axis, motor, encoder, controller = registers[i : i + 4]
            errors |= Heartbeat(
                axis, 0, motor != 0, encoder != 0, controller != 0, trajectory_done=True
            ).errors
        return int(errors if wanted_armed else errors & ~AxisError.WATCHDOG_TIMER_EXPIRED)


class _EndpointBatch:
    """Endpoints of a drive that are read or written together, in order.

    The package keeps four transfers in flight, so every four cost a round trip.
    """

    def __init__(self, device: Any, properties: Sequence[Any]) -> None:
        self._device = device.device
        self._ids = [each.endpoint_id for each in properties]
        self._sizes = [each.codec.size for each in properties]
        self._codec = struct.Struct("<" + "".join(each.codec.struct_format for each in properties))

    async def read(self) -> tuple[Any, ...]:
        buffer = await self._device.read_endpoints(self._ids, self._sizes, transient=False)
        return self._codec.unpack(buffer)

    async def write(self, values: Sequence[float]) -> None:
        await self._device.write_endpoints(self._ids, self._sizes, self._codec.pack(*values))


class TargetWriter:
    """Writes the values of both motors' targets that the drive does not have yet.

    Args:
        device: the package's `RuntimeDevice`.
        properties: position and torque of axis0, then of axis1; then position and velocity
            gain of axis0, then of axis1.
    """

    def __init__(self, device: Any, properties: Sequence[Any]) -> None:
        self._device = device
        self._properties = properties
        self._written: list[float] | None = None
        self._batches: dict[tuple[int, ...], _EndpointBatch] = {}

    def forget(self) -> None:
        """Write everything next time: the drive's present values are unknown."""
        self._written = None

    async def write(self, target: MotorTarget) -> None:
        """Write the inputs, then the gains, so that new gains act on new inputs."""
        values = values_of(target)
        written = self._written
        if written is None:
            new = tuple(range(len(values)))
            written = list(values)
        else:
            new = tuple(at for at, value in enumerate(values) if value != written[at])
        if not new:
            return
        batch = self._batches.get(new)
        if batch is None:
            properties = [self._properties[index] for index in new]
            batch = self._batches[new] = _EndpointBatch(self._device, properties)
        self._written = None  # if it fails, the drive's values are unknown
        await batch.write([values[index] for index in new])
        for index in new:
            written[index] = values[index]
        self._written = written


def values_of(target: MotorTarget) -> tuple[float, ...]:
    """Return a target's values in the order of `TargetWriter`.

    `input_vel` stays at zero, because four inputs take one round trip and six take two. The
    velocity is sent in the position, `pos + vel / pos_gain`, or in the torque if pos_gain is 0.
    The firmware's law and clamp then give the same torque, even when writing stops.
    """
    pos_0, torque_0 = _inputs_of(target, 0)
    pos_1, torque_1 = _inputs_of(target, 1)
    (k_0, k_1), (b_0, b_1) = target.pos_gain, target.vel_gain
    return pos_0, torque_0, pos_1, torque_1, k_0, b_0, k_1, b_1


def _inputs_of(target: MotorTarget, axis: int) -> tuple[float, float]:
    """Return input_pos and input_torque of an axis."""
    pos, vel, k = target.pos_turns[axis], target.vel_turns[axis], target.pos_gain[axis]
    if k > 0.0:
        return pos + vel / k, target.torque[axis]
    return pos, target.torque[axis] + target.vel_gain[axis] * vel


class OdriveV3:
    """A connected drive: its properties and functions, looked up once.

    `device` is a `RuntimeDevice` of the `odrive` package, which no other driver than `odrive_usb`
    imports.

    Attributes:
        sample: position of both axes, then velocity.
        sample_and_state: `sample`, then the state of both axes.
        errors: the four error registers of axis0, then of axis1.
        target: the inputs and gains of both axes.

    Raises:
        DriveError: the driver does not know this drive or firmware.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        estimates = [
            *self._both(("encoder.pos_estimate",)),
            *self._both(("encoder.vel_estimate",)),
        ]
        self.sample = _EndpointBatch(device, estimates)
        self.sample_and_state = _EndpointBatch(
            device, [*estimates, *self._both(("current_state",))]
        )
        self.errors = _EndpointBatch(
            device,
            self._both(("error", "motor.error", "encoder.error", "controller.error")),
        )
        self._currents = _EndpointBatch(device, self._both(("motor.current_control.Iq_setpoint",)))
        inputs = ("controller.input_pos", "controller.input_torque")
        gains = ("controller.config.pos_gain", "controller.config.vel_gain")
        self.target = TargetWriter(device, [*self._both(inputs), *self._both(gains)])
        self._watchdogs = _EndpointBatch(device, self._both(("config.enable_watchdog",)))
        self._counts_per_turn = _EndpointBatch(device, self._both(("encoder.config.cpr",)))
        self._food: list[Any] = []
        # firmware before 0.5.2 has it at the motor
        self._directions: _EndpointBatch | None = None
        if all(f"{axis}.{_DIRECTION}" in device.properties for axis in _AXES):
            self._directions = _EndpointBatch(device, self._both((_DIRECTION,)))
        self._signs = (1, 1)
        self._counts = _EndpointBatch(device, self._both(_COUNTS))
        # firmware before 0.5.2 lacks these, too
        self._heat: _EndpointBatch | None = None
        if all(f"{axis}.{name}" in device.properties for axis in _AXES for name in _THERMISTORS):
            self._heat = _EndpointBatch(device, self._both(_THERMISTORS))

    async def read_settings(self) -> None:
        """Read which watchdogs are enabled, and the currents' direction."""
        enabled = await self._watchdogs.read()
        self._food = [
            self.device.functions[f"{axis}.watchdog_feed"]
            for axis, on in zip(_AXES, enabled, strict=True)
            if on
        ]
        if self._directions is not None:
            first, second = await self._directions.read()
            self._signs = (-1 if first < 0 else 1, -1 if second < 0 else 1)

    async def torques(self, torque_constant: float) -> Pair | None:
        """Return the torques that both axes' own loops request, N m; None if one is not finite.

        A current's sign follows the direction that the encoder's calibration found, which depends
        on the phase wiring: the firmware inverts the torque where the direction is -1.
        """
        first, second = await self._currents.read()
        if not (isfinite(first) and isfinite(second)):
            return None
        sign_0, sign_1 = self._signs
        return sign_0 * first * torque_constant, sign_1 * second * torque_constant

    async def encoder_zero(self) -> Pair:
        """Return where both encoders' angles within the turn are 0, in turns modulo one."""
        count, in_turn, per_turn, count_1, in_turn_1, per_turn_1 = await self._counts.read()
        zero_1 = (count_1 - in_turn_1) % per_turn_1 / per_turn_1
        return (count - in_turn) % per_turn / per_turn, zero_1

    async def heat(self) -> tuple[Pair | None, Pair | None]:
        """Return thermistor readings of output stages and motors, C; None without thermistors."""
        if self._heat is None:
            return None, None
        fet_0, motor_0, fet_1, motor_1 = await self._heat.read()
        return real_readings(fet_0, fet_1), real_readings(motor_0, motor_1)

    @property
    def hungry(self) -> bool:
        """True if a watchdog is enabled: over USB, only `feed` feeds it."""
        return bool(self._food)

    async def feed(self) -> None:
        """Feed the enabled watchdogs."""
        for food in self._food:
            await self.device.call_function(food)

    async def set_position(self, turns: Pair) -> None:
        """Set the readings of both encoders, turns at the motor."""
        counts_per_turn = await self._counts_per_turn.read()
        for axis, where, cpr in zip(_AXES, turns, counts_per_turn, strict=True):
            name = f"{axis}.encoder.set_linear_count"
            await self.device.call_function(self.device.functions[name], round(where * cpr))

    async def clear_errors(self) -> None:
        """Clear all errors of both axes."""
        await self.device.call_function("clear_errors")

    async def arm(self, vel_limit: float, current_lim: float) -> None:
        """Command closed loop on both axes, without torque or gains; limits in turn/s and A."""
        await self.clear_errors()
        modes = (ControlMode.POSITION, InputMode.PASSTHROUGH)
        await self._write_both(ARM_SETTINGS, (*modes, vel_limit, current_lim, *[0.0] * 5))
        await self.feed()
        await self._write_both(("requested_state",), (AxisState.CLOSED_LOOP_CONTROL,))

    async def idle(self) -> None:
        """Command both axes to go idle, with their input torque zeroed."""
        await self._write_both(IDLE_SETTINGS, (0.0, AxisState.IDLE))

    async def _write_both(self, names: tuple[str, ...], values: tuple[float, ...]) -> None:
        """Write the same values to both axes, axis0 first."""
        await _EndpointBatch(self.device, self._both(names)).write([*values, *values])

    def _both(self, names: tuple[str, ...]) -> list[Any]:
        """Return properties of axis0, then the same of axis1."""
        properties = self.device.properties
        paths = [f"{axis}.{name}" for axis in _AXES for name in names]
        missing = [path for path in paths if path not in properties]
        if missing:
            raise DriveError(
                f"ODrive {self.device.serial_number}, firmware {self.device.fw_version}: it lacks "
                f"{missing[0]}; use an ODrive v3 with firmware 0.5.x"
            )
        return [properties[path] for path in paths]
