"""Replies of an ODrive's two axes over CANSimple, such as counts and currents. Pure.

Counts replace the estimates of firmware 0.5.6, which are exactly 0, 0 from each start-up until the
first closed loop, wherever the motor is.
"""

from __future__ import annotations

from math import isfinite
from typing import Final

from services.joint.drivers.base import real_readings
from services.joint.drivers.can_link import request_of
from shared.bus.messages import Pair
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.cansimple_06 import Command06

NOTHING: Final = (0.0, 0.0)
"""The estimate of an axis that has not been in closed loop yet, turns and turn/s."""

_BYTES: Final = 8


class Replies:
    """Newest replies of both axes; axis0, then axis1.

    Attributes:
        ask_version: requests for the firmware's version.
        ask_currents: requests for the currents.
        ask_count: request for the encoder's count, for each axis.
        ask_heat: requests for the temperatures, which firmware 0.6 reports.
        ask_supply: request for the voltage of the supply.
        supply_v: the newest supply voltage, V; 0 if unknown.
        has_news: True after a reply that `encoder_zero` or `heat` may return.
        counted: for each axis, its position by the count, turns, with a velocity of 0; None without
            a reply, or after real estimates have arrived.
    """

    def __init__(
        self, node_ids: tuple[int, int], torque_constant: float, counts_per_turn: int | None
    ) -> None:
        """Start without replies.

        Args:
            node_ids: CAN nodes of axis0 and axis1.
            torque_constant: N m/A.
            counts_per_turn: counts of an encoder per turn; None to ignore counts.
        """

        def requests(command: int) -> bytes:
            return b"".join(request_of(node, command) for node in node_ids)

        self.ask_version = requests(Command06.GET_VERSION)
        self.ask_currents = requests(Command.GET_IQ)
        self.ask_count = [request_of(n, Command.GET_ENCODER_COUNT) for n in node_ids]
        self.ask_heat = requests(Command06.GET_TEMPERATURE)
        self.counted: list[Pair | None] = [None, None]
        self._heat: list[Pair | None] = [None, None]
        self.ask_supply = request_of(node_ids[0], Command.GET_VBUS)
        self.supply_v = 0.0
        self.has_news = False
        self._torques: list[float | None] = [None, None]
        self._zeros: list[float | None] = [None, None]
        self._torque_constant = torque_constant
        self._counts_per_turn = counts_per_turn

    @property
    def torques(self) -> Pair | None:
        """Torque of both motors' own loops, N m; None if unknown."""
        a, b = self._torques
        return (a, b) if a is not None and b is not None else None

    def heat(self) -> tuple[Pair | None, Pair | None]:
        """Return the thermistor readings of output stages and motors, C, once both axes reply."""
        first, second = self._heat
        if first is None or second is None:
            return None, None
        self._heat[:] = None, None
        return real_readings(first[0], second[0]), real_readings(first[1], second[1])

    def take_heat(self, axis: int, data: bytes) -> None:
        """Store the temperatures of axis 0 or 1: output stage, motor."""
        if len(data) == _BYTES:
            self._heat[axis] = cansimple.unpack_two_floats(data)
            self.has_news = True

    def forget_counts(self) -> None:
        """Forget the counts: the drive may have restarted, or may be another one."""
        self.counted[:] = self._zeros[:] = None, None

    def encoder_zero(self) -> Pair | None:
        """Return `DriveReading.encoder_zero`, once each time both axes have replied."""
        a, b = self._zeros
        if a is None or b is None:
            return None
        self._zeros[:] = None, None
        return (a, b)

    def forget_torques(self) -> None:
        """Forget the currents: they predate the last command."""
        self._torques[:] = None, None

    def take_count(self, axis: int, data: bytes) -> None:
        """Store the count of axis 0 or 1; a count shows no velocity."""
        if len(data) == _BYTES and self._counts_per_turn is not None:
            shadow_count, in_turn = cansimple.unpack_two_ints(data)
            self.counted[axis] = (shadow_count / self._counts_per_turn, 0.0)
            per_turn = self._counts_per_turn
            self._zeros[axis] = (shadow_count - in_turn) % per_turn / per_turn
            self.has_news = True

    def take_supply(self, _axis: int, data: bytes) -> None:
        """Store the voltage of the supply, which both axes share."""
        if len(data) == _BYTES:
            volts, _ = cansimple.unpack_two_floats(data)
            if isfinite(volts):
                self.supply_v = max(0.0, volts)

    def take_current(self, axis: int, data: bytes) -> None:
        """Store the motor current that axis 0 or 1 requests, A, unless it is not finite.

        Its sign is that of the torque only if `encoder.config.direction` is 1. Firmware 0.5 does
        not report the direction over CAN; `xrl doctor` reads it over USB.
        """
        if len(data) == _BYTES:
            current, _ = cansimple.unpack_two_floats(data)
            if isfinite(current):
                self._torques[axis] = current * self._torque_constant
