"""A pad that nobody knows is learnt by moving each control as asked."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import pytest

from shared.exceptions import FleetError
from tests.tools.pads.fake_pad import PADS, FakePad
from tools.pads.calibration import ASKED, calibrate, keep
from tools.pads.controls import EV_ABS, EV_KEY, PadControl
from tools.pads.mappings import mapping_of

UNKNOWN = PADS["Stadia"]._replace(vendor=0x1234)
BUTTONS = {
    "a": 0x130, "b": 0x131, "x": 0x133, "y": 0x134, "leftshoulder": 0x136, "rightshoulder": 0x137,
}  # fmt: skip
MOVES = {"lefty": (1, 0.0), "righty": (5, 1.0), "lefttrigger": (10, 1.0), "righttrigger": (9, 1.0)}
"""The right stick's values rise forwards: it is inverted."""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakePad:
    monkeypatch.setenv("HOME", str(tmp_path))
    return FakePad(UNKNOWN)


def person(
    device: FakePad,
    clumsy: Collection[str] = (),
    moves: Mapping[str, tuple[int, float]] = MOVES,
) -> Callable[[str], None]:
    """Return someone who does what is asked, at first not well where clumsy."""
    tried: set[str] = set()

    def do(text: str) -> None:
        name = next((name for name, asked in ASKED.items() if asked in text), "")
        if not name:
            device.report_rest()
            device.press(0x13C)
        elif name in clumsy and name not in tried:
            tried.add(name)
            for axis in (0, 1, 2, 5):
                device.move(axis, 0.9)
            device.report_rest()
        elif name in moves:
            device.move(*moves[name])
            device.report_rest()
        elif name in BUTTONS:
            device.press(BUTTONS[name])

    return do


@pytest.mark.parametrize("clumsy", [set(), {"lefty", "righttrigger"}], ids=["well", "clumsily"])
def test_a_pad_is_learnt_and_kept(device: FakePad, clumsy: set[str]) -> None:
    do = person(device, clumsy)
    mapping = calibrate(device, do, patience_s=1.0)
    assert mapping == {
        "lefty": PadControl(EV_ABS, 1), "righty": PadControl(EV_ABS, 5, inverted=True),
        "lefttrigger": PadControl(EV_ABS, 10), "righttrigger": PadControl(EV_ABS, 9),
        **{name: PadControl(EV_KEY, code) for name, code in BUTTONS.items()},
    }, "buttons that the pad lacks are left out"  # fmt: skip
    keep(device, {**mapping, "b": PadControl(EV_KEY, 0x134)})
    file = Path(keep(device, mapping))
    assert len(file.read_text().splitlines()) == 1, "the newer one stands in place of the older"
    assert mapping_of(device) == mapping


def test_a_trigger_that_is_also_a_button_is_its_axis(device: FakePad) -> None:
    do = person(device)

    def with_buttons(text: str) -> None:
        if ASKED["righttrigger"] in text:
            device.send(EV_KEY, 0x2C0, 1)
            device.send(EV_KEY, 0x2C0, 0)
        do(text)

    mapping = calibrate(device, with_buttons, patience_s=1.0)
    assert mapping["righttrigger"] == PadControl(EV_ABS, 9)


def test_one_control_is_not_taken_for_two(device: FakePad) -> None:
    moves = {**MOVES, "righttrigger": MOVES["lefttrigger"]}
    with pytest.raises(FleetError, match=r"righttrigger: nothing moved as asked.*nothing is"):
        calibrate(device, person(device, moves=moves), patience_s=1.0)


def test_a_person_who_does_nothing_writes_nothing(device: FakePad, tmp_path: Path) -> None:
    with pytest.raises(FleetError, match="no button was pressed; nothing is written"):
        calibrate(device, print, patience_s=0.05)
    device.unplug()
    with pytest.raises(FleetError, match="is gone; nothing is written"):
        calibrate(device, print, patience_s=1.0)
    assert not list(tmp_path.iterdir())


def test_without_a_home_it_says_so(device: FakePad, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.pads.calibration.own_file", lambda: None)
    with pytest.raises(FleetError, match="no home directory; set HOME"):
        keep(device, {})
