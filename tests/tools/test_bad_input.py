"""Bad input gets one line that says what is wrong, exit code 2, and leaves nothing half-written."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from shared.exceptions import RunError
from shared.mcap_log.writer import SCHEMA_VERSION
from tests.tools.exit_codes import exit_code
from tests.tools.logs.reexecution.test_golden import GOLDEN
from tools import cli
from tools.logs.run_log import RunLog, read_run
from tools.output import write_atomically

RUN = str(GOLDEN)
LONG = "x" * 5000
READERS = ("info", "report", "explain", "resim", "play", "recover")

CASES: list[list[str]] = [
    ["sim", "--push", "1:0.3:nan,0,0"],
    ["sim", "--push", "1:nan:1,1,1"],
    ["sim", "--kill", "planner@nan"],
    ["sim", "--plant", "drivetrain.stiffness=nan"],
    ["sim", "--inject", "all delay=nan"],
    ["sim", "--inject", "[/red] delay=3"],
    ["sim", "--scenario", "[/red]"],
    *(["log", verb, bad] for bad in (LONG, "/dev/zero") for verb in READERS),
    ["log", "export", LONG],
    *(["sim", flag, LONG] for flag in ("--config", "--scenario", "--plant", "--out")),
    *(["sim", flag, "/dev/zero"] for flag in ("--config", "--scenario")),
    ["log", "report", RUN, "-o", LONG, "--open", "no"],
    ["log", "export", RUN, "--gif", LONG],
    ["gains", "--check", "--config", "/dev/zero"],
    ["status", "--run-dir", LONG],
    ["down", "--run-dir", LONG],
]  # fmt: skip


def told(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the last line of what a refused command line is told."""
    code, err = exit_code(words), capsys.readouterr().err
    assert code == 2, err
    return err.strip().splitlines()[-1]


@pytest.mark.parametrize("words", CASES, ids=lambda words: " ".join(words)[:60])
def test_a_bad_command_line_is_refused_in_words(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    line = told(words, capsys)
    assert line.startswith("xrl")
    assert len(line) > 20
    assert list(tmp_path.iterdir()) == []


def test_a_pipe_is_not_waited_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe")
    for verb in READERS:
        assert "not a regular file" in told(["log", verb, str(tmp_path / "pipe")], capsys)
    with pytest.raises(RunError, match="not a regular file"):
        write_atomically(tmp_path / "pipe", b"x")
    assert (tmp_path / "pipe").is_fifo(), "nor replaced by an output"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = " + b"[" * 9000, "nested too deeply"),
        (b"\xff\xfe", "cannot be read"),
        (b"a" * (1 << 25), "larger than 16 MiB"),
    ],
)
def test_a_robot_file_that_is_none_is_refused(
    content: bytes, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "robot.toml"
    path.write_bytes(content)
    assert words in told(["gains", "--check", "--config", str(path)], capsys)


# -- logs that somebody made up ------------------------------------------------------------


@cache
def newest() -> RunLog:
    return read_run(GOLDEN)


def made_up(
    path: Path,
    metadata: Mapping[str, dict[str, str]] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    change: Callable[[str, int, bytes], tuple[int, bytes]] = lambda _, t_ns, data: (t_ns, data),
    foreign: Sequence[str] = (),
    most: int | None = None,
) -> str:
    """Write a copy of a run with something wrong in it; at most so many messages of each key."""
    log = newest()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="xrl")
        more = {name: {} for name in metadata or {}}
        for name, entries in (more | log.metadata).items():
            writer.add_metadata(name, entries | (metadata or {}).get(name, {}))
        for name, content in (log.attachments | (attachments or {})).items():
            writer.add_attachment(0, 0, name, "", content)
        schema = writer.register_schema("x", "jsonschema", b"{}")
        for key in foreign:
            number = writer.register_channel(key, "json", schema, {"rate_hz": key})
            writer.add_message(number, log.offset_ns, b"{}", log.offset_ns)
        for key in log.keys():  # noqa: SIM118 - a log is no mapping
            channel = writer.register_channel(key, "json", schema)
            for received_ns, payload, seq in log.raw(key)[:most]:
                t_ns, data = change(key, received_ns + log.offset_ns, payload)
                writer.add_message(channel, t_ns, data, t_ns, seq)
        writer.finish()
    return str(path)


