"""The CAN side of the emulated drives: frames to and from an `AxisBank` (docs/drives.md)."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_settings import N_DRIVES
from services.simulator.fronts.cansimple_dialects import DIALECTS, DialectName, Setter
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.cansimple_06 import Command06
from shared.can.unix_can import REMOTE_FLAG, pack_frames
from shared.joints import N_JOINTS

_DATA_BYTES = 8
_SDO_BYTES = 4
_MAILBOXES = 3
_EARLY_S = 1e-6  # tolerance for rounding at a period's end
_S_PER_MS = 1e-3
_FLOAT = struct.Struct("<f").unpack_from
_FLAGGED_ID = REMOTE_FLAG | cansimple.NODE_MASK << cansimple.COMMAND_BITS | cansimple.COMMAND_MASK


class CanSimpleFront:
    """CAN front of the bank: applies received frames, sends estimates and heartbeats.

    `nodes[i]` maps the CAN node ids on `hubs[i]` to axes of the bank. A drive that does not
    communicate (no power, starting up, unplugged) neither receives nor sends nor acknowledges
    frames. On a bus without another node, frames wait until the drive returns. The settings
    `config.can.encoder_rate_ms` and `config.can.heartbeat_rate_ms` set an axis's rates.
    """

    def __init__(
        self,
        bank: AxisBank,
        hubs: Sequence[UnixCanHub],
        nodes: Sequence[Mapping[int, int]],
        *,
        heartbeat_period_ms: int | None = None,
        dialect: DialectName = "0.5",
    ) -> None:
        """Put the drives on their buses.

        Args:
            bank: the drives.
            hubs: the buses.
            nodes: for each bus, the axis (0 .. 11) of each node on it.
            heartbeat_period_ms: heartbeat period for all axes; None keeps their settings.
            dialect: firmware whose CANSimple the drives use.
        """
        self._bank = bank
        self._dialect = DIALECTS[dialect]
        setters = {**_SETTERS, **self._dialect.setters}
        self._buses = [_Bus(hub, node, setters) for hub, node in zip(hubs, nodes, strict=True)]
        self._next_heartbeat_s = [-math.inf] * N_JOINTS
        self._next_encoder_s = [-math.inf] * N_JOINTS
        self._heartbeat_from_s = -math.inf
        self._sent = [(-math.inf, 0)] * N_DRIVES  # time of the last heartbeats, frames with them
        self._crowded = 0
        self._seen = -1
        if heartbeat_period_ms is not None:
            bank.settings.fill("config.can.heartbeat_rate_ms", heartbeat_period_ms)
        for node in nodes:
            for number, axis in node.items():
                bank.settings.set(axis >> 1, f"axis{axis & 1}.config.can.node_id", number)
        for drive in range(N_DRIVES):
            bank.settings.save(drive)

    def receive(self) -> None:
        """Apply all received frames in order."""
        bank = self._bank
        silent, choked = bank.conditions.silent | bank.conditions.deaf, bank.conditions.choked
        for bus in self._buses:
            mailboxes = bus.mailboxes
            bus.hub.choked = not choked.isdisjoint(bus.axes)
            bus.hub.acknowledged = bus.hub.shared or not (silent and silent.issuperset(bus.axes))
            for can_id, data in bus.hub.poll():
                mailbox = mailboxes.get(can_id)
                if mailbox is None:
                    self._answer(bus, can_id, data)
                elif mailbox[0] not in silent:
                    axis, setter = mailbox
                    bank.feed(axis)
                    # The firmware reads all eight bytes of its buffer, even for a shorter frame.
                    setter(bank, axis, data.ljust(_DATA_BYTES, b"\0"))

    def send_encoders(self) -> None:
        """Send the encoder estimates of all axes that are due, in one packet per bus."""
        bank = self._bank
        self._read_periods()
        now_s, silent = bank.now_s, bank.conditions.silent
        due_s, periods_s = self._next_encoder_s, self._encoder_periods_s
        pos, vel = (column.tolist() for column in self._dialect.estimates(bank))
        for bus in self._buses:
            if not bus.hub.clients:
                continue
            fields: list[float] = []
            for encoder_id, axis in bus.encoders:
                due = due_s[axis]
                if now_s >= due - _EARLY_S and axis not in silent:
                    due_s[axis] = (due if due > now_s else now_s) + periods_s[axis]
                    fields += (encoder_id, _DATA_BYTES, pos[axis], vel[axis])
            if len(fields) == bus.encoder_fields:
                bus.hub.broadcast_packet(bus.encoder_packet(*fields))
            elif fields:
                layout = struct.Struct("<" + "IB3xff" * (len(fields) // 4))
                bus.hub.broadcast_packet(layout.pack(*fields))

    def send_heartbeats(self, now_s: float) -> None:
        """Send the heartbeat of each axis whose period has passed by `now_s`."""
        if now_s < self._heartbeat_from_s - _EARLY_S:
            return
        bank, due_s = self._bank, self._next_heartbeat_s
        self._read_periods()
        for bus in self._buses:
            frames = []
            for node, axis in bus.nodes.items():
                due = due_s[axis]
                if now_s >= due - _EARLY_S:
                    due_s[axis] = max(due, now_s - _EARLY_S) + self._heartbeat_periods_s[axis]
                    if bank.is_responding(axis):
                        self._count(axis, now_s)
                        can_id = cansimple.arbitration_id(node, Command.HEARTBEAT)
                        frames.append((can_id, self._dialect.heartbeat(bank, axis)))
            if frames:
                bus.hub.broadcast(frames)
        dues = (due_s[axis] for bus in self._buses for axis in bus.axes)
        self._heartbeat_from_s = min(dues, default=math.inf)

    def _count(self, axis: int, now_s: float) -> None:
        """Count the mailboxes that a heartbeat, and an encoder frame sent with it, occupy."""
        sent_s, frames = self._sent[axis >> 1]
        since_s = now_s - (self._next_encoder_s[axis] - self._encoder_periods_s[axis])
        frames = 1 + (abs(since_s) < _EARLY_S) + (frames if sent_s == now_s else 0)
        self._sent[axis >> 1] = now_s, frames

    def _read_periods(self) -> None:
        """Read the periods from the settings if these have changed; 0 disables a message."""
        settings = self._bank.settings
        if self._seen == settings.version:
            return
        self._seen = settings.version
        self._heartbeat_from_s = -math.inf
        self._encoder_periods_s = _periods_s(settings.axis("config.can.encoder_rate_ms"))
        self._heartbeat_periods_s = _periods_s(settings.axis("config.can.heartbeat_rate_ms"))
        for due_s, periods_s in (
            (self._next_encoder_s, self._encoder_periods_s),
            (self._next_heartbeat_s, self._heartbeat_periods_s),
        ):
            for axis, period_s in enumerate(periods_s):
                if period_s == math.inf or due_s[axis] == math.inf:
                    due_s[axis] = period_s if period_s == math.inf else self._bank.now_s

    def _answer(self, bus: _Bus, can_id: int, data: bytes) -> None:
        """Answer a frame that sets nothing, if its command has an answer."""
        node, command = cansimple.split_id(can_id)
        axis = bus.nodes.get(node)
        bank = self._bank
        if axis is None or can_id & ~_FLAGGED_ID or not bank.is_responding(axis):
            return
        if axis in bank.conditions.deaf:
            return
        self._bank.feed(axis)
        answer = self._dialect.answers.get(command)
        reply: bytes | None = None
        asked = self._dialect.asked.get(command)
        reply_id = can_id & ~REMOTE_FLAG
        if asked is not None:
            reply = asked(self._bank, axis, data.ljust(_DATA_BYTES, b"\0"))
        elif answer is not None and (can_id & REMOTE_FLAG or not data):
            reply = answer(self._bank, axis)
        elif command == Command06.RX_SDO and self._dialect.sdo is not None:
            reply_id = cansimple.arbitration_id(node, Command06.TX_SDO)
            reply = self._dialect.sdo(self._bank, axis, data.ljust(_SDO_BYTES, b"\0"))
        if reply is not None and not self._is_lost(axis):
            bus.hub.broadcast_packet(pack_frames([(reply_id, reply)]))

    def _is_lost(self, axis: int) -> bool:
        """Return True if an answer is lost because all three mailboxes of its drive are full.

        They are full for about 0.6 ms while heartbeats and encoder frames of both axes are sent.
        With encoder frames at 1 kHz, 0.6 % of the requests get no answer, and the drive repeats
        none.
        """
        sent_s, frames = self._sent[axis >> 1]
        if frames < _MAILBOXES or sent_s != self._bank.now_s:
            return False
        self._crowded = (self._crowded + 1) % 5
        return self._crowded < 3


def _periods_s(periods_ms: NDArray[np.float64]) -> list[float]:
    """Return periods in s; 0 ms becomes infinite."""
    return [ms * _S_PER_MS if ms > 0.0 else math.inf for ms in periods_ms.tolist()]


class _Bus:
    """A hub with its axes, and precomputed values."""

    def __init__(
        self, hub: UnixCanHub, nodes: Mapping[int, int], setters: Mapping[int, Setter]
    ) -> None:
        self.hub = hub
        self.nodes = dict(nodes)
        self.axes = tuple(nodes.values())
        self.mailboxes = {
            cansimple.arbitration_id(node, command): (axis, setter)
            for node, axis in nodes.items()
            for command, setter in setters.items()
        }
        self.encoders = [
            (cansimple.arbitration_id(node, Command.GET_ENCODER_ESTIMATES), axis)
            for node, axis in nodes.items()
        ]
        self.encoder_fields = 4 * len(self.encoders)
        self.encoder_packet = struct.Struct("<" + "IB3xff" * len(self.encoders)).pack


def _writer(columns: Sequence[str], unpack: Callable[[bytes], Sequence[float]]) -> Setter:
    """Return a setter that writes a frame's numbers to columns of the bank."""

    def write(bank: AxisBank, axis: int, data: bytes) -> None:
        for column, value in zip(columns, unpack(data), strict=True):
            getattr(bank, column)[axis] = value

    return write


