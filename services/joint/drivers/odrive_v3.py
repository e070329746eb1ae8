"""What of an ODrive v3's tree the USB driver uses, by the names of firmware 0.5.x."""

from __future__ import annotations

import struct
from collections.abc import Awaitable, Sequence
from typing import Any, Final

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


class OdriveV3:
    """A connected drive: its properties and functions, looked up once.

    `device` is the package's `RuntimeDevice`; only `odrive_usb` imports the package.

    Attributes:
        sample: position, velocity and state of axis0, then of axis1.
        errors: the four error registers of axis0, then of axis1.
        currents: what each axis's own loop asks for.
        inputs: position, velocity and torque of axis0, then of axis1.
        gains: position and velocity gain of axis0, then of axis1.

    Raises:
        DriveError: it is another drive or firmware than this driver knows.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        self.sample = self._both(("encoder.pos_estimate", "encoder.vel_estimate", "current_state"))
        self.errors = self._both(("error", "motor.error", "encoder.error", "controller.error"))
        self.currents = self._both(("motor.current_control.Iq_setpoint",))
        self.inputs = self._both(
            ("controller.input_pos", "controller.input_vel", "controller.input_torque")
        )
        self.gains = self._both(("controller.config.pos_gain", "controller.config.vel_gain"))
        self._watchdogs = self._both(("config.enable_watchdog",))
        self._food: list[Any] = []

    async def find_watchdogs(self) -> None:
        """Look which axes have a watchdog that runs; they are set and saved, not switched."""
        enabled = await self.device.read_multiple(self._watchdogs)
        self._food = [
            self.device.functions[f"{axis}.watchdog_feed"]
            for axis, on in zip(_AXES, enabled, strict=True)
            if on
        ]

    def feed(self) -> list[Awaitable[Any]]:
        """Return the calls that feed the watchdogs that run: over USB nothing else does."""
        return [self.device.call_function(food) for food in self._food]

    async def write(self, properties: Sequence[Any], values: Sequence[float]) -> None:
        """Write properties in order, in one pipelined round trip."""
        codecs = [each.codec for each in properties]
        wire = [codec.to_wire(value) for codec, value in zip(codecs, values, strict=True)]
        await self.device.device.write_endpoints(
            [each.endpoint_id for each in properties],
            [codec.size for codec in codecs],
            struct.pack("<" + "".join(codec.struct_format for codec in codecs), *wire),
        )

    async def write_both(self, names: tuple[str, ...], values: tuple[float, ...]) -> None:
        """Write the same values to both axes, axis0 first."""
        await self.write(self._both(names), [*values, *values])

    def _both(self, names: tuple[str, ...]) -> list[Any]:
        """Return properties of axis0, then the same of axis1."""
        properties = self.device.properties
        paths = [f"{axis}.{name}" for axis in _AXES for name in names]
        missing = [path for path in paths if path not in properties]
        if missing:
            raise DriveError(
                f"ODrive {self.device.serial_number}, firmware {self.device.fw_version}: it has no "
                f"{missing[0]}; this driver is for an ODrive v3 with firmware 0.5.x"
            )
        return [properties[path] for path in paths]
