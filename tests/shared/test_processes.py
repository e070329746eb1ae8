"""Each process's priority and processors, and the planner's end as its joint services see it."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shared import scheduling
from shared.joints import MODULES
from shared.places import CHECKOUT, FILES
from shared.planner_life import OwnLife, PlannerLife, if_possible, path_of
from shared.scheduling import SLICE_NS, TABLE, TIMER_SLACK_NS, half_of
from tests.waiting import comes_true
from tools.fleet.process_table import TABLE as PROCESSES
from tools.fleet.process_table import load_table

READ_BACK = """
from pathlib import Path
from shared.scheduling import short_slice
print(short_slice())
print(Path("/proc/self/timerslack_ns").read_text().strip())
"""


def said(script: str, env: dict[str, str] | None = None) -> list[str]:
    """Return the lines that a process of its own prints."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
    return done.stdout.splitlines()


def test_a_short_slice_and_exact_timers_need_no_privilege() -> None:
    granted, slack = said(READ_BACK)
    assert slack == str(TIMER_SLACK_NS)
    assert f"timer slack {TIMER_SLACK_NS} ns" in granted
    if "slice" not in granted.replace("timer slack", ""):
        pytest.skip("this kernel takes no slice by sched_setattr")
    assert f"slice {SLICE_NS} ns" in granted


def test_every_process_has_a_row_and_what_a_step_needs_first_the_higher_priority() -> None:
    """The gateway to ROS 2 is off the control path: it is nicer than all others."""
    assert {row.kind for row in load_table(PROCESSES).process} - {"ros2_gateway"} == set(TABLE)
    order = ("simulator", "joint", "planner", "harness", "recorder")
    priorities = [TABLE[kind].fifo for kind in order]
    assert priorities == sorted(priorities, reverse=True)
    assert len(set(priorities)) == len(order)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_the_halves_are_the_legs_and_no_processor_is_left_out(count: int) -> None:
    processors = list(range(10, 10 + count))
    right, left = (half_of(processors, "joint", name) for name in ("knee_right", "hip_left"))
    assert right | left == set(processors)
    assert not right & left or count == 1
    assert abs(len(right) - len(left)) <= 1
    for module in MODULES:
        half = half_of(processors, "joint", module)
        assert half == (right if module.endswith("right") else left)
    assert half_of(processors, "planner") == half_of(processors, "recorder") == left
    assert half_of(processors, "simulator") == half_of(processors, "harness") == right