def _set_input_pos(bank: AxisBank, axis: int, data: bytes) -> None:
    """Write a target; `_writer` is too slow for this frequent frame."""
    pos, vel, torque = cansimple.unpack_input_pos(data)
    bank.input_pos[axis] = pos
    bank.input_vel[axis] = vel
    bank.input_torque[axis] = torque


_TWO: Final = cansimple.unpack_two_floats
_SETTERS: Final[dict[int, Setter]] = {
    Command.ESTOP: lambda bank, axis, _: bank.estop(axis),
    Command.SET_AXIS_STATE: lambda b, axis, data: b.request_state(axis, cansimple.unpack_u32(data)),
    Command.SET_CONTROLLER_MODE: lambda bank, axis, data: bank.set_modes(
        axis, *cansimple.unpack_two_ints(data)
    ),
    Command.SET_INPUT_POS: _set_input_pos,
    Command.SET_INPUT_VEL: _writer(("input_vel", "input_torque"), _TWO),
    Command.SET_INPUT_TORQUE: _writer(("input_torque",), _FLOAT),
    Command.SET_LIMITS: _writer(("vel_limit", "current_lim"), _TWO),
    Command.REBOOT: lambda bank, axis, _: bank.reboot(axis),
    Command.SET_LINEAR_COUNT: lambda bank, axis, data: bank.set_count(
        axis, cansimple.unpack_two_ints(data)[0]
    ),
    Command.CLEAR_ERRORS: lambda bank, axis, _: bank.clear_errors(axis),
    Command.SET_POS_GAIN: _writer(("pos_gain",), _FLOAT),
    Command.SET_VEL_GAINS: _writer(("vel_gain", "vel_integrator_gain"), _TWO),
}
