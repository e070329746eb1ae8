"""Recovery: what was flushed comes back, and the mcap package reads it."""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from services.recorder import auto_recover
from shared.bus import topics
from shared.exceptions import RunError
from shared.mcap_log import recover
from shared.mcap_log.recover import Interrupted
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ATTACHMENTS, Queue, by_the_package, item
from tools.logs.run_log import read_run

LOGGER = logging.getLogger("test")


pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def test_a_killed_file_comes_back_whole(tmp_path: Path) -> None:
    killed = runs.killed_file(tmp_path)
    outcome = recover.recover(killed.path, tmp_path / "out.mcap")
    assert by_the_package(outcome.out) == list(range(1200))
    assert (outcome.messages, outcome.cut, outcome.damage) == (1200, None, ())
    log = read_run(outcome.out)
    assert log.complete
    assert log.attachments == ATTACHMENTS
    assert log.metadata["recovered"]["from"] == "killed.mcap"
    assert log.messages(topics.JOINT_STATE, "knee_right")[-1] == runs.state(1199)


def test_the_messages_before_the_cut_in_a_chunk_come_back(tmp_path: Path) -> None:
    """zstd gives back whole blocks of up to 128 KiB of a chunk that is cut."""
    with runs.writer(tmp_path / "written", chunk_kib=4096) as run:
        run.take_from(Queue(item(seq) for seq in range(3000)), 3000)
        run.flush()
        data = run.path.read_bytes()
    start = data.index(b"zstd") + 4
    length = int.from_bytes(data[start : start + 8], "little")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: start + 8 + length * 3 // 4])
    outcome = recover.recover(cut, tmp_path / "out.mcap")
    found = by_the_package(outcome.out)
    assert 500 < len(found) < 3000
    assert found == list(range(len(found)))
    assert outcome.cut is not None
    # some messages of any time within the chunk may be missing: they are grouped by key
    lost_s = (outcome.cut.last_ns - outcome.cut.first_ns) / 1e9
    assert lost_s == pytest.approx(2.999, abs=2e-3)
    assert f"{lost_s:.3f} s" in "\n".join(recover.describe(outcome))


def test_garbage_after_a_power_cut_is_no_message(tmp_path: Path) -> None:
    """The chunk's length reached the disk, and its content did not."""
    killed = runs.killed_file(tmp_path)
    data = killed.path.read_bytes()
    start = data.index(b"zstd", killed.flushed[-2][0])
    killed.path.write_bytes(data[: start + 30] + bytes(5000))
    outcome = recover.recover(killed.path, tmp_path / "out.mcap")
    assert by_the_package(outcome.out) == list(range(1100))


def test_a_damaged_original_stays_and_its_recovery_goes_beside_it_once(tmp_path: Path) -> None:
    killed = runs.killed_file(tmp_path)
    data = bytearray(killed.path.read_bytes())
    data[data.index(b"zstd", killed.flushed[5][0]) + 100] ^= 1
    killed.path.write_bytes(data)
    for _ in range(2):
        auto_recover.recover_in_place(killed.path, 0, LOGGER, lambda: False)
    assert killed.path.read_bytes() == data
    beside = tmp_path / "killed.recovered.mcap"
    assert len(by_the_package(beside)) >= 1100
    assert {p.name for p in tmp_path.glob("*.mcap")} == {"killed.mcap", beside.name}


def being_written(path: Path, _patch: pytest.MonkeyPatch) -> None:
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        auto_recover.recover_in_place(path, 0, LOGGER, lambda: False)


def without_space(path: Path, _patch: pytest.MonkeyPatch) -> None:
    auto_recover.recover_in_place(path, 1 << 62, LOGGER, lambda: False)


def stopped(path: Path, _patch: pytest.MonkeyPatch) -> None:
    asked = iter([False] * 9 + [True])
    with pytest.raises(Interrupted):
        auto_recover.recover_in_place(path, 0, LOGGER, lambda: next(asked))


def full_disk(path: Path, patch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    patch.setattr("os.fsync", full)
    with pytest.raises(RunError, match="cannot be written: No space left") as caught:
        recover.recover(path, path.with_name("out.mcap"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("tried", [being_written, without_space, stopped, full_disk])
def test_what_keeps_a_recovery_from_its_end_leaves_the_original_and_nothing_else(
    tmp_path: Path, tried: Callable[[Path, pytest.MonkeyPatch], None],
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    path = runs.killed_file(tmp_path).path
    before, there = path.read_bytes(), sorted(tmp_path.iterdir())
    tried(path, monkeypatch)
    assert path.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == there
    assert ("not enough space to recover it" in caplog.text) is (tried is without_space)


def test_the_rescue_of_a_directory_takes_what_is_unfinished_and_survives_the_rest(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    path = runs.killed_file(tmp_path).path
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "other.mcap").write_bytes(b"no mcap file at all")
    finished = runs.write(tmp_path / "written2", [item(0)])
    target = tmp_path / "finished.mcap"
    target.write_bytes(finished.read_bytes())
    there = sorted(tmp_path.glob("*.mcap"))
    thread = auto_recover.AutoRecovery(tmp_path, 0, LOGGER)
    thread.start()
    thread.join(60.0)
    assert not thread.is_alive()
    assert by_the_package(path) == list(range(1200)), "replaced by its recovery"
    assert sorted(tmp_path.glob("*.mcap")) == there
    assert target.read_bytes() == finished.read_bytes()
    warned = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warned) == 3
    assert "killed.mcap was not finished; recovered to killed.mcap: kept: 1200" in caplog.text
