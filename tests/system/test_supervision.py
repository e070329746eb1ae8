"""A fleet of stand-ins under the real supervisor: nothing may be left behind, ever."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
from supervisor.states import ProcessStates

from shared.exceptions import FleetError
from shared.places import DEFAULT_CONFIG
from tests.system.waiting import wait_for
from tools import cli
from tools.fleet import procfs, supervise
from tools.fleet import run_dir as run_dir_module
from tools.fleet.run_dir import MARKER
from tools.fleet.supervise import ServiceInfo, SupervisedFleet
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
    files = {name: path.with_name(f"{name}.py") for name in programs}
    for name, program in programs.items():
        files[name].write_text(program, encoding="utf-8")
    rows = [
        f"""
[[process]]
name = {json.dumps(name)}
kind = "planner"
command = ["{{python}}", {json.dumps(str(files[name]))}, "{{config}}", "{{run}}"]
autostart = true
ready = {json.dumps(ready)}
topic = {json.dumps("joint/*/state" if name == "ankle_right" else "")}
stop_signal = "TERM"
stop_s = 1
settle_s = 1
why = "a stand-in"
"""
        for name in programs
    ]
    path.write_text("[environment]\n" + "".join(rows), encoding="utf-8")
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
    def start(programs: dict[str, str] | None = None, **arguments: object) -> SupervisedFleet:
        table = write_table(
            tmp_path / "processes.toml", programs or {"planner": SLEEPER, "harness": SLEEPER}
        )
        return SupervisedFleet.start(DEFAULT_CONFIG, run_dir, table_path=table, **arguments)

    return start


def service(fleet: SupervisedFleet, name: str) -> ServiceInfo:
    return next(row for row in fleet.info() if row.name == name)


def supervisor_pid(fleet: SupervisedFleet) -> int:
    return int(fleet.run.supervisor_pid.read_text(encoding="utf-8"))


def assert_nothing_left(run_dir: Path, pids: Sequence[int]) -> None:
    assert procfs.fleet_pids(run_dir) == set()
    assert all(procfs.is_gone(pid) for pid in pids)
    assert not run_dir.exists() or {path.name for path in run_dir.iterdir()} <= {
        "logs",
        MARKER,
    }


def test_a_stopped_fleet_leaves_no_process_and_no_file(start: Start, run_dir: Path) -> None:
    fleet = start()
    assert [row.state for row in fleet.info()] == ["running", "running"]
    pids = [*fleet.pids().values(), supervisor_pid(fleet)]
    assert set(pids) == procfs.fleet_pids(run_dir)
    fleet.stop()
    assert_nothing_left(run_dir, pids)
    assert not run_dir.exists()


def test_a_killed_service_is_restarted_and_counted(start: Start) -> None:
    fleet = start()
    before = fleet.kill("planner", signal.SIGKILL)
    assert wait_for(lambda: fleet.pids().get("planner", before) != before)
    planner, harness = service(fleet, "planner"), service(fleet, "harness")
    assert (planner.restarts, harness.restarts) == (1, 0)
    assert "SIGKILL" in planner.last_exit


def test_a_service_that_is_not_to_restart_stays_down_until_it_is_started(start: Start) -> None:
    fleet = start(no_restart=frozenset({"planner"}))
    fleet.kill("planner")
    assert wait_for(lambda: service(fleet, "planner").state == "exited")
    time.sleep(1.0)
    assert service(fleet, "planner").pid is None
    fleet.start_service("planner")
    assert wait_for(lambda: service(fleet, "planner").state == "running")


@pytest.mark.usefixtures("signal_handlers")
def test_a_service_that_is_asleep_waits_until_it_is_started(
    start: Start, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = start(not_started=("planner",))
    assert [service(fleet, name).state for name in ("planner", "harness")] == ["stopped", "running"]
    assert cli.main(["start", "planner", "--run-dir", str(run_dir)]) == 0
    assert "planner: started" in capsys.readouterr().out
    assert wait_for(lambda: service(fleet, "planner").state == "running")


def test_a_suspended_service_is_shown_and_resumed(start: Start) -> None:
    fleet = start()
    pid = fleet.kill("planner", signal.SIGSTOP)
    assert wait_for(lambda: service(fleet, "planner").state == "suspended")
    assert fleet.kill("planner", signal.SIGCONT) == pid
    assert wait_for(lambda: service(fleet, "planner").state == "running")
    assert service(fleet, "planner").restarts == 0


@pytest.mark.parametrize("program", [SLEEPER, STUBBORN])
def test_a_suspended_or_stubborn_service_does_not_hold_the_stop(
    start: Start, run_dir: Path, program: str
) -> None:
    fleet = start({"planner": program, "harness": SLEEPER})
    pid = fleet.kill("planner", signal.SIGSTOP)
    fleet.stop()
    assert_nothing_left(run_dir, [pid])


def test_a_suspended_supervisor_does_not_hold_the_stop(start: Start, run_dir: Path) -> None:
    fleet = start()
    pid = supervisor_pid(fleet)
    os.kill(pid, signal.SIGSTOP)
    fleet.stop()
    assert_nothing_left(run_dir, [pid])


@pytest.mark.usefixtures("signal_handlers")
def test_services_outlive_their_supervisor_and_are_shown_signalled_and_ended(
    start: Start,
    run_dir: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """They keep a robot standing, and nothing but a person may end that."""
    fleet = start({"planner": STUBBORN, "harness": SLEEPER})
    pids = fleet.pids()
    where = ["--run-dir", str(run_dir)]
    os.kill(supervisor_pid(fleet), signal.SIGKILL)
    assert wait_for(lambda: bool(fleet.supervision_fault()))
    assert [row.state for row in fleet.info()] == ["unsupervised", "unsupervised"]
    assert cli.main(["status", *where]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "nothing restarts what ends" in shown
    assert fleet.pids() == pids
    with pytest.raises(FleetError, match="processes of a fleet without a supervisor"):
        start()
    assert fleet.pids() == pids, "a refused start ends nothing"
    assert cli.main(["start", "planner", *where]) == 0
    assert "runs already" in capsys.readouterr().out
    assert cli.main(["kill", "harness", *where]) == 0
    assert "nothing restarts what ends" in caplog.text
    assert wait_for(lambda: [row.state for row in fleet.info()] == ["unsupervised", "gone"])
    assert cli.main(["start", "harness", *where]) == 2
    assert cli.main(["down", *where]) == 0
    assert_nothing_left(run_dir, list(pids.values()))


def test_a_start_that_nobody_asked_for_takes_the_place_of_an_unsupervised_fleet(
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


def test_a_fleet_can_start_where_one_was_killed(start: Start, run_dir: Path) -> None:
    start()
    procfs.signal_all(procfs.fleet_pids(run_dir), signal.SIGKILL)
    assert wait_for(lambda: not procfs.fleet_pids(run_dir))
    assert len(start().pids()) == 2


@pytest.mark.usefixtures("signal_handlers")
@pytest.mark.parametrize("disaster", ["full", "removed", "a file in the place of the folder"])
def test_supervision_goes_on_without_a_place_for_its_logs(
    start: Start, run_dir: Path, disaster: str, capsys: pytest.CaptureFixture[str]
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
    assert cli.main(["status", "--run-dir", str(run_dir)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "log lines are lost" in shown
    assert fleet.lost_lines()[1] in shown


@pytest.mark.usefixtures("signal_handlers")
def test_status_says_why_a_service_does_not_come_up(
    start: Start, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = start({"planner": FAILING, "harness": SLEEPER}, disarmed=True)
    assert wait_for(lambda: service(fleet, "planner").restarts > 0)
    assert cli.main(["status", "--run-dir", str(run_dir)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "planner: exit status 3" in shown
    assert "no drive on can0" in shown


def test_the_wait_before_another_start_is_bounded() -> None:
    """After a power cut a planner failed 135 starts, and a mended one waited for minutes."""
    waiting = Service.__new__(Service)
    waiting.state, waiting.backoff = ProcessStates.STARTING, 135
    waiting.config = SimpleNamespace(name="planner")
    waiting.change_state(ProcessStates.BACKOFF)
    assert waiting.delay <= time.time() + BACKOFF_MAX_S


def test_a_start_with_too_few_open_files_says_so(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise.resource, "getrlimit", lambda _limit: (100, 100))
    with pytest.raises(FleetError, match="100 files may be open, and a fleet needs 128"):
        start()


def test_a_start_on_a_full_disk_says_so(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir_module, "free_mib_at", lambda _path: 0.4)
    with pytest.raises(FleetError, match=r"0\.4 MiB free, and a fleet needs 4 MiB"):
        start()


def test_a_second_fleet_in_the_same_directory_is_refused_and_harms_nothing(start: Start) -> None:
    fleet = start()
    before = fleet.pids()
    with pytest.raises(FleetError, match="a fleet is up in"):
        start()
    assert fleet.pids() == before


def test_a_service_that_ends_at_once_fails_the_start_with_its_log(
    start: Start, run_dir: Path
) -> None:
    with pytest.raises(FleetError, match=r"planner ended at once \(exit status 3\)") as failure:
        start({"harness": SLEEPER, "planner": FAILING})
    assert "no drive on can0" in str(failure.value)
    assert_nothing_left(run_dir, [])


def test_a_start_that_nobody_asked_for_ends_nothing_when_a_service_fails(start: Start) -> None:
    """To end the others would idle the drives of those that hold a person."""
    fleet = start({"harness": SLEEPER, "planner": FAILING}, disarmed=True)
    try:
        assert wait_for(lambda: service(fleet, "harness").state == "running")
        before = fleet.pids()["harness"]
        assert wait_for(lambda: service(fleet, "planner").restarts > 0), "it is tried again"
        assert fleet.pids()["harness"] == before
    finally:
        fleet.stop()


def test_a_service_that_never_listens_fails_the_start(run_dir: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "p.toml", {"planner": SLEEPER}, ready="endpoint")
    with pytest.raises(FleetError, match="not up after 2 s: planner"):
        SupervisedFleet.start(DEFAULT_CONFIG, run_dir, table_path=table, timeout_s=2.0)
    assert_nothing_left(run_dir, [])


def test_a_port_in_use_is_refused_before_anything_starts(run_dir: Path, tmp_path: Path) -> None:
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        config = tmp_path / "robot.toml"
        text = text.replace('mode = "local"', 'mode = "open"', 1)
        config.write_text(text.replace("unixsock-stream/{run}/planner.zenoh", endpoint))
        table = write_table(tmp_path / "p.toml", {"planner": SLEEPER})
        with pytest.raises(FleetError, match=f"planner: {endpoint}: port in use"):
            SupervisedFleet.start(config, run_dir, table_path=table)
    assert_nothing_left(run_dir, [])


def up_in_a_process(run_dir: Path, table: Path, *, then: str = "") -> subprocess.Popen[str]:
    """Start a fleet as `xrl up` does, in a process of its own that may be interrupted."""
    code = (
        "import sys, time, tools.cli, tools.verbs.up, tools.fleet.supervise as s\n"
        "from pathlib import Path\n"
        "def run(args):\n"
        f"    s.SupervisedFleet.start(args.config, args.run_dir, table_path=Path({str(table)!r}),"
        f" leashed={bool(then)}, timeout_s=60)\n"
        f"    {then or 'return 0'}\n"
        "tools.verbs.up.run = run\n"
        f"sys.exit(tools.cli.main(['up', '--run-dir', {str(run_dir)!r}]))\n"
    )
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("delay_s", [0.0, 0.4])
def test_an_interrupt_in_the_middle_of_a_start_leaves_nothing(
    run_dir: Path, tmp_path: Path, number: signal.Signals, delay_s: float
) -> None:
    table = write_table(tmp_path / "p.toml", {"planner": SLEEPER}, ready="endpoint")  # never up
    process = up_in_a_process(run_dir, table)
    assert wait_for(lambda: bool(procfs.fleet_pids(run_dir)))
    time.sleep(delay_s)
    pids = procfs.fleet_pids(run_dir)
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + number
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


@pytest.fixture
def signal_handlers() -> Iterator[None]:
    """Put back what `cli.main` changes in this process."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signal_handlers")
