"""A gamepad through SDL (extra `pad`). SDL's database identifies its axes and buttons.

SDL opens neither a display nor a window for a pad. Its hints and mappings come from the
environment, as in a game: `SDL_GAMECONTROLLERCONFIG` maps a pad that the database lacks.
"""

from __future__ import annotations

import ctypes
import warnings
from typing import Any, Final

from shared.exceptions import FleetError
from shared.extras import late, require
from tools.pads.pilot import DEAD_ZONE, Deflection

sdl2: Any = late("sdl2")

STICKS: Final = {"lefty": "left stick", "righty": "right stick"}
TRIGGERS: Final = {"lefttrigger": "left trigger", "righttrigger": "right trigger"}
"""SDL's names of the axes, and the names for messages."""
BUTTONS: Final = ("a", "b", "x", "y", "leftshoulder", "rightshoulder", "back", "start")
"""Named by position, as on an Xbox pad: `a` is the lower button, `b` right, `x` left, `y` upper."""
STICK_REST_MAX: Final = DEAD_ZONE
"""Deflection up to which a stick counts as released.

Rest positions are learned only up to this value, which equals the dead zone. So a stick that was
held while its rest was learned commands no motion after its release.
"""
TRIGGER_REST_MAX: Final = 0.1
"""Deflection up to which a trigger counts as released."""
_FULL: Final = 32767.0


class Gamepad:
    """Present state of sticks and buttons.

    Attributes:
        name: name of the pad.
        gone: the pad was unplugged, or its receiver lost it.
        stopped: the stop was pressed, however briefly.
        settled: the rest positions of sticks and triggers are known; until then it cannot lead.
    """

    def __init__(self, index: int, *, hold: str = "rightshoulder", stop: str = "b") -> None:
        """Open a pad by its SDL index; `hold` names the dead man's button, `stop` the stop."""
        self._pad = sdl2.SDL_GameControllerOpen(index)
        self.name = _text(sdl2.SDL_GameControllerNameForIndex(index))
        self.gone, self.stopped, self.settled = not self._pad, False, False
        if self.gone:
            raise FleetError(f"{self.name}: cannot open it: {_text(sdl2.SDL_GetError())}")
        self._hold, self._stop = self._button(hold), self._button(stop)
        self._is_down = self._was_pressed = False
        self._axes = {name: self._axis(name) for name in (*STICKS, *TRIGGERS)}
        self._rest = dict.fromkeys(self._axes, 0.0)
        self._event = sdl2.SDL_Event()

    def _button(self, name: str) -> int:
        button = sdl2.SDL_GameControllerGetButtonFromString(name.encode())
        if not sdl2.SDL_GameControllerHasButton(self._pad, button):
            raise FleetError(f"{self.name}: its mapping has no {name}; choose another button")
        return int(button)

    def _axis(self, name: str) -> int:
        axis = sdl2.SDL_GameControllerGetAxisFromString(name.encode())
        if not sdl2.SDL_GameControllerHasAxis(self._pad, axis):
            raise FleetError(
                f"{self.name}: its mapping has no {name}; map it with SDL_GAMECONTROLLERCONFIG"
            )
        return int(axis)

    @property
    def held(self) -> bool:
        """True while the dead man's button is held on a pad that is present and settled."""
        return self._is_down and self.settled and not self.gone

    @property
    def deflection(self) -> Deflection:
        """Left stick: height; right stick: pitch (push forward to lean forward); triggers: assist.

        A lost pad has zero deflection.
        """
        if self.gone:
            return Deflection()
        way = {name: self._way(name) for name in self._axes}
        return Deflection(-way["lefty"], -way["righty"], way["righttrigger"] - way["lefttrigger"])

    def _position(self, name: str) -> float:
        """Return an axis value from SDL: -1 to 1 for a stick, 0 to 1 for a trigger."""
        value = sdl2.SDL_GameControllerGetAxis(self._pad, self._axes[name])
        return max(-1.0, float(value) / _FULL)

    def _way(self, name: str) -> float:
        """Return the deflection from the rest position."""
        rest = self._rest[name]
        off = self._position(name) - rest
        if name in TRIGGERS:
            return max(0.0, off / (1.0 - rest))
        return off / (1.0 - rest if off > 0.0 else 1.0 + rest)

    def settle(self) -> str:
        """Learn the rest positions once sticks, triggers and dead man's button are released.

        Return the next instruction to the person, or "" once settled.
        """
        held = []
        for name, shown in (STICKS | TRIGGERS).items():
            off = abs(self._position(name))
            if off > (STICK_REST_MAX if name in STICKS else TRIGGER_REST_MAX):
                held.append(f"{shown} ({100.0 * off:.0f} %)")
        if held:
            return f"let go of: {', '.join(held)}; if already released, move it once"
        if not self._was_pressed:
            return "press the dead man's button once"
        if self._is_down:
            return "let go of the dead man's button"
        self._rest = {name: self._position(name) for name in self._axes}
        self.settled = True
        return ""

    def wait(self, timeout_s: float) -> None:
        """Wait for an event, for at most `timeout_s`; process all events that have arrived."""
        event = ctypes.byref(self._event)
        came = sdl2.SDL_WaitEventTimeout(event, round(1000 * timeout_s))
        while came:
            if self._event.type == sdl2.SDL_CONTROLLERBUTTONDOWN:
                self._receive(self._event.cbutton.button, is_down=True)
            elif self._event.type == sdl2.SDL_CONTROLLERBUTTONUP:
                self._receive(self._event.cbutton.button, is_down=False)
            came = sdl2.SDL_PollEvent(event)
        if not sdl2.SDL_GameControllerGetAttached(self._pad):
            self.gone, self._is_down = True, False

    def _receive(self, button: int, *, is_down: bool) -> None:
        self.stopped |= is_down and button == self._stop
        if button == self._hold:
            self._is_down = is_down
            self._was_pressed |= is_down


