"""Files of a writer that failed, was interrupted or finished twice: each is read to its end.

The mcap package's own writer makes them. It counts and indexes a message before it writes it, and
goes on behind what it wrote of a record; the CRC of a chunk covers that as well.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from shared.mcap_log import recover
from shared.mcap_log.reader import open_log
from tools import cli
from tools.logs.survey import Survey

COUNT = 8
FAILED = 3
BAD_MESSAGES: dict[str, dict[str, Any]] = {
    "sequence": {"data": b"{}", "publish_time": 1, "sequence": -1},
    "time": {"data": b"{}", "publish_time": None},
    "data": {"data": "{}", "publish_time": 1},
}
WHOLE = "finished, whole and indexed; nothing to recover"

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


@contextlib.contextmanager
def writing(path: Path, **how: Any) -> Iterator[tuple[Writer, Callable[[int], None]]]:
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start()
        channel = writer.register_channel("a/b", "json", 0)

        def add(seq: int) -> None:
            writer.add_message(channel, seq, b'{"t":%d}' % seq, seq, seq)

        yield writer, add
        writer.finish()  # type: ignore[no-untyped-call]


def with_a_failed_message(path: Path, bad: dict[str, Any], **how: Any) -> Path:
    with writing(path, **how) as (writer, add):
        for seq in range(COUNT):
            if seq == FAILED:
                with contextlib.suppress(Exception):
                    writer.add_message(1, seq, **bad)
            else:
                add(seq)
    return path


def by_the_package(path: Path) -> list[int]:
    with path.open("rb") as file:
        list(StreamReader(file, validate_crcs=True).records)
    with path.open("rb") as file:
        return [m.sequence for _, _, m in make_reader(file, validate_crcs=True).iter_messages()]


def by_us(path: Path) -> list[int]:
    with open_log(path) as reader:
        return [row.seq for record in reader for row in record.rows]


def output(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert cli.main(["log", *map(str, words)]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("bad", BAD_MESSAGES)
def test_only_the_incomplete_message_of_a_chunk_with_a_right_crc_is_lost_and_reported(
    tmp_path: Path, bad: str, compression: CompressionType, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_a_failed_message(tmp_path / "x.mcap", BAD_MESSAGES[bad], compression=compression)
    kept = [seq for seq in range(COUNT) if seq != FAILED]
    assert by_us(path) == kept
    for verb in ("info", "recover"):
        found = output(capsys, verb, path)
        assert "lost: part of the chunk at byte 42" in found
        assert "by its index, 1 message" in found
        assert "lost: 1 of the 8 messages that its summary counts" in found
        assert WHOLE not in found
    assert by_the_package(tmp_path / "x.recovered.mcap") == kept
    assert WHOLE in output(capsys, "recover", tmp_path / "x.recovered.mcap")


def test_wherever_ctrl_c_comes_a_file_is_called_whole_only_if_it_has_all_it_counts(
    tmp_path: Path,
) -> None:
    """Interrupt a message, an attachment and finishing at every third line of the package."""
    verdicts = set()
    for interrupted_line in itertools.count(step=3):
        path = tmp_path / "x.mcap"
        with (
            contextlib.suppress(ValueError),  # its buffer is closed
            writing(path) as (writer, add),
        ):
            for seq in range(FAILED):
                add(seq)
            reached = interrupt_at(interrupted_line, functools.partial(use, writer, add))
            for seq in range(FAILED + 1, COUNT):
                add(seq)
        found, whole = by_us(path), recover.is_whole(path)
        survey = Survey()
        facts = survey.add(path)
        assert facts.messages + facts.orphans == len(found)
        if whole:
            assert {*range(COUNT)} - {*found} <= {FAILED}
            assert by_the_package(path) == found
            assert facts.counted == len(found)
        else:
            outcome = recover.recover(path, tmp_path / "copy.mcap")
            assert by_the_package(outcome.out) == found
            assert recover.is_whole(outcome.out)
        verdicts.add(whole)
        if not reached:
            break
    assert verdicts == {True, False}


def use(writer: Writer, add: Callable[[int], None]) -> None:
    add(FAILED)
    writer.add_attachment(0, 0, "robot.toml", "text/plain", b"")
    writer.finish()  # type: ignore[no-untyped-call]


def interrupt_at(number: int, call: Callable[[], None]) -> bool:
    """Call; at a line of the mcap package, counted from 0, press Ctrl-C. False: it has fewer."""
    lines = itertools.count()

    def trace(frame: FrameType, event: str, _argument: object) -> Any:
        if "mcap" not in Path(frame.f_code.co_filename).parts:
            return None
        if event == "line" and next(lines) == number:
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


@pytest.mark.parametrize("cut", [0, 60])
@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_that_was_finished_twice_is_read_to_its_end(
    tmp_path: Path, cut: int, *, chunked: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mcap"
    with writing(path, use_chunking=chunked) as (writer, add):
        for seq in range(COUNT):
            add(seq)
            if seq == FAILED:
                writer.finish()  # type: ignore[no-untyped-call]
    path.write_bytes(path.read_bytes()[: path.stat().st_size - cut])
    assert by_us(path) == list(range(COUNT))
    for verb in ("info", "recover"):
        found = output(capsys, verb, path)
        assert "1 end in the middle of the file, where some readers stop" in found
        assert WHOLE not in found
    assert by_the_package(tmp_path / "x.recovered.mcap") == list(range(COUNT))
