"""A fleet of stand-ins under the real supervisor: nothing is left behind, nor open to others."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tomli_w
from supervisor.states import ProcessStates

from shared.exceptions import FleetError
from shared.places import DEFAULT_CONFIG
from shared.run_directory import live_dir
from tests.system.fleets import command, wait_for
from tests.tools.fleet.plans import robot_file
from tests.waiting import comes_true
from tools import cli
from tools.fleet import procfs
from tools.fleet.process_table import FleetOptions
from tools.fleet.run_dir import MARKER
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.supervisor_client import ServiceInfo
from tools.fleet.supervisor_process import BACKOFF_MAX_S, Service

pytestmark = pytest.mark.system

SLEEPER = "import time; print('awake', flush=True); time.sleep(600)"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEPER}"
FAILING = "print('no drive on can0'); raise SystemExit(3)"
JOINT = """
import sys, time
from pathlib import Path
from shared.bus.session import open_session
from shared.config.files import load
from shared.bus.messages import JointState, Mode
from shared.bus.topics import JOINT_STATE
zero = (0.0, 0.0)
with open_session(load(Path(sys.argv[1])), "ankle_right", Path(sys.argv[2])) as session:
    publisher = session.publisher(JOINT_STATE, JointState, "ankle_right")
    for seq in range(100_000):
        publisher.put(JointState(
            t_ns=time.monotonic_ns(), seq=seq, q=zero, v=zero, tau=zero, mode=Mode.HOLD,
            cause=0, ready=False, age_ns=-1, session=0, command_seq=-1, cycle=seq, late=0,
            dropouts=0, refused=0, drive=2, drive_error=0))
        time.sleep(0.01)
"""


def write_table(path: Path, programs: dict[str, str], *, ready: str = "running") -> Path:
    rows = []
    for name, program in programs.items():
        file = path.with_name(f"{name}.py")
        file.write_text(program, encoding="utf-8")
        rows.append(
            {
                "name": name, "kind": "planner", "autostart": True, "ready": ready,
                "command": ["{python}", str(file), "{config}", "{run}"],
                "topic": "joint/*/state" if name == "ankle_right" else "",
                "stop_signal": "TERM", "stop_s": 1, "settle_s": 1, "why": "a stand-in",
            }
        )  # fmt: skip
    path.write_text(tomli_w.dumps({"environment": {}, "process": rows}), encoding="utf-8")
    return path


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as parent:
        path = Path(parent) / "run"
        yield path
        SupervisedFleet(path).stop()


Start = Callable[..., SupervisedFleet]


@pytest.fixture
def start(run_dir: Path, tmp_path: Path) -> Start:
    def start(
        programs: dict[str, str] | None = None,
        config: Path = DEFAULT_CONFIG,
        ready: str = "running",
        **options: Any,
    ) -> SupervisedFleet:
        two = {"planner": SLEEPER, "harness": SLEEPER}
        table = write_table(tmp_path / "processes.toml", programs or two, ready=ready)
        return SupervisedFleet.start(config, run_dir, FleetOptions(table_path=table, **options))

    return start


Order = Callable[..., tuple[int, str]]


@pytest.fixture
def order(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Order]:
    """Return what runs a verb on the fleet in this process, and gives its exit code and words."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}

    def run(*words: str) -> tuple[int, str]:
        capsys.readouterr()
        code = cli.main([*words, "--run-dir", str(run_dir)])
        return code, "".join(capsys.readouterr())

    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


def service(fleet: SupervisedFleet, name: str) -> ServiceInfo:
    return next(row for row in fleet.info() if row.name == name)


def supervisor_pid(fleet: SupervisedFleet) -> int:
    return int(fleet.run.supervisor_pid.read_text(encoding="utf-8"))


def assert_nothing_left(run_dir: Path, pids: Sequence[int]) -> None:
    assert procfs.fleet_pids(run_dir) == set()
    assert all(procfs.is_gone(pid) for pid in pids)
    assert not run_dir.exists() or {path.name for path in run_dir.iterdir()} <= {"logs", MARKER}


