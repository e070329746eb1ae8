"""A machine that stalls: measured, recorded, and judged apart."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from shared import scheduling
from shared.bus import topics
from shared.bus.messages import Cause, JointEvent, Mode, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S, now_ns
from shared.joints import MODULES
from tests.messages import sample
from tests.tools.logs.test_impairment_intervals import judged, shown
from tools.fleet import stalls
from tools.fleet.stalls import APART_NS, Disturbance, Stall, StallWatch, disturbances, stalls_of
from tools.judge import verdict, verdict_table
from tools.judge.standing import LIMITS
from tools.judge.verdict import ShownStall
from tools.live.scenario_runner import STARTING, ScenarioRunner, describe_machine
from tools.logs.run_log import RunLog, RunPart

WATCH = """
import sys, time
from tools.fleet.stalls import StallWatch
with StallWatch() as watch:
    time.sleep(0.2)
    watch.take()
    print("ready", flush=True)
    sys.stdin.readline()
    time.sleep(0.05)
    print(max(watch.take(), key=lambda stall: stall.lasted_ms).lasted_ms)
"""


def ms(value: float) -> int:
    return round(value * NS_PER_MS)


A = Stall(ms(100), ms(160))


def test_a_stall_is_measured_as_long_as_it_was() -> None:
    pipe = subprocess.PIPE
    words = [sys.executable, "-c", WATCH]
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        os.kill(process.pid, signal.SIGSTOP)  # what a machine that stalls does to all
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGCONT)
        told, _ = process.communicate("\n", timeout=20)
    assert float(told) > 250.0


def test_in_slow_motion_a_stall_is_as_long_as_the_fleets_clock_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watch = StallWatch()
    watch._gaps += [(ms(920), ms(1000)), (ms(1100), ms(1130))]  # the second is of 15 ms
    monkeypatch.setattr(stalls, "pace", lambda: 0.5)
    assert watch.take() == [Stall(ms(460), ms(500))]
    assert watch.take() == []


def test_the_live_line_marks_a_stall_and_forgets_it_after_moments() -> None:
    runner = object.__new__(ScenarioRunner)
    runner._stalls, runner._killed, runner._note = StallWatch(), False, ""
    assert runner._stall_words() == ""
    now = now_ns()
    runner._stalls._gaps += [(now - ms(93), now - ms(30))]
    runner._stalls.take()
    for held in (2, 6, 0):
        runner._stalls.note_held(held)
    runner._stalls._gaps += [(now - ms(26), now)]
    runner._stalls.take()
    words = "the machine stalled for 63 ms"
    assert runner._stall_words() == f"{words}: all six held", "though they track again"
    runner._killed = True
    assert runner._stall_words() == words, "they hold for another reason"
    runner._note = STARTING
    assert runner._stall_words() == "", "services that start take the machine's time"
    runner._note = ""
    runner._stalls.longest = Stall(now - 3 * NS_PER_S, now - round(2.5 * NS_PER_S))
    assert runner._stall_words() == ""


@pytest.mark.parametrize(("idle", "told"), [(0.19, True), (0.2, False)])
def test_a_nearly_full_machine_says_that_the_kernel_stops_a_core_that_real_time_fills(
    monkeypatch: pytest.MonkeyPatch, idle: float, told: bool
) -> None:
    monkeypatch.setattr(scheduling, "real_time_pause_ms", lambda: 50.0)
    words = describe_machine(idle)
    assert f" cores, {100 * idle:.0f} % idle beside the fleet" in words
    assert ("for 50 ms in each second; to prevent that, run `sudo sysctl kernel." in words) == told


@given(st.integers(ms(1e5), ms(1e9)), st.integers(ms(20), ms(9e4)))
def test_an_event_in_the_record_gives_the_stall_again(end_ns: int, long_ns: int) -> None:
    (found,) = stalls_of([Stall(end_ns - long_ns, end_ns).event(1, 0)])
    assert found.end_ns == end_ns
    assert found.begin_ns == pytest.approx(end_ns - long_ns, abs=ms(0.051))


@pytest.mark.parametrize("detail", ["", "x ms", "inf ms", "-5 ms", "nan ms", "1e300 ms"])
def test_a_stall_in_other_words_is_left_out(detail: str) -> None:
    event = sample(RunEvent, kind=int(RunEventKind.STALLED), detail=detail)
    assert stalls_of([event]) == []


def change(t_ms: float, cause: Cause, after: Mode = Mode.HOLD) -> JointEvent:
    found: JointEvent = sample(
        JointEvent, t_ns=ms(t_ms), mode_before=int(Mode.TRACK), mode_after=int(after),
        cause=int(cause),
    )  # fmt: skip
    return found


STALE = change(170, Cause.COMMAND_STALE)
HELD: dict[str, tuple[Stall, list[JointEvent], int]] = {
    "one by itself": (A, [STALE], 1),
    "the others were asked": (A, [STALE, change(172, Cause.HOLD_ALL)], 2),
    "the planner asked all: it may have tripped": (A, [change(170, Cause.HOLD_ALL)], 0),
    "long after it": (A, [change(900, Cause.COMMAND_STALE)], 0),
    "it was too short": (A._replace(begin_ns=ms(135)), [STALE], 0),
    "a fault": (A, [change(170, Cause.COMMAND_STALE, Mode.FAULT)], 0),
    "a stop": (A, [change(170, Cause.COMMAND_STALE, Mode.DAMP)], 0),
}


@pytest.mark.parametrize("case", HELD)
def test_what_a_stall_made_is_apart_and_what_it_does_not_explain_is_judged(case: str) -> None:
    stall, changes, held = HELD[case]
    (row,) = disturbances([stall.event(1, 0)], changes, 5 * NS_PER_S)
    assert (row.stall, row.held) == (stall, held)
    assert row.end_ns == stall.end_ns + (APART_NS if held else stalls.PERIOD_NS)


@pytest.mark.parametrize("kind", [RunEventKind.KILLED, RunEventKind.FAULTED])
@pytest.mark.parametrize(("at_ms", "held"), [(95, 0), (165, 0), (900, 1)])
def test_after_a_kill_or_a_fault_nothing_is_excused(
    kind: RunEventKind, at_ms: int, held: int
) -> None:
    event = sample(RunEvent, t_ns=ms(at_ms), kind=int(kind))
    (row,) = disturbances([A.event(1, 0), event], [STALE], 5 * NS_PER_S)
    assert row.held == held
    assert row.end_ns <= max(ms(at_ms), A.end_ns + stalls.PERIOD_NS)


def test_figures_leave_out_what_a_stall_made_of_a_run_and_a_line_tells_it(log: RunLog) -> None:
    """The planner is dead from 1 to 1.8 s while the hand leads down: as if the machine stalled."""
    until_s = (verdict.course(log).zero_ns - log.began_ns()) / 1e9 + 3.15  # before the fault
    part = RunLog(log.index, RunPart(0.0, until_s))
    events = part.messages(topics.RUN_EVENT)
    (stop,) = (row for row in events if row.kind == RunEventKind.KILLED)
    kept = [row for row in events if row.kind == RunEventKind.STARTED]
    zero_ns = round(stop.t_ns - stop.scenario_s * NS_PER_S)
    stall = Stall(stop.t_ns, stop.t_ns + ms(80))
    series = part._series[topics.RUN_EVENT.key(part.robot)]
    series.decoded = [*kept]
    for module in MODULES:
        part._series[topics.JOINT_EVENT.key(part.robot, module)].decoded = [
            structs.replace(row, cause=int(Cause.COMMAND_STALE))
            if row.cause == Cause.PLANNER_ENDED
            else row
            for row in part.messages(topics.JOINT_EVENT, module)
        ]
    without = verdict.summarise(part, 3.1)
    series.decoded = [*kept, stall.event(9, zero_ns)]
    apart = verdict.summarise(part, 3.1)
    (force,) = (row for row in LIMITS if row.key == "operator_peak_n")
    assert verdict_table.mark(force, without) == "over"
    assert verdict_table.mark(force, apart) == "ok"
    (row,) = apart.stalls
    assert row.modules_held == 6
    assert row.said.endswith(" s: the machine stalled for 80 ms: all six held")
    words = shown(apart)
    assert row.said in words
    assert "exclude the consequences of stalls" in words


def test_stalls_without_effect_share_a_line() -> None:
    quiet = [ShownStall(0.0, length, 0.0, 0, "") for length in (21.0, 34.0)]
    words = shown(judged(stalls=quiet))
    assert "Stalls of the machine without consequence: 2, at most 34 ms\n" in words


@pytest.mark.parametrize(
    ("factor", "late_s", "stalled_s", "kept_up"),
    [
        (1.0, 0.0, 0.0, True),
        (0.98, 0.2, 0.0, False),
        (0.98, 0.2, 0.2, True),  # 10 s of the world in 10.2 s of the clock
        (0.98, 0.2, 0.06, False),
        (0.999, 0.01, 0.025, True),
    ],
)
def test_a_world_that_stood_still_kept_up_while_it_ran(
    factor: float, late_s: float, stalled_s: float, kept_up: bool
) -> None:
    last = sample(SimTruth, scenario_s=10.0, real_time_factor=factor, late_s=late_s)
    assert verdict._in_real_time(last, stalled_s) is kept_up


def test_a_disturbance_is_apart_from_its_begin_to_its_end() -> None:
    row = Disturbance(A, ms(200), 1)
    times_ns = np.array([ms(t) for t in (99, 100, 160, 200, 201)])
    assert stalls.inside([row], times_ns).tolist() == [False, True, True, True, False]