def test_status_shows_mode_tier_age_and_rate(
    start: Start, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = start({"ankle_right": JOINT, "planner": SLEEPER})
    assert cli.main(["status", "--json", "--run-dir", str(run_dir)]) == 0
    status = json.loads(capsys.readouterr().out)
    ankle = status["services"]["ankle_right"]
    assert ankle["pid"] == fleet.pids()["ankle_right"]
    assert ankle["state"] == "running"
    assert 20 < ankle["rate_hz"] < 150
    assert 0 <= ankle["age_s"] < 1
    assert status["modules"]["ankle_right"] == {
        "mode": "HOLD", "tier": 2, "cause": "NONE", "drive": "ARMED", "q": [0.0, 0.0],
        "way_out": "", "stiffened": False, "outside": "", "session": 0, "refusals": [],
        "stopped_by": "",
    }  # fmt: skip
    assert status["services"]["planner"]["rate_hz"] is None
    assert cli.main(["status", "--run-dir", str(run_dir)]) == 0
    assert "ankle_right" in capsys.readouterr().out


@pytest.mark.usefixtures("signal_handlers")
def test_kill_and_down_work_from_the_command_line(
    start: Start, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = start()
    pids = list(fleet.pids().values())
    where = ["--run-dir", str(run_dir)]
    assert cli.main(["kill", "plannr", *where]) == 2
    assert "one of planner, harness" in capsys.readouterr().err
    assert cli.main(["kill", "planner", "--signal", "STOP", *where]) == 0
    assert wait_for(lambda: service(fleet, "planner").state == "suspended")
    assert cli.main(["down", *where]) == 0
    assert_nothing_left(run_dir, pids)


@pytest.mark.usefixtures("signal_handlers")
def test_top_hz_and_echo_show_what_the_services_send(
    start: Start, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = start({"ankle_right": JOINT, "planner": SLEEPER})
    place = ["--run-dir", str(run_dir)]
    assert cli.main(["topic", "hz", "joint/ankle_right/state", "--for", "1", *place]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "ankle_right" in line)
    assert row.split()[1].endswith("/250"), "the rate, and the nominal one"
    assert 20 < float(row.split()[1].removesuffix("/250")) < 150
    assert cli.main(["topic", "hz", "planner/status", "--for", "0.2", *place]) == 3, "nothing came"
    capsys.readouterr()

    words = ["topic", "echo", "joint/*/state", "--count", "2", "--field", "mode", "--field", "seq"]
    assert cli.main([*words, "--json", *place]) == 0
    first, second = map(json.loads, capsys.readouterr().out.splitlines())
    assert first["topic"] == "joint/ankle_right/state"
    assert second["seq"] == first["seq"] + 1, "none is lost"
    assert set(first) == {"topic", "mode", "seq"}
    assert cli.main([*words, *place]) == 0
    assert "mode: HOLD (1)" in capsys.readouterr().out

    assert cli.main(["status", "--watch", "--traffic", "--once", *place]) == 0
    shown = capsys.readouterr().out
    assert str(fleet.pids()["ankle_right"]) in shown
    assert "joint/ankle_right/state" in shown
    assert "planner/status" not in shown, "on which nothing has come"