def test_a_service_is_suspended_resumed_killed_restarted_and_counted(start: Start) -> None:
    fleet = start()
    before = fleet.kill("planner", signal.SIGSTOP)
    assert wait_for(lambda: service(fleet, "planner").state == "suspended")
    assert fleet.kill("planner", signal.SIGCONT) == before
    assert wait_for(lambda: service(fleet, "planner").state == "running")
    assert service(fleet, "planner").restarts == 0
    assert fleet.kill("planner", signal.SIGKILL) == before
    assert wait_for(lambda: fleet.pids().get("planner", before) != before)
    planner, harness = service(fleet, "planner"), service(fleet, "harness")
    assert (planner.restarts, harness.restarts) == (1, 0)
    assert "SIGKILL" in planner.last_exit


def test_a_service_that_is_asleep_or_not_to_restart_stays_down_until_it_is_started(
    start: Start, order: Order
) -> None:
    fleet = start(not_started=("planner",), no_restart=frozenset({"planner"}))
    assert [service(fleet, name).state for name in ("planner", "harness")] == ["stopped", "running"]
    code, said = order("start", "planner")
    assert (code, "planner: started" in said) == (0, True)
    assert wait_for(lambda: service(fleet, "planner").state == "running")
    fleet.kill("planner")
    assert wait_for(lambda: service(fleet, "planner").state == "exited")
    time.sleep(1.0)
    assert service(fleet, "planner").pid is None
    fleet.start_service("planner")
    assert wait_for(lambda: service(fleet, "planner").state == "running")


@pytest.mark.parametrize("suspended", ["service", "stubborn service", "supervisor"])
def test_who_is_suspended_or_stubborn_does_not_hold_the_stop_which_leaves_nothing(
    start: Start, run_dir: Path, suspended: str
) -> None:
    program = STUBBORN if suspended.startswith("stubborn") else SLEEPER
    fleet = start({"planner": program, "harness": SLEEPER})
    pids = fleet.pids() | {"supervisor": supervisor_pid(fleet)}
    assert {*pids.values()} == procfs.fleet_pids(run_dir)
    os.kill(pids["supervisor" if suspended == "supervisor" else "planner"], signal.SIGSTOP)
    fleet.stop()
    assert_nothing_left(run_dir, list(pids.values()))
    assert not run_dir.exists()


def test_services_outlive_their_supervisor_and_are_shown_signalled_and_ended(
    start: Start, run_dir: Path, order: Order, caplog: pytest.LogCaptureFixture
) -> None:
    """They keep a robot standing, and nothing but a person may end that."""
    fleet = start({"planner": STUBBORN, "harness": SLEEPER})
    pids = fleet.pids()
    for name in pids:  # its first words into a pipe that nobody reads would end it
        assert wait_for(lambda name=name: "awake" in fleet.run.log_of(name).read_text())
    os.kill(supervisor_pid(fleet), signal.SIGKILL)
    assert wait_for(lambda: bool(fleet.supervision_fault()))
    assert [row.state for row in fleet.info()] == ["unsupervised", "unsupervised"]
    code, said = order("status")
    assert (code, "nothing restarts one that ends" in " ".join(said.split())) == (0, True)
    assert fleet.pids() == pids
    with pytest.raises(FleetError, match="a fleet without a supervisor runs here"):
        start()
    assert fleet.pids() == pids, "a refused start ends nothing"
    code, said = order("start", "planner")
    assert (code, "already runs" in said) == (0, True)
    assert order("kill", "harness")[0] == 0
    assert "nothing restarts one that ends" in caplog.text
    assert wait_for(lambda: [row.state for row in fleet.info()] == ["unsupervised", "gone"])
    assert order("start", "harness")[0] == 2
    assert order("down")[0] == 0
    assert_nothing_left(run_dir, list(pids.values()))


