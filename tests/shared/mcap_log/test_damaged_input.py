"""Cut, flipped, foreign, old, empty: one clear line or a good recovery, by every reader."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from shared.bus import topics
from shared.exceptions import RunError
from shared.mcap_log import recover
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ATTACHMENTS, STATE_KEY, Killed
from tools import cli
from tools.logs.run_log import read_run
from tools.logs.survey import Survey

CUTS = 250
SENT = [runs.state(seq) for seq in range(120)]


pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    """A small log as a kill leaves it: 12 chunks of ten messages."""
    directory = tmp_path_factory.mktemp("small")
    return runs.killed_file(directory, batches=12, size=10, keys=runs.few_topics())


@pytest.fixture(scope="module")
def finished(killed: Killed) -> bytes:
    return (killed.path.parent / "written" / "run.mcap").read_bytes()


def in_one_line(error: RunError) -> None:
    assert "\n" not in str(error)


def counted(path: Path) -> int | None:
    """Return the messages that `xrl log info` counts, or None for one clear line."""
    survey = Survey()
    try:
        survey.add(path)
    except RunError as error:
        return in_one_line(error)
    return survey.messages


def recovered(path: Path) -> int | None:
    """Return the messages that recovery gives back to the mcap package, or None for a line."""
    try:
        outcome = recover.recover(path, path.with_name("recovered.mcap"))
    except RunError as error:
        return in_one_line(error)
    assert all("\n" not in line for line in recover.describe(outcome))
    with outcome.out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [message for _, _, message in reader.iter_messages()]
        list(reader.iter_attachments())
        list(reader.iter_metadata())
    assert len(found) == outcome.messages
    return len(found)


def read(path: Path) -> int | None:
    """Return the messages that the reader of runs finds, or None for one clear line."""
    try:
        found = read_run(path).messages(topics.JOINT_STATE, "knee_right")
    except RunError as error:
        return in_one_line(error)
    assert found == [SENT[message.seq] for message in found], "a message that was never sent"
    return len(found)


def test_cut_at_hundreds_of_bytes_what_was_flushed_is_read_by_all_three(
    tmp_path: Path, killed: Killed
) -> None:
    data, began = killed.path.read_bytes(), killed.flushed[0][0]
    dice = random.Random(5)
    path = tmp_path / "cut.mcap"
    sizes = {dice.randrange(len(data) + 1) for _ in range(CUTS)}
    for size in sorted({*range(50), *range(began - 30, began), *sizes, *dict(killed.flushed)}):
        path.write_bytes(data[:size])
        counts = {counted(path), recovered(path)}
        if size < began:
            assert read(path) in (None, 0)
        else:
            log = read_run(path)
            found = log.messages(topics.JOINT_STATE, "knee_right")
            assert found == SENT[: len(found)]
            assert len(found) >= killed.at_least(size)
            assert (log.complete, log.damage, log.attachments) == (False, [], ATTACHMENTS)
            counts.add(len(found))
        assert len(counts) == 1, f"cut at {size}: {counts}"


def test_a_cut_in_the_end_of_a_finished_file_loses_no_message(
    tmp_path: Path, finished: bytes
) -> None:
    path = tmp_path / "cut.mcap"
    end = finished.rindex(b"zstd")  # of the last chunk's index
    for size in range(end, len(finished), 7):
        path.write_bytes(finished[:size])
        assert (counted(path), recovered(path), read(path)) == (120, 120, 120)


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_whatever_bytes_are_flipped_nothing_breaks_and_nothing_false_is_read(
    tmp_path: Path, finished: bytes, data: st.DataObject
) -> None:
    content = bytearray(finished)
    places = st.tuples(st.integers(0, len(content) - 1), st.integers(1, 255))
    for place, flip in data.draw(st.lists(places, min_size=1, max_size=8)):
        content[place] ^= flip
    keep = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path = tmp_path / "flipped.mcap"
    path.write_bytes(content[:keep])
    counts = counted(path), recovered(path)
    assert counts[0] is None or counts[0] <= 120
    assert counts[0] == counts[1]
    with contextlib.suppress(RunError):  # a flipped name of a field, caught by the decoder
        read(path)


def old_version(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("xrl")
        writer.add_metadata("run", {"robot": runs.ROBOT, "schema_version": "0"})
        writer.add_metadata("clock", {"offset_ns": "0"})
        channel = writer.register_channel(STATE_KEY, "json", 0)
        writer.add_message(channel, 1, b'{"t_ns":1,"seq":1,"angle":3.0}', 1, 1)
        writer.finish()


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = writer.register_channel("/odom\x1b[31m[bold]", "cdr", 0)
        writer.add_message(channel, 10**18, b"\0\1", 10**18, 1)
        writer.add_message(channel, 2**64 - 1, b"\0\1", 0, 2)
        writer.finish()


def test_other_writers_sequence_numbers_show_neither_losses_nor_restarts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = writer.register_channel("/odom", "cdr", 0)
        for number, sequence in enumerate((0, 0, 5)):
            writer.add_message(channel, number, b"\0\1", number, sequence)
        writer.finish()
    assert cli.main(["log", "info", str(path), "--json"]) == 0
    counts = msgspec.json.decode(capsys.readouterr().out)["topics"]["/odom"]["sequence"]
    assert (counts["count"], counts["missing"], counts["restarts"]) == (3, 0, 0)


@pytest.mark.parametrize("make", [old_version, foreign])
def test_another_version_and_a_foreign_file_are_shown_recovered_and_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mcap"
    make(path)
    assert cli.main(["log", "info", str(path)]) == 0
    output = capsys.readouterr().out
    assert ("0; this code writes" in output) == (make is old_version)
    assert ("foreign" in output) == (make is foreign)
    assert "\x1b" not in output
    assert cli.main(["log", "recover", str(path), "-o", str(tmp_path / "y.mcap")]) == 0
    with pytest.raises(RunError) as caught:
        read_run(path).messages(topics.JOINT_STATE, "knee_right")
    assert "\n" not in str(caught.value)
    assert ("schema version 0" in str(caught.value)) == (make is old_version)
