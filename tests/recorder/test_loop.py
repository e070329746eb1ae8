"""The recorder's cycle, with a clock and a disk that the test turns."""

from __future__ import annotations

import itertools
import logging
import random
import shutil
from pathlib import Path

import pytest

from services.recorder import __main__ as recorder
from services.recorder.host_watch import MIB
from services.recorder.loop import Recorder
from shared.bus import topics
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import RecorderConfig
from shared.mcap_log.writer import RunWriter
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import STATE_KEY, Queue, item
from tools.logs.run_log import read_run

CYCLE_NS = 20 * NS_PER_MS


class Rig:
    """A recording of ten messages a cycle; each is stamped when it comes."""

    def __init__(self, out: Path, config: RecorderConfig, free: int) -> None:
        self.now_ns = 0
        self.free = free
        self.sent = 0
        self.queue = Queue()
        self.writer: RunWriter = runs.writer(out, begin=False)
        self.recording = Recorder(
            self.queue,
            self.writer,
            config,
            logging.getLogger("test"),
            free_bytes=lambda: self.free,
            now_ns=0,
        )

    def run(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        while self.now_ns < end_ns:
            for _ in range(10):
                key, payload, _ = item(self.sent)
                self.queue.items.append((key, payload, self.now_ns))
                self.sent += 1
            self.recording.cycle(self.now_ns)
            self.now_ns += CYCLE_NS

    def finish(self) -> None:
        self.recording.close()
        self.writer.__exit__(None, None, None)


def rig(out: Path, *, free: int = 10_000 * MIB, **changes: float) -> Rig:
    settings = {"chunk_kib": 64, "flush_ms": 250.0, "fsync_s": 1.0, "free_min_mib": 100}
    return Rig(out, RecorderConfig(**settings | changes), free)  # type: ignore[arg-type]


def seqs(path: Path) -> list[int]:
    log = read_run(path)
    assert log.complete
    return [m.seq for m in log.messages(topics.JOINT_STATE, "knee_right")]


def test_what_came_is_in_the_file_within_the_flush_period(tmp_path: Path) -> None:
    run = rig(tmp_path)
    for _ in range(40):
        run.run(0.1)
        there = read_run(tmp_path / "run.mcap").count(STATE_KEY)
        assert there >= run.sent - 10 * (250 // 20 + 2), "a killed recorder loses so much at most"
    run.finish()
    assert seqs(tmp_path / "run.mcap") == list(range(run.sent))


def test_messages_under_another_key_are_in_the_recorders_counts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    run = rig(tmp_path)
    run.queue.misdelivered = 4
    run.run(10.1)
    run.finish()
    assert "; 4 left out, delivered under another key" in caplog.text


def test_it_splits_by_time_and_loses_nothing(tmp_path: Path) -> None:
    run = rig(tmp_path, split_s=2.0)
    run.run(7.0)
    run.finish()
    paths = [tmp_path / name for name in ("run.mcap", *(f"run_{n}.mcap" for n in (1, 2, 3)))]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    parts = [seqs(path) for path in paths]
    assert list(itertools.chain(*parts)) == list(range(run.sent))
    assert all(900 <= len(part) <= 1200 for part in parts[:3])


def test_it_splits_by_size(tmp_path: Path) -> None:
    run = rig(tmp_path, split_mib=1)
    dice = random.Random(1)
    seq = 0
    while run.writer.begun < 3:
        noise = dice.randbytes(50_000).hex().encode()  # zstd halves it
        run.queue.items.append((STATE_KEY, b'{"t_ns":1,"seq":%d,"x":"%s"}' % (seq, noise), seq))
        seq += 1
        run.recording.cycle(run.now_ns)
        run.now_ns += CYCLE_NS
    run.finish()
    logs = [read_run(tmp_path / name) for name in ("run.mcap", "run_1.mcap", "run_2.mcap")]
    assert all(MIB < log.path.stat().st_size < 2 * MIB for log in logs[:2])
    assert all(log.metadata["split"]["why"] == "size" for log in logs[1:])
    assert sum(log.count(STATE_KEY) for log in logs) == seq
    assert [log.gaps()[STATE_KEY].missing for log in logs[:2]] == [0, 0]


def test_short_of_space_it_warns_stops_with_a_finished_file_and_goes_on_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = rig(tmp_path)
    run.run(1.5)
    run.free = 190 * MIB
    run.run(1.5)
    assert "recording stops below 100 MiB" in caplog.text
    run.free = 90 * MIB
    run.run(2.0)
    errors = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "recorder.free_min_mib = 100" in errors[0]
    assert run.recording.trouble == errors[0], "for as long as it lasts"
    first = seqs(tmp_path / "run.mcap")
    assert first == list(range(len(first)))
    run.run(2.0)
    assert list(tmp_path.iterdir()) == [tmp_path / "run.mcap"], "nothing written, nothing deleted"
    run.free = 1000 * MIB
    run.run(2.0)
    assert run.recording.trouble == ""
    run.finish()
    second = seqs(tmp_path / "run_1.mcap")
    assert second == list(range(second[0], run.sent))
    left_out = second[0] - first[-1] - 1
    assert left_out > 0
    assert f"messages left out so far: {left_out}" in caplog.text
    assert read_run(tmp_path / "run_1.mcap").metadata["split"]["why"] == "space again"


def test_a_folder_that_is_removed_is_told_at_once_and_recording_goes_on_in_the_next_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "out"
    run = rig(out)
    run.run(1.0)
    shutil.rmtree(out)
    run.run(0.5)
    assert "run.mcap was removed while being written, with" in caplog.text
    run.run(1.0)
    run.finish()
    log = read_run(out / "run_1.mcap")
    assert log.metadata["split"]["why"] == "the previous file was removed"
    kept, lost = log.count(STATE_KEY), run.recording.removed_messages
    assert (kept + lost, run.recording.removed_files) == (run.sent, 1)
    assert lost <= 1.3 * 500


def test_a_file_that_is_moved_away_is_finished_there(tmp_path: Path) -> None:
    run = rig(tmp_path / "out")
    run.run(1.0)
    run.writer.path.rename(tmp_path / "mine.mcap")
    run.run(1.0)
    run.finish()
    logs = [read_run(path) for path in (tmp_path / "mine.mcap", tmp_path / "out" / "run_1.mcap")]
    assert all(log.complete for log in logs)
    assert sum(log.count(STATE_KEY) for log in logs) == run.sent
    assert run.recording.removed_files == 0


def test_a_folder_that_is_removed_at_the_end_is_told_too(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = rig(tmp_path / "out")
    run.run(1.0)
    shutil.rmtree(tmp_path / "out")
    run.finish()
    assert run.recording.removed_files == 1
    assert "was removed while being written, with" in caplog.text
    logger = logging.getLogger("test")
    assert recorder._tell_end(run.writer, run.recording, "", logger) == 2, "the exit code"
    assert "removed while being written: 1 of 1 files" in caplog.text