def test_threads_of_a_core_stay_in_one_half_and_the_shipped_setting_is_the_doctors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Processors i and i + 4 are the threads of core i."""
    monkeypatch.setattr(scheduling, "_core_of", lambda processor: (0, processor % 4, processor))
    assert half_of(range(8), "harness") == {0, 4, 1, 5}
    assert half_of(range(8), "planner") == {2, 6, 3, 7}
    lines = (FILES / "sysctl/90-xrl.conf").read_text(encoding="utf-8").splitlines()
    assert [line.replace(" ", "") for line in lines if not line.startswith("#")] == [
        scheduling.NO_PAUSE
    ]
    assert scheduling.has_real_time(os.getpid()) is False
    assert scheduling.has_real_time(2**22 + 1) is None


def test_processors_are_kept_awake_by_a_latency_of_0_where_the_kernel_takes_it(
    tmp_path: Path,
) -> None:
    assert scheduling.keep_processors_awake(tmp_path) is None
    file = tmp_path / scheduling.IDLE_LATENCY
    file.parent.mkdir()
    file.touch()
    held = scheduling.keep_processors_awake(tmp_path)
    assert held is not None
    os.close(held)
    assert file.read_bytes() == bytes(4)


@pytest.mark.parametrize(
    ("limit", "capable", "may"),
    [(resource.RLIM_INFINITY, False, True), (1 << 30, True, True), (1 << 30, False, False),
     (0, False, False)],
)  # fmt: skip
def test_memory_is_locked_only_where_no_later_allocation_can_fail_for_it(
    monkeypatch: pytest.MonkeyPatch, limit: int, capable: bool, may: bool
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _kind: (limit, limit))
    monkeypatch.setattr(scheduling, "_has_capability", lambda _bit: capable)
    assert scheduling.may_lock() == may


APPLY = """
import os
from shared import scheduling
before = os.sched_getaffinity(0)
print(scheduling.apply("joint", "hip_left"))
print(os.sched_getaffinity(0) == scheduling.half_of(before, "joint", "hip_left"), len(before))
block = bytearray(50_000_000)
"""


@pytest.mark.parametrize("pinned", ["0", "1"])
def test_a_process_is_pinned_only_where_the_fleets_table_says_so(pinned: str) -> None:
    granted, row = said(APPLY, os.environ | {"XRL_PINNED": pinned})
    same, count = row.split()
    assert ("processors" in granted) == (pinned == "1")
    assert (same == "True") == (pinned == "1" or count == "1")


@pytest.mark.parametrize("first", ["services.planner.planner", "tools.cli"])
def test_linear_algebra_runs_in_one_thread_whatever_is_imported_first(first: str) -> None:
    script = (
        f"import {first}, numpy as np\n"
        "from scipy.linalg import lapack\n"
        "A = np.eye(400)\n"
        "A @ A, lapack.dgetrf(A)\n"
        "import os; print(len(os.listdir('/proc/self/task')))"
    )
    bare = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    assert said(script, bare) == ["1"]


@pytest.mark.parametrize(("may", "granted"), [(True, "SCHED_FIFO 20"), (False, "RLIMIT_RTTIME")])
def test_no_real_time_is_taken_that_the_kernel_would_kill_for(
    may: bool, granted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = [(200_000, resource.RLIM_INFINITY if may else 200_000)]
    taken: list[int] = []

    def set_limit(_kind: int, wanted: tuple[int, int]) -> None:
        if not may:
            raise ValueError("not allowed to raise maximum limit")
        limits.append(wanted)

    monkeypatch.setattr(resource, "getrlimit", lambda _kind: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", set_limit)
    monkeypatch.setattr(scheduling, "short_slice", lambda: "a short slice")
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: taken.append(1))
    assert granted in scheduling.raise_priority(20)
    assert bool(taken) == may


pytestmark = [pytest.mark.system]

PLANNER = """
import sys, time
from pathlib import Path
from shared.planner_life import OwnLife
own = OwnLife(Path(sys.argv[1]))
own.announce(int(sys.argv[2]))
print("up", flush=True)
time.sleep(60)
"""


@contextmanager
def planner(run_dir: Path, session: int) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-c", PLANNER, str(run_dir), str(session)]
    with subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "up\n"
            yield process
        finally:
            process.kill()


def told(life: PlannerLife) -> int:
    """Wait until a session has ended; return it."""
    session = 0

    def ended() -> int:
        nonlocal session
        session = life.ended()
        return session

    assert comes_true(ended)
    return session


def test_each_service_hears_once_of_a_killed_process_and_does_without_shared_memory(
    short_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = PlannerLife(short_dir), PlannerLife(short_dir)
    assert first.ended() == 0, "there is no planner"
    with planner(short_dir, 7) as process:
        assert (first.ended(), second.ended()) == (0, 0)
        process.kill()
        assert (told(first), told(second)) == (7, 7)
        assert (first.ended(), second.ended()) == (0, 0)
    for end in (OwnLife, PlannerLife):
        assert if_possible(end, short_dir) is not None
    path_of(short_dir / "other").mkdir(parents=True)  # in the way
    for end in (OwnLife, PlannerLife):
        assert if_possible(end, short_dir / "other") is None
    words = "a dead planner will be noticed only by the age of its commands"
    assert caplog.text.count(words) == 2


def test_a_planner_that_hangs_is_left_to_the_age_rule_and_one_that_is_gone_is_reported(
    short_dir: Path,
) -> None:
    life = PlannerLife(short_dir)
    with planner(short_dir, 7) as process:
        life.ended()
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        assert life.ended() == 0
    with planner(short_dir, 7) as process:
        process.kill()
    assert told(PlannerLife(short_dir)) == 7


def test_the_next_planner_and_another_session_take_its_place(short_dir: Path) -> None:
    life = PlannerLife(short_dir)
    with planner(short_dir, 7) as process:
        life.ended()
        process.kill()
        assert told(life) == 7
    with planner(short_dir, 9) as process:
        assert life.ended() == 0
        process.kill()
        assert told(life) == 9
    own = OwnLife(short_dir)
    own.announce(10)
    assert life.ended() == 0
    own.announce(11)
    assert life.ended() == 0, "the process goes on in another session"
