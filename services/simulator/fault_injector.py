"""Injects a scenario's faults into the emulated drives, and ends them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_faults import AXIS_NAMES
from services.simulator.drives.axis_heat import OVER_TEMP_MARGIN
from services.simulator.drives.dc_bus import SUPPLY_VOLTAGE
from services.simulator.drives.odd_encoder import Words
from shared.config.scenarios import Fault
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX

_AT_ONCE: Final = {"watchdog": "WATCHDOG", "disarmed": "DISARM", "overspeed": "OVERSPEED"}
"""Momentary kinds, with the bank's fault."""
_PULSED: Final = {"bus_full": (0.04, 0.1), "bus_flap": (0.06, 0.15)}
"""Lasting kinds that come and go: how long each time, and how often, s."""
_ABOVE: Final = 5.0
"""V or C beyond the limit."""


class FaultInjector:
    """The faults of a run, and which of them have started."""

    def __init__(self, faults: Sequence[Fault], bank: AxisBank) -> None:
        """Take the faults in any order."""
        self._bank = bank
        self._coming = sorted(faults, key=lambda fault: fault.at)
        self._lasting: list[Fault] = []

    def advance(self, scenario_s: float) -> list[Fault]:
        """Start and end what is due at scenario time; return the faults that started."""
        if not self._coming and not self._lasting:
            return []
        for fault in [row for row in self._lasting if scenario_s >= row.at + row.lasts_s]:
            self._lasting.remove(fault)
            self._act(fault, begins=False)
        begun = [fault for fault in self._coming if fault.at <= scenario_s]
        for fault in begun:
            self._coming.remove(fault)
            if fault.kind in _AT_ONCE:
                self._bank.inject(AXIS_NAMES[axis_of(fault)], _AT_ONCE[fault.kind])
            else:
                self._lasting.append(fault)
                self._act(fault, begins=True)
        for fault in self._lasting:
            if fault.kind in _PULSED:
                lasts_s, period_s = _PULSED[fault.kind]
                self._act(fault, begins=(scenario_s - fault.at) % period_s < lasts_s)
        return begun

    def _act(self, fault: Fault, *, begins: bool) -> None:
        """Bring a drive into a lasting fault, or out of it."""
        bank, axis = self._bank, axis_of(fault)
        drive = axis >> 1
        match fault.kind:
            case "over_temperature":
                limit = bank.settings.axis("motor.fet_thermistor.config.temp_limit_upper")[axis]
                hot = float(limit) + OVER_TEMP_MARGIN + _ABOVE
                bank.heat.force(axis, hot if begins else None)
            case "encoder" | "encoder_gap" | "encoder_zero":
                wrong = Words.ZERO if fault.kind == "encoder_zero" else Words.NONE
                bank.conditions.read_encoder(axis, wrong if begins else Words.TRUE)
            case "link_lost" | "bus_flap":
                bank.conditions.link(drive, up=not begins)
            case "no_ack":
                bank.conditions.deafen(drive, deaf=begins)
            case "bus_full":
                bank.conditions.choke(drive, full=begins)
            case "over_voltage":
                limit = bank.settings.drive("config.dc_bus_overvoltage_trip_level")[drive]
                bank.supply(drive, float(limit) + _ABOVE if begins else SUPPLY_VOLTAGE)
            case "brown_out":
                bank.supply(drive, 0.0 if begins else SUPPLY_VOLTAGE)
            case _:
                raise DriveError(f"{fault.kind}: no lasting fault of the emulated drives")


def axis_of(fault: Fault) -> int:
    """Return the axis (0 .. 11) that a fault is of; of the whole ODrive, its first."""
    return 2 * MODULE_INDEX[fault.module] + (fault.axis or 0)