ROBOT_FILES = (b"\xff\xfe", b"a = " + b"[" * 9000, b"a = 1")
SCHEDULES = (b"{}", b"\xff", b"[")


@pytest.mark.parametrize(
    ("broken", "verbs", "words"),
    [
        *(({"metadata": {"clock": {"offset_ns": "9" * digits}}}, "report explain", "offset_ns")
          for digits in (19, 20, 5000)),
        *(({"attachments": {"robot.toml": text}}, "explain resim", "robot.toml")
          for text in ROBOT_FILES),
        *(({"attachments": {"robot.gains.json": text}}, "resim", "not a gain schedule")
          for text in SCHEDULES),
    ],
)  # fmt: skip
def test_a_log_whose_clock_robot_or_gains_cannot_be_is_refused(
    broken: dict[str, Any], verbs: str, words: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = made_up(tmp_path / "a.mcap", **broken, most=20)
    for verb in verbs.split():
        assert words in told(["log", verb, path], capsys)


def test_times_beyond_64_bits_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made_up(tmp_path / "a.mcap", change=lambda _, t, data: (min(2**63 + t, 2**64 - 1), data))
    assert "contradict clock.offset_ns" in told(["log", "report", path], capsys)


def test_the_memory_of_another_version_is_refused_with_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def foreign(_key: str, t_ns: int, data: bytes) -> tuple[int, bytes]:
        return t_ns, re.sub(rb'"snapshot":"(?:[^"\\]|\\.)+"', b'"snapshot":"{\\\\"a\\\\":1}"', data)

    path = made_up(tmp_path / "a.mcap", change=foreign)
    assert "use the checkout that wrote the log" in told(["log", "resim", path], capsys)


def test_a_small_file_that_expands_to_gigabytes_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=30 << 20, compression=CompressionType.ZSTD)
        writer.start(profile="xrl")
        writer.add_metadata("run", {"robot": "xrl", "schema_version": SCHEMA_VERSION})
        writer.add_metadata("clock", {"offset_ns": "0"})
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("xrl/xrl/planner/status", "json", schema)
        for number in range(12):
            writer.add_message(channel, number, b" " * (30 << 20), number, number)
        writer.finish()
    assert path.stat().st_size < 100_000
    for verb in ("report", "play"):
        assert "expands to over" in told(["log", verb, str(path)], capsys)


def test_300_000_false_marks_of_chunks_are_passed_in_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each claims 50 MB; the reader searched all of them for every mark."""
    mark = b"\x06" + struct.pack("<Q", 50 << 20) + b"\0" * 28 + b"\x04\0\0\0zstd"
    path = tmp_path / "marks.mcap"
    path.write_bytes(GOLDEN.read_bytes()[:20_000] + mark * 300_000)
    assert cli.main(["log", "info", str(path)]) == 0
    assert "not finished" in capsys.readouterr().out


@settings(
    max_examples=int(os.environ.get("XRL_FUZZ_CASES", "25")),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=30),
    kept=st.floats(0.0, 1.0),
)
def test_no_damage_ends_a_reader_without_words(
    places: list[tuple[float, int]], kept: float, tmp_path: Path
) -> None:
    data = bytearray(GOLDEN.read_bytes())
    for place, byte in places:
        data[int(place * (len(data) - 1))] = byte
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data[: max(1, int(kept * len(data)))])
    for verb, *words in (
        ["info"],
        ["report", "--open", "no"],
        ["explain"],
        ["resim", "--service", "knee_left"],
    ):
        expected = (0, 1, 2) if verb == "resim" else (0, 2)  # 1: another output than recorded
        assert cli.main(["log", verb, str(path), *words]) in expected
