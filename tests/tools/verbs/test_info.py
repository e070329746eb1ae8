"""`xrl log info` on files whose contents are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from shared.bus import codec, topics
from shared.bus.messages import JointState, Wrench
from shared.bus.traces import LinkEvent
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import OFFSET_NS, ROBOT, STATE_KEY, Queue
from tools import cli

WRENCH_KEY = topics.WRENCH.key(ROBOT)
MS = 1_000_000


def state(seq: int, t_ms: int) -> tuple[str, bytes, int]:
    payload = codec.encode(runs.sample(JointState, seq=seq, t_ns=t_ms * MS))
    return STATE_KEY, payload, t_ms * MS + 20 * MS


def wrench(seq: int, t_ms: int) -> tuple[str, bytes, int]:
    payload = codec.encode(runs.sample(Wrench, seq=seq, t_ns=t_ms * MS))
    return WRENCH_KEY, payload, t_ms * MS


def as_json(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert cli.main(["log", "info", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def as_text(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert cli.main(["log", "info", *map(str, words)]) == 0
    return capsys.readouterr().out


def test_counts_rates_gaps_losses_and_restarts_are_those_of_the_messages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """250 Hz with three lost at 100 ms, and a sender that is away from 200 to 500 ms."""
    before = [state(seq, 4 * seq) for seq in range(51) if seq not in (25, 26, 27)]
    after = [state(seq, 500 + 4 * seq) for seq in range(51)]
    found = as_json(capsys, runs.write(tmp_path, [*before, *after]))
    topic, file = found["topics"][STATE_KEY], found["files"][0]
    counted = topic["sequence"]
    assert [counted[n] for n in ("count", "missing", "gaps", "restarts")] == [99, 3, 1, 1]
    assert topic["longest_gap_ns"] == pytest.approx(300 * MS)
    assert topic["nominal_hz"] == topics.JOINT_STATE.rate_hz
    assert topic["schema"] == "xrl.JointState"
    assert (file["first_ns"], file["last_ns"]) == (OFFSET_NS + 20 * MS, OFFSET_NS + 720 * MS)
    assert (file["metadata"]["run"]["robot"], file["messages"]) == (ROBOT, 99)
    assert file["finished"]


def test_an_unfinished_file_is_counted_and_names_how_to_recover(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = runs.killed_file(tmp_path)
    output = as_text(capsys, killed.path)
    assert "not finished" in output
    assert f"xrl log recover {killed.path}" in output
    found = as_json(capsys, killed.path)
    assert found["files"][0]["messages"] == 1200
    assert not found["files"][0]["finished"]


def test_a_file_that_is_being_written_is_called_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with runs.writer(tmp_path) as run:
        run.take_from(Queue([state(0, 0)]), 1)
        run.flush()
        output = as_text(capsys, run.path)
    assert "being written" in output
    assert "injected" not in output
    assert "xrl log recover" not in output


def test_a_cut_is_described_with_its_extent_and_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = runs.killed_file(tmp_path)
    data = killed.path.read_bytes()
    size = data.index(b"zstd", killed.flushed[-2][0]) + 100
    killed.path.write_bytes(data[:size])
    lost = size - killed.flushed[-2][0]
    assert f"lost: the last {lost} bytes, cut off: 0." in as_text(capsys, killed.path)
    cut = as_json(capsys, killed.path)["files"][0]["cut"]
    # of the last hundred messages, 1 ms apart
    assert OFFSET_NS + 1100 * MS <= cut["first_ns"] < cut["last_ns"] <= OFFSET_NS + 1200 * MS


@pytest.fixture
def split_run(tmp_path: Path) -> list[Path]:
    rows = [state(seq, seq) for seq in range(12 * 11) if seq % 11 < 10]  # one lost between files
    paths = runs.write_in_parts(runs.writer(tmp_path), rows, 12)
    runs.write(tmp_path, [state(0, 0)])  # another run in the same directory
    return paths


def test_the_other_files_of_the_run_are_named_in_order(
    split_run: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    found = as_json(capsys, split_run[1])
    assert found["run_files"] == [str(path) for path in split_run]
    assert found["files"][0]["messages"] == 10
    assert "run_2.mcap, run_3.mcap" in as_text(capsys, split_run[1])


def test_a_directory_stands_for_the_first_file_of_its_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = runs.write(tmp_path, [state(0, 0), state(1, 1)])
    assert as_json(capsys, tmp_path) == as_json(capsys, path)


def test_a_run_is_counted_over_all_its_files(
    split_run: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    found = as_json(capsys, split_run[3], "--run")
    counted = found["topics"][STATE_KEY]["sequence"]
    assert [file["path"] for file in found["files"]] == [str(path) for path in split_run]
    assert (counted["count"], counted["missing"], counted["gaps"]) == (120, 11, 11)


def test_a_slow_topic_stands_beside_its_rate_and_an_event_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    event = topics.RUN_EVENT
    items = [wrench(seq, 10 * seq) for seq in range(11)]
    for seq in range(3):
        payload = codec.encode(runs.sample(event.type, seq=seq, t_ns=seq * MS))
        items.append((event.key(ROBOT), payload, seq * MS))
    output = as_text(capsys, runs.write(tmp_path, items))
    (row,) = [line.split() for line in output.splitlines() if "harness/wrench" in line]
    assert row == ["harness/wrench", "11", "100.0", "250", "10.0", "0", "0"]
    (row,) = [line.split() for line in output.splitlines() if "run/event" in line]
    assert row == ["run/event", "3"], "several may send it: its losses are unknown"


def test_an_injection_is_reported_with_its_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    items = [state(seq, 4 * seq) for seq in range(50)]
    for seq, (t_ms, begins) in enumerate(((100, True), (150, False))):
        event = runs.sample(
            LinkEvent, t_ns=t_ms * MS, seq=seq, link="planner->knee_left", number=1,
            requested="planner->left", detail="delay=5ms", active=begins, passed=20, lost=7,
        )  # fmt: skip
        items.append((topics.LINK_EVENT.key(ROBOT), codec.encode(event), t_ms * MS))
    output = " ".join(as_text(capsys, runs.write(tmp_path, items)).split())
    assert "injected planner->left delay=5ms: 0." in output
    assert "20 messages passed, 7 lost (s since the start of the log)" in output


def test_a_file_without_a_message_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = as_json(capsys, runs.write(tmp_path, []))
    assert [file["messages"] for file in found["files"]] == [0]
    assert not any(topic["sequence"]["count"] for topic in found["topics"].values())


def test_a_large_finished_file_is_told_from_its_index_like_the_messages_tell_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    items = [item for seq in range(3000) for item in (state(seq, 4 * seq), wrench(seq, 4 * seq))]
    del items[2000:2060]
    path = runs.write(tmp_path, items)
    read = as_json(capsys, path)
    monkeypatch.setattr("tools.verbs.log.info.LARGE", 1)
    found = as_json(capsys, path)
    full = as_json(capsys, path, "--full")
    assert full == read
    for key in (STATE_KEY, WRENCH_KEY):
        topic, told = found["topics"][key], read["topics"][key]
        for name in ("sequence", "schema", "nominal_hz"):
            assert topic[name] == told[name]
        assert topic["first_ns"] == pytest.approx(told["first_ns"], abs=1e9)
        assert (topic["bytes"], topic["longest_gap_ns"]) == (None, None)
    for name in ("first_ns", "last_ns", "messages"):
        assert found["files"][0][name] == read["files"][0][name]
    assert "--full reads every message" in as_text(capsys, path)


def test_a_large_file_that_was_cut_off_is_read_through(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = runs.write(tmp_path, [state(seq, 4 * seq) for seq in range(3000)])
    path.write_bytes(path.read_bytes()[:-200])
    monkeypatch.setattr("tools.verbs.log.info.LARGE", 1)
    found = as_json(capsys, path)
    assert not found["files"][0]["finished"]
    assert found["topics"][STATE_KEY]["bytes"] > 0
