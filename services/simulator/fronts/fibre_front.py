"""Native protocol (Fibre, legacy packet format) of the emulated drives (docs/drives.md).

`endpoints` returns the part of firmware 0.5.6's tree that this project uses: the bank's settings by
the firmware's names, measurements, and functions. Units at the motor: turns, turn/s, N m, A, V, C.

`FibreFront` is the protocol of one board: it turns requests into answers, all little-endian.

Request: sequence number, endpoint id (bit 15 requests an answer), size of the answer,
payload, and a trailer that identifies the client's table of endpoints. Answer: the
sequence number with bit 15 set, payload.

Source: odriverobotics/ODrive, docs/protocol.rst, Firmware/fibre-cpp and odrive-interface.yaml.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_settings import AXIS_SETTINGS, DRIVE_SETTINGS, Value
from shared.can.cansimple import AxisState, InputMode
from shared.exceptions import DriveError

PROTOCOL_VERSION: Final = 1
ANSWER_BYTES: Final = 61
"""Maximum bytes after an answer's sequence number; a longer answer is truncated."""

_CRC16_POLYNOMIAL = 0x3D65
_ANSWER = 0x8000
_VERSION_ID = 0xFFFF_FFFF  # this "offset" into the JSON requests its id instead
_HEADER = struct.Struct("<HHH")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")

AXES: Final = (0, 1)
HARDWARE: Final = (3, 6, 56)
FIRMWARE: Final = (0, 5, 6)

CODECS: Final = {
    "bool": struct.Struct("<?"),
    "uint8": struct.Struct("<B"),
    "uint16": struct.Struct("<H"),
    "uint32": struct.Struct("<I"),
    "uint64": struct.Struct("<Q"),
    "int32": struct.Struct("<i"),
    "float": struct.Struct("<f"),
}
"""Fibre's types."""

_UNSIGNED = {
    "can.config.baud_rate": "uint32",
    "config.can.node_id": "uint32",
    "config.can.heartbeat_rate_ms": "uint32",
    "config.can.encoder_rate_ms": "uint32",
    "controller.config.control_mode": "uint8",
    "controller.config.input_mode": "uint8",
    "encoder.config.mode": "uint16",
}
"""Integer settings whose type is not int32."""
_INPUT_MODE = "controller.config.input_mode"
_MODES = ("controller.config.control_mode", _INPUT_MODE)


class EmulatedBoard(NamedTuple):
    """One emulated ODrive: two axes of a bank."""

    bank: AxisBank
    drive: int
    """0 .. 5, in the order of the modules."""
    serial_number: int

    def axis(self, i: int) -> int:
        """Return the index of axis0 or axis1 in the bank."""
        return 2 * self.drive + i

    @property
    def is_responding(self) -> bool:
        """True if the board is powered, started and plugged in."""
        return self.bank.is_responding(self.axis(0))

    def save(self) -> None:
        """Save the configuration, which restarts the board; ignored unless both axes are idle."""
        if all(self.bank.state[self.axis(i)] == AxisState.IDLE for i in AXES):
            self.bank.settings.save(self.drive)
            self.bank.reboot(self.axis(0))


class Property(NamedTuple):
    """A value that can be read, and written unless `write` is None."""

    name: str
    type: str
    read: Callable[[EmulatedBoard], Value]
    write: Callable[[EmulatedBoard, Value], None] | None = None


class _Argument(NamedTuple):
    """An argument of a function: a separate endpoint, written before the call."""

    name: str
    type: str


class Function(NamedTuple):
    """A function without results; the endpoints of its arguments follow it."""

    name: str
    call: Callable[..., None]
    """Called with the board and the arguments."""
    arguments: tuple[_Argument, ...] = ()


Endpoint = Property | Function | _Argument


def endpoints() -> list[Endpoint]:
    """Return all endpoints of a board by dotted name, in the order of their ids from 1."""
    rows: list[Endpoint] = [
        Property("vbus_voltage", "float", lambda b: b.bank.bus.state(b.drive)[0]),
        Property("ibus", "float", lambda b: b.bank.bus.state(b.drive)[1]),
        Property("serial_number", "uint64", lambda b: b.serial_number),
        *_version("hw_version_", ("major", "minor", "variant"), HARDWARE),
        *_version("fw_version_", ("major", "minor", "revision"), FIRMWARE),
        *_version("fw_version_", ("unreleased",), (0,)),
        Property("error", "uint8", lambda b: b.bank.faults[b.axis(0)].odrive, _set_odrive_error),
        *(_setting(name, default) for name, default in DRIVE_SETTINGS.items()),
        Function("clear_errors", lambda b: b.bank.clear_errors(b.axis(0))),
        Function("save_configuration", EmulatedBoard.save),
        Function("reboot", lambda b: b.bank.reboot(b.axis(0))),
    ]
    for i in AXES:
        for row in _axis(i):
            rows.append(row._replace(name=f"axis{i}.{row.name}"))
            rows += row.arguments if isinstance(row, Function) else ()
        rows += [_setting(f"axis{i}.{name}", default) for name, default in AXIS_SETTINGS.items()]
    return rows


