"""A pad's events as deflections: of a pad at rest, of a worn one, of one that is lost."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
import sdl2
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.exceptions import FleetError, MissingPackageError
from tests.tools.pads.virtual_pad import AXES, HOLD, STOP, VirtualPad, virtual_pad
from tools.pads.gamepad import BUTTONS, TRIGGERS, Gamepad, find_pad, start_sdl
from tools.pads.pilot import DEAD_ZONE, Pilot


@pytest.fixture
def device() -> Iterator[VirtualPad]:
    with virtual_pad() as pad:
        yield pad


def settled(device: VirtualPad) -> Gamepad:
    """Return a pad whose rest is learnt."""
    device.rest()
    pad = Gamepad(device.index)
    device.press(HOLD)
    pad.wait(0.1)
    assert pad.settle() == ""
    return pad


@pytest.mark.parametrize(
    ("axis", "share", "deflection"),
    [
        ("lefty", -1.0, (1.0, 0.0, 0.0)),  # forward is up
        ("righty", 1.0, (0.0, -1.0, 0.0)),  # back is back
        ("righttrigger", 1.0, (0.0, 0.0, 1.0)),
        ("lefttrigger", 1.0, (0.0, 0.0, -1.0)),
        ("leftx", 1.0, (0.0, 0.0, 0.0)),
        ("rightx", 1.0, (0.0, 0.0, 0.0)),
    ],
)
def test_each_control_leads_what_it_is_there_for(
    device: VirtualPad, axis: str, share: float, deflection: tuple[float, float, float]
) -> None:
    pad = settled(device)
    assert not pad.held
    device.set_button(HOLD, is_down=True)
    device.move(axis, share)
    pad.wait(0.1)
    assert pad.held
    assert pad.deflection == pytest.approx(deflection, abs=0.01)
    assert not pad.stopped


MOVES = st.lists(st.tuples(st.integers(0, 40), st.floats(-1.0, 1.0)), max_size=30)


def move_whatever(device: VirtualPad, moves: list[tuple[int, float]], but: str = "") -> None:
    controls = [name for name in (*AXES, *BUTTONS) if name != but]
    for which, share in moves:
        name = controls[which % len(controls)]
        if name in BUTTONS:
            device.set_button(name, is_down=share > 0.0)
        else:
            device.move(name, abs(share) if name in TRIGGERS else share)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(moves=MOVES, drift=st.floats(-0.15, 0.15))
def test_whatever_came_a_pad_at_rest_leads_nowhere(
    device: VirtualPad, moves: list[tuple[int, float]], drift: float
) -> None:
    pad = settled(device)
    move_whatever(device, moves)
    device.rest()
    device.move("lefty", drift)
    pad.wait(0.0)
    pilot = Pilot(1.0, 0.1, 150.0)
    assert pilot.integrate(pad.deflection, 1.0) == (1.0, 0.1, 0.0)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(moves=MOVES)
def test_only_the_right_trigger_raises_the_assist(
    device: VirtualPad, moves: list[tuple[int, float]]
) -> None:
    pad = settled(device)
    pilot = Pilot(1.0, 0.1, 150.0)
    for move in moves:
        move_whatever(device, [move], but="righttrigger")
        pad.wait(0.0)
        assert pilot.integrate(pad.deflection, 0.1).assist_n == 0.0


@pytest.mark.parametrize("drift", [-0.15, 0.15])
def test_a_worn_sticks_rest_is_learnt(device: VirtualPad, drift: float) -> None:
    pad = Gamepad(device.index)
    device.move("lefty", drift)
    device.press(HOLD)
    pad.wait(0.1)
    assert pad.settle() == ""
    for share, height in ((drift, 0.0), (-1.0, 1.0), (1.0, -1.0)):
        device.move("lefty", share)
        pad.wait(0.1)
        assert pad.deflection.height == pytest.approx(height, abs=1e-4)


@pytest.mark.parametrize(
    ("axis", "share", "told"),
    [("lefty", 0.5, r"left stick (50 %)"), ("righty", -0.6, "right stick"),
     ("righttrigger", 1.0, "right trigger"), ("lefttrigger", 0.3, "left trigger")],
)  # fmt: skip
def test_a_pad_that_is_held_begins_only_once_it_is_released(
    device: VirtualPad, axis: str, share: float, told: str
) -> None:
    pad = Gamepad(device.index)
    device.move(axis, share)
    pad.wait(0.1)
    assert told in pad.settle()
    device.move(axis, 0.0)
    pad.wait(0.1)
    assert pad.settle() == "press the dead man's button once"
    device.set_button(HOLD, is_down=True)
    pad.wait(0.1)
    assert pad.settle() == "let go of the dead man's button"
    assert not pad.held, "nothing is led before the rest is known"
    device.set_button(HOLD, is_down=False)
    pad.wait(0.1)
    assert pad.settle() == ""


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(held=st.floats(-1.0, 1.0))
def test_a_stick_held_while_rest_is_learnt_leads_nowhere_once_it_is_released(
    device: VirtualPad, held: float
) -> None:
    pad = Gamepad(device.index)
    device.move("lefty", held)
    device.press(HOLD)
    pad.wait(0.0)
    if pad.settle() == "":
        device.move("lefty", 0.0)
        pad.wait(0.0)
        assert abs(pad.deflection.height) <= DEAD_ZONE


def test_the_stop_counts_before_rest_is_learnt_however_briefly_it_is_pressed(
    device: VirtualPad,
) -> None:
    pad = Gamepad(device.index)
    device.press(STOP)
    pad.wait(0.1)
    assert pad.stopped


def test_a_pad_that_is_lost_releases_everything(device: VirtualPad) -> None:
    pad = settled(device)
    device.set_button(HOLD, is_down=True)
    device.move("lefty", -1.0)
    pad.wait(0.1)
    assert pad.held
    device.unplug()
    pad.wait(0.1)
    assert pad.gone
    assert not pad.held
    assert pad.deflection == (0.0, 0.0, 0.0)
    pad.wait(0.001)


def test_a_button_or_an_axis_that_the_mapping_lacks_is_refused(device: VirtualPad) -> None:
    guid = sdl2.SDL_JoystickGetDeviceGUID(device.index)
    mapping = sdl2.SDL_GameControllerMappingForGUID(guid)
    for part, told in ((b"b:b1,", "no b; choose another"), (b"righty:a3,", "no righty; map it")):
        assert sdl2.SDL_GameControllerAddMapping(mapping.replace(part, b"")) == 0
        with pytest.raises(FleetError, match=f"its mapping has {told}"):
            Gamepad(device.index)


def test_a_pad_is_found_by_a_part_of_its_name_and_needs_no_display(device: VirtualPad) -> None:
    assert find_pad(None) == find_pad("Virtual") == device.index
    with pytest.raises(FleetError, match="no gamepad 'Xbox'; found: Virtual Controller at"):
        find_pad("Xbox")
    assert not sdl2.SDL_WasInit(sdl2.SDL_INIT_VIDEO)


def test_without_the_package_or_a_pad_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FleetError, match="no gamepad; found: none that this user may read; join"):
        find_pad(None)
    monkeypatch.setitem(sys.modules, "sdl2", None)
    with pytest.raises(MissingPackageError, match=r"`pad` .*; or lead with the keyboard: --keys"):
        start_sdl()