def test_a_fleet_starts_where_one_was_killed_and_unasked_where_one_is_unsupervised(
    start: Start, run_dir: Path
) -> None:
    first = start(simulation=False)
    pids = list(first.pids().values())
    os.kill(supervisor_pid(first), signal.SIGKILL)
    assert wait_for(lambda: bool(first.supervision_fault()))
    second = start(simulation=False, disarmed=True)
    assert all(procfs.is_gone(pid) for pid in pids)
    assert not second.supervision_fault()
    assert len(second.pids()) == 2
    procfs.signal_all(procfs.fleet_pids(run_dir), signal.SIGKILL)
    assert wait_for(lambda: not procfs.fleet_pids(run_dir))
    assert len(start().pids()) == 2


@pytest.mark.parametrize("disaster", ["full", "removed", "a file in the place of the folder"])
def test_supervision_goes_on_without_a_place_for_its_logs(
    start: Start, disaster: str, order: Order
) -> None:
    """supervisord itself died of a log line on a full disk, and its services with it."""
    fleet = start({"planner": SLEEPER, "harness": SLEEPER})
    logs = fleet.run.logs
    if disaster == "full":
        for log in logs.iterdir():
            log.unlink()
            log.symlink_to("/dev/full")
    else:
        shutil.rmtree(logs)
    if disaster.startswith("a file"):
        logs.write_text("in the way")
    for restarts in range(1, 4):
        assert wait_for(lambda: "planner" in fleet.pids())
        fleet.kill("planner")
        assert wait_for(lambda n=restarts: service(fleet, "planner").restarts == n)
    assert "SIGKILL" in service(fleet, "planner").last_exit
    assert service(fleet, "harness").restarts == 0
    if disaster == "removed":
        assert wait_for(lambda: "awake" in fleet.run.log_of("planner").read_text())
        return
    assert wait_for(lambda: fleet.lost_lines()[0] > 3)
    shown = " ".join(order("status")[1].split())
    assert "log lines are lost" in shown
    assert fleet.lost_lines()[1] in shown


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Make a folder read-only, as its disk after an error."""
    steps = (["--bind", folder, folder], ["-o", "remount,ro,bind", folder])
    for step in steps:
        if subprocess.run(["mount", *step], check=False, capture_output=True).returncode:
            pytest.skip("only root may mount")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def test_on_a_read_only_disk_a_killed_service_is_reached_again_and_status_warns(
    start: Start, run_dir: Path, order: Order
) -> None:
    """Its dead socket could not be removed, and `xrl kill` sent no signal."""

    def rate_hz() -> float:
        return json.loads(order("status", "--json")[1])["services"]["ankle_right"]["rate_hz"] or 0.0

    fleet = start({"ankle_right": JOINT, "planner": SLEEPER})
    assert wait_for(lambda: rate_hz() > 20)
    before = fleet.pids()["ankle_right"]
    with read_only(run_dir):
        assert order("kill", "ankle_right")[0] == 0
        assert wait_for(lambda: fleet.pids().get("ankle_right", before) != before)
        assert wait_for(lambda: rate_hz() > 20)
        assert f"{run_dir}: its disk is read-only" in " ".join(order("status")[1].split())
        assert order("down", "--limp")[0] == 0
        assert procfs.fleet_pids(run_dir) == set()


def test_a_fleet_runs_at_paths_with_characters_that_are_special_in_other_files(
    run_dir: Path, tmp_path: Path
) -> None:
    odd = "a #b ;c 50% d?e 'f"
    (tmp_path / odd).mkdir()
    table = write_table(tmp_path / odd / "p.toml", {"ankle_right": JOINT}, ready="endpoint")
    options = FleetOptions(table_path=table)
    fleet = SupervisedFleet.start(robot_file(tmp_path / odd), run_dir.parent / odd, options)
    try:
        assert comes_true(lambda: [row.state for row in fleet.info()] == ["running"])
        assert fleet.run.log_of("ankle_right").exists()
    finally:
        fleet.stop()


def test_the_wait_before_another_start_is_bounded() -> None:
    """After a power cut a planner failed 135 starts, and a mended one waited for minutes."""
    waiting = Service.__new__(Service)
    waiting.state, waiting.backoff = ProcessStates.STARTING, 135
    waiting.config = SimpleNamespace(name="planner")
    waiting.change_state(ProcessStates.BACKOFF)
    assert waiting.delay <= time.time() + BACKOFF_MAX_S


def test_a_service_that_ends_at_once_or_never_listens_fails_the_start(
    start: Start, run_dir: Path
) -> None:
    with pytest.raises(FleetError, match=r"planner ended at once \(exit status 3\)") as failure:
        start({"harness": SLEEPER, "planner": FAILING})
    assert "no drive on can0" in str(failure.value)
    assert_nothing_left(run_dir, [])
    with pytest.raises(FleetError, match="not up, and no progress for 2 s: planner"):
        start({"planner": SLEEPER}, ready="endpoint", timeout_s=2.0)
    assert_nothing_left(run_dir, [])


def test_a_start_that_nobody_asked_for_ends_nothing_when_a_service_fails_and_status_says_why(
    start: Start, order: Order
) -> None:
    """To end the others would idle the drives of those that hold a person."""
    fleet = start({"harness": SLEEPER, "planner": FAILING}, disarmed=True)
    assert wait_for(lambda: service(fleet, "harness").state == "running")
    before = fleet.pids()["harness"]
    assert wait_for(lambda: service(fleet, "planner").restarts > 0), "it is tried again"
    shown = ""

    def is_told() -> bool:  # not while it is being started again
        nonlocal shown
        shown = " ".join(order("status")[1].split())
        return "planner: exit status 3" in shown

    assert wait_for(is_told), shown
    assert "no drive on can0" in shown
    assert fleet.pids()["harness"] == before
    assert wait_for(lambda: service(fleet, "planner").ends_lately >= 3)
    code, said = order("start", "planner")
    assert (code, "planner is in a crash loop: it ended" in said) == (3, True), said
    assert "exit status 3: no drive on can0" in said
    assert "already runs" not in said


def test_a_start_that_goes_on_takes_as_long_as_the_machine_needs(start: Start) -> None:
    """At load 11 to 26, 6 of 17 starts gave up after 30 s."""
    slow = f"import time\nwhile time.process_time() < 4.0:\n    pass\n{JOINT}"
    fleet = start({"ankle_right": slow}, ready="endpoint", timeout_s=2.0)
    assert [row.state for row in fleet.info()] == ["running"]


def up_in_a_process(run_dir: Path, table: Path, *, then: str = "") -> subprocess.Popen[str]:
    """Start a fleet as `xrl up` does, in a process of its own that may be interrupted."""
    code = (
        "import sys, time, tools.cli, tools.verbs.up, tools.fleet.supervise as s\n"
        "from pathlib import Path\n"
        "def run(flags: tools.verbs.up.UpFlags) -> int:\n"
        f"    options = s.FleetOptions(table_path=Path({str(table)!r}), leashed={bool(then)},"
        " timeout_s=60)\n"
        "    s.SupervisedFleet.start(flags.config, flags.run_dir, options)\n"
        f"    {then or 'return 0'}\n"
        "tools.verbs.up.run = run\n"
        f"sys.exit(tools.cli.main(['up', '--run-dir', {str(run_dir)!r}]))\n"
    )
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)


def test_an_interrupt_in_the_middle_of_a_start_leaves_nothing(
    run_dir: Path, tmp_path: Path
) -> None:
    table = write_table(tmp_path / "p.toml", {"planner": SLEEPER}, ready="endpoint")  # never up
    process = up_in_a_process(run_dir, table)
    assert wait_for(lambda: bool(procfs.fleet_pids(run_dir)))
    time.sleep(0.4)
    pids = procfs.fleet_pids(run_dir)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in errors
    assert_nothing_left(run_dir, sorted(pids))
    assert not run_dir.exists()


def test_a_leashed_fleet_ends_when_its_owner_is_killed(run_dir: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "p.toml", {"planner": SLEEPER})
    process = up_in_a_process(run_dir, table, then="print('up'); time.sleep(600)")
    assert wait_for(lambda: len(procfs.fleet_pids(run_dir)) == 2)
    time.sleep(0.5)
    process.kill()
    process.communicate(timeout=30)
    assert wait_for(lambda: not procfs.fleet_pids(run_dir))


def test_status_and_echo_show_what_the_services_send(start: Start, order: Order) -> None:
    fleet = start({"ankle_right": JOINT, "planner": SLEEPER})
    code, said = order("status", "--json")
    assert code == 0
    status = json.loads(said)
    ankle = status["services"]["ankle_right"]
    assert ankle["pid"] == fleet.pids()["ankle_right"]
    assert ankle["state"] == "running"
    assert 20 < ankle["rate_hz"] < 150
    assert 0 <= ankle["age_s"] < 1
    assert status["modules"]["ankle_right"] == {
        "mode": "HOLD", "tier": 2, "cause": "NONE", "drive": "ARMED", "q": [0.0, 0.0],
        "way_out": "", "stiffened": False, "outside": "", "session": 0, "refusals": [],
        "stopped_by": "", "celsius": None, "heat_left_s": None,
    }  # fmt: skip
    assert status["services"]["planner"]["rate_hz"] is None
    assert "ankle_right" in order("status")[1]

    words = ["topic", "echo", "joint/*/state", "--count", "2", "--field", "mode", "--field", "seq"]
    first, second = map(json.loads, order(*words, "--json")[1].splitlines())
    assert first["topic"] == "joint/ankle_right/state"
    assert second["seq"] == first["seq"] + 1, "none is lost"
    assert set(first) == {"topic", "mode", "seq"}
    code, said = order(*words)
    assert (code, "mode: HOLD (1)" in said) == (0, True)


def test_a_second_fleet_here_is_refused_and_the_first_is_killed_and_ended_by_verbs(
    start: Start, run_dir: Path, order: Order
) -> None:
    fleet = start()
    assert [row.state for row in fleet.info()] == ["running", "running"]
    pids = list(fleet.pids().values())
    with pytest.raises(FleetError, match="a fleet is up in"):
        start()
    assert list(fleet.pids().values()) == pids, "that harms nothing"
    code, said = order("kill", "plannr")
    assert (code, "one of planner, harness" in said) == (2, True)
    assert order("kill", "planner", "--signal", "STOP")[0] == 0
    assert wait_for(lambda: service(fleet, "planner").state == "suspended")
    assert order("down")[0] == 0
    assert_nothing_left(run_dir, pids)


SHARED_MEMORY = Path("/dev/shm")


def test_a_fleet_that_was_started_with_umask_0_leaves_nothing_to_others(
    run_dir: Path, tmp_path: Path
) -> None:
    before = set(SHARED_MEMORY.iterdir())
    out = tmp_path / "record"
    only = ("--only", "ankle_right,simulator,recorder", "--scenario", "stand")
    words = command("up", "--run-dir", run_dir, "--out", out, *only)
    script = 'umask 0; exec "$@"'
    try:
        subprocess.run(["bash", "-c", script, "-", *words], check=True, timeout=90)
        # "up" is a service that listens; what else it opens follows, on a busy machine later
        opened = (live_dir(run_dir) / "ankle_right.rearm", live_dir(run_dir) / "joints.near")
        assert wait_for(lambda: all(path.exists() for path in opened) and any(out.glob("*.mcap")))
        folders = (run_dir, live_dir(run_dir))
        found = [*folders, *(path for folder in folders for path in folder.rglob("*"))]
        found += set(SHARED_MEMORY.iterdir()) - before
        modes = {str(path): stat.S_IMODE(path.lstat().st_mode) for path in found}
        assert {path.suffix for path in found} >= {".rearm", ".near", ".log"}
        assert {path: oct(mode) for path, mode in modes.items() if mode & 0o077} == {}
        (record,) = out.glob("*.mcap")
        assert stat.S_IMODE(record.stat().st_mode) == 0o640
    finally:
        assert cli.main(["down", "--run-dir", str(run_dir)]) == 0
