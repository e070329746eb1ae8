"""Leading by sticks: within limits, only while the dead man's button is held."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from evdev import ecodes
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.led_hand import HEIGHTS, PITCHES
from shared.exceptions import FleetError
from tools.fleet import gamepad
from tools.fleet.gamepad import (
    AXES,
    BUTTONS,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    SYN_DROPPED,
    Gamepad,
    open_pad,
)
from tools.fleet.pilot import (
    ASSIST_RATE,
    DEAD_ZONE,
    HEIGHT_RATE,
    PITCH_RATE,
    Deflection,
    Pilot,
)

ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(ANY, ANY, ANY, st.floats(0.0, 0.1)), max_size=30))
def test_whatever_is_done_it_stays_within_the_limits_and_makes_no_jump(
    done: list[tuple[float, float, float, float]],
) -> None:
    pilot = Pilot(1.0, 0.1, 150.0)
    for *sticks, dt in done:
        before = pilot.led
        led = pilot.advance(Deflection(*sticks), dt)
        assert HEIGHTS[0] <= led.height <= HEIGHTS[1]
        assert PITCHES[0] <= led.pitch <= PITCHES[1]
        assert 0.0 <= led.assist_n <= 150.0
        for now, then, rate in zip(
            led, before, (HEIGHT_RATE, PITCH_RATE, ASSIST_RATE), strict=True
        ):
            assert abs(now - then) <= rate * dt + 1e-12


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_stick_near_its_middle_is_none_and_a_whole_one_is_the_whole_rate(sign: float) -> None:
    pilot = Pilot(1.0, 0.0, 100.0)
    assert pilot.advance(Deflection(height=sign * DEAD_ZONE), 1.0).height == 1.0
    assert pilot.advance(Deflection(height=sign), 0.1).height == pytest.approx(
        1.0 + sign * 0.1 * HEIGHT_RATE
    )


def test_it_begins_where_the_robot_is_or_at_the_nearest_that_it_may_lead() -> None:
    assert Pilot(0.95, 0.2, 100.0).led == (0.95, 0.2, 0.0)
    assert Pilot(2.0, -3.0, 100.0).led == (HEIGHTS[1], PITCHES[0], 0.0)


class FakePad:
    """A pad whose events are written by the test; a pipe makes it readable."""

    name = "a pad"

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        self._events: list[SimpleNamespace] = []
        self.gone = False
        self.at: dict[int, int] = {}
        self.down: list[int] = []

    def fileno(self) -> int:
        return self._read

    def absinfo(self, axis: int) -> SimpleNamespace:
        trigger = axis in (AXES["lefttrigger"], AXES["righttrigger"])
        low, high = (0, 255) if trigger else (-32768, 32767)
        return SimpleNamespace(value=self.at.get(axis, 0), min=low, max=high)

    def active_keys(self) -> list[int]:
        return self.down

    def read(self) -> Iterator[SimpleNamespace]:
        os.read(self._read, 100)
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        events, self._events = self._events, []
        return iter(events)

    def send(self, kind: int, code: int, value: int) -> None:
        self._events.append(SimpleNamespace(type=kind, code=code, value=value))
        os.write(self._write, b"x")

    def unplug(self) -> None:
        self.gone = True
        os.write(self._write, b"x")


def test_sticks_and_buttons_are_read_and_forward_is_forward() -> None:
    device = FakePad()
    pad = Gamepad(device)
    assert not pad.held
    device.send(EV_KEY, BUTTONS["rightshoulder"], 1)
    device.send(EV_ABS, AXES["lefty"], -32768)
    device.send(EV_ABS, AXES["righty"], -32768)
    device.send(EV_ABS, AXES["lefttrigger"], 0)
    device.send(EV_ABS, AXES["righttrigger"], 255)
    pad.wait(0.1)
    assert pad.held
    assert pad.deflection == pytest.approx((1.0, 1.0, 1.0), abs=1e-4), "up, forward, more"
    device.send(EV_KEY, BUTTONS["rightshoulder"], 0)
    pad.wait(0.1)
    assert not pad.held


def test_before_a_trigger_is_touched_it_asks_for_nothing() -> None:
    """A pad tells an axis only once it moves."""
    assert Gamepad(FakePad()).deflection.assist == 0.0


@pytest.mark.parametrize("trigger", ["lefttrigger", "righttrigger"])
def test_a_trigger_that_was_tapped_asks_for_nothing_more(trigger: str) -> None:
    """At rest it is at the end of its way, not in the middle."""
    device = FakePad()
    pad = Gamepad(device)
    for value in (200, 0):
        device.send(EV_ABS, AXES[trigger], value)
    pad.wait(0.1)
    assert pad.deflection.assist == pytest.approx(0.0, abs=1e-9)


def test_after_a_loss_of_events_the_dead_mans_button_is_to_be_pressed_again() -> None:
    device = FakePad()
    pad = Gamepad(device)
    device.send(EV_KEY, BUTTONS["rightshoulder"], 1)
    device.send(EV_ABS, AXES["lefty"], -32768)
    pad.wait(0.1)
    device.at[AXES["lefty"]] = 0
    device.down = [BUTTONS["b"]]
    device.send(EV_SYN, SYN_DROPPED, 0)
    pad.wait(0.1)
    assert not pad.held
    assert pad.stopped, "its press may be among what was lost"
    assert pad.deflection.height == pytest.approx(0.0, abs=1e-4)


def test_the_stop_is_kept_however_short_it_is_pressed() -> None:
    device = FakePad()
    pad = Gamepad(device)
    device.send(EV_KEY, BUTTONS["b"], 1)
    device.send(EV_KEY, BUTTONS["b"], 0)
    pad.wait(0.1)
    assert pad.stopped


def test_a_pad_that_is_lost_lets_go() -> None:
    device = FakePad()
    pad = Gamepad(device)
    device.send(EV_KEY, BUTTONS["rightshoulder"], 1)
    pad.wait(0.1)
    device.unplug()
    pad.wait(0.1)
    assert pad.gone
    assert not pad.held
    pad.wait(0.001)


def test_without_evdev_or_a_pad_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FleetError, match="event device is right"):
        open_pad("/dev/null/pad")
    monkeypatch.setattr(gamepad, "evdev", SimpleNamespace(list_devices=list))
    with pytest.raises(FleetError, match="no gamepad: none in /dev/input"):
        open_pad(None)
    monkeypatch.setattr(gamepad, "evdev", None)
    with pytest.raises(FleetError, match="pip install"):
        open_pad(None)


def test_the_codes_are_the_kernels() -> None:
    names = {
        "a": "BTN_SOUTH", "b": "BTN_EAST", "x": "BTN_NORTH", "y": "BTN_WEST",
        "leftshoulder": "BTN_TL", "rightshoulder": "BTN_TR", "back": "BTN_SELECT",
        "start": "BTN_START",
    }  # fmt: skip
    assert {name: getattr(ecodes, code) for name, code in names.items()} == dict(BUTTONS)
    axes = {"lefty": "ABS_Y", "righty": "ABS_RY", "lefttrigger": "ABS_Z", "righttrigger": "ABS_RZ"}
    assert {name: getattr(ecodes, code) for name, code in axes.items()} == dict(AXES)
    assert (EV_SYN, EV_KEY, EV_ABS) == (ecodes.EV_SYN, ecodes.EV_KEY, ecodes.EV_ABS)
    assert SYN_DROPPED == ecodes.SYN_DROPPED
