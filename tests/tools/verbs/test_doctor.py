"""`xrl doctor` on the emulated robot, from the command line to the last line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.cansimple_06 import Command06
from shared.places import CHECKOUT
from shared.run_directory import live_dir
from tests.system.fleets import command
from tools import cli
from tools.bringup.findings import ok, wrong
from tools.fleet import procfs
from tools.verbs import doctor as verb

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

MODULE = "knee_left"
AXIS = f"{MODULE}.axis0"
DIRECTION = "encoder.config.direction"
MEASURED = ("heartbeat", "encoder frames", "load cells", "processors")
"""What depends on how busy the machine is: a full one may find any of it wrong."""
START_S = 60.0


@pytest.fixture
def run_dir(run_dir: Path) -> Iterator[Path]:
    yield run_dir
    assert procfs.fleet_pids(run_dir) == set(), "no process is left"
    assert not run_dir.exists(), "and no file"


def rows_of(result: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    """Return a report's rows; its exit code must follow from them."""
    report = json.loads(result.stdout)
    rows = [row for group in report["groups"].values() for row in group]
    assert report["wrong"] == sum(row["verdict"] == "wrong" for row in rows)
    assert result.returncode == (3 if report["wrong"] else 0), result.stderr
    return rows


def bad_rows_of(result: subprocess.CompletedProcess[str], *verdicts: str) -> list[dict[str, Any]]:
    """Return the rows with one of some verdicts, of what does not depend on the machine."""
    rows = [row for row in rows_of(result) if row["what"] not in MEASURED]
    return [row for row in rows if row["verdict"] in verdicts]


RECORDED = """
import contextlib, json, sys
from shared.can import unix_can
from tools import cli
from tools.bringup import drive_access

said = {"can": [], "usb": [], "reads": 0}
send_packet = unix_can.UnixCanBus.send_packet

def record_packet(bus, packet):
    frames = unix_can.unpack_frames(packet)
    remote = unix_can.REMOTE_FLAG
    said["can"] += [[can_id & ~remote, bool(can_id & remote)] for can_id, _ in frames]
    return send_packet(bus, packet)

unix_can.UnixCanBus.send_packet = record_packet
emulated_usb = drive_access.emulated_usb

@contextlib.contextmanager
def recorded_usb(run_dir):
    with emulated_usb(run_dir):
        from odrive.libodrive import Device
        read = Device.read_endpoints

        async def reads(*args, **names):
            said["reads"] += 1
            return await read(*args, **names)

        def recorded(name):
            before = getattr(Device, name)
            def call(*args, **names):
                said["usb"].append(name)
                return before(*args, **names)
            return call

        Device.read_endpoints = reads
        for name in ("write_endpoints", "call_function"):
            setattr(Device, name, recorded(name))
        yield

drive_access.emulated_usb = recorded_usb
code = cli.main(["doctor", "--json", "--run-dir", sys.argv[1]])
print(json.dumps(said), file=sys.stderr)
sys.exit(code)
"""
"""The verb, with everything that it tells a drive written down."""


def test_nothing_is_wrong_with_the_robot_as_shipped_and_it_is_asked_questions_only(
    run_dir: Path,
) -> None:
    """No endpoint is written, and no function called."""
    result = subprocess.run(
        [sys.executable, "-c", RECORDED, str(run_dir)],
        capture_output=True, text=True, cwd=CHECKOUT, check=False,
    )  # fmt: skip
    assert bad_rows_of(result, "warning", "wrong") == []
    whats = Counter(row["what"] for row in rows_of(result))
    counts = {"settings": 6, "calibrated": 12, "zero": 6, "heartbeat": 12}
    assert {what: whats[what] for what in counts} == counts
    assert {"load cells", "gain schedule", "endpoints", "real-time priority"} <= set(whats)
    summary = json.loads(result.stderr.splitlines()[-1])
    assert summary["usb"] == [], "no endpoint is written, no function called"
    assert summary["reads"] > 6, "it did read, through what is recorded here"
    assert len(summary["can"]) == 36, "three questions to each axis"
    for arbitration_id, is_remote in summary["can"]:
        _, command = cansimple.split_id(arbitration_id)
        assert is_remote
        assert command in (Command06.GET_VERSION, Command.GET_VBUS, Command.GET_ENCODER_COUNT)


def test_the_terminal_ends_in_what_is_wrong(
    run_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [ok("robot file", "read", "lab"), wrong(AXIS, DIRECTION, "-1", "1", "swap two")]
    monkeypatch.setattr(verb, "survey", lambda *_: {"drives": rows})
    assert cli.main(["doctor", "--run-dir", str(run_dir)]) == 3
    assert capsys.readouterr().out.endswith(f"1 wrong: {AXIS} direction\n")


def test_ctrl_c_stops_the_simulator_that_was_started(run_dir: Path) -> None:
    process = subprocess.Popen(
        command("doctor", "--run-dir", run_dir),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    deadline = time.monotonic() + START_S
    while not (live_dir(run_dir) / "can_knee_left.sock").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors.decode()
    assert b"Traceback" not in errors
