"""A pad that SDL emulates: a test moves its sticks and presses its buttons."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import sdl2

from tools.pads.gamepad import BUTTONS, STICKS, TRIGGERS, start_sdl

AXES: Final = ("leftx", "lefty", "rightx", "righty", "lefttrigger", "righttrigger")
HOLD, STOP = "rightshoulder", "b"
_FULL: Final = 32767


class VirtualPad:
    """Its axes and buttons are SDL's, in SDL's order."""

    def __init__(self) -> None:
        kind = sdl2.SDL_JOYSTICK_TYPE_GAMECONTROLLER
        self.index = sdl2.SDL_JoystickAttachVirtual(kind, len(AXES), 15, 0)
        self._joystick = sdl2.SDL_JoystickOpen(self.index)
        self._is_there = True
        self.rest()

    def move(self, axis: str, share: float) -> None:
        """Move a stick, -1 to 1, or a trigger, 0 to 1."""
        raw = 2.0 * share - 1.0 if axis in TRIGGERS else share
        number, value = AXES.index(axis), round(_FULL * raw)
        assert sdl2.SDL_JoystickSetVirtualAxis(self._joystick, number, value) == 0
        sdl2.SDL_JoystickUpdate()

    def set_button(self, name: str, is_down: bool) -> None:
        button = sdl2.SDL_GameControllerGetButtonFromString(name.encode())
        assert sdl2.SDL_JoystickSetVirtualButton(self._joystick, button, is_down) == 0
        sdl2.SDL_JoystickUpdate()

    def press(self, name: str) -> None:
        for is_down in (True, False):
            self.set_button(name, is_down)

    def rest(self) -> None:
        for axis in (*STICKS, *TRIGGERS):
            self.move(axis, 0.0)
        for name in BUTTONS:
            self.set_button(name, is_down=False)

    def unplug(self) -> None:
        if self._is_there:
            sdl2.SDL_JoystickDetachVirtual(self.index)
        self._is_there = False


@contextmanager
def virtual_pad() -> Iterator[VirtualPad]:
    start_sdl()
    pad = VirtualPad()
    try:
        yield pad
    finally:
        pad.unplug()
        sdl2.SDL_Quit()
