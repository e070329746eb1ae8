"""Whose a run directory is, and what is removed from it: nothing of anybody else's."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from services.harness.loop import ZeroFile
from services.harness.loop import zero_path as zero_of
from services.joint.rearm_guard import LastState, RearmGuard, request_stop, stop_source
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.run_directory import FLEET_VARIABLE, live_dir, make_live_dir
from tests.tools.fleet.plans import plan
from tools import cli
from tools.fleet import kept_state, procfs
from tools.fleet.run_dir import ENDING_S, MARKER, RunDir
from tools.fleet.supervise import SupervisedFleet


@pytest.fixture
def claimed(run_dir: Path) -> Iterator[RunDir]:
    run = RunDir(run_dir)
    lock = run.claim()
    run.prepare(plan(run_dir))
    yield run
    os.close(lock)


def files_in(directory: Path) -> list[str]:
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("*"))


def test_the_run_directory_has_one_owner_at_a_time(run_dir: Path) -> None:
    lock = RunDir(run_dir).claim()
    with pytest.raises(FleetError, match="a fleet is up in"):
        RunDir(run_dir).claim()
    ends = threading.Timer(0.1 * ENDING_S, os.close, [lock])
    ends.start()
    os.close(RunDir(run_dir).claim())  # its owner is just ending
    ends.join()


def test_clearing_leaves_foreign_files_and_sockets_alone(claimed: RunDir) -> None:
    (claimed.path / "notes.txt").write_text("mine")
    for name in ("thesis.tex", "notes.log"):
        (claimed.logs / name).write_text("mine")
    claimed.log_of("planner").write_text("a line")
    for name in ("planner.zenoh", "foreign.sock"):
        with closing(socket.socket(socket.AF_UNIX)) as dead:
            dead.bind(str(claimed.live / name))
    claimed.clear(keep_logs=False)
    kept = [MARKER, "logs", "logs/notes.log", "logs/thesis.tex", "notes.txt"]
    assert sorted({*files_in(claimed.path), *files_in(claimed.live)}) == sorted(
        [*kept, "foreign.sock"]
    )


def test_a_start_in_a_used_directory_keeps_what_a_person_put_there_and_an_empty_one_goes(
    claimed: RunDir,
) -> None:
    (claimed.logs / "thesis.tex").write_text("mine")
    claimed.prepare(plan(claimed.path))
    assert (claimed.logs / "thesis.tex").read_text() == "mine"
    (claimed.logs / "thesis.tex").unlink()
    claimed.clear(keep_logs=False)
    assert not claimed.path.exists()
    assert not claimed.live.exists()


def test_a_folder_of_a_persons_own_files_is_refused_and_stays_as_it_is(run_dir: Path) -> None:
    (run_dir / "logs").mkdir(parents=True)
    (run_dir / "logs/run.log").write_text("mine")
    (run_dir / "supervisord.conf").write_text("mine too")
    with pytest.raises(FleetError, match="contains logs, which does not belong to a fleet"):
        RunDir(run_dir).claim()
    RunDir(run_dir).clear(keep_logs=False)
    SupervisedFleet(run_dir).stop()
    assert cli.main(["down", "--run-dir", str(run_dir)]) == 0
    assert files_in(run_dir) == ["logs", "logs/run.log", "supervisord.conf"]
    assert cli.main(["down", "--run-dir", str(run_dir / "none")]) == 0
    assert not (run_dir / "none").exists()


@pytest.mark.parametrize("name", ["supervisord.conf", "fleet.json", "poetry.lock", "x.pid"])
def test_one_file_with_a_name_that_a_fleet_uses_too_is_a_persons(run_dir: Path, name: str) -> None:
    run_dir.mkdir()
    (run_dir / name).write_text("mine")
    with pytest.raises(FleetError, match=f"contains {name}, which does not belong to a fleet"):
        RunDir(run_dir).claim()
    assert (run_dir / name).read_text() == "mine"


def test_what_services_started_by_hand_or_an_earlier_version_left_is_no_obstacle(
    run_dir: Path, tmp_path: Path
) -> None:
    """An earlier version left its logs, and no mark."""
    run_dir.mkdir()
    with closing(socket.socket(socket.AF_UNIX)) as dead:
        dead.bind(str(run_dir / "play.zenoh"))
    (run_dir / "play.zenoh.lock").touch()
    for name in ("knee_left.rearm", "knee_left.heat", "joints.near", "harness.zero"):
        (run_dir / name).touch()
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/supervisord.log").touch()
    for used in (run_dir, tmp_path):
        os.close(RunDir(used).claim())


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702])
def test_a_directory_that_others_may_write_to_is_refused(run_dir: Path, mode: int) -> None:
    run_dir.mkdir()
    run_dir.chmod(mode)
    with pytest.raises(FleetError, match="other users can write to it"):
        RunDir(run_dir).claim()


def test_a_fleet_whose_directory_became_writable_for_others_can_be_stopped(
    claimed: RunDir, capsys: pytest.CaptureFixture[str]
) -> None:
    claimed.path.chmod(0o777)
    with pytest.raises(FleetError, match="other users can write to it"):
        SupervisedFleet.attach(claimed.path)
    RearmGuard(claimed.path, "knee_left")
    assert cli.main(["estop", "--local", "--run-dir", str(claimed.path)]) != 0
    assert "not stopped" in capsys.readouterr().err, "asked, but no service is there"
    assert RearmGuard(claimed.path, "knee_left").stop_requested


def test_a_stop_is_written_into_no_file_that_a_link_leads_to(run_dir: Path) -> None:
    run_dir.mkdir()
    (run_dir / "mine").write_bytes(b"0123456789abcdef")
    (make_live_dir(run_dir) / "knee_left.rearm").symlink_to(run_dir / "mine")
    with pytest.raises(OSError, match="symbolic links"):
        request_stop(run_dir, "knee_left")
    assert (run_dir / "mine").read_bytes() == b"0123456789abcdef"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a directory away")
@pytest.mark.parametrize("linked", [False, True])
def test_a_strangers_directory_is_refused_by_every_verb(
    run_dir: Path, linked: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = run_dir.with_name("theirs")
    theirs.mkdir()
    os.chown(theirs, 12345, 12345)
    if linked:
        run_dir.symlink_to(theirs)
        os.chown(run_dir, 12345, 12345, follow_symlinks=False)
    else:
        theirs.rename(run_dir)
    for words in (["up"], ["down"], ["status"], ["kill", "planner"]):
        with pytest.raises(SystemExit) as ended:
            cli.main([*words, "--run-dir", str(run_dir)])
        assert ended.value.code == 2
        assert "belongs to another user" in capsys.readouterr().err
    with pytest.raises(FleetError, match="belongs to another user"):
        SupervisedFleet.attach(run_dir)


def test_a_service_of_another_fleet_gets_no_signal(claimed: RunDir) -> None:
    other = {procfs.FLEET_VARIABLE: "/tmp/other", "SUPERVISOR_PROCESS_NAME": "planner"}
    with subprocess.Popen(
        [sys.executable, "-c", "input()"], stdin=subprocess.PIPE, env={**os.environ, **other}
    ) as stranger:
        with pytest.raises(FleetError, match="planner has no process to signal now"):
            SupervisedFleet(claimed.path).kill("planner", signal.SIGKILL)
        assert stranger.poll() is None
        stranger.communicate(b"\n")


def test_a_process_of_the_fleet_is_known_by_its_mark(claimed: RunDir) -> None:
    marked = {**os.environ, FLEET_VARIABLE: str(claimed.path)}
    words = [sys.executable, "-c", "print(flush=True); input()"]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, env=marked) as member:
        assert member.stdout is not None
        member.stdout.readline()  # until then the kernel may still be laying out its environment
        assert procfs.fleet_pids(claimed.path) == {member.pid}
        assert procfs.fleet_pids(claimed.path.with_name("other")) == set()
        member.communicate(b"\n")


@pytest.mark.parametrize("last", [LastState.HELD, LastState.DAMP])
def test_a_start_that_nobody_asked_for_keeps_what_a_module_was_and_a_stop(
    claimed: RunDir, last: LastState
) -> None:
    RearmGuard(claimed.path, "knee_left").write(last)
    request_stop(claimed.path, "knee_left", "anna")
    claimed.log_of("knee_left").write_text("why it ended")
    claimed.prepare(plan(claimed.path, disarmed=True))
    guard = RearmGuard(claimed.path, "knee_left")
    assert (guard.read(), guard.stop_requested) == (last, True)
    assert stop_source(claimed.path, "knee_left") == "anna"
    assert claimed.log_of("knee_left").read_text() == "why it ended"
    others = {RearmGuard(claimed.path, module).read() for module in MODULES[1:]}
    assert others - {last} <= {LastState.HELD}, "it arms nothing that was down"


def test_a_persons_start_forgets_a_stop_and_so_does_down_unless_it_is_told_not_to(
    claimed: RunDir,
) -> None:
    request = ("knee_left", "anna")
    RearmGuard(claimed.path, "knee_left")
    request_stop(claimed.path, *request)
    claimed.clear(keep_logs=True, keep_stops=True)
    assert stop_source(claimed.path, "knee_left") == "anna"
    claimed.prepare(plan(claimed.path))
    assert stop_source(claimed.path, "knee_left") == ""


@pytest.mark.parametrize(
    ("what", "kept"), [("a start", False), ("a disarmed start", True), ("a clean end", False)]
)
def test_the_harness_keeps_its_zero_where_only_the_supervisor_has_crashed(
    claimed: RunDir, what: str, kept: bool
) -> None:
    """A person may rest on it then; after any other end it tares again."""
    ZeroFile(claimed.path).write(np.ones(6))
    if what == "a clean end":
        claimed.clear(keep_logs=True, keep_stops=True)
    else:
        claimed.prepare(plan(claimed.path, disarmed=what == "a disarmed start"))
    assert zero_of(claimed.path).exists() is kept


IN_MEMORY = pytest.mark.skipif(
    live_dir(Path("/nowhere")) == Path("/nowhere"), reason="this host has no folder in memory"
)


def power_cut(run: RunDir) -> None:
    """Lose what is in memory."""
    shutil.rmtree(run.live)


@IN_MEMORY
@pytest.mark.parametrize("disarmed", [True, False])
def test_a_stop_outlasts_a_power_cut_until_a_person_starts(claimed: RunDir, disarmed: bool) -> None:
    RearmGuard(claimed.path, "knee_left").write(LastState.DAMP)
    request_stop(claimed.path, "knee_left", "anna")
    assert kept_state.save(claimed.path)
    power_cut(claimed)
    claimed.prepare(plan(claimed.path, disarmed=disarmed))
    guard = RearmGuard(claimed.path, "knee_left")
    assert (guard.read() is LastState.DAMP, guard.stop_requested) == (disarmed, disarmed)


@IN_MEMORY
def test_the_copy_on_the_disk_follows_the_memory_and_never_replaces_it(claimed: RunDir) -> None:
    guard = RearmGuard(claimed.path, "knee_left")
    for last in (LastState.HELD, LastState.NOTHING):
        guard.write(last)
        assert kept_state.save(claimed.path)
        assert (claimed.path / "knee_left.rearm").read_bytes()[0] == last
    guard.write(LastState.DAMP)
    kept_state.restore(claimed.path)
    assert RearmGuard(claimed.path, "knee_left").read() is LastState.DAMP


@IN_MEMORY
def test_how_warm_the_windings_are_outlasts_down_and_a_power_cut(claimed: RunDir) -> None:
    (claimed.live / "knee_left.heat").write_bytes(b"warm")
    claimed.clear(keep_logs=True)
    assert not claimed.live.exists()
    claimed.prepare(plan(claimed.path))
    assert (claimed.live / "knee_left.heat").read_bytes() == b"warm"
