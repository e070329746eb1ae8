"""A gamepad, by evdev: the extra `pad`."""

from __future__ import annotations

import select
from typing import Any, Final

from shared.exceptions import FleetError
from shared.extras import late, require
from tools.pads.controls import (
    BTN_JOYSTICK,
    BTN_SOUTH,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    STICKS,
    SYN_DROPPED,
    TRIGGERS,
    PadControl,
    PadDevice,
    PadMapping,
    codes_of,
)
from tools.pads.mappings import mapping_or_none
from tools.pads.pilot import DEAD_ZONE, Deflection

evdev: Any = late("evdev")


STICK_REST_MAX: Final = DEAD_ZONE
"""Farthest from its middle that a stick let go of lies, of half its way.

Whoever holds one farther away is asked to let go. Within it the middle is learnt. It is no more
than the dead zone: a stick that was held while it was learnt leads nowhere once it is let go.
"""
TRIGGER_REST_MAX: Final = 0.1
"""Farthest from its end that a trigger let go of lies, of its whole way."""
SHOWN: Final = {
    "lefty": "left stick", "righty": "right stick", "lefttrigger": "left trigger",
    "righttrigger": "right trigger",
}  # fmt: skip


class Axis:
    """One axis, or a button in its place: the way from where it rests."""

    def __init__(self, name: str, control: PadControl, device: PadDevice) -> None:
        """Take its range and its value."""
        self.name, self.control = name, control
        self._sign = -1.0 if control.inverted else 1.0
        low, high = 0.0, 1.0
        if control.kind == EV_ABS:
            span = device.absinfo(control.code)
            low, high = float(span.min), float(span.max)
        if not low < high:
            raise FleetError(f"{device.name}: {SHOWN[name]}: its axis has no range")
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._rest = 0.0 if name in STICKS else -1.0
        self.value = self._middle
        self.read(device)

    def read(self, device: PadDevice) -> None:
        """Ask the kernel for its value now."""
        if self.control.kind == EV_ABS:
            self.value = device.absinfo(self.control.code).value
        else:
            self.value = int(self.control.code in device.active_keys())

    @property
    def _position(self) -> float:
        """Its place in its range, -1 to 1."""
        place = self._sign * (self.value - self._middle) / self._half
        return max(-1.0, min(1.0, place))

    @property
    def way(self) -> float:
        """Way from where it rests: -1 to 1 of a stick, 0 to 1 of a trigger."""
        off = self._position - self._rest
        if self.name in TRIGGERS:
            return max(0.0, off / (1.0 - self._rest))
        return off / (1.0 - self._rest if off > 0.0 else 1.0 + self._rest)

    def held(self) -> str:
        """Return how far it is from where one rests that nobody touches; "" if it rests."""
        position = self._position
        if self.name in STICKS:
            off, most = abs(position), STICK_REST_MAX
        else:
            off, most = 0.5 * (position + 1.0), TRIGGER_REST_MAX
        return "" if off <= most else f"{SHOWN[self.name]} ({100.0 * off:.0f} %)"

    def learn_rest(self) -> None:
        """Take where it is as where it rests."""
        self._rest = self._position


class Gamepad:
    """Sticks and buttons as they are now.

    Attributes:
        name: of the pad.
        gone: it was unplugged, or its receiver lost it.
        stopped: the stop was pressed.
        settled: it is known where the sticks and triggers rest; until then nothing is led.
    """

    def __init__(
        self, device: PadDevice, mapping: PadMapping, *, hold: str = "rightshoulder",
        stop: str = "b",
    ) -> None:  # fmt: skip
        """Take an open device, its mapping, and the dead man's button and the stop by name."""
        for name in (hold, stop):
            if name not in mapping:
                raise FleetError(f"{device.name}: its mapping has no {name}; choose another button")
        self._device, self.name, self.gone = device, device.name, False
        self._hold, self._stop = mapping[hold].code, mapping[stop].code
        self._down: set[int] = set()
        self._axes = {name: Axis(name, mapping[name], device) for name in (*STICKS, *TRIGGERS)}
        self._by_control = {
            (axis.control.kind, axis.control.code): axis for axis in self._axes.values()
        }
        self._pressed = False
        self.stopped, self.settled = False, False

    @property
    def held(self) -> bool:
        """True while the dead man's button is held on a pad that is there and settled."""
        return self._hold in self._down and self.settled and not self.gone

    @property
    def deflection(self) -> Deflection:
        """Left stick: height; right stick: pitch (forward is forward); triggers: assist."""
        way = {name: axis.way for name, axis in self._axes.items()}
        return Deflection(-way["lefty"], -way["righty"], way["righttrigger"] - way["lefttrigger"])

    def settle(self) -> str:
        """Learn where sticks and triggers rest, once nobody holds them; return what is to be done.

        The kernel knows no axis before the pad's first report: a press of a button makes it send.
        """
        held = [text for axis in self._axes.values() if (text := axis.held())]
        if held:
            return f"let go of: {', '.join(held)}; if nobody holds it, move it once"
        if not self._pressed:
            return "press the dead man's button once"
        if self._hold in self._down:
            return "let go of the dead man's button"
        for axis in self._axes.values():
            axis.learn_rest()
        self.settled = True
        return ""

    def wait(self, timeout_s: float) -> None:
        """Take what comes within a time, s."""
        if self.gone:
            select.select([], [], [], timeout_s)
            return
        try:
            if select.select([self._device], [], [], timeout_s)[0]:
                for event in self._device.read():
                    self._receive(event)
        except OSError:
            self.gone = True
            self._down.clear()

    def _receive(self, event: Any) -> None:
        axis = self._by_control.get((event.type, event.code))
        if axis is not None:
            axis.value = event.value
        if event.type == EV_KEY:
            (self._down.add if event.value else self._down.discard)(event.code)
            self.stopped |= event.code == self._stop and bool(event.value)
            self._pressed |= event.code == self._hold and bool(event.value)
        elif event.type == EV_SYN and event.code == SYN_DROPPED:
            self._read_again()

    def _read_again(self) -> None:
        """Read what is down after a loss; the dead man's button counts once it is pressed again."""
        self._down.clear()
        self.stopped |= self._stop in self._device.active_keys()
        for axis in self._axes.values():
            axis.read(self._device)


def open_pad(path: str | None) -> PadDevice:
    """Return a pad: of several, the first one with a known mapping."""
    found = open_pads(path)
    return next((pad for pad in found if mapping_or_none(pad) is not None), found[0])


def open_pads(path: str | None) -> list[PadDevice]:
    """Return the pads that are there, one at least, known or not."""
    require("pad", "lead by keys: --keys")
    found: list[PadDevice] = []
    for candidate in [path] if path is not None else evdev.list_devices():
        try:
            device: PadDevice = evdev.InputDevice(candidate)
        except OSError as error:
            if path is not None:
                raise FleetError(
                    f"{path}: {error.strerror}; a pad's event device is right"
                ) from None
            continue
        if codes_of(device, EV_KEY) & {BTN_SOUTH, BTN_JOYSTICK} and codes_of(device, EV_ABS):
            found.append(device)
    if not found:
        where = path if path is not None else "none in /dev/input that this user may read"
        raise FleetError(
            f"no gamepad: {where}; join group `input`, name it with --pad, or use --keys"
        )
    return found
