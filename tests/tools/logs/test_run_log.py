from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from shared.bus import codec, topics
from shared.bus.messages import Wrench
from shared.exceptions import RunError
from shared.mcap_log.reader import ChunkPlace, LogReader
from shared.mcap_log.records import PREFIX
from shared.mcap_log.writer import SCHEMA_VERSION
from tests.conftest import ROBOT_FILE
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ATTACHMENTS, OFFSET_NS, ROBOT, STATE_KEY, Killed, Queue, item
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, parts_of, read_run, robot_of

WRENCH_KEY = topics.WRENCH.key(ROBOT)


def test_a_finished_file_gives_back_every_message_in_order(tmp_path: Path) -> None:
    log = read_run(runs.write(tmp_path, [item(seq) for seq in range(1000)]))
    assert log.messages(topics.JOINT_STATE, "knee_right") == [runs.state(s) for s in range(1000)]
    assert log.received_ns(topics.JOINT_STATE, "knee_right")[3] == 3_000_500
    assert log.count(STATE_KEY) == 1000
    assert log.keys() == [STATE_KEY]
    assert (log.complete, log.damage, log.offset_ns, log.robot) == (True, [], OFFSET_NS, ROBOT)


def test_a_key_without_messages_is_empty_and_no_error(tmp_path: Path) -> None:
    log = read_run(runs.write(tmp_path, [item(0)]))
    assert log.messages(topics.WRENCH) == []
    assert log.received_ns(topics.WRENCH) == []
    assert log.count("xrl/lab/nobody") == 0


def test_metadata_and_attachments_are_read(tmp_path: Path) -> None:
    log = read_run(runs.write(tmp_path, [item(0)]))
    assert log.attachments == ATTACHMENTS
    assert log.metadata["run"]["robot"] == ROBOT
    assert set(log.metadata) == {"run", "packages", "clock", "split", "counts"}


def test_gaps_are_those_the_recorder_counted(tmp_path: Path) -> None:
    wrenches = [(WRENCH_KEY, codec.encode(runs.sample(Wrench, seq=seq)), 1) for seq in (5, 6, 9, 0)]
    with runs.writer(tmp_path) as run:
        run.take_from(Queue([*(item(seq) for seq in (0, 1, 3)), *wrenches]), 100)
    gaps = read_run(run.path).gaps()
    assert gaps == {key: count for key, count in run.counts.items() if count.count}
    assert (gaps[WRENCH_KEY].missing, gaps[WRENCH_KEY].restarts) == (2, 1)


def test_zeros_after_a_power_cut_are_the_end(tmp_path: Path) -> None:
    path, flushed = runs.killed_file(tmp_path)
    with path.open("ab") as file:
        file.write(bytes(10_000))
    assert read_run(path).count(STATE_KEY) == flushed[-1][1]


@pytest.mark.parametrize("batch", [0, 3])
def test_a_damaged_chunk_is_counted_and_the_others_are_read(tmp_path: Path, batch: int) -> None:
    """Also the first, which alone holds schemas and channels in a file of the mcap package."""
    path, flushed = runs.killed_file(tmp_path)
    data = bytearray(path.read_bytes())
    position = data.index(b"zstd", flushed[batch][0]) + 200  # in the batch's first chunk
    data[position : position + 50] = bytes(50)
    path.write_bytes(data)
    log = read_run(path)
    assert len(log.damage) == 1
    assert 0 < log.count(STATE_KEY) < flushed[-1][1]
    assert log.messages(topics.JOINT_STATE, "knee_right")[-1] == runs.state(1199)


def test_a_wrong_length_costs_its_own_chunk_only(tmp_path: Path) -> None:
    path, flushed = runs.killed_file(tmp_path)
    data = bytearray(path.read_bytes())
    data[flushed[3][0] + 1 : flushed[3][0] + 9] = (2**62).to_bytes(8, "little")
    path.write_bytes(data)
    log = read_run(path)
    assert (len(log.damage), log.cut) == (1, None)
    assert [m.seq for m in log.messages(topics.JOINT_STATE, "knee_right")[:300]] == list(range(300))
    assert log.messages(topics.JOINT_STATE, "knee_right")[-1] == runs.state(1199)
    assert log.count(STATE_KEY) > 1000


def test_messages_of_another_version_are_refused_with_the_key(tmp_path: Path) -> None:
    old = (STATE_KEY, b'{"t_ns":1,"seq":1,"angle":3.0}', 1)
    log = read_run(runs.write(tmp_path, [old]))
    assert log.count(STATE_KEY) == 1
    with pytest.raises(RunError, match=f"{STATE_KEY}.*JointState.*schema version {SCHEMA_VERSION}"):
        log.messages(topics.JOINT_STATE, "knee_right")


def test_a_module_is_asked_for_exactly_where_there_is_one(tmp_path: Path) -> None:
    log = read_run(runs.write(tmp_path, [item(0)]))
    with pytest.raises(RunError, match="name a module"):
        log.messages(topics.JOINT_STATE)
    with pytest.raises(RunError, match="remove the module"):
        log.messages(topics.WRENCH, "knee_right")


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    return runs.killed_file(tmp_path_factory.mktemp("killed"))


def heads_of_chunks(data: bytes) -> list[int]:
    """Return where the two times of each chunk with messages are."""
    reader = LogReader(data)
    return [found.start + PREFIX.size for found in reader.skim() if isinstance(found, ChunkPlace)]


@pytest.mark.parametrize("which", [0, 1, -1])
@pytest.mark.parametrize("bit", [34, 60])
@pytest.mark.parametrize("time", ["first", "last"])
def test_a_flipped_bit_in_the_times_of_a_chunk_loses_none_of_its_messages(
    killed: Killed, tmp_path: Path, which: int, bit: int, time: str
) -> None:
    """No CRC covers them: 34 is the first bit of more than 10 s."""
    data = bytearray(killed.path.read_bytes())
    at = heads_of_chunks(bytes(data))[which] + (8 if time == "last" else 0) + bit // 8
    data[at] ^= 1 << bit % 8
    flipped = tmp_path / "flipped.mcap"
    flipped.write_bytes(data)
    index = RunIndex(flipped)
    found = []
    for part in parts_of(index, part_s=index.length_s / 5, margin_s=0.0):
        found += part.messages(topics.JOINT_STATE, "knee_right")
    assert found == [runs.state(seq) for seq in range(killed.flushed[-1][1])]


def test_the_robot_of_a_log_has_the_thresholds_of_the_person_who_wore_it() -> None:
    files = {
        "robot.toml": ROBOT_FILE.read_bytes(),
        "robot.wearer.toml": b"open_n = 31.0\nopen_back_nm = 7.5\nstill_s = 0.6\n",
    }
    log = cast(RunLog, SimpleNamespace(path="a.mcap", attachments=files))
    park = robot_of(log).park
    assert (park.open_n, park.open_back_nm, park.still_s) == (31.0, 7.5, 0.6)