def _axis(i: int) -> list[Property | Function]:
    def shown(name: str, kind: str, value: Callable[[AxisBank, int], Value]) -> Property:
        return Property(name, kind, lambda b: value(b.bank, b.axis(i)))

    def fault(name: str, kind: str, register: str) -> Property:
        read = lambda b: int(getattr(b.bank.faults[b.axis(i)], register))  # noqa: E731
        write = lambda b, value: b.bank.set_error(b.axis(i), register, int(value))  # noqa: E731
        return Property(name, kind, read, write)

    return [
        fault("error", "uint32", "axis"),
        shown("current_state", "uint8", lambda bank, axis: int(bank.state[axis])),
        Property(
            "requested_state",
            "uint8",
            lambda _: int(AxisState.UNDEFINED),
            lambda b, value: b.bank.request_state(b.axis(i), int(value)),
        ),
        Function("watchdog_feed", lambda b: b.bank.feed(b.axis(i))),
        fault("motor.error", "uint64", "motor"),
        shown("motor.is_calibrated", "bool", lambda bank, axis: bank.calibration.motor[axis]),
        shown("motor.is_armed", "bool", _is_armed),
        shown("motor.fet_thermistor.temperature", "float", lambda bank, axis: bank.heat.fet[axis]),
        shown(
            "motor.motor_thermistor.temperature", "float", lambda bank, axis: bank.heat.motor[axis]
        ),
        shown(
            "motor.current_control.Iq_setpoint", "float", lambda bank, axis: bank.currents(axis)[0]
        ),
        shown(
            "motor.current_control.Iq_measured", "float", lambda bank, axis: bank.currents(axis)[1]
        ),
        fault("encoder.error", "uint16", "encoder"),
        shown("encoder.is_ready", "bool", lambda bank, axis: bank.calibration.encoder[axis]),
        shown("encoder.shadow_count", "int32", lambda bank, axis: bank.encoder_count(axis)),
        shown("encoder.count_in_cpr", "int32", lambda bank, axis: bank.encoder_angle(axis)),
        shown(
            "encoder.calib_scan_response",
            "float",
            lambda bank, axis: bank.calibration.response[axis],
        ),
        shown("encoder.pos_estimate", "float", lambda bank, axis: bank.pos_estimate[axis]),
        shown("encoder.vel_estimate", "float", lambda bank, axis: bank.vel_estimate[axis]),
        Function(
            "encoder.set_linear_count",
            lambda b, count: b.bank.set_count(b.axis(i), count),
            (_Argument("count", "int32"),),
        ),
        fault("controller.error", "uint8", "controller"),
        *(_input(name, i) for name in ("input_pos", "input_vel", "input_torque")),
    ]


def _version(prefix: str, parts: tuple[str, ...], numbers: tuple[int, ...]) -> list[Endpoint]:
    def constant(part: str, number: int) -> Property:
        return Property(prefix + part, "uint8", lambda _: number)

    return [constant(part, number) for part, number in zip(parts, numbers, strict=True)]


def _set_odrive_error(board: EmulatedBoard, value: Value) -> None:
    for i in AXES:
        board.bank.set_error(board.axis(i), "odrive", int(value))


def _is_armed(bank: AxisBank, axis: int) -> bool:
    return bank.state[axis] not in (AxisState.IDLE, AxisState.UNDEFINED)


def _input(name: str, i: int) -> Property:
    def write(board: EmulatedBoard, value: Value) -> None:
        getattr(board.bank, name)[board.axis(i)] = value

    return Property(
        f"controller.{name}", "float", lambda b: float(getattr(b.bank, name)[b.axis(i)]), write
    )


def _setting(name: str, default: Value) -> Property:
    below = name.partition(".")[2] if name.startswith("axis") else name
    if isinstance(default, bool):
        kind = "bool"
    else:
        kind = "float" if isinstance(default, float) else _UNSIGNED.get(below, "int32")
    return Property(
        name,
        kind,
        lambda b: b.bank.settings.get(b.drive, name),
        lambda b, value: _set(b, name, value),
    )


