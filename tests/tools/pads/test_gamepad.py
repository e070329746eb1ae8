"""A pad's events as deflections: of well-known pads, of worn ones, of pads that nobody knows."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from evdev import ecodes
from hypothesis import given
from hypothesis import strategies as st

from shared.exceptions import FleetError, MissingPackageError
from tests.tools.pads.fake_pad import PADS, S16, FakePad, Seen
from tools.pads import controls, gamepad, mappings
from tools.pads.controls import EV_ABS, EV_KEY, EV_SYN, SYN_DROPPED
from tools.pads.gamepad import Gamepad, open_pad
from tools.pads.mappings import LAYOUTS, known_mapping, mapping_of
from tools.pads.pilot import DEAD_ZONE, Pilot

XBOX = PADS["Xbox 360 by cable"]
PEDALS = PADS["Xbox Series by Bluetooth"]
SIGNED = XBOX._replace(axes={**XBOX.axes, 2: S16, 5: S16})
SIGNED_8 = XBOX._replace(axes={**XBOX.axes, 2: (-127, 127), 5: (-127, 127)})


@pytest.fixture(autouse=True)
def _no_mappings_of_this_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mappings, "given_lines", lambda: iter(()))


def fresh(seen: Seen) -> tuple[FakePad, Gamepad]:
    """Return a pad that has not reported yet."""
    device = FakePad(seen)
    mapping = known_mapping(device)
    assert mapping is not None
    return device, Gamepad(device, mapping)


def pad_of(seen: Seen) -> tuple[FakePad, Gamepad]:
    """Return a pad whose rest is learnt."""
    device, pad = fresh(seen)
    device.report_rest()
    device.press(seen.shoulder)
    pad.wait(0.1)
    assert pad.settle() == ""
    return device, pad


@pytest.mark.parametrize("seen", PADS.values(), ids=PADS)
def test_each_control_of_a_known_pad_leads_what_it_is_there_for(seen: Seen) -> None:
    device, pad = pad_of(seen)
    device.send(EV_KEY, seen.shoulder, 1)
    device.move(1, 0.0)
    pad.wait(0.1)
    assert pad.held
    assert pad.deflection == pytest.approx((1.0, 0.0, 0.0), abs=0.01), "forward is up"
    device.move(1, 0.5)
    device.move(seen.righty, 1.0)
    pad.wait(0.1)
    assert pad.deflection == pytest.approx((0.0, -1.0, 0.0), abs=0.01), "back is back"
    device.move(seen.righty, 0.5)
    for code, sign in zip(seen.triggers, (-1.0, 1.0), strict=True):
        kind = EV_ABS if code in seen.axes else EV_KEY
        device.send(kind, code, seen.axes[code][1] if kind == EV_ABS else 1)
        pad.wait(0.1)
        assert pad.deflection == pytest.approx((0.0, 0.0, sign), abs=0.01)
        device.send(kind, code, seen.axes[code][0] if kind == EV_ABS else 0)
    pad.wait(0.1)
    assert pad.deflection == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert not pad.stopped
    device.press(seen.east)
    pad.wait(0.1)
    assert pad.stopped


EVENT = st.tuples(st.integers(0, 40), st.integers(-40_000, 70_000))


def inputs_of(
    seen: Seen, events: list[tuple[int, int]], but: int = -1
) -> Iterator[tuple[int, int, int]]:
    """Yield what a pad can send, whatever the numbers are, but for one control."""
    inputs = [(EV_ABS, axis) for axis in seen.axes] + [(EV_KEY, key) for key in seen.buttons]
    inputs = [one for one in inputs if one[1] != but]
    for which, value in events:
        kind, code = inputs[which % len(inputs)]
        yield kind, code, value if kind == EV_ABS else value % 2


@given(st.sampled_from(sorted(PADS)), st.lists(EVENT, max_size=30), st.floats(-0.15, 0.15))
def test_whatever_came_a_pad_at_rest_leads_nowhere(
    name: str, events: list[tuple[int, int]], drift: float
) -> None:
    seen = PADS[name]
    device, pad = pad_of(seen)
    for event in inputs_of(seen, events):
        device.send(*event)
    for key in seen.buttons:
        device.send(EV_KEY, key, 0)
    for axis in seen.axes:
        device.move(axis, 0.0 if axis in seen.triggers else 0.5 + 0.5 * drift)
    pad.wait(0.1)
    pilot = Pilot(1.0, 0.1, 150.0)
    assert pilot.integrate(pad.deflection, 1.0) == (1.0, 0.1, 0.0)


@given(st.sampled_from(sorted(PADS)), st.lists(EVENT, min_size=1, max_size=30))
def test_only_the_right_trigger_raises_the_assist(name: str, events: list[tuple[int, int]]) -> None:
    seen = PADS[name]
    device, pad = pad_of(seen)
    pilot = Pilot(1.0, 0.1, 150.0)
    for event in inputs_of(seen, events, but=seen.triggers[1]):
        device.send(*event)
        pad.wait(0.1)
        assert pilot.integrate(pad.deflection, 0.1).assist_n == 0.0


@pytest.mark.parametrize("seen", [XBOX, SIGNED, SIGNED_8], ids=["0..255", "16 bits", "8 bits"])
@pytest.mark.parametrize("trigger", [0, 1])
def test_a_trigger_that_was_tapped_asks_for_nothing_more(seen: Seen, trigger: int) -> None:
    device, pad = pad_of(seen)
    for share in (0.8, 0.0):
        device.move(seen.triggers[trigger], share)
    pad.wait(0.1)
    assert pad.deflection.assist == 0.0


@pytest.mark.parametrize("drift", [-0.15, 0.15])
def test_a_worn_sticks_rest_is_learnt(drift: float) -> None:
    device, pad = fresh(XBOX)
    device.report_rest()
    device.move(1, 0.5 + 0.5 * drift)
    device.press(XBOX.shoulder)
    pad.wait(0.1)
    assert pad.settle() == ""
    assert pad.deflection.height == 0.0
    device.move(1, 0.0)
    pad.wait(0.1)
    assert pad.deflection.height == pytest.approx(1.0)
    device.move(1, 1.0)
    pad.wait(0.1)
    assert pad.deflection.height == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("axis", "share", "told"),
    [(1, 0.75, "left stick"), (4, 0.2, "right stick"), (5, 1.0, "right trigger"),
     (2, 0.3, "left trigger")],
)  # fmt: skip
def test_a_pad_that_is_held_begins_only_once_it_is_let_go_of(
    axis: int, share: float, told: str
) -> None:
    device, pad = fresh(XBOX)
    device.report_rest()
    device.move(axis, share)
    device.press(XBOX.shoulder)
    device.send(EV_KEY, XBOX.shoulder, 1)
    pad.wait(0.1)
    assert told in pad.settle()
    assert not pad.held, "nothing is led before it is known what rest is"
    device.report_rest()
    pad.wait(0.1)
    assert "let go of the dead man's button" in pad.settle()
    device.send(EV_KEY, XBOX.shoulder, 0)
    pad.wait(0.1)
    assert pad.settle() == ""


@given(st.floats(-1.0, 1.0))
def test_a_stick_held_while_rest_is_learnt_leads_nowhere_once_it_is_let_go(held: float) -> None:
    device, pad = fresh(XBOX)
    device.report_rest()
    device.move(1, 0.5 + 0.5 * held)
    device.press(XBOX.shoulder)
    pad.wait(0.1)
    if pad.settle() == "":
        device.move(1, 0.5)
        pad.wait(0.1)
        assert abs(pad.deflection.height) <= DEAD_ZONE


def test_before_its_first_report_a_pad_is_asked_for_one() -> None:
    """The kernel says 0 for an axis that was not reported: of 0..65535 that is an end."""
    device, pad = fresh(PEDALS)
    assert "left stick (100 %)" in pad.settle()
    device.report_rest()
    pad.wait(0.1)
    assert "press the dead man's button" in pad.settle()


@pytest.mark.parametrize("seen", [XBOX._replace(product=0xB0B), PEDALS._replace(product=0x28E)])
def test_a_pad_without_mapping_is_refused(seen: Seen) -> None:
    """Also one that has a known number, and other axes."""
    device = FakePad(seen)
    with pytest.raises(FleetError, match=rf"a pad \(045e:{seen.product:04x}\).*--calibrate"):
        mapping_of(device)


def test_every_pad_of_the_table_has_a_capability_table_or_shares_a_layout_that_has() -> None:
    tested = set()
    for seen in PADS.values():
        device = FakePad(seen)
        tested |= {id(a.mapping) for a in LAYOUTS[seen.vendor, seen.product] if a.fits(device)}
    assert {id(a.mapping) for layouts in LAYOUTS.values() for a in layouts} <= tested


def test_a_button_that_the_mapping_lacks_is_refused() -> None:
    device = FakePad(XBOX)
    mapping = {name: at for name, at in mapping_of(device).items() if name != "b"}
    with pytest.raises(FleetError, match="its mapping has no b"):
        Gamepad(device, mapping)


def test_after_a_loss_of_events_the_dead_mans_button_is_to_be_pressed_again() -> None:
    device, pad = pad_of(XBOX)
    device.send(EV_KEY, XBOX.shoulder, 1)
    device.move(1, 0.0)
    pad.wait(0.1)
    device.at[1] = device.at_share(1, 0.5)
    device.down = [XBOX.east]
    device.send(EV_SYN, SYN_DROPPED, 0)
    pad.wait(0.1)
    assert not pad.held
    assert pad.stopped, "its press may be among what was lost"
    assert pad.deflection.height == pytest.approx(0.0, abs=1e-4)


def test_the_stop_counts_before_rest_is_learnt_however_short_it_is_pressed() -> None:
    device, pad = fresh(XBOX)
    device.press(XBOX.east)
    pad.wait(0.1)
    assert pad.stopped


def test_a_pad_that_is_lost_lets_go() -> None:
    device, pad = pad_of(XBOX)
    device.send(EV_KEY, XBOX.shoulder, 1)
    pad.wait(0.1)
    assert pad.held
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
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(MissingPackageError, match=r"the extra `pad` .*; or lead by keys: --keys"):
        open_pad(None)


def test_of_several_pads_the_first_known_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown, known = FakePad(XBOX._replace(vendor=1)), FakePad(XBOX)
    pads = {"0": unknown, "1": known}
    fake = SimpleNamespace(list_devices=lambda: list(pads), InputDevice=pads.__getitem__)
    monkeypatch.setattr(gamepad, "evdev", fake)
    assert open_pad(None) is known
    del pads["1"]
    assert open_pad(None) is unknown, "to say which pad is not known"


def test_the_codes_are_the_kernels() -> None:
    for name in ("EV_SYN", "EV_KEY", "EV_ABS", "SYN_DROPPED", "ABS_HAT0X", "ABS_HAT3Y",
                 "BTN_JOYSTICK", "BTN_SOUTH"):  # fmt: skip
        assert getattr(controls, name) == getattr(ecodes, name)
    kernels = {
        "lefty": "ABS_Y", "righty": "ABS_RY", "lefttrigger": "ABS_Z", "righttrigger": "ABS_RZ",
        "a": "BTN_SOUTH", "b": "BTN_EAST", "x": "BTN_WEST", "y": "BTN_NORTH",
        "leftshoulder": "BTN_TL", "rightshoulder": "BTN_TR", "back": "BTN_SELECT",
        "start": "BTN_START",
    }  # fmt: skip
    device = FakePad(PADS["DualSense"])
    codes = {name: control.code for name, control in mapping_of(device).items()}
    assert codes == {name: getattr(ecodes, code) for name, code in kernels.items()}
