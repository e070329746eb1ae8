"""Pads whose events a test writes, with the axes and buttons that real ones report."""

from __future__ import annotations

import errno
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

from tools.pads.controls import EV_ABS, EV_KEY

Span = tuple[int, int]
S16: Span = (-32768, 32767)
U16: Span = (0, 65535)
U10: Span = (0, 1023)
U8: Span = (0, 255)
HATS = {0x10: (-1, 1), 0x11: (-1, 1)}
XPAD_BUTTONS = (0x130, 0x131, 0x133, 0x134, *range(0x136, 0x138), *range(0x13A, 0x13F))
HID_BUTTONS = tuple(range(0x130, 0x13F))


def axes(
    sticks: Span, triggers: Span, right: Sequence[int], ends: Sequence[int]
) -> dict[int, Span]:
    return {
        **dict.fromkeys((0, 1, *right), sticks), **dict.fromkeys(ends, triggers), **HATS
    }  # fmt: skip


class Seen(NamedTuple):
    """What evtest shows of a pad, and by hand which control is which."""

    vendor: int
    product: int
    axes: Mapping[int, Span]
    buttons: Sequence[int]
    righty: int
    triggers: tuple[int, int]
    """Left and right: axes, or buttons."""
    shoulder: int
    east: int


_STANDARD = ((3, 4), (2, 5))
_PEDALS = ((2, 5), (9, 10))
_XPAD = Seen(0x045E, 0x028E, axes(S16, U8, *_STANDARD), XPAD_BUTTONS, 4, (2, 5), 0x137, 0x131)
_HID = Seen(0x045E, 0x0B20, axes(U16, U10, *_PEDALS), HID_BUTTONS, 5, (10, 9), 0x137, 0x131)
_SONY = _XPAD._replace(
    vendor=0x054C, axes=axes(U8, U8, *_STANDARD),
    buttons=(0x130, 0x131, 0x133, 0x134, *range(0x136, 0x13F)),
)  # fmt: skip
PADS = {
    "Xbox 360 by cable": _XPAD,
    "Xbox One S by Bluetooth, first firmware": Seen(
        0x045E, 0x02E0, axes(U16, U10, *_STANDARD), (0x8B, *range(0x130, 0x13A)),
        4, (2, 5), 0x135, 0x131,
    ),
    "Xbox One S by Bluetooth": _HID._replace(product=0x02FD, buttons=(0x9E, 0xAC, *HID_BUTTONS)),
    "Xbox One S by Bluetooth, xpadneo": _XPAD._replace(
        product=0x02FD, axes=axes(S16, U10, *_STANDARD)
    ),
    "Xbox Series by Bluetooth": _HID._replace(product=0x0B13, buttons=(0xA7, *HID_BUTTONS)),
    "Xbox One S, BLE": _HID,
    "DualShock 4": _SONY._replace(product=0x09CC),
    "DualShock 4 without its driver": Seen(
        0x054C, 0x05C4, axes(U8, U8, (2, 5), (3, 4)), tuple(range(0x130, 0x13E)),
        5, (3, 4), 0x135, 0x132,
    ),
    "DualSense": _SONY._replace(product=0x0CE6),
    "Switch Pro": Seen(
        0x057E, 0x2009, axes((-32767, 32767), U8, (3, 4), ()),
        (0x130, 0x131, *range(0x133, 0x13F)), 4, (0x138, 0x139), 0x137, 0x131,
    ),
    "8BitDo Pro 2": _HID._replace(
        vendor=0x2DC8, product=0x6006, axes=axes(U8, U8, *_PEDALS), east=0x130
    ),
    "8BitDo Ultimate": _XPAD._replace(vendor=0x2DC8, product=0x3106),
    "Logitech F310": _XPAD._replace(vendor=0x046D, product=0xC21D),
    "Logitech F710": _XPAD._replace(vendor=0x046D, product=0xC21F),
    "Stadia": _HID._replace(
        vendor=0x18D1, product=0x9400, axes=axes((1, 255), U8, *_PEDALS),
        buttons=(*XPAD_BUTTONS, *range(0x2C0, 0x2C4)),
    ),
}  # fmt: skip


def _close(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


class FakePad:
    """A pad; a pipe makes it readable. It begins as the kernel does: every axis at 0."""

    def __init__(self, seen: Seen, name: str = "a pad") -> None:
        self.seen, self.name = seen, name
        self.info = SimpleNamespace(
            bustype=5, vendor=seen.vendor, product=seen.product, version=0x903
        )
        self._read, self._write = os.pipe()
        self.close = weakref.finalize(self, _close, self._read, self._write)
        self._events: list[SimpleNamespace] = []
        self._gone = False
        self.at = dict.fromkeys(seen.axes, 0)
        self.down: list[int] = []

    def fileno(self) -> int:
        return self._read

    def capabilities(self, verbose: bool = False, absinfo: bool = True) -> dict[int, list[int]]:
        assert not verbose
        assert not absinfo
        return {EV_KEY: list(self.seen.buttons), EV_ABS: list(self.seen.axes)}

    def absinfo(self, axis_num: int) -> SimpleNamespace:
        low, high = self.seen.axes[axis_num]
        return SimpleNamespace(value=self.at[axis_num], min=low, max=high)

    def active_keys(self) -> list[int]:
        return self.down

    def read(self) -> Iterator[SimpleNamespace]:
        os.read(self._read, 1000)
        if self._gone:
            raise OSError(errno.ENODEV, "No such device")
        events, self._events = self._events, []
        return iter(events)

    def send(self, kind: int, code: int, value: int) -> None:
        if kind == EV_ABS:
            self.at[code] = value
        self._events.append(SimpleNamespace(type=kind, code=code, value=value))
        os.write(self._write, b"x")

    def unplug(self) -> None:
        self._gone = True
        os.write(self._write, b"x")

    def at_share(self, axis: int, share: float) -> int:
        """Return the value of an axis at a share of its range, 0 to 1."""
        low, high = self.seen.axes[axis]
        return round(low + share * (high - low))

    def move(self, axis: int, share: float) -> None:
        self.send(EV_ABS, axis, self.at_share(axis, share))

    def press(self, button: int) -> None:
        for value in (1, 0):
            self.send(EV_KEY, button, value)

    def report_rest(self) -> None:
        """Tell where everything is when nobody touches it, as the first report does."""
        for axis in self.seen.axes:
            self.move(axis, 0.0 if axis in self.seen.triggers else 0.5)
