"""Axes and buttons of the kernel, and the names that SDL gives them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
"""Types of events, of linux/input-event-codes.h."""
SYN_DROPPED: Final = 3
"""Events were lost, because nobody read them in time."""
ABS_HAT0X: Final = 0x10
ABS_HAT3Y: Final = 0x17
BTN_JOYSTICK: Final = 0x120
BTN_SOUTH: Final = 0x130

STICKS: Final = ("lefty", "righty")
TRIGGERS: Final = ("lefttrigger", "righttrigger")
BUTTONS: Final = ("a", "b", "x", "y", "leftshoulder", "rightshoulder", "back", "start")
"""By place, as on an Xbox pad: `a` is below, `b` right, `x` left, `y` above."""


class PadControl(NamedTuple):
    """An axis or a button."""

    kind: int
    """EV_ABS or EV_KEY."""
    code: int
    """The kernel's."""
    inverted: bool = False
    """Its values fall where others rise."""


PadMapping: TypeAlias = Mapping[str, PadControl]
"""PadControl of each of `STICKS`, `TRIGGERS` and `BUTTONS`; a pad may lack buttons."""


class PadDevice(Protocol):
    """What is used of `evdev.InputDevice`."""

    name: str
    info: Any
    """Its `bustype`, `vendor`, `product` and `version`."""

    def fileno(self) -> int:
        """Return what select waits for."""

    def read(self) -> Any:
        """Return the events that have come; raises OSError once the pad is gone."""

    def absinfo(self, axis_num: int) -> Any:
        """Return an axis's `value`, `min` and `max`."""

    def active_keys(self) -> Any:
        """Return the buttons that are down."""

    def capabilities(self, verbose: bool = ..., absinfo: bool = ...) -> Any:
        """Return the codes of each type of event that it has."""


def codes_of(device: PadDevice, kind: int) -> frozenset[int]:
    """Return the axes or the buttons that a pad has."""
    return frozenset(device.capabilities(absinfo=False).get(kind, ()))


def counted(device: PadDevice, kind: int) -> list[int]:
    """Return a device's axes or buttons in the order in which SDL counts them on Linux.

    Buttons of keyboards come behind those of pads. A hat of a direction pad is no axis.
    """
    codes = sorted(codes_of(device, kind))
    if kind == EV_KEY:
        return sorted(codes, key=lambda code: (code < BTN_JOYSTICK, code))
    return [code for code in codes if not _is_hat(device, code)]


def _is_hat(device: PadDevice, axis: int) -> bool:
    """Return True for a direction pad: the first hat, or another of three positions."""
    if not ABS_HAT0X <= axis <= ABS_HAT3Y:
        return False
    span = device.absinfo(axis)
    return axis <= ABS_HAT0X + 1 or (span.min, span.max) == (-1, 1)


def identity_of(device: PadDevice) -> str:
    """Return a pad's name and its vendor and product, as lsusb shows them."""
    return f"{device.name} ({device.info.vendor:04x}:{device.info.product:04x})"
