"""`xrl log play` without a bus: what it refuses, and what it makes of its arguments."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.places import DEFAULT_CONFIG
from tests.certified import certified, opened
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import item, write
from tests.tools.exit_codes import exit_code
from tools.flags import add_flags, read_flags
from tools.logs.playback import reading
from tools.verbs.log import play

LENGTH = 40
"""Messages, a millisecond apart."""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write(tmp_path, [item(n) for n in range(LENGTH)])


def test_help_shows_the_keys_and_the_way_to_subscribe(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["log", "play", "--help"]) == 0
    shown = capsys.readouterr().out
    for words in (
        "examples:\n  xrl log play",
        "replay/xrl/<robot>/x",
        play.LISTEN,
        "space",
        "130",
    ):
        assert words in shown


def arguments_of(log: Path, *words: str) -> play.PlayFlags:
    parser = argparse.ArgumentParser()
    add_flags(parser, play.PlayFlags)
    return read_flags(play.PlayFlags, parser.parse_args([str(log), *words]))


def test_the_bus_is_that_of_the_robot_file_given_else_of_the_log_else_as_shipped(
    tmp_path: Path, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = tmp_path / "given.toml"
    given.write_text(DEFAULT_CONFIG.read_text().replace('name = "xrl"', 'name = "given"', 1))
    words = ("--run-dir", str(tmp_path / "r"))
    old = write(tmp_path / "old", [item(0)])  # its robot file is one that cannot be used
    recording = reading.read([old])
    found = play.bus_of(recording, arguments_of(old, *words))
    assert found.robot.name == robot.name
    assert "another version" in found.note
    found = play.bus_of(recording, arguments_of(old, "--config", str(given), *words))
    assert (found.robot.name, found.note) == ("given", "")
    text = config_file.to_toml(robot).replace('name = "xrl"', 'name = "lab"', 1)
    monkeypatch.setitem(runs.ATTACHMENTS, "robot.toml", text.encode())
    new = write(tmp_path / "new", [item(0)])
    found = play.bus_of(reading.read([new]), arguments_of(new, *words))
    assert (found.robot.name, found.note) == ("lab", "")


def test_no_endpoint_of_a_log_is_dialled(
    tmp_path: Path, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoints = {name: f"tcp/10.9.9.9:{port}" for port, name in enumerate(robot.bus.endpoints, 1)}
    strange = opened(robot, endpoints)
    monkeypatch.setitem(runs.ATTACHMENTS, "robot.toml", config_file.to_toml(strange).encode())
    log = write(tmp_path / "log", [item(0)])
    found = play.bus_of(reading.read([log]), arguments_of(log, "--run-dir", str(tmp_path / "r")))
    assert found.note == "", "its robot file was taken, but for the bus"
    assert found.robot.bus == robot.bus


def test_beside_a_certified_fleet_a_log_is_played_on_a_bus_of_its_own(
    tmp_path: Path, robot: RobotConfig
) -> None:
    own, _ = certified(robot, tmp_path)
    file = tmp_path / "robot.toml"
    file.write_text(config_file.to_toml(own), encoding="utf-8")
    log = write(tmp_path / "log", [item(0)])
    words = ("--run-dir", str(tmp_path / "r"), "--config", str(file))
    found = play.bus_of(reading.read([log]), arguments_of(log, *words))
    assert found.robot.bus == robot.bus
    assert "mtls" in found.note
    with pytest.raises(RunError, match="no process may write another's keys"):
        play.bus_of(reading.read([log]), arguments_of(log, *words, "--prefix", ""))


def test_a_part_of_the_log_is_counted_from_its_first_message_of_all_topics(log: Path) -> None:
    recording = reading.read([log])
    args = arguments_of(log, "--start-offset", "0.01", "--duration", "0.005")
    part = play.part_of(recording, args)
    keys = {key: key for key in recording.keys}
    schedule = play.schedule_of(recording, keys, part, loop=False)
    played = []
    while schedule.next_ns() is not None:
        played.append(schedule.pop())
    assert len(played) == 5
    assert played[0].payload == item(10)[1]


def test_old_logs_are_played_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    about = {**runs.METADATA["run"], "schema_version": "0"}
    monkeypatch.setitem(runs.METADATA, "run", about)
    payload = b'{"t_ns":1,"seq":2,"nobody":"knows"}'
    old = write(tmp_path, [(runs.STATE_KEY, payload, 5)])
    assert [entry.payload for entry in reading.read([old]).entries()] == [payload]
