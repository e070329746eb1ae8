"""The CAN side of the emulated drives: frames to and from an `AxisBank` (design section 5)."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from services.simulator.axis_bank import AxisBank
from shared import cansimple
from shared.cansimple import Command
from shared.unix_can import REMOTE_FLAG, pack_frames
from shared.unix_can_hub import UnixCanHub

BUS_VOLTAGE: Final = 48.0
"""V, what the emulated drives report."""

_DATA_BYTES = 8
_S_PER_MS = 1e-3
_TORQUE = struct.Struct("<f").unpack_from
_FLAGGED_ID = REMOTE_FLAG | cansimple.NODE_MASK << cansimple.COMMAND_BITS | cansimple.COMMAND_MASK


class CanSimpleFront:
    """Applies received frames to the bank and sends its estimates and heartbeats.

    `nodes[i]` maps the CAN node ids on `hubs[i]` to axes of the bank.
    """

    def __init__(
        self,
        bank: AxisBank,
        hubs: Sequence[UnixCanHub],
        nodes: Sequence[Mapping[int, int]],
        *,
        heartbeat_period_ms: int,
    ) -> None:
        self._bank = bank
        self._buses = [_Bus(hub, node) for hub, node in zip(hubs, nodes, strict=True)]
        self._heartbeat_period_s = heartbeat_period_ms * _S_PER_MS
        self._next_heartbeat_s = -math.inf

    def receive(self) -> None:
        """Apply all frames that have arrived; in each mailbox the newest wins."""
        bank = self._bank
        for bus in self._buses:
            torque_axes = bus.torque_axes
            for can_id, data in bus.hub.poll():
                axis = torque_axes.get(can_id)
                if axis is not None and len(data) >= 4:
                    bank.feed(axis)
                    bank.input_torque[axis] = _TORQUE(data)[0]
                else:
                    self._apply(bus, can_id, data)

    def send_encoders(self) -> None:
        """Send the encoder estimates of all axes, in one packet per bus."""
        pos = self._bank.pos_estimate.tolist()
        vel = self._bank.vel_estimate.tolist()
        for bus in self._buses:
            if not bus.hub.clients:
                continue
            fields: list[float] = []
            for encoder_id, axis in bus.encoders:
                fields += (encoder_id, _DATA_BYTES, pos[axis], vel[axis])
            bus.hub.broadcast_packet(bus.encoder_packet(*fields))

    def send_heartbeats(self, now_s: float) -> None:
        """Send every axis's heartbeat if its period has passed by `now_s`."""
        if now_s < self._next_heartbeat_s:
            return
        self._next_heartbeat_s = max(self._next_heartbeat_s, now_s) + self._heartbeat_period_s
        for bus in self._buses:
            bus.hub.broadcast(
                (
                    cansimple.arbitration_id(node, Command.HEARTBEAT),
                    cansimple.pack_heartbeat(self._bank.heartbeat(axis)),
                )
                for node, axis in bus.nodes.items()
            )

    def _apply(self, bus: _Bus, can_id: int, data: bytes) -> None:
        """Apply or answer one frame that is not an input torque."""
        node, command = cansimple.split_id(can_id)
        axis = bus.nodes.get(node)
        if axis is None or can_id & ~_FLAGGED_ID:
            return
        self._bank.feed(axis)
        answer = _ANSWERS.get(command)
        if answer is not None:
            if can_id & REMOTE_FLAG or not data:
                bus.hub.broadcast_packet(
                    pack_frames([(can_id & ~REMOTE_FLAG, answer(self._bank, axis))])
                )
            return
        setter = _SETTERS.get(command)
        if setter is not None:
            # The firmware reads its eight-byte buffer whatever the frame's length.
            setter(self._bank, axis, data.ljust(_DATA_BYTES, b"\0"))


class _Bus:
    """A hub with its axes, and what is worked out once."""

    def __init__(self, hub: UnixCanHub, nodes: Mapping[int, int]) -> None:
        self.hub = hub
        self.nodes = dict(nodes)
        self.torque_axes = {
            cansimple.arbitration_id(node, Command.SET_INPUT_TORQUE): axis
            for node, axis in nodes.items()
        }
        self.encoders = [
            (cansimple.arbitration_id(node, Command.GET_ENCODER_ESTIMATES), axis)
            for node, axis in nodes.items()
        ]
        self.encoder_packet = struct.Struct("<" + "IB3xff" * len(self.encoders)).pack


