from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared import places
from shared.exceptions import ConfigError, RunError
from shared.places import DEFAULT_CONFIG
from shared.process import service_parser
from tests.tools.exit_codes import exit_code
from tools.bringup import drive_access
from tools.fleet.run_dir import RunDir
from tools.verb_table import VERBS
from tools.verbs import estop

SAID = "config: ./robot.toml\n"
DECIDE_LATER = {
    "doctor", "drive configure", "drive identify body", "drive identify joint", "drive jog",
    "drive zero", "estop", "log explain", "log play", "view",
}  # fmt: skip
"""Verbs that take a running fleet's or a record's robot before they look for a file."""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "robot.toml"


def own_defaults() -> Iterator[tuple[str, object]]:
    """Yield each verb whose flags have `--config`, and what it is without the flag."""
    for verb in VERBS:
        if not hasattr(verb.module, "add_parser"):
            for field in dataclasses.fields(verb.declaration):  # type: ignore[arg-type]
                if field.name == "config":
                    made = field.default_factory
                    yield verb.name, field.default if made is dataclasses.MISSING else made


def test_a_robot_file_of_the_working_directory_is_taken_and_named_but_one_that_is_named_wins(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here.write_text("")
    assert service_parser("A service.", "example").parse_args([]).config == here
    assert capsys.readouterr().err == SAID
    assert places.robot_file() == here
    assert capsys.readouterr().err == SAID
    assert places.robot_file(Path("lab.toml")) == Path("lab.toml")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("folder", [None, DEFAULT_CONFIG.parent])
def test_without_one_of_ones_own_it_is_the_shipped_one_and_nothing_is_said(
    folder: Path | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(folder or tmp_path)
    assert places.robot_file() == DEFAULT_CONFIG
    assert capsys.readouterr().err == ""


def test_a_link_that_leads_nowhere_does_not_let_the_shipped_robot_in(here: Path) -> None:
    here.symlink_to("lost.toml")
    assert places.robot_file() == here


def test_another_users_robot_file_is_not_taken_unasked(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here.write_text("")
    if os.getuid() == 0:
        os.chown(here, 4711, -1)
    else:
        monkeypatch.setattr(os, "getuid", lambda: here.stat().st_uid + 1)
    with pytest.raises(ConfigError, match="belongs to another user"):
        places.robot_file()


def test_every_verb_that_takes_a_robot_file_looks_for_one() -> None:
    found = dict(own_defaults())
    assert {name for name, default in found.items() if default is None} == DECIDE_LATER
    assert {default for default in found.values() if default is not None} == {places.robot_file}
    assert len(found) > 2 * len(DECIDE_LATER)


def test_an_empty_name_is_no_search(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    here.write_text("")
    assert exit_code(["gains", "--stiffness", "--config", ""]) == 2
    assert SAID not in capsys.readouterr().err


def test_a_file_of_another_kind_is_named_in_the_error(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here.write_text('[vacuum]\nname = "cleaner"\n')
    assert exit_code(["gains", "--stiffness"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"{SAID}xrl: {here}: ")
    assert told.count("\n") == 2


def test_a_flag_before_the_verb_is_told_where_it_goes(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["--config", "lab.toml", "sim"]) == 2
    assert "--config comes after the verb" in capsys.readouterr().err


@pytest.mark.parametrize("given", [None, "fleet.toml"])
def test_a_fleet_that_is_up_keeps_its_robot_file(
    given: str | None, here: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    here.write_text("")
    fleets = here.with_name("fleet.toml")
    manifest = argparse.Namespace(config=str(fleets))
    monkeypatch.setattr(RunDir, "read_manifest", lambda _: manifest)
    monkeypatch.setattr(drive_access, "is_up", lambda _: True)
    args = argparse.Namespace(run_dir=here.parent, config=Path(given) if given else None)
    assert drive_access.robot_file(args) == fleets
    assert capsys.readouterr().err == ""


def test_a_stop_from_afar_takes_the_robot_file_of_the_working_directory(here: Path) -> None:
    flags = estop.EstopFlags(run_dir=here.parent)
    with pytest.raises(estop.FleetError, match="--config"):
        estop._robot(flags)
    here.write_bytes(DEFAULT_CONFIG.read_bytes())
    assert estop._robot(flags).name == "xrl"


def test_a_wheel_says_what_needs_a_checkout_and_its_files_are_not_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places.need_checkout("--against")
    places.refuse_shipped(DEFAULT_CONFIG)
    monkeypatch.setattr(places, "IS_CHECKOUT", False)
    monkeypatch.setattr(places, "FILES", tmp_path)
    with pytest.raises(RunError, match="--against needs a checkout"):
        places.need_checkout("--against")
    with pytest.raises(RunError, match="xrl new DIR"):
        places.refuse_shipped(tmp_path / "robot.gains.json")
