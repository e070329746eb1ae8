"""The robot file that is used, whose the run directory is, and who may read what lies in it."""

from __future__ import annotations

import argparse
import dataclasses
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.rearm_guard import LastState, RearmGuard, path_of
from shared import places, run_directory
from shared.exceptions import ConfigError, FleetError
from shared.places import DEFAULT_CONFIG
from shared.process import service_parser
from shared.run_directory import (
    FLEET_VARIABLE,
    check_own,
    live_dir,
    make_live_dir,
    open_private,
    service_directory,
)
from tools.bringup import drive_access
from tools.fleet.run_dir import RunDir
from tools.verb_table import VERBS
from tools.verbs import estop

SAID = "config: ./robot.toml\n"
DECIDE_LATER = {
    "doctor", "drive configure", "drive identify", "drive jog", "drive zero", "estop", "view",
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


def test_a_robot_file_of_the_working_directory_is_taken_even_if_its_link_leads_nowhere(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here.write_text("")
    assert service_parser("A service.", "example").parse_args([]).config == here
    assert capsys.readouterr().err == SAID
    assert places.robot_file() == here
    assert capsys.readouterr().err == SAID
    assert places.robot_file(Path("lab.toml")) == Path("lab.toml")
    assert capsys.readouterr().err == ""
    here.unlink()
    here.symlink_to("lost.toml")
    assert places.robot_file() == here


@pytest.mark.parametrize("folder", [None, DEFAULT_CONFIG.parent])
def test_without_one_of_ones_own_it_is_the_shipped_one_and_nothing_is_said(
    folder: Path | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(folder or tmp_path)
    assert places.robot_file() == DEFAULT_CONFIG
    assert capsys.readouterr().err == ""


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


AS_ROOT = pytest.mark.skipif(os.getuid() != 0, reason="gives a directory to somebody else")


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_shared_memory_is_its_users_alone_whatever_the_umask_and_the_mode_before(
    tmp_path: Path,
) -> None:
    RearmGuard(tmp_path, "knee_left").write(LastState.DAMP)
    path_of(tmp_path, "knee_left").chmod(0o666)
    assert RearmGuard(tmp_path, "knee_left").read() is LastState.DAMP
    assert mode_of(path_of(tmp_path, "knee_left")) == 0o600


def test_a_link_is_not_followed_and_a_way_over_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "aim").touch()
    (tmp_path / "link").symlink_to("aim")
    with pytest.raises(OSError, match="symbolic link"):
        open_private(tmp_path / "link")
    (tmp_path / "mine" / "run").mkdir(parents=True)
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "open" / "link").symlink_to(tmp_path / "mine")
    with pytest.raises(FleetError, match="other users can write to"):
        check_own(tmp_path / "open" / "link" / "run")


@pytest.mark.parametrize("there", [True, False])
def test_a_directory_that_others_could_replace_is_refused(there: bool, tmp_path: Path) -> None:
    open_to_all = tmp_path / "open"
    run_dir = open_to_all / "below" / "run"
    (run_dir if there else open_to_all).mkdir(parents=True)
    open_to_all.chmod(0o777)
    with pytest.raises(
        FleetError, match=r"other users can write to .*/open and replace it; run `chmod"
    ):
        check_own(run_dir)
    check_own(run_dir, alone=False)  # it can still be stopped
    open_to_all.chmod(0o1777)
    check_own(run_dir)


def test_a_service_by_hand_is_refused_there_and_a_successor_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module whose service crashed is to be held, whatever has become of the directory."""
    tmp_path.chmod(0o777)
    monkeypatch.delenv(FLEET_VARIABLE, raising=False)
    with pytest.raises(argparse.ArgumentTypeError, match="other users can write to it"):
        service_directory(str(tmp_path))
    monkeypatch.setenv(FLEET_VARIABLE, str(tmp_path))
    assert service_directory(str(tmp_path)) == tmp_path


IN_MEMORY = pytest.mark.skipif(
    live_dir(Path("/nowhere")) == Path("/nowhere"), reason="this host has no folder in memory"
)


@IN_MEMORY
def test_the_live_directory_is_in_memory_found_by_any_path_and_private(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (tmp_path / "link").symlink_to(run_dir)
    live = make_live_dir(run_dir)
    assert live_dir(tmp_path / "link") == live_dir(tmp_path / "." / "run") == live
    assert live_dir(tmp_path / "other") != live
    assert live.parent in run_directory._MEMORY_FOLDERS
    assert mode_of(live) == 0o700


def test_without_a_folder_in_memory_the_live_directory_is_the_run_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folders in ((), (tmp_path,), (Path("/proc"),), (Path("/nowhere"),)):
        monkeypatch.setattr(run_directory, "_MEMORY_FOLDERS", folders)
        assert live_dir(tmp_path / "run") == tmp_path / "run"


@IN_MEMORY
@pytest.mark.parametrize("mode", [0o777, 0o770])
def test_a_live_directory_that_others_may_write_to_is_refused(tmp_path: Path, mode: int) -> None:
    live = make_live_dir(tmp_path)
    live.chmod(mode)
    with pytest.raises(FleetError, match=rf"{live}: other users can write to it"):
        check_own(tmp_path)
    check_own(tmp_path, alone=False)


@AS_ROOT
@IN_MEMORY
def test_a_strangers_live_directory_is_refused_and_a_strangers_parent_too(tmp_path: Path) -> None:
    os.chown(make_live_dir(tmp_path), 12345, 12345)
    with pytest.raises(FleetError, match="belongs to another user"):
        check_own(tmp_path, alone=False)
    (tmp_path / "theirs" / "run").mkdir(parents=True)
    os.chown(tmp_path / "theirs", 12345, 12345)
    with pytest.raises(FleetError, match="theirs belongs to another user, who can replace it"):
        check_own(tmp_path / "theirs" / "run")