def _set_state(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.request_state(axis, cansimple.unpack_u32(data))


def _set_modes(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.set_modes(axis, *cansimple.unpack_two_ints(data))


def _set_input_pos(bank: AxisBank, axis: int, data: bytes) -> None:
    pos, vel, torque = cansimple.unpack_input_pos(data)
    bank.input_pos[axis] = pos
    bank.input_vel[axis] = vel
    bank.input_torque[axis] = torque


def _set_input_vel(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.input_vel[axis], bank.input_torque[axis] = cansimple.unpack_two_floats(data)


def _set_input_torque(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.input_torque[axis] = cansimple.unpack_float(data)


def _set_limits(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.vel_limit[axis], bank.current_lim[axis] = cansimple.unpack_two_floats(data)


def _set_pos_gain(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.pos_gain[axis] = cansimple.unpack_float(data)


def _set_vel_gains(bank: AxisBank, axis: int, data: bytes) -> None:
    bank.vel_gain[axis], bank.vel_integrator_gain[axis] = cansimple.unpack_two_floats(data)


def _estop(bank: AxisBank, axis: int, _data: bytes) -> None:
    bank.estop(axis)


def _clear_errors(bank: AxisBank, axis: int, _data: bytes) -> None:
    bank.clear_errors(axis)


def _reboot(bank: AxisBank, axis: int, _data: bytes) -> None:
    bank.reboot(axis)


_SETTERS: Final[dict[int, Callable[[AxisBank, int, bytes], None]]] = {
    Command.ESTOP: _estop,
    Command.SET_AXIS_STATE: _set_state,
    Command.SET_CONTROLLER_MODE: _set_modes,
    Command.SET_INPUT_POS: _set_input_pos,
    Command.SET_INPUT_VEL: _set_input_vel,
    Command.SET_INPUT_TORQUE: _set_input_torque,
    Command.SET_LIMITS: _set_limits,
    Command.REBOOT: _reboot,
    Command.CLEAR_ERRORS: _clear_errors,
    Command.SET_POS_GAIN: _set_pos_gain,
    Command.SET_VEL_GAINS: _set_vel_gains,
}


def _encoder_estimates(bank: AxisBank, axis: int) -> bytes:
    return cansimple.pack_two_floats(bank.pos_estimate[axis], bank.vel_estimate[axis])


def _encoder_count(bank: AxisBank, axis: int) -> bytes:
    count = round(bank.pos_estimate[axis] * bank.encoder_counts_per_turn)
    return cansimple.pack_two_ints(count, count % bank.encoder_counts_per_turn)


def _iq(bank: AxisBank, axis: int) -> bytes:
    iq = bank.torque[axis] / bank.torque_constant
    return cansimple.pack_two_floats(iq, iq)


def _vbus(_bank: AxisBank, _axis: int) -> bytes:
    return cansimple.pack_two_floats(BUS_VOLTAGE, 0.0)


def _motor_error(bank: AxisBank, axis: int) -> bytes:
    return cansimple.pack_motor_error(bank.faults[axis].motor)


def _encoder_error(bank: AxisBank, axis: int) -> bytes:
    return cansimple.pack_u32(bank.faults[axis].encoder).ljust(_DATA_BYTES, b"\0")


def _controller_error(bank: AxisBank, axis: int) -> bytes:
    return cansimple.pack_u32(bank.faults[axis].controller).ljust(_DATA_BYTES, b"\0")


_ANSWERS: Final[dict[int, Callable[[AxisBank, int], bytes]]] = {
    Command.GET_MOTOR_ERROR: _motor_error,
    Command.GET_ENCODER_ERROR: _encoder_error,
    Command.GET_ENCODER_ESTIMATES: _encoder_estimates,
    Command.GET_ENCODER_COUNT: _encoder_count,
    Command.GET_IQ: _iq,
    Command.GET_VBUS: _vbus,
    Command.GET_CONTROLLER_ERROR: _controller_error,
}
