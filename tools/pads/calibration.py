"""Learns what a pad's axes and buttons mean: a person moves each as asked."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from typing import Final

from shared.atomic_file import replace_file
from shared.exceptions import FleetError
from tools.pads.controls import (
    BUTTONS,
    EV_ABS,
    EV_KEY,
    STICKS,
    TRIGGERS,
    PadControl,
    PadDevice,
    PadMapping,
    counted,
)
from tools.pads.mappings import OWN_FILE, line_for, line_is_of, own_file

ASKED: Final = {
    "lefty": "push the left stick forward, away from you, and let go",
    "righty": "push the right stick forward, away from you, and let go",
    "lefttrigger": "press the left trigger to its end and let go",
    "righttrigger": "press the right trigger to its end and let go",
    "a": "press the lower one of the four buttons at the right",
    "b": "press the right one of the four",
    "x": "press the left one of the four",
    "y": "press the upper one of the four",
    "leftshoulder": "press the left shoulder button",
    "rightshoulder": "press the right shoulder button",
    "back": "press the small button left of the middle",
    "start": "press the small button right of the middle",
}
PATIENCE_S: Final = 20.0
"""Wait for a movement; a button that a pad lacks is left out after it."""
MOVED: Final = {**dict.fromkeys(STICKS, 0.3), **dict.fromkeys(TRIGGERS, 0.6)}
"""Share of its range by which an axis moves: a stick goes half its range, a trigger all of it."""
AT_REST: Final = 0.1
"""Share of its range within which an axis has come back."""
CLEARER: Final = 2.0
"""By how much the axis that is meant moves more than each other one."""


class _Movement:
    """What moves between two rests."""

    def __init__(self, device: PadDevice) -> None:
        self._device = device
        spans = {axis: device.absinfo(axis) for axis in counted(device, EV_ABS)}
        self._range = {
            axis: float(at.max - at.min) for axis, at in spans.items() if at.max > at.min
        }
        self._rest: dict[int, float] = {}
        self._off = dict.fromkeys(self._range, 0.0)
        self._down: set[int] = set()
        self.farthest: dict[int, float] = {}
        """Return how far each axis moved, in shares of its range, with its sign."""
        self.pressed: list[int] = []

    def watch(self, timeout_s: float) -> bool:
        """Collect until something moved and all is at rest again; return False if nothing moved."""
        self.farthest, self.pressed = {}, []
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if select.select([self._device], [], [], 0.05)[0]:
                for event in self._device.read():
                    self._receive(event.type, event.code, event.value)
            resting = not self._down and all(abs(off) < AT_REST for off in self._off.values())
            if resting and (self.farthest or self.pressed):
                return True
        return False

    def watch_button(self, timeout_s: float) -> bool:
        """Wait for a press of any button, and take where every axis is then as its rest.

        Before a pad's first report the kernel knows no axis.
        """
        self._rest.clear()
        pressed = self.watch(timeout_s)
        self._rest = {axis: float(self._device.absinfo(axis).value) for axis in self._range}
        return pressed

    def _receive(self, kind: int, code: int, value: int) -> None:
        if kind == EV_KEY:
            (self._down.add if value else self._down.discard)(code)
            self.pressed += [code] if value and code not in self.pressed else []
        elif kind == EV_ABS and code in self._rest:
            off = self._off[code] = (value - self._rest[code]) / self._range[code]
            if abs(off) > max(AT_REST, abs(self.farthest.get(code, 0.0))):
                self.farthest[code] = off

    def meant(self, name: str) -> PadControl | None:
        """Return the control that moved as one does that is asked for; None if it is not clear."""
        if name in BUTTONS:
            return PadControl(EV_KEY, self.pressed[0]) if len(self.pressed) == 1 else None
        ordered = sorted(self.farthest.items(), key=lambda item: -abs(item[1]))
        if not ordered and name in TRIGGERS and len(self.pressed) == 1:
            return PadControl(EV_KEY, self.pressed[0])
        if not ordered or abs(ordered[0][1]) < MOVED[name]:
            return None
        (axis, off), *others = ordered
        if any(abs(other) * CLEARER > abs(off) for _, other in others):
            return None
        return PadControl(EV_ABS, axis, inverted=off > 0.0 if name in STICKS else off < 0.0)


def calibrate(
    device: PadDevice, say: Callable[[str], None], patience_s: float = PATIENCE_S
) -> PadMapping:
    """Ask for every stick, trigger and button, and return the mapping."""
    movement = _Movement(device)
    found: dict[str, PadControl] = {}
    try:
        say("let go of the sticks and triggers, and press any button once")
        if not movement.watch_button(patience_s):
            raise FleetError(f"{device.name}: no button was pressed; nothing is written")
        for name, asked in ASKED.items():
            control = _asked(movement, name, asked, found, say, patience_s)
            if control is not None:
                found[name] = control
    except OSError:
        raise FleetError(f"{device.name}: is gone; nothing is written") from None
    return found


def _asked(
    movement: _Movement, name: str, asked: str, found: PadMapping, say: Callable[[str], None],
    patience_s: float,
) -> PadControl | None:  # fmt: skip
    """Ask until one control moves alone; None for a button that the pad lacks."""
    again = ""
    deadline = time.monotonic() + patience_s
    while (left_s := deadline - time.monotonic()) > 0.0:
        say(f"{again}{asked}" + (f" (none: wait {left_s:.0f} s)" if name in BUTTONS else ""))
        if not movement.watch(left_s):
            break
        control = movement.meant(name)
        if control is not None and all(control[:2] != other[:2] for other in found.values()):
            return control
        again = "not clear, once more: " if control is None else "that is another one: "
    if name in BUTTONS:
        return None
    raise FleetError(f"{name}: nothing moved as asked within {patience_s:g} s; nothing is written")


def keep(device: PadDevice, mapping: PadMapping) -> str:
    """Write a mapping into the user's file, in place of an older one; return the file's name."""
    file = own_file()
    if file is None:
        raise FleetError(f"{OWN_FILE}: this user has no home directory; set HOME")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        before = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        lines = [line for line in before if not line_is_of(line, device)]
        lines.append(line_for(device, mapping))
        replace_file(file, "".join(f"{line}\n" for line in lines).encode())
    except (OSError, UnicodeDecodeError) as error:
        raise FleetError(f"{file}: cannot be written: {error}") from None
    return str(file)
