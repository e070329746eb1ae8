"""Which files are read, and what of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from shared.bus import codec, topics
from shared.exceptions import RunError
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import STATE_KEY, item, killed_file, write, writer
from tools.logs.playback import reading
from tools.logs.playback.reading import files_named, read
from tools.logs.run_index import further_files

WRENCH_KEY = topics.WRENCH.key(runs.ROBOT)


def payloads(path: Path) -> list[bytes]:
    return [entry.payload for entry in read([path]).entries()]


def split_run(directory: Path, parts: int = 3, size: int = 10) -> list[Path]:
    rows = [item(n) for n in range(parts * size)]
    return runs.write_in_parts(writer(directory, keys=runs.few_topics()), rows, parts)


def test_messages_are_given_as_recorded_in_the_order_of_their_reception(tmp_path: Path) -> None:
    items = [item(n, STATE_KEY if n % 3 else WRENCH_KEY) for n in range(50)]
    recording = read([write(tmp_path, items)])
    found = [(recording.keys[e.key], e.payload, e.time_ns) for e in recording.entries()]
    assert found == items
    assert recording.robot == runs.ROBOT
    assert recording.robot_file == runs.ATTACHMENTS["robot.toml"].decode()
    assert (recording.began_ns, recording.ended_ns) == (items[0][2], items[-1][2])


def test_what_came_at_one_moment_stays_as_it_stood_in_the_file(tmp_path: Path) -> None:
    keys = (STATE_KEY, WRENCH_KEY)
    items = [(keys[n * n % 5 % 2], codec.encode(runs.state(n)), 1_000) for n in range(40)]
    assert payloads(write(tmp_path, items)) == [payload for _, payload, _ in items]


def test_the_files_of_a_run_are_one_log_in_whatever_order_they_are_given(tmp_path: Path) -> None:
    paths = split_run(tmp_path)
    assert len(paths) == 3
    forwards, backwards = read(paths), read(paths[::-1])
    assert [e.payload for e in forwards.entries()] == [item(n)[1] for n in range(30)]
    assert [(e.time_ns, e.payload) for e in backwards.entries()] == [
        (e.time_ns, e.payload) for e in forwards.entries()
    ]


def test_a_directory_is_the_run_in_it(tmp_path: Path) -> None:
    paths = split_run(tmp_path)
    shutil.copy(paths[0], tmp_path / "run.recovered.mcap")
    (tmp_path / "notes.txt").write_text("x")
    assert files_named([tmp_path]) == paths
    assert further_files(paths[1]) == [paths[0], paths[2]]


def test_a_recovered_file_stands_in_for_one_that_is_gone(tmp_path: Path) -> None:
    (path,) = split_run(tmp_path, parts=1)
    copy = path.rename(tmp_path / "run.recovered.mcap")
    assert files_named([tmp_path]) == [copy]


def test_a_directory_with_two_runs_or_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"holds no \.mcap"):
        files_named([tmp_path])
    write(tmp_path, [item(1)])
    write(tmp_path, [item(2)])
    with pytest.raises(RunError, match=r"2 runs \(run\.mcap, run-1\.mcap\)"):
        files_named([tmp_path])
    with pytest.raises(RunError, match="no FILE"):
        files_named([])


def test_the_same_part_twice_is_refused(tmp_path: Path) -> None:
    paths = split_run(tmp_path)
    copy = shutil.copy(paths[1], tmp_path / "copy.mcap")
    with pytest.raises(RunError, match="the same part"):
        read([*paths, Path(copy)])


def test_runs_of_two_robots_or_two_clocks_are_not_played_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = write(tmp_path / "a", [item(1)])
    monkeypatch.setattr(runs, "OFFSET_NS", runs.OFFSET_NS + 86_400_000_000_000)
    other_day = write(tmp_path / "b", [item(1)])
    monkeypatch.undo()
    monkeypatch.setitem(runs.METADATA, "run", {**runs.METADATA["run"], "robot": "another"})
    other_robot = write(tmp_path / "c", [item(1)])
    with pytest.raises(RunError, match="86400 s apart"):
        read([one, other_day])
    with pytest.raises(RunError, match="one robot at a time"):
        read([one, other_robot])


def test_an_unfinished_file_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    killed = killed_file(tmp_path, batches=3, size=20)
    recording = read([killed.path])
    assert len(recording.entries()) == 60
    assert recording.unfinished == [killed.path]


def test_a_run_without_a_message_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no message"):
        reading.read([write(tmp_path, [])])
