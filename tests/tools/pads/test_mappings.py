"""Mappings that somebody gives in SDL's form."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import FleetError
from tests.tools.pads.fake_pad import PADS, FakePad
from tools.pads import mappings
from tools.pads.controls import EV_ABS, EV_KEY, PadControl
from tools.pads.mappings import (
    GivenLine,
    given_lines,
    guid_of,
    known_mapping,
    line_for,
    mapping_from,
    mapping_of,
)

UNKNOWN = PADS["Stadia"]._replace(vendor=0x1234, product=0x5678)
GUID = "05000000341200007856000003090000"
BASIC = "lefty:a1,righty:a3,lefttrigger:a5,righttrigger:a4,a:b0,b:b1,rightshoulder:b5"


@pytest.fixture
def device() -> FakePad:
    return FakePad(UNKNOWN, "a, pad")


@pytest.fixture(autouse=True)
def _own_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv(mappings.TEXT_VARIABLE, raising=False)
    monkeypatch.delenv(mappings.FILE_VARIABLE, raising=False)


def test_axes_and_buttons_are_counted_as_sdl_does(device: FakePad) -> None:
    found = mapping_from(GivenLine("here", f"{GUID},x,{BASIC},platform:Linux,"), device)
    assert found is not None
    assert found["righty"] == PadControl(EV_ABS, 5)
    assert (found["lefttrigger"].code, found["righttrigger"].code) == (10, 9)
    assert found["rightshoulder"] == PadControl(EV_KEY, 0x137)


def test_a_line_is_for_its_device_whatever_sum_of_the_name_stands_in_it(device: FakePad) -> None:
    assert guid_of(device) == GUID
    for guid, fits in [
        (f"{GUID[:4]}abcd{GUID[8:]}", True), (GUID.upper(), True), (GUID[:24] + "00000000", False),
        ("xinput", False),
    ]:  # fmt: skip
        found = mapping_from(GivenLine("here", f"{guid},x,{BASIC},"), device)
        assert (found is not None) is fits, guid
    assert mapping_from(GivenLine("here", f"{GUID},x,{BASIC},platform:Windows,"), device) is None


@pytest.mark.parametrize(
    ("was", "becomes", "told"),
    [
        ("righty:a3,", "", "righty: missing"),
        ("righty:a3", "righty:b3", "righty: b3"),
        ("righty:a3", "righty:a9", "righty: a9"),
        ("righttrigger:a4", "righttrigger:+a4", r"righttrigger: \+a4"),
    ],
)
def test_a_mapping_that_cannot_be_used_is_refused(
    device: FakePad, was: str, becomes: str, told: str
) -> None:
    line = GivenLine("a file: line 3", f"{GUID},x,{BASIC.replace(was, becomes)},")
    with pytest.raises(FleetError, match=f"a file: line 3: {told}"):
        mapping_from(line, device)


@pytest.mark.parametrize("seen", PADS.values(), ids=PADS)
def test_what_is_written_is_read_again(seen: object) -> None:
    pad = FakePad(seen)  # type: ignore[arg-type]
    mapping = dict(known_mapping(pad) or {})
    mapping["righty"] = mapping["righty"]._replace(inverted=True)
    assert mapping_from(GivenLine("here", line_for(pad, mapping)), pad) == mapping


def test_the_environment_comes_first_and_then_the_users_own_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, device: FakePad
) -> None:
    own = tmp_path / ".config/xrl/gamepads.txt"
    own.parent.mkdir(parents=True)
    own.write_text(f"# mine\n\n{GUID},x,{BASIC},\n")
    assert mapping_of(device)["righty"].inverted is False
    named = tmp_path / "db.txt"
    named.write_text(f"{GUID},x,{BASIC.replace('a3', 'a3~')},\n")
    monkeypatch.setenv(mappings.FILE_VARIABLE, str(named))
    assert mapping_of(device)["righty"].inverted
    monkeypatch.setenv(mappings.TEXT_VARIABLE, f"{GUID},x,{BASIC.replace('a3', 'a2')},\n")
    assert mapping_of(device)["righty"] == PadControl(EV_ABS, 2)
    assert [line.where for line in given_lines()] == [
        "SDL_GAMECONTROLLERCONFIG: line 1", f"{named}: line 1", f"{own}: line 3",
    ]  # fmt: skip


def test_a_file_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(mappings.FILE_VARIABLE, "/nowhere/db.txt")
    with pytest.raises(FleetError, match=r"/nowhere/db\.txt: cannot be read"):
        list(given_lines())
