"""The DC bus of each emulated ODrive: its voltage, and the current of motors and regeneration.

The supply is a constant voltage behind a resistance and accepts current both ways, like a battery.
The current covers mechanical power and copper losses: I_bus = sum(torque 2 pi vel + 1.5 R Iq^2) /
V_bus, Iq = torque / torque_constant; the 1.5 is due to the firmware's amplitude-invariant currents.
A brake resistor dissipates regenerated current beyond `max_regen_current`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_settings import N_DRIVES, Settings

Vector = NDArray[np.float64]

SUPPLY_VOLTAGE: Final = 48.0
SUPPLY_RESISTANCE: Final = 0.05
"""Resistance of battery and cable, ohm; assumed."""
DEAD_VOLTAGE: Final = 6.0
"""Voltage below which the processor stops, V."""
BRAKE_DUTY_MAX: Final = 0.95


class DcBus:
    """Voltages and currents of the six ODrives.

    Attributes:
        supply: voltage of each supply (6,), V.
        resistance: resistance of each supply (6,), ohm.
    """

    def __init__(self, settings: Settings, power: Vector, mechanical: Vector) -> None:
        """Bind the settings, and the motors' electrical and mechanical powers (12,), W."""
        self._settings = settings
        self._seen = -1
        self.supply = np.full(N_DRIVES, SUPPLY_VOLTAGE)
        self.resistance = np.full(N_DRIVES, SUPPLY_RESISTANCE)
        self._power, self._mechanical = power, mechanical

    def changed(self) -> None:
        """Record that a supply has changed."""
        self._seen = -1

    def check(self, least: float, most: float) -> dict[int, str]:
        """Return the drives (0 .. 5) beyond a limit, each with the fault's name in `BUS_FAULTS`.

        `least` and `most` are the present minimum and maximum power of a motor, W.
        """
        if self._seen != self._settings.version:
            self._derive()
        near = least < self._least or most > self._most
        return self._trips() if near or self._always else {}

    def state(self, drive: int) -> tuple[float, float]:
        """Return a drive's bus voltage, V, and current, A, positive if drawn."""
        voltage, current = self._solve()
        return float(voltage[drive]), float(current[drive])

    def powers(self, axis: int) -> tuple[float, float]:
        """Return an axis's electrical and mechanical power at the last check, W."""
        return float(self._power[axis]), float(self._mechanical[axis])

    def _derive(self) -> None:
        """Compute the constants, and the range of powers in which no limit can be near."""
        settings = self._settings
        self._seen = settings.version
        self._lowest = settings.drive("config.dc_bus_undervoltage_trip_level").copy()
        self._highest = settings.drive("config.dc_bus_overvoltage_trip_level").copy()
        self._negative = settings.drive("config.dc_max_negative_current").copy()
        self._positive = settings.drive("config.dc_max_positive_current").copy()
        braking = settings.drive("config.enable_brake_resistor") > 0.0
        brake = settings.drive("config.brake_resistance")
        self._brake_max = np.where(braking, BRAKE_DUTY_MAX / brake, 0.0)  # A per V
        self._regen_free = settings.drive("config.max_regen_current").copy()
        # Each axis may use half of a drive's limit, halved again for the change of voltage.
        resistance = np.maximum(self.resistance, 1e-6)
        push = np.minimum(-self._negative, (self._highest - self.supply) / resistance)
        draw = np.minimum(self._positive, (self.supply - self._lowest) / resistance)
        self._always = bool((push <= 0.0).any() or (draw <= 0.0).any())
        self._least = -0.25 * float((push * self.supply).min())
        self._most = 0.25 * float((draw * self.supply).min())

    def _solve(self) -> tuple[Vector, Vector]:
        """Return voltages and currents (6,) for the power of the last check."""
        if self._seen != self._settings.version:
            self._derive()
        power = self._power[0::2] + self._power[1::2]
        # V = supply - R I and V I = P: the higher root; beyond the peak power, half the supply
        root = np.maximum(self.supply**2 - 4.0 * self.resistance * power, 0.0)
        voltage = 0.5 * (self.supply + np.sqrt(root))
        current = np.divide(power, voltage, out=np.zeros(N_DRIVES), where=voltage > 1.0)
        surplus = np.maximum(-current - self._regen_free, 0.0)
        current += np.minimum(surplus, self._brake_max * voltage)
        return self.supply - self.resistance * current, current

    def _trips(self) -> dict[int, str]:
        voltage, current = self._solve()
        limits = (
            ("OVER_CURRENT", current > self._positive),
            ("OVER_REGEN_CURRENT", current < self._negative),
            ("UNDER_VOLTAGE", voltage < self._lowest),
            ("OVER_VOLTAGE", voltage > self._highest),
        )
        return {int(drive): name for name, beyond in limits for drive in np.flatnonzero(beyond)}