def _set(board: EmulatedBoard, name: str, value: Value) -> None:
    """Set a setting; a mode goes to the controller, which checks it."""
    axis, _, below = name.partition(".")
    if below not in _MODES or (below == _INPUT_MODE and value == InputMode.PASSTHROUGH):
        board.bank.settings.set(board.drive, name, value)
        if below.endswith(".pre_calibrated"):
            board.bank.calibration.take_mark(board.axis(int(axis[-1])), below)
        return
    modes = [int(board.bank.settings.get(board.drive, f"{axis}.{mode}")) for mode in _MODES]
    modes[_MODES.index(below)] = int(value)
    board.bank.set_modes(board.axis(int(axis[-1])), *modes)


def crc16(initial: int, data: bytes) -> int:
    """Return Fibre's CRC16: polynomial 0x3d65, no reflection, no final xor."""
    crc = initial
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (_CRC16_POLYNOMIAL if crc & 0x8000 else 0)) & 0xFFFF
    return crc


class FibreFront:
    """The protocol of one board.

    Attributes:
        descriptor: the JSON with endpoints and ids, for clients.
        ignored: number of invalid requests, which the firmware ignores too, and of values that a
            setting refused.
    """

    def __init__(self, board: EmulatedBoard) -> None:
        self.board = board
        self.ignored = 0
        self._rows = endpoints()
        self._arguments: dict[int, float] = {
            number: 0 for number, row in enumerate(self._rows) if isinstance(row, _Argument)
        }
        self.descriptor = json.dumps(_tree(self._rows), separators=(",", ":")).encode()
        self._crc = crc16(PROTOCOL_VERSION, self.descriptor)
        self._version_id = self._crc << 16 | crc16(self._crc, self.descriptor)

    def answer(self, packet: bytes) -> bytes | None:
        """Execute one request; return the answer, or None if there is none."""
        if len(packet) < _HEADER.size + _U16.size:
            self.ignored += 1
            return None
        sequence, endpoint, size = _HEADER.unpack_from(packet)
        (trailer,) = _U16.unpack_from(packet, len(packet) - _U16.size)
        payload = packet[_HEADER.size : -_U16.size]
        number = endpoint & ~_ANSWER
        if sequence & _ANSWER or trailer != (self._crc if number else PROTOCOL_VERSION):
            self.ignored += 1
            return None
        known = number <= len(self._rows)  # the firmware's answer for others is empty
        result = self._operate(number, payload)[: min(size, ANSWER_BYTES)] if known else b""
        if not endpoint & _ANSWER:
            return None
        return _U16.pack(sequence | _ANSWER) + result

    def _operate(self, number: int, payload: bytes) -> bytes:
        """Write to an endpoint or call it; return its value before that."""
        if number == 0:
            return self._describe(payload)
        row = self._rows[number - 1]
        if isinstance(row, Function):
            first = number  # the index of its first argument: ids count from 1
            values = [self._arguments[first + i] for i in range(len(row.arguments))]
            row.call(self.board, *values)
            return b""
        codec = CODECS[row.type]
        if isinstance(row, _Argument):
            held = codec.pack(self._arguments[number - 1])
            if len(payload) >= codec.size:
                self._arguments[number - 1] = codec.unpack_from(payload)[0]
            return held
        held = codec.pack(row.read(self.board))
        if row.write is not None and len(payload) >= codec.size:
            try:
                row.write(self.board, codec.unpack_from(payload)[0])
            except DriveError:
                self.ignored += 1
        return held

    def _describe(self, payload: bytes) -> bytes:
        if len(payload) < _U32.size:
            return b""
        (offset,) = _U32.unpack_from(payload)
        if offset == _VERSION_ID:
            return _U32.pack(self._version_id)
        return self.descriptor[offset:]


def _tree(rows: list[Endpoint]) -> list[dict[str, Any]]:
    """Return the JSON descriptor of endpoints with dotted names; ids count from 1."""
    root: list[dict[str, Any]] = [{"name": "", "id": 0, "type": "json", "access": "r"}]
    objects = {"": root}

    def members(path: str) -> list[dict[str, Any]]:
        if path not in objects:
            above, _, name = path.rpartition(".")
            objects[path] = []
            members(above).append({"name": name, "type": "object", "members": objects[path]})
        return objects[path]

    for number, row in enumerate(rows, start=1):
        if not isinstance(row, _Argument):
            path, _, name = row.name.rpartition(".")
            members(path).append({"name": name, "id": number, **_description(number, row)})
    return root


def _description(number: int, row: Property | Function) -> dict[str, Any]:
    if isinstance(row, Property):
        return {"type": row.type, "access": "r" if row.write is None else "rw"}
    inputs = [
        {"name": each.name, "id": number + 1 + i, "type": each.type, "access": "rw"}
        for i, each in enumerate(row.arguments)
    ]
    return {"type": "function", "inputs": inputs, "outputs": []}
