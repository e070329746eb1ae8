"""A board of the emulated bank in virtual time, its motors free: whoever waits moves time on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_settings import NAMES
from services.simulator.fronts.fibre_front import EmulatedBoard, Property, endpoints
from shared.can.cansimple import AxisState
from tests.simulator.banks import CPR, DRIVE, ZERO, FreeRotors
from tools.bringup.boards import Value

DRIVE_INDEX = 4
"""knee_left"""
FIRST = 2 * DRIVE_INDEX
BOOT_S = 1.6
SCAN = 4.0 * np.pi
"""rad; a quarter of what it is as shipped, and of its time."""


class BankBoard:
    """Implements `tools.bringup.boards.Board`.

    Attributes:
        bank: the emulated drives, watchdogs on.
        rotors: what their motors turn.
        deaf: it takes no request for IDLE.
        restarts: how often it has restarted.
    """

    def __init__(self, **settings: float) -> None:
        """Have an uncalibrated board with the robot's settings and these, `__` in them for dots."""
        self.bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR)
        self._board = EmulatedBoard(self.bank, DRIVE_INDEX, 0x3A0000000005)
        rows = [row for row in endpoints() if isinstance(row, Property)]
        self._rows = {row.name: row for row in rows}
        self.serial_number, self.firmware = "3A0000000005", (0, 5, 6)
        self.settings = NAMES
        self.deaf, self.restarts = False, 0
        fresh = {"motor.config.pre_calibrated": False, "encoder.config.pre_calibrated": False,
                 "encoder.config.direction": 0, "motor.config.phase_resistance": 0.0,
                 "encoder.config.calib_scan_distance": SCAN}  # fmt: skip
        given = {name.replace("__", "."): value for name, value in settings.items()}
        for name, value in (fresh | given).items():
            for axis in ("axis0", "axis1"):
                self.bank.settings.set(DRIVE_INDEX, f"{axis}.{name}", value)
        self.bank.settings.save(DRIVE_INDEX)
        self.bank.step(0.0, ZERO + 0.28, ZERO)
        self.rotors = FreeRotors(self.bank, ZERO + 0.28, dt_s=2e-3)
        self.restart()
        self.restarts = 0

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        return {n: self._rows[n].read(self._board) for n in names if n in self._rows}

    def write(self, values: Mapping[str, Value]) -> None:
        for name, value in values.items():
            if not (self.deaf and name.endswith("requested_state") and value == AxisState.IDLE):
                write = self._rows[name].write
                assert write is not None
                write(self._board, value)  # type: ignore[arg-type]

    def save(self) -> None:
        self._board.save()
        self._wait_for_it()

    def restart(self) -> None:
        self.bank.reboot(FIRST)
        self._wait_for_it()

    def clear_errors(self) -> None:
        self.bank.clear_errors(FIRST)

    def states(self) -> tuple[int, int]:
        return int(self.bank.state[FIRST]), int(self.bank.state[FIRST + 1])

    def table(self) -> dict[str, float]:
        """Return all settings as numbers, a NaN as one that equals itself."""
        table = self.bank.settings.table(DRIVE_INDEX)
        return {name: float(np.nan_to_num(value, nan=-1e9)) for name, value in table.items()}

    def clock(self) -> float:
        return self.bank.now_s

    def pause(self, seconds: float) -> None:
        self.rotors.run(seconds)

    def _wait_for_it(self) -> None:
        assert not self._board.is_responding
        self.restarts += 1
        self.rotors.run(BOOT_S)
        assert self._board.is_responding
