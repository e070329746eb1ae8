"""A gamepad, by evdev: the extra `pad`. Buttons and axes have SDL's names."""

from __future__ import annotations

import select
from collections.abc import Mapping
from typing import Any, Final, Protocol

from shared.exceptions import FleetError
from tools.fleet.pilot import Deflection

evdev: Any
try:
    import evdev
except ImportError:
    evdev = None

EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
"""Types of events, of linux/input-event-codes.h."""
SYN_DROPPED: Final = 3
"""Events were lost, because nobody read them in time."""
BUTTONS: Final[Mapping[str, int]] = {
    "a": 0x130, "b": 0x131, "x": 0x133, "y": 0x134, "leftshoulder": 0x136, "rightshoulder": 0x137,
    "back": 0x13A, "start": 0x13B,
}  # fmt: skip
"""BTN_SOUTH, BTN_EAST, BTN_NORTH, BTN_WEST, BTN_TL, BTN_TR, BTN_SELECT, BTN_START."""
AXES: Final[Mapping[str, int]] = {
    "lefty": 0x01, "righty": 0x04, "lefttrigger": 0x02, "righttrigger": 0x05,
}  # fmt: skip
"""ABS_Y, ABS_RY, ABS_Z, ABS_RZ."""


class PadDevice(Protocol):
    """What is used of `evdev.InputDevice`."""

    name: str

    def fileno(self) -> int:
        """Return what select waits for."""

    def read(self) -> Any:
        """Return the events that have come; raises OSError once the pad is gone."""

    def absinfo(self, axis: int) -> Any:
        """Return an axis's `value`, `min` and `max`."""

    def active_keys(self) -> list[int]:
        """Return the buttons that are down."""


class Gamepad:
    """Sticks and buttons as they are now.

    Attributes:
        name: of the pad.
        gone: it was unplugged, or its receiver lost it.
    """

    def __init__(self, device: PadDevice, *, hold: str = "rightshoulder", stop: str = "b") -> None:
        """Take an open device, and the names of the dead man's button and of the stop."""
        self._device, self.name, self.gone = device, device.name, False
        self._hold, self._stop = BUTTONS[hold], BUTTONS[stop]
        self._down: set[int] = set()
        self._spans = {axis: device.absinfo(axis) for axis in AXES.values()}
        self._values = {axis: self._scaled(axis, span.value) for axis, span in self._spans.items()}
        self.stopped = False

    @property
    def held(self) -> bool:
        """True while the dead man's button is held on a pad that is there."""
        return self._hold in self._down and not self.gone

    @property
    def deflection(self) -> Deflection:
        """Left stick: height; right stick: pitch (forward is forward); triggers: assist."""
        value = {name: self._values[code] for name, code in AXES.items()}
        trigger = 0.5 * (value["righttrigger"] - value["lefttrigger"])
        return Deflection(-value["lefty"], -value["righty"], trigger)

    def wait(self, timeout_s: float) -> None:
        """Take what comes within a time, s."""
        if self.gone:
            select.select([], [], [], timeout_s)
            return
        try:
            if select.select([self._device], [], [], timeout_s)[0]:
                for event in self._device.read():
                    self._take(event)
        except OSError:
            self.gone = True
            self._down.clear()

    def _take(self, event: Any) -> None:
        if event.type == EV_KEY:
            (self._down.add if event.value else self._down.discard)(event.code)
            self.stopped |= event.code == self._stop and bool(event.value)
        elif event.type == EV_ABS and event.code in self._values:
            self._values[event.code] = self._scaled(event.code, event.value)
        elif event.type == EV_SYN and event.code == SYN_DROPPED:
            self._look_again()

    def _look_again(self) -> None:
        """Read what is down after a loss; the dead man's button counts once it is pressed again."""
        self._down.clear()
        self.stopped |= self._stop in self._device.active_keys()
        for axis in self._values:
            self._values[axis] = self._scaled(axis, self._device.absinfo(axis).value)

    def _scaled(self, axis: int, value: int) -> float:
        """Return a position of an axis from -1 to 1."""
        span = self._spans[axis]
        middle, half = 0.5 * (span.max + span.min), 0.5 * (span.max - span.min)
        return (value - middle) / half if half else 0.0


def open_pad(path: str | None) -> PadDevice:
    """Return a pad.

    Args:
        path: such as /dev/input/event7; None: the first one that has the button.

    Raises:
        FleetError: there is none, or evdev is not installed.
    """
    if evdev is None:
        raise FleetError("a gamepad needs evdev: pip install 'xrl[pad]'; or lead by keys: --keys")
    paths = [path] if path is not None else evdev.list_devices()
    for candidate in paths:
        try:
            device: PadDevice = evdev.InputDevice(candidate)
        except OSError as error:
            if path is not None:
                raise FleetError(
                    f"{path}: {error.strerror}; a pad's event device is right"
                ) from None
            continue
        if BUTTONS["rightshoulder"] in device.capabilities().get(EV_KEY, ()):  # type: ignore[attr-defined]
            return device
    where = path if path is not None else "none in /dev/input that this user may read"
    raise FleetError(f"no gamepad: {where}; join group `input`, name it with --pad, or use --keys")
