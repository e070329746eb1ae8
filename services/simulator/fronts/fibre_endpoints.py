"""Table of endpoints that an emulated ODrive v3 shows over its native (Fibre) protocol.

It is the part of firmware 0.5.6's tree that this project uses: all settings of the bank by the
firmware's names, measurements, and functions. Units at the
motor: turns, turn/s, N m, A, V, C.

Source: odriverobotics/ODrive, Firmware/odrive-interface.yaml.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_settings import AXIS_SETTINGS, DRIVE_SETTINGS, Value
from shared.can.cansimple import AxisState, InputMode

AXES: Final = (0, 1)
HARDWARE: Final = (3, 6, 56)
FIRMWARE: Final = (0, 5, 6)

CODECS: Final = {
    "bool": "?",
    "uint8": "B",
    "uint16": "H",
    "uint32": "I",
    "uint64": "Q",
    "int32": "i",
    "float": "f",
}
"""Fibre's types and their `struct` letters, all little-endian."""

_UNSIGNED = {
    "can.config.baud_rate": "uint32",
    "config.can.node_id": "uint32",
    "config.can.heartbeat_rate_ms": "uint32",
    "config.can.encoder_rate_ms": "uint32",
    "controller.config.control_mode": "uint8",
    "controller.config.input_mode": "uint8",
    "encoder.config.mode": "uint16",
}
"""Whole settings that are not an int32."""
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
        """True if the board is powered, up and plugged in."""
        return self.bank.is_responding(self.axis(0))

    def save(self) -> None:
        """Save the configuration, which restarts the board; refused while an axis is armed."""
        if all(self.bank.state[self.axis(i)] == AxisState.IDLE for i in AXES):
            self.bank.settings.save(self.drive)
            self.bank.reboot(self.axis(0))


class Property(NamedTuple):
    """A value that can be read, and written if `write` is there."""

    name: str
    type: str
    read: Callable[[EmulatedBoard], Value]
    write: Callable[[EmulatedBoard, Value], None] | None = None


class Argument(NamedTuple):
    """An argument of a function: an endpoint of its own, written before the call."""

    name: str
    type: str


class Function(NamedTuple):
    """A function without results; the endpoints of its arguments follow it."""

    name: str
    call: Callable[..., None]
    """Function of the board and the arguments."""
    arguments: tuple[Argument, ...] = ()


Endpoint = Property | Function | Argument


def endpoints() -> list[Endpoint]:
    """Return all endpoints of a board by dotted name, in the order of their ids from 1."""
    rows: list[Endpoint] = [
        Property("vbus_voltage", "float", lambda b: b.bank.bus.state(b.drive)[0]),
        Property("ibus", "float", lambda b: b.bank.bus.state(b.drive)[1]),
        Property("serial_number", "uint64", lambda b: b.serial_number),
        *_version("hw_version_", ("major", "minor", "variant"), HARDWARE),
        *_version("fw_version_", ("major", "minor", "revision"), FIRMWARE),
        *_version("fw_version_", ("unreleased",), (0,)),
        Property("error", "uint8", lambda b: b.bank.faults[b.axis(0)].odrive),
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
    """Return the endpoints of one axis but for its settings."""
    return [
        _fault("error", "uint32", i, "axis"),
        Property("current_state", "uint8", lambda b: int(b.bank.state[b.axis(i)])),
        Property(
            "requested_state",
            "uint8",
            lambda _: int(AxisState.UNDEFINED),
            lambda b, value: b.bank.request_state(b.axis(i), int(value)),
        ),
        Function("watchdog_feed", lambda b: b.bank.feed(b.axis(i))),
        _fault("motor.error", "uint64", i, "motor"),
        Property("motor.is_calibrated", "bool", lambda b: b.bank.calibration.motor[b.axis(i)]),
        Property(
            "motor.is_armed",
            "bool",
            lambda b: b.bank.state[b.axis(i)] == AxisState.CLOSED_LOOP_CONTROL,
        ),
        Property(
            "motor.fet_thermistor.temperature",
            "float",
            lambda b: b.bank.conditions.temperature[b.axis(i)],
        ),
        Property("motor.current_control.Iq_setpoint", "float", lambda b: _current(b, i)),
        Property("motor.current_control.Iq_measured", "float", lambda b: _current(b, i)),
        _fault("encoder.error", "uint16", i, "encoder"),
        Property("encoder.is_ready", "bool", lambda b: b.bank.calibration.encoder[b.axis(i)]),
        Property("encoder.pos_estimate", "float", lambda b: float(b.bank.pos_estimate[b.axis(i)])),
        Property("encoder.vel_estimate", "float", lambda b: float(b.bank.vel_estimate[b.axis(i)])),
        Function(
            "encoder.set_linear_count",
            lambda b, count: b.bank.set_count(b.axis(i), count),
            (Argument("count", "int32"),),
        ),
        _fault("controller.error", "uint8", i, "controller"),
        *(_input(name, i) for name in ("input_pos", "input_vel", "input_torque")),
    ]


def _version(prefix: str, parts: tuple[str, ...], numbers: tuple[int, ...]) -> list[Endpoint]:
    def constant(part: str, number: int) -> Property:
        return Property(prefix + part, "uint8", lambda _: number)

    return [constant(part, number) for part, number in zip(parts, numbers, strict=True)]


def _fault(name: str, kind: str, i: int, register: str) -> Property:
    return Property(name, kind, lambda b: int(getattr(b.bank.faults[b.axis(i)], register)))


def _current(board: EmulatedBoard, i: int) -> float:
    axis = board.axis(i)
    return board.bank.settings.current(axis, board.bank.torque[axis])


def _input(name: str, i: int) -> Property:
    def write(board: EmulatedBoard, value: Value) -> None:
        getattr(board.bank, name)[board.axis(i)] = value

    return Property(
        f"controller.{name}", "float", lambda b: float(getattr(b.bank, name)[b.axis(i)]), write
    )


def _setting(name: str, default: Value) -> Property:
    """Return a setting's endpoint."""
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
    """Set a setting; a mode goes to the controller, which knows which there are."""
    axis, _, below = name.partition(".")
    if below not in _MODES or (below == _INPUT_MODE and value == InputMode.PASSTHROUGH):
        board.bank.settings.set(board.drive, name, value)
        return
    modes = [int(board.bank.settings.get(board.drive, f"{axis}.{mode}")) for mode in _MODES]
    modes[_MODES.index(below)] = int(value)
    board.bank.set_modes(board.axis(int(axis[-1])), *modes)
