"""`xrl log recover`; what it can bring back is in tests/shared/mcap_log/test_recover.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import STATE_KEY, Queue, item
from tools import cli
from tools.logs.run_log import read_run


def test_the_copy_goes_beside_the_original_which_is_not_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = runs.killed_file(tmp_path)
    before = killed.path.read_bytes()
    assert cli.main(["log", "recover", str(killed.path)]) == 0
    log = read_run(tmp_path / "killed.recovered.mcap")
    assert (log.complete, log.count(STATE_KEY)) == (True, 1200)
    assert killed.path.read_bytes() == before
    output = capsys.readouterr().out
    assert "kept: 1200 messages over 1.20 s" in output
    assert "lost: nothing that had reached the file" in output


def test_a_finished_file_is_left_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = runs.write(tmp_path, [item(0)])
    assert cli.main(["log", "recover", str(path)]) == 0
    assert "nothing to recover" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [path]


def test_a_finished_file_with_damage_is_recovered(tmp_path: Path) -> None:
    path = runs.write(tmp_path, [item(seq) for seq in range(1000)])
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd") + 100] ^= 1
    path.write_bytes(data)
    assert cli.main(["log", "recover", str(path)]) == 0
    assert 0 < read_run(tmp_path / "run.recovered.mcap").count(STATE_KEY) < 1000


def test_with_an_output_a_finished_file_is_copied_too(tmp_path: Path) -> None:
    path = runs.write(tmp_path, [item(0)])
    assert cli.main(["log", "recover", str(path), "-o", str(tmp_path / "copy.mcap")]) == 0
    assert read_run(tmp_path / "copy.mcap").count(STATE_KEY) == 1


def test_an_existing_output_is_replaced_only_by_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = runs.killed_file(tmp_path)
    out = tmp_path / "out.mcap"
    out.write_text("mine")
    assert cli.main(["log", "recover", str(killed.path), "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert cli.main(["log", "recover", str(killed.path), "-o", str(out), "--force"]) == 0
    assert read_run(out).complete


def test_a_file_that_is_being_written_is_recovered_so_far(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with runs.writer(tmp_path) as run:
        run.take_from(Queue([item(0), item(1)]), 10)
        run.flush()
        assert cli.main(["log", "recover", str(run.path), "-o", str(tmp_path / "so_far.mcap")]) == 0
        assert "is writing this file" in capsys.readouterr().out
    assert read_run(tmp_path / "so_far.mcap").count(STATE_KEY) == 2
    assert read_run(run.path).complete
