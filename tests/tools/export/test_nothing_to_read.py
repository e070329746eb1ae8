"""A verb that finds no message says so with exit code 2, and writes nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import cli
from tools.logs.reexecution import rewritten
from tools.logs.run_index import RunIndex
from tools.logs.run_log import NOTHING, RunLog

WRITERS = (
    "log report --open no -o OUT",
    "log export --ros2bag OUT",
    "log export --csv OUT",
    "log export --csv OUT --rate 10",
    "log export --gif OUT",
    "log export --scene -o OUT",
    "view --html OUT",
)
READERS = (
    "log explain",
    "log resim",
    "log whatif --kill planner",
    "log play --wait 0 --run-dir OUT",
)


@pytest.fixture(scope="module")
def silent(run_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run's file with all that is said about it, and without a message."""
    log = RunLog(RunIndex(run_file), NOTHING)
    log.forget()
    path = tmp_path_factory.mktemp("silent") / "run.mcap"
    assert rewritten.write(log, path, {}, {}) == 0
    return path


@pytest.mark.parametrize("words", [*WRITERS, *READERS])
def test_a_run_without_a_message_is_exit_code_2_and_one_line(
    silent: Path, tmp_path: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = words.replace("OUT", str(tmp_path / "out")).split()
    begin = 2 if given[0] == "log" else 1
    assert cli.main([*given[:begin], str(silent), *given[begin:]]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
    assert list(silent.parent.iterdir()) == [silent]
