"""Whose the run directory is, and who may read what lies in it."""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import LastState, RearmGuard, path_of
from shared.exceptions import FleetError
from shared.run_directory import FLEET_VARIABLE, check_own, open_private, service_directory

AS_ROOT = pytest.mark.skipif(os.getuid() != 0, reason="gives a directory to somebody else")


@pytest.fixture
def umask_0() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.usefixtures("umask_0")
def test_shared_memory_is_its_users_alone_whatever_the_umask(tmp_path: Path) -> None:
    RearmGuard(tmp_path, "knee_left")
    Neighbours(tmp_path, "knee_left")
    assert {mode_of(path) for path in tmp_path.iterdir()} == {0o600}


def test_a_file_that_others_could_write_is_taken_from_them_and_kept(tmp_path: Path) -> None:
    RearmGuard(tmp_path, "knee_left").write(LastState.DAMP)
    path_of(tmp_path, "knee_left").chmod(0o666)
    assert RearmGuard(tmp_path, "knee_left").read() is LastState.DAMP
    assert mode_of(path_of(tmp_path, "knee_left")) == 0o600


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "aim").touch()
    (tmp_path / "link").symlink_to("aim")
    with pytest.raises(OSError, match="symbolic link"):
        open_private(tmp_path / "link")


@pytest.mark.parametrize("there", [True, False])
def test_a_directory_that_others_could_replace_is_refused(there: bool, tmp_path: Path) -> None:
    open_to_all = tmp_path / "open"
    run_dir = open_to_all / "below" / "run"
    (run_dir if there else open_to_all).mkdir(parents=True)
    open_to_all.chmod(0o777)
    with pytest.raises(FleetError, match=r"others may write to .*/open and replace it; `chmod"):
        check_own(run_dir)
    check_own(run_dir, alone=False)  # it can still be stopped
    open_to_all.chmod(0o1777)
    check_own(run_dir)


def test_a_way_over_a_link_in_such_a_directory_is_refused_too(tmp_path: Path) -> None:
    (tmp_path / "mine" / "run").mkdir(parents=True)
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "open" / "link").symlink_to(tmp_path / "mine")
    with pytest.raises(FleetError, match="others may write to"):
        check_own(tmp_path / "open" / "link" / "run")


@AS_ROOT
def test_a_directory_in_a_strangers_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs" / "run").mkdir(parents=True)
    os.chown(tmp_path / "theirs", 12345, 12345)
    with pytest.raises(FleetError, match="theirs belongs to another user, who can replace it"):
        check_own(tmp_path / "theirs" / "run")


def test_a_service_by_hand_is_refused_there_and_a_successor_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module whose service crashed is to be held, whatever has become of the directory."""
    tmp_path.chmod(0o777)
    monkeypatch.delenv(FLEET_VARIABLE, raising=False)
    with pytest.raises(argparse.ArgumentTypeError, match="others may write to it"):
        service_directory(str(tmp_path))
    monkeypatch.setenv(FLEET_VARIABLE, str(tmp_path))
    assert service_directory(str(tmp_path)) == tmp_path
