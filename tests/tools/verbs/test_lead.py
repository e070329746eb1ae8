"""`xrl lead` by a pad: nothing is led before the rest positions of the sticks are known."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from rich.console import Console
from rich.text import Text

from shared.exceptions import FleetError
from tests.tools.pads.virtual_pad import HOLD, STOP, VirtualPad, virtual_pad
from tools.pads.gamepad import Gamepad
from tools.pads.pilot import Deflection
from tools.verbs import lead


class Following:
    """Takes what is led; after some looks the pad is unplugged."""

    def __init__(self, device: VirtualPad, looks: int) -> None:
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
def device() -> Iterator[VirtualPad]:
    with virtual_pad() as pad:
        yield pad


def by_pad(pad: Gamepad, leader: Following) -> lead.Key | None:
    return lead._by_pad(pad, leader, Console(quiet=True))  # type: ignore[arg-type]


def test_a_stick_that_is_held_at_the_start_leads_nothing_and_is_named(
    device: VirtualPad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lead, "SETTLE_S", 0.2)
    pad = Gamepad(device.index)
    device.move("righty", 1.0)
    device.press(HOLD)
    device.set_button(HOLD, is_down=True)
    leader = Following(device, 1)
    with pytest.raises(FleetError, match=r"not ready within 0.2 s: let go of: right stick \(100 %"):
        by_pad(pad, leader)
    assert not leader.led


def test_the_stop_counts_while_a_stick_is_still_held(device: VirtualPad) -> None:
    pad = Gamepad(device.index)
    device.move("righty", 1.0)
    device.press(STOP)
    assert by_pad(pad, Following(device, 1)) is lead.Key.STOP


def test_once_rest_is_known_it_leads_until_the_pad_is_lost(device: VirtualPad) -> None:
    pad = Gamepad(device.index)
    device.press(HOLD)
    pad.wait(0.1)
    assert pad.settle() == ""
    device.set_button(HOLD, is_down=True)
    device.move("lefty", -1.0)
    leader = Following(device, 3)
    assert by_pad(pad, leader) is None
    assert pad.gone
    assert leader.led
    assert all(wanted.height == pytest.approx(1.0) for wanted in leader.led)
