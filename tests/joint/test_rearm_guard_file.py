"""The file of what a joint service left, and the verbs that re-arm a module."""

from __future__ import annotations

import errno
import getpass
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from services.joint import neighbours
from services.joint.rearm_guard import (
    SOURCE_MAX,
    LastState,
    Pendant,
    RearmGuard,
    clear,
    path_of,
    request_stop,
    stop_source,
)
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from shared.run_directory import make_live_dir
from tools.fleet import emergency_stop, process_table, procfs, supervise
from tools.fleet.run_dir import RunDir
from tools.fleet.supervise import SupervisedFleet
from tools.verbs import services

MODULE = "knee_left"

PID = 4711


@pytest.fixture
def file(tmp_path: Path) -> RearmGuard:
    return RearmGuard(tmp_path, MODULE)


@pytest.fixture
def left(file: RearmGuard) -> RearmGuard:
    """Return what a service of MODULE left that held, mapped as by one that runs."""
    file.write(LastState.HELD)
    return file


@pytest.mark.parametrize("last_state", list(LastState))
def test_what_a_process_leaves_the_next_one_reads(tmp_path: Path, last_state: LastState) -> None:
    RearmGuard(tmp_path, MODULE).write(last_state)
    assert RearmGuard(tmp_path, MODULE).read() is last_state
    assert RearmGuard(tmp_path, "ankle_left").read() is LastState.NOTHING, "without a predecessor"


@pytest.mark.parametrize("byte", [3, 0x20, 0xFF, LastState.HELD])
def test_a_file_of_one_byte_is_read_and_an_odd_state_is_held(tmp_path: Path, byte: int) -> None:
    make_live_dir(tmp_path)
    path_of(tmp_path, MODULE).write_bytes(bytes([byte]))
    old = RearmGuard(tmp_path, MODULE)
    assert (old.read(), old.stop_requested) == (LastState.HELD, False)


@pytest.mark.parametrize("last_state", [LastState.HELD, LastState.DAMP])
def test_what_is_forgotten_is_so_for_a_process_that_has_it_mapped(
    tmp_path: Path, file: RearmGuard, last_state: LastState
) -> None:
    file.write(last_state)
    successor = RearmGuard(tmp_path, MODULE)
    clear(tmp_path, MODULE)
    assert file.read() is LastState.NOTHING
    for each in (file, successor):
        each.write(last_state)
        assert file.read() is LastState.NOTHING, "it has nothing new to say: that undoes nothing"
    other = LastState.HELD if last_state is LastState.DAMP else LastState.DAMP
    file.write(other)
    assert RearmGuard(tmp_path, MODULE).read() is other, "still the same file"


