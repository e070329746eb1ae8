"""`xrl log play` on a real bus, as a person types it, with real subscribers."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.tools.logs.playback.bench import (
    NAME,
    ROOT,
    STATE,
    WRENCH,
    LiveJoint,
    command_items,
    ended,
    items,
    listening,
    play,
    playing,
    write,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


def test_a_subscriber_gets_every_message_in_the_recorded_order_byte_for_byte(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(3.0)
    log = write(tmp_path / "log", rows, monkeypatch, parts=3)
    with (
        listening(run_dir) as ear,
        playing(run_dir, str(log), "--rate", "5", "--wait", "60") as process,
    ):
        assert ear.all(process) == [(f"replay/{key}", payload) for key, payload, _ in rows]
        done = ended(process)
    assert done.code == 0, done.out
    assert f"{len(rows)} messages on 3 keys" in done.out
    assert "all sent" in done.out
    assert not list(run_dir.glob("*")), "the player's socket is gone"


def test_nothing_is_lost_to_a_subscriber_when_it_plays_as_fast_as_it_can(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(60.0)
    log = write(tmp_path, rows, monkeypatch)
    words = (str(log / "run.mcap"), "--rate", "1000", "--wait", "60")
    with listening(run_dir) as ear, playing(run_dir, *words) as process:
        assert [payload for _, payload in ear.all(process)] == [row[1] for row in rows]


STANDS_STILL = """
import os, signal, sys, time
from pathlib import Path
from shared.bus.session import open_session
from tests.tools.logs.playback.bench import LISTEN, ROBOT
with open_session(ROBOT, "ear", Path(sys.argv[1]), connect=[LISTEN]) as session:
    stream = session.stream(["replay/**"], capacity=1_000_000)
    while stream.take() is None:
        pass
    os.kill(os.getpid(), signal.SIGSTOP)
    heard, deadline = 1, time.monotonic() + 10.0
    while heard < int(sys.argv[2]) and time.monotonic() < deadline:
        heard += stream.take() is not None
    print(heard)
