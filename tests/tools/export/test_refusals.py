"""An export that finds nothing, or is ended half-way, leaves nothing that looks whole."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.shared.mcap_log.runs import writer_like
from tools import cli
from tools.logs.run_index import RunIndex
from tools.logs.run_log import NOTHING, RunLog

WAIT_S = 60.0


@pytest.mark.system
@pytest.mark.parametrize(
    ("flag", "number"),
    [("--csv", signal.SIGKILL), ("--csv", signal.SIGINT), ("--ros2bag", signal.SIGTERM)],
)
def test_a_folder_that_is_ended_half_way_is_not_there_and_is_written_the_next_time(
    run_file: Path, tmp_path: Path, flag: str, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    words = ["log", "export", str(run_file), flag, str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", *words],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    part, deadline = tmp_path / ".out.part", time.monotonic() + WAIT_S
    while not part.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)
    process.send_signal(number)
    code = process.wait(WAIT_S)
    if code == 0:
        pytest.skip("the machine stalled: it was written before the signal came")
    assert code == (130 if number == signal.SIGINT else 143 if number == signal.SIGTERM else -9)
    assert not out.exists()
    assert part.exists() == (number == signal.SIGKILL)
    assert cli.main(words) == 0
    assert list(tmp_path.iterdir()) == [out]
    assert list(out.iterdir())


def test_a_file_that_is_ended_half_way_leaves_the_one_that_was_there(
    run_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_arguments: object, **_more: object) -> None:
        (part,) = (path for path in tmp_path.iterdir() if path.name.endswith(".part"))
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out.gif"
    out.write_bytes(b"old")
    monkeypatch.setattr("PIL.Image.Image.save", interrupted)
    assert cli.main(["log", "export", str(run_file), "--gif", "out.gif", "--force"]) == 130
    assert out.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


WRITERS = (
    "log report --open no -o OUT",
    "log export --ros2bag OUT",
    "log export --csv OUT",
    "log export --csv OUT --rate 10",
    "log export --gif OUT",
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
    with writer_like(log, tmp_path_factory.mktemp("silent")) as run:
        return run.path


@pytest.mark.parametrize("words", [*WRITERS, *READERS])
def test_a_run_without_a_message_is_exit_code_2_and_one_line(
    silent: Path, tmp_path: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *flags = words.removeprefix("log ").replace("OUT", str(tmp_path / "out")).split()
    noun = ["log"] if words.startswith("log ") else []
    assert cli.main([*noun, verb, str(silent), *flags]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
    assert list(silent.parent.iterdir()) == [silent]
