from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from services.simulator.physics import plant
from shared.config import files as config_file
from shared.config import scenarios
from shared.places import DEFAULT_CONFIG, SCENARIOS
from tests.tools.exit_codes import exit_code
from tools.hosts import hosts_file
from tools.verbs import new

WRITES = len(new.contents())
RENAMES = 5


def test_a_new_directory_holds_the_shipped_robot_and_all_of_it_loads(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    assert exit_code(["new", lab]) == 0
    robot = config_file.load(lab / "robot.toml")
    assert robot == config_file.load(DEFAULT_CONFIG)
    hosts_file.load(lab / "hosts.example.toml", robot)
    for path in SCENARIOS.glob("*.toml"):
        assert scenarios.load(lab / "scenarios" / path.name) == scenarios.load(path)
    for name, values in plant.NAMED.items():
        assert plant.load(lab / "plants" / f"{name}.toml") == values
    found = {path.relative_to(lab).as_posix() for path in lab.rglob("*") if path.is_file()}
    assert found == set(new.contents())


def test_an_empty_directory_is_filled_and_a_name_with_a_space_is_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(["new", "."]) == 0
    assert (tmp_path / "robot.toml").is_file()
    assert exit_code(["new", tmp_path / "my lab"]) == 0
    assert f"next steps:\n  cd '{tmp_path}/my lab'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "words"),
    [("full", "not empty"), ("full/file", "not a directory"), ("none/lab", "does not exist")],
)
def test_a_place_that_cannot_be_filled_is_told_and_left(
    name: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    assert exit_code(["new", tmp_path / name]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"xrl: {tmp_path / name}: ")
    assert words in told
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "file"]


def failing(call: Callable[..., object], at: int, error: BaseException) -> Callable[..., object]:
    """Return a call that raises the n-th time, and works otherwise."""
    count = 0

    def called(*args: object) -> object:
        nonlocal count
        count += 1
        if count == at:
            raise error
        return call(*args)

    return called


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize(
    ("what", "at"),
    [("write_bytes", 1), ("write_bytes", WRITES), ("rename", 1), ("rename", RENAMES)],
)
@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), 130), (OSError(errno.ENOSPC, "full"), 2)]
)
def test_what_ends_in_the_middle_leaves_nothing(
    what: str, at: int, error: BaseException, code: int, exists: bool, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    lab = tmp_path / "lab"
    if exists:
        lab.mkdir()
    monkeypatch.setattr(Path, what, failing(getattr(Path, what), at, error))
    assert exit_code(["new", lab]) == code
    assert os.listdir(tmp_path) == (["lab"] if exists else [])  # noqa: PTH208 - hidden ones too
    assert not exists or os.listdir(lab) == []  # noqa: PTH208


def test_the_robot_file_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    rename = Path.rename

    def recorded(path: Path, to: Path) -> Path:
        moved.append(to.name)
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", recorded)
    assert exit_code(["new", tmp_path / "lab"]) == 0
    assert len(moved) == RENAMES
    assert moved[-1] == "robot.toml"
