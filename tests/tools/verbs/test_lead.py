"""`xrl lead` by a pad: nothing is led before it is known where the sticks rest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.text import Text

from shared.exceptions import FleetError
from tests.tools.exit_codes import exit_code
from tests.tools.pads.fake_pad import PADS, FakePad
from tools.pads import gamepad, mappings
from tools.pads.controls import EV_KEY
from tools.pads.gamepad import Gamepad
from tools.pads.mappings import guid_of, known_mapping
from tools.pads.pilot import Deflection
from tools.verbs import lead

XBOX = PADS["Xbox 360 by cable"]


class Following:
    """Takes what is led; after some looks the pad is unplugged."""

    def __init__(self, device: FakePad, looks: int) -> None:
        self.device, self.looks = device, looks
        self.led: list[Deflection] = []

    def take_hold(self) -> None:
        pass

    def lead(self, wanted: Deflection, dt: float) -> None:
        assert dt <= 2 * lead.PERIOD_S
        self.led.append(wanted)

    def describe(self, held: str) -> Text:
        self.looks -= 1
        if not self.looks:
            self.device.unplug()
        return Text(held)


@pytest.fixture
def device() -> Iterator[FakePad]:
    pad = FakePad(XBOX)
    yield pad
    pad.close()


def pad_on(device: FakePad) -> Gamepad:
    mapping = known_mapping(device)
    assert mapping is not None
    return Gamepad(device, mapping)


def by_pad(pad: Gamepad, leader: Following) -> lead.Key | None:
    return lead._by_pad(pad, leader, Console(quiet=True))  # type: ignore[arg-type]


def test_a_stick_that_is_held_at_the_start_leads_nothing_and_is_named(
    device: FakePad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lead, "SETTLE_S", 0.2)
    device.report_rest()
    device.move(XBOX.righty, 1.0)
    device.press(XBOX.shoulder)
    device.send(EV_KEY, XBOX.shoulder, 1)
    leader = Following(device, 1)
    with pytest.raises(FleetError, match=r"not begun within 0.2 s: let go of: right stick \(100 %"):
        by_pad(pad_on(device), leader)
    assert not leader.led


def test_the_stop_counts_while_a_stick_is_still_held(device: FakePad) -> None:
    device.move(XBOX.righty, 1.0)
    device.press(XBOX.east)
    assert by_pad(pad_on(device), Following(device, 1)) is lead.Key.STOP


def test_once_rest_is_known_it_leads_until_the_pad_is_lost(device: FakePad) -> None:
    device.report_rest()
    device.press(XBOX.shoulder)
    pad = pad_on(device)
    pad.wait(0.1)
    assert pad.settle() == ""
    device.send(EV_KEY, XBOX.shoulder, 1)
    device.move(1, 0.0)
    leader = Following(device, 3)
    assert by_pad(pad, leader) is None
    assert pad.gone
    assert leader.led
    assert all(wanted.height == pytest.approx(1.0) for wanted in leader.led)


def test_a_pad_whose_kept_mapping_is_broken_can_be_calibrated(
    device: FakePad, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / ".config/xrl/gamepads.txt"
    file.parent.mkdir(parents=True)
    file.write_text(f"{guid_of(device)},a pad,lefty:b99,\n")
    fake = SimpleNamespace(list_devices=lambda: ["0"], InputDevice=lambda _: device)
    monkeypatch.setattr(gamepad, "evdev", fake)
    mapping = known_mapping(device)
    assert mapping is not None
    monkeypatch.setattr(lead, "calibrate", lambda *_: mapping)
    assert exit_code(["lead", "--calibrate"]) == 0
    assert mappings.mapping_of(device) == mapping
    assert len(file.read_text().splitlines()) == 1