class Fleet:
    """Stands for the supervisor and the system: keeps what they are asked to do."""

    def __init__(self, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.pids: dict[str, int] = {}
        self.suspended = False
        self.made: list[tuple[object, ...]] = []
        self.run_dir = run_dir
        self.start = SupervisedFleet(run_dir)
        asked = SimpleNamespace(call=lambda *words: self.made.append(words))
        kill_for = SimpleNamespace(kill=lambda *words: self.made.append(("kill", *words)))
        monkeypatch.setattr(self.start, "_supervisor", asked)
        monkeypatch.setattr(self.start, "pids", lambda: self.pids)
        monkeypatch.setattr(
            SupervisedFleet, "manifest", SimpleNamespace(services=(MODULE, "planner"))
        )
        monkeypatch.setattr(SupervisedFleet, "attach", lambda _run_dir: self.start)
        monkeypatch.setattr(procfs, "is_suspended", lambda _pid: self.suspended)
        monkeypatch.setattr(procfs, "belongs", lambda _pid, _run_dir: True)
        monkeypatch.setattr(supervise, "os", kill_for)

    def kill(self, service: str, name: str) -> None:
        """Run `xrl kill` on a service that is up."""
        self.pids = {service: PID}
        flags = services.KillFlags(run_dir=self.run_dir, service=service, signal=cast("Any", name))
        assert services.kill(flags) == 0


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    return Fleet(tmp_path, monkeypatch)


def test_a_stop_is_seen_at_once_until_it_is_forgotten(tmp_path: Path, file: RearmGuard) -> None:
    """Where no service is nothing is forgotten or stopped."""
    assert not file.stop_requested
    assert request_stop(tmp_path, MODULE)
    assert file.stop_requested
    assert RearmGuard(tmp_path, MODULE).stop_requested, "and by whoever is started in its stead"
    file.write(LastState.HELD)
    assert file.stop_requested, "what the service leaves does not undo it"
    clear(tmp_path, MODULE)
    assert not file.stop_requested
    clear(tmp_path, "hip_left")
    assert not request_stop(tmp_path, "hip_left")
    assert stop_source(tmp_path, "hip_left") == ""
    assert not path_of(tmp_path, "hip_left").exists()


def test_a_pendant_reaches_the_services_that_run(tmp_path: Path, file: RearmGuard) -> None:
    other = RearmGuard(tmp_path, "hip_left")
    pendant = Pendant(tmp_path, MODULES)
    assert set(pendant.modules) == {MODULE, "hip_left"}
    assert file.beats == 0, "it is not missed before it was heard"
    for beats in range(1, 300):
        pendant.beat()
        assert (file.beats, other.beats) == (beats, beats)
    assert (file.read(), file.stop_requested) == (LastState.NOTHING, False)
    clear(tmp_path, MODULE)
    assert (file.beats, other.beats) == (0, 299), "one from before is forgotten with the rest"
    pendant.beat()
    pendant.lay_down()
    assert (file.beats, other.beats) == (0, 0)


def test_a_pendant_reaches_a_service_whose_file_has_not_its_size_yet(tmp_path: Path) -> None:
    make_live_dir(tmp_path)
    path_of(tmp_path, MODULE).write_bytes(bytes([LastState.HELD, 0]))
    Pendant(tmp_path, MODULES).beat()
    found = RearmGuard(tmp_path, MODULE)
    assert (found.read(), found.stop_requested, found.beats) == (LastState.HELD, False, 1)


@pytest.mark.parametrize("state", ["down", "runs", "suspended"])
def test_a_service_that_is_down_starts_with_no_past_and_starting_what_runs_asks_for_none(
    fleet: Fleet, left: RearmGuard, state: str
) -> None:
    """It knows itself what it has held; should it crash after, the next has to know as well."""
    fleet.pids, fleet.suspended = {MODULE: PID} if state != "down" else {}, state == "suspended"
    assert (fleet.start.start_service(MODULE) == PID) is (state == "runs"), "it runs already"
    started = ("supervisor.startProcess", MODULE, False) in fleet.made
    assert started is (state == "down")
    assert state == "down" or [made[0] for made in fleet.made] == ["kill"] * fleet.suspended
    assert left.read() is (LastState.NOTHING if state == "down" else LastState.HELD)


@pytest.mark.parametrize("name", ["KILL", "TERM", "STOP", "CONT"])
def test_the_verb_that_ends_a_service_asks_for_the_next_and_one_that_suspends_it_does_not(
    fleet: Fleet, left: RearmGuard, name: str
) -> None:
    fleet.kill(MODULE, name)
    assert fleet.made == [("kill", PID, signal.Signals[f"SIG{name}"])]
    assert left.read() is (LastState.NOTHING if name in ("KILL", "TERM") else LastState.HELD)


def test_a_service_without_a_drive_leaves_nothing_to_forget(fleet: Fleet, tmp_path: Path) -> None:
    fleet.kill("planner", "KILL")
    assert not path_of(tmp_path, "planner").exists()


@pytest.mark.parametrize("name", ["KILL", "TERM"])
def test_the_signal_is_sent_though_the_state_cannot_be_cleared_and_the_verb_says_so(
    fleet: Fleet, name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """After a stop it is the only way out of it, also on a read-only disk."""

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), "/run/x/knee_left.rearm")

    monkeypatch.setattr(supervise.rearm_guard, "clear", refuse)
    fleet.kill(MODULE, name)
    assert fleet.made == [("kill", PID, signal.Signals[f"SIG{name}"])]
    assert "arms no drive: /run/x/knee_left.rearm: Read-only file system; the disk" in caplog.text