"""


def test_the_end_is_not_lost_to_a_subscriber_that_stands_still_for_half_a_second(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(3.0)  # more than a socket takes, less than the player's queue besides
    log = write(tmp_path, rows, monkeypatch)
    words = (str(log / "run.mcap"), "--rate", "1000", "--wait", "60")
    with playing(run_dir, *words) as process:
        command = [sys.executable, "-c", STANDS_STILL, str(run_dir), str(len(rows))]
        ear = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        try:
            os.waitpid(ear.pid, os.WUNTRACED)
            time.sleep(0.5)
            ear.send_signal(signal.SIGCONT)
            assert ended(process).code == 0
            assert ear.communicate(timeout=30)[0] == f"{len(rows)}\n"
        finally:
            ear.kill()
            ear.communicate()


def test_chosen_topics_of_a_part_go_under_other_names_with_the_recorded_time_beside(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(2.0)
    log = write(tmp_path, rows, monkeypatch)
    words = (
        *(str(log), "--prefix", "lab/7", "--topics", "joint/*/state", "harness/*"),
        *("--exclude", "harness/tare", "--remap", "joint/*/state=was/*", "--clock"),
        *("--start-offset", "0.5", "--duration", "1", "--wait", "60"),
    )
    with listening(run_dir, "lab/**") as ear, playing(run_dir, *words) as process:
        received = ear.all(process)
    first, last = rows[0][2] + 500_000_000, rows[0][2] + 1_500_000_000
    wanted = {STATE: f"lab/7/xrl/{NAME}/was/knee_left", WRENCH: f"lab/7/{WRENCH}"}
    assert [row for row in received if row[0] != "lab/7/clock"] == [
        (wanted[key], payload) for key, payload, at in rows if key in wanted and first <= at < last
    ]
    ticks = [json.loads(payload) for key, payload in received if key == "lab/7/clock"]
    assert [tick["seq"] for tick in ticks] == list(range(ticks[0]["seq"], ticks[-1]["seq"] + 1))
    stamps = [tick["t_ns"] for tick in ticks]
    assert stamps == sorted(stamps)
    assert first <= stamps[0] < stamps[-1] <= last


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_loop_runs_until_a_signal_and_then_reports_its_counts_and_leaves_nothing(
    number: signal.Signals, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(0.5)
    log = write(tmp_path, rows, monkeypatch)
    with listening(run_dir) as ear, playing(run_dir, str(log), "--loop", "--wait", "60") as process:
        assert ear.has(2 * len(rows) + 5)
        process.send_signal(number)
        done = ended(process)
    assert done.code == 128 + number, done.out
    assert "messages on 3 keys" in done.out
    assert "passes" in done.out
    assert "Traceback" not in done.out
    assert not list(run_dir.glob("*"))
    assert [payload for _, payload in ear.received] == [
        row[1] for row in itertools.islice(itertools.cycle(rows), len(ear.received))
    ]


def test_on_a_terminal_space_begins_right_steps_and_q_ends(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(60.0)
    log = write(tmp_path, rows, monkeypatch)
    words = (str(log), "--start-paused", "--run-dir", str(run_dir))
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-m", "tools.cli", "log", "play", *words])  # noqa: S606
    screen = bytearray()
    over = threading.Event()

    def read() -> None:
        with contextlib.suppress(OSError):
            while not over.is_set():
                if select.select([terminal], [], [], 0.1)[0]:
                    screen.extend(os.read(terminal, 4096))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        with listening(run_dir) as ear:
            assert ear.until(lambda: b"paused" in screen and b"nobody" not in screen[-60:])
            for count in (1, 2):
                os.write(terminal, b"\x1b[C")
                assert ear.has(count)
            assert ear.quiet() == 2
            os.write(terminal, b" ")
            assert ear.has(30)
            os.write(terminal, b"q")
            _, status = os.waitpid(pid, 0)
        pid = 0
    finally:
        if pid:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        over.set()
        reader.join()
        os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 0, screen.decode()
    assert b"all sent" in screen
    assert [payload for _, payload in ear.received] == [row[1] for row in rows[: len(ear.received)]]


def test_on_live_keys_commands_are_refused_beside_a_live_drive_and_never_forced(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under its prefix a player does not reach a live joint service at all."""
    log = str(write(tmp_path, command_items(), monkeypatch))
    with LiveJoint(run_dir) as joint:
        with listening(run_dir) as ear, playing(run_dir, log, "--wait", "60") as process:
            assert len(ear.all(process)) == 400
            assert process.returncode == 0
        assert (joint.commands, joint.estops) == (0, 0)
        refused = play(run_dir, log, "--prefix", "")
        assert refused.code == 2
        assert "knee_left" in refused.out
        assert "estop, joint/*/command" in refused.out
        assert (joint.commands, joint.estops) == (0, 0)
        only = play(run_dir, log, "--prefix", "", "--force", "--topics", "joint/*/command")
        assert only.code == 2
        assert "even with --force" in only.out
        forced = play(run_dir, log, "--prefix", "", "--force", "--wait", "60")
        assert forced.code == 0, forced.out
        assert "left out even with --force: joint/*/command" in forced.out
        assert joint.commands == 0
        assert joint.estops > 0


def test_with_no_live_drive_the_live_keys_are_played_until_one_comes_up(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = str(write(tmp_path, command_items(), monkeypatch))
    words = (log, "--prefix", "", "--wait", "60", "--loop")
    with listening(run_dir, f"xrl/{NAME}/**") as ear, playing(run_dir, *words) as process:
        assert ear.has(101)
        assert {key for key, _ in ear.received} == {row[0] for row in command_items()}
        with LiveJoint(run_dir):
            done = ended(process)
    assert done.code == 2
    assert "stopped: the joint service knee_left is heard" in done.out
    assert "messages on 2 keys" in done.out


def test_a_second_player_on_one_endpoint_is_one_line(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = str(write(tmp_path, items(0.5), monkeypatch))
    with listening(run_dir) as ear, playing(run_dir, log, "--loop", "--wait", "60"):
        assert ear.has(1)
        second = play(run_dir, log)
        assert second.code == 2
        assert "in use" in second.out
        assert "Traceback" not in second.out
        elsewhere = play(run_dir, log, "--listen", "none", "--wait", "0")
        assert elsewhere.code == 0, elsewhere.out
        assert "nobody listened" in elsewhere.out