def start_sdl() -> None:
    """Start SDL's gamepad support, without a display and without SDL's signal handlers."""
    with warnings.catch_warnings():  # the package warns that it uses its own library
        warnings.simplefilter("ignore")
        require("pad", "lead with the keyboard: --keys")
    sdl2.SDL_SetHint(sdl2.SDL_HINT_NO_SIGNAL_HANDLERS, b"1")
    sdl2.SDL_SetHint(sdl2.SDL_HINT_JOYSTICK_ALLOW_BACKGROUND_EVENTS, b"1")
    sdl2.SDL_SetHint(sdl2.SDL_HINT_GAMECONTROLLER_USE_BUTTON_LABELS, b"0")  # positions, not letters
    if sdl2.SDL_Init(sdl2.SDL_INIT_GAMECONTROLLER) != 0:
        raise FleetError(f"SDL does not start: {_text(sdl2.SDL_GetError())}; use --keys")


def find_pad(wanted: str | None) -> int:
    """Return the index of the first pad that SDL knows and whose name or path contains `wanted`."""
    start_sdl()
    found = []
    for index in range(sdl2.SDL_NumJoysticks()):
        name = _text(sdl2.SDL_JoystickNameForIndex(index))
        shown = f"{name} at {_text(sdl2.SDL_JoystickPathForIndex(index))}"
        is_known = bool(sdl2.SDL_IsGameController(index))
        if is_known and (wanted is None or wanted in shown):
            return index
        found.append(shown if is_known else f"{shown}, whose axes are unknown to SDL")
    raise FleetError(
        f"no gamepad{'' if wanted is None else f' {wanted!r}'}; found: "
        f"{'; '.join(found) or 'none that this user may read'}; join group `input`, "
        "map an unknown pad with SDL_GAMECONTROLLERCONFIG, or use --keys"
    )


def _text(name: bytes | None) -> str:
    return (name or b"?").decode(errors="replace")