@pytest.mark.parametrize("ends", ["a new fleet", "a fleet that goes down"])
def test_a_fleet_knows_no_state_before_it(tmp_path: Path, left: RearmGuard, ends: str) -> None:
    assert left.read() is LastState.HELD
    neighbours.Neighbours(tmp_path, MODULE)
    if ends == "a new fleet":
        options = process_table.FleetOptions(services=[MODULE])
        plan = process_table.make_plan(DEFAULT_CONFIG, Path("/nowhere"), options)
        RunDir(tmp_path).prepare(plan)
    else:
        run = RunDir(tmp_path)
        lock = run.claim()
        run.clear(keep_logs=True)
        os.close(lock)
    assert not path_of(tmp_path, MODULE).exists()
    assert not neighbours.path_of(tmp_path).exists()


def test_the_memory_of_a_service_takes_its_space_when_it_is_made(tmp_path: Path) -> None:
    """A store to memory that a full disk cannot back ends the process with SIGBUS.

    The file does not grow, and a stop is one byte of it.
    """
    for _ in range(3):
        RearmGuard(tmp_path, MODULE)
        request_stop(tmp_path, MODULE)
    assert path_of(tmp_path, MODULE).read_bytes() == b"\x00\x01" + bytes(14 + SOURCE_MAX)
    neighbours.Neighbours(tmp_path, MODULE)
    for path in (path_of(tmp_path, MODULE), neighbours.path_of(tmp_path)):
        found = path.stat()
        assert found.st_blocks * 512 >= found.st_size > 0


def test_memory_that_cannot_be_made_is_refused_by_its_name(tmp_path: Path) -> None:
    path_of(tmp_path, MODULE).mkdir(parents=True)
    with pytest.raises(
        FleetError, match=rf"{MODULE}\.rearm: cannot create shared memory: Is a directory"
    ):
        RearmGuard(tmp_path, MODULE)


def test_a_signal_stops_a_service_whose_file_is_gone(tmp_path: Path, file: RearmGuard) -> None:
    before = signal.getsignal(signal.SIGUSR1)
    try:
        file.stop_on(signal.SIGUSR1)
        path = path_of(tmp_path, MODULE)
        elsewhere = path.rename(path.with_name("elsewhere"))
        assert not file.stop_requested
        os.kill(os.getpid(), signal.SIGUSR1)
        assert file.stop_requested
        elsewhere.rename(path)
        assert stop_source(tmp_path, MODULE) == "signal SIGUSR1"
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_the_first_named_source_of_a_stop_is_kept_until_asked_for(tmp_path: Path) -> None:
    guard = RearmGuard(tmp_path, MODULE)
    assert stop_source(tmp_path, MODULE) == ""
    guard.note_stop("")
    request_stop(tmp_path, MODULE, "Xaver")
    request_stop(tmp_path, MODULE, "somebody else")
    guard.note_stop("a third")
    assert stop_source(tmp_path, MODULE) == "Xaver"
    for given, kept in (
        ("é" * SOURCE_MAX, "é" * (SOURCE_MAX // 2)),
        ("a" + "é" * SOURCE_MAX, "a" + "é" * (SOURCE_MAX // 2 - 1) + "\ufffd"),
        ("l\udce9a", "l?a"),
    ):
        clear(tmp_path, MODULE)
        guard.note_stop(given)
        assert stop_source(tmp_path, MODULE) == kept
        assert not guard.stop_requested, "a long name reaches nothing else"
        assert guard.beats == 0


@pytest.mark.parametrize("name", [KeyError("uid not found: 12345"), "l\udce9a"])
def test_a_user_without_a_name_or_with_a_broken_one_stops_the_robot_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: KeyError | str
) -> None:
    def who() -> str:
        if isinstance(name, KeyError):
            raise name
        return name

    monkeypatch.setattr(getpass, "getuser", who)
    guard = RearmGuard(tmp_path, MODULE)
    assert emergency_stop.request_here(tmp_path) == ([MODULE], [])
    assert guard.stop_requested
    assert stop_source(tmp_path, MODULE).startswith("xrl estop by ")
