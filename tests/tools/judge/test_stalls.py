"""A machine that stands still: found, told once, recorded, and judged apart."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from shared import scheduling
from shared.bus import topics
from shared.bus.messages import (
    Cause,
    JointEvent,
    JointState,
    Mode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
)
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S, now_ns
from shared.joints import MODULES
from tests.shared.mcap_log.runs import sample
from tests.tools.logs.test_impairment_intervals import judged, shown
from tools.fleet.stall_watch import ANY_CORE, Gap
from tools.judge import verdict, verdict_table
from tools.judge.stalls import (
    ALL,
    CATCH_UP_NS,
    EXCUSED_MAX_NS,
    MACHINE,
    SERVICES,
    SIMULATOR,
    Disturbance,
    Stall,
    disturbances,
    drop_outs,
    stalls_of,
)
from tools.judge.standing import LIMITS
from tools.live.live_stalls import (
    A_THREAD,
    MERGE_NS,
    CommonSilence,
    LiveStalls,
    StallFinder,
    merged,
)
from tools.logs.run_log import RunLog, RunPart

CYCLE_MS = 4


def ms(value: float) -> int:
    return round(value * NS_PER_MS)


def states_of(stops_ms: Sequence[tuple[float, float]], until_ms: int = 400) -> list[JointState]:
    """Return the states of a module that sends every 4 ms, except while it is stopped."""
    sent, t = [], 0.0
    while t < until_ms:
        stop = next(((a, b) for a, b in stops_ms if a <= t < b), None)
        t = stop[1] if stop else t
        sent.append(sample(JointState, t_ns=ms(t), seq=len(sent) + 1, cycle=2 * len(sent)))
        t += CYCLE_MS
    return sent


def found_in(states: dict[str, list[JointState]], every: int = 1) -> list[Stall]:
    silences = CommonSilence()
    rows = [(module, state) for module, sent in states.items() for state in sent[::every]]
    rows.sort(key=lambda row: row[1].t_ns)
    stalls = (silences.feed(module, state) for module, state in rows)
    return [stall for stall in stalls if stall is not None]


@pytest.mark.parametrize("every", [1, 3], ids=["each state is seen", "one of three is seen"])
def test_a_time_in_which_no_module_sends_is_a_stall_of_the_services(every: int) -> None:
    states = {module: states_of([(100 + i, 180 + i)]) for i, module in enumerate(MODULES)}
    (stall,) = found_in(states, every)
    assert stall.who == SERVICES
    assert stall.lasted_ms == pytest.approx(80, abs=3 * CYCLE_MS + 4 * (every - 1) * CYCLE_MS)
    assert stall.begin_ns == pytest.approx(ms(100), abs=ms(2 * every * CYCLE_MS))


def test_a_module_that_died_long_before_has_no_part_in_a_stall() -> None:
    states = {module: states_of([(1900, 1980)], 2400) for module in MODULES[1:]}
    states[MODULES[0]] = states_of([], 400)
    assert len(found_in(states)) == 1


def all_but(silent: Sequence[str]) -> dict[str, list[JointState]]:
    """While one module sends, nothing stands still."""
    return {module: states_of([(100, 180)] if module in silent else []) for module in MODULES}


def one_after_the_other() -> dict[str, list[JointState]]:
    return {m: states_of([(100 + 50 * i, 140 + 50 * i)]) for i, m in enumerate(MODULES)}


def started_again() -> dict[str, list[JointState]]:
    """Return the states of services that count from one again."""
    later = [sample(JointState, t_ns=ms(900 + 4 * i), seq=i, cycle=2 * i) for i in range(20)]
    return {module: [*states_of([])[:50], *later] for module in MODULES}


def silent_drives() -> dict[str, list[JointState]]:
    """Return the states of services that run on, and repeat the stamp of the last sample."""
    states = {module: states_of([], 100) for module in MODULES}
    for sent in states.values():
        last = sent[-1]
        for _ in range(20):  # 100 ms
            sent.append(structs.replace(sent[-1], seq=sent[-1].seq + 1, cycle=sent[-1].cycle + 1))
        after = sent[-1].cycle + 1
        sent += [structs.replace(last, t_ns=ms(200 + 4 * i), cycle=after + 2 * i) for i in range(9)]
    return states


@pytest.mark.parametrize(
    "states",
    [partial(all_but, MODULES[:5]), partial(all_but, MODULES[:1]), partial(all_but, ()),
     one_after_the_other, started_again, silent_drives],
    ids=["one sends", "five send", "all send", "silences one after the other",
         "services start again", "drives are silent"],
)  # fmt: skip
def test_what_is_no_stall_of_the_services(
    states: Callable[[], dict[str, list[JointState]]],
) -> None:
    assert found_in(states()) == []


def test_a_world_that_sends_no_truth_is_a_stall_of_the_simulator() -> None:
    finder = StallFinder(2, list)
    for seq, t_ms in enumerate([0, 10, 20, 142, 150, 160, 180, 190]):  # one of them is not seen
        finder.see(sample(SimTruth, t_ns=ms(t_ms), seq=seq + (t_ms >= 180)))
    (stall,) = finder.take(ms(300), 1.0)
    assert stall == Stall(ms(20), ms(142), SIMULATOR)


def test_a_world_that_is_slow_all_the_time_does_not_stand_still_all_the_time() -> None:
    finder = StallFinder(2, list)
    for seq in range(40):
        finder.see(sample(SimTruth, t_ns=ms(34 * seq), seq=seq))
    assert len(finder.rest()) == 1


A = Stall(ms(100), ms(160), "core 0")


A_THREADS, OF_SERVICES, OF_THE_WORLD = (
    A._replace(who=who) for who in (A_THREAD, SERVICES, SIMULATOR)
)


@pytest.mark.parametrize(
    ("stalls", "cores", "who"),
    [
        ([A], 2, "core 0"),
        ([A, A._replace(who="core 1")], 2, MACHINE),
        ([A, A._replace(who="core 1")], 4, "cores 0, 1"),
        ([A, A._replace(who="core 1", begin_ns=ms(160), end_ns=ms(230))], 2, "cores 0, 1"),
        ([A], 1, MACHINE),
        ([A, A_THREADS], 2, "core 0"),
        ([A, OF_SERVICES._replace(end_ns=ms(190))], 2, "core 0"),
        ([A, A._replace(who=MACHINE)], 2, MACHINE),
        ([A, OF_THE_WORLD], 2, "core 0"),
        ([OF_SERVICES, OF_THE_WORLD], 2, ALL),
        ([A_THREADS, OF_SERVICES], 2, SERVICES),
    ],
)
def test_what_overlaps_is_one_stall_of_all_that_stood_still(
    stalls: list[Stall], cores: int, who: str
) -> None:
    (stall,) = merged(stalls, cores)
    assert stall.who == who
    assert stall.end_ns == max(row.end_ns for row in stalls)


def test_a_thread_without_real_time_tells_nothing_alone() -> None:
    assert merged([A_THREADS], 2) == []


def test_stalls_that_follow_each_other_closely_are_told_while_they_come() -> None:
    gaps: list[Gap] = []
    finder = StallFinder(2, lambda: [gaps.pop()] if gaps else [])
    told = []
    for t_ms in range(1000, 2000, 5):
        if t_ms % 45 == 0:
            gaps.append(Gap(ms(t_ms), ms(22), 0, 0))
        told += finder.take(ms(t_ms), 1.0)
    assert len(told) > 15
    assert len(told) + len(finder.rest()) == 22


def test_what_does_not_overlap_are_stalls_of_their_own() -> None:
    later = A._replace(begin_ns=ms(170), end_ns=ms(200))
    assert merged([later, A], 2) == [A, later]


def test_a_live_stall_is_told_once_whatever_finds_it() -> None:
    gaps = [Gap(ms(180), ms(76), core, ms(70)) for core in (0, 1)]
    finder = StallFinder(2, lambda: [gaps.pop()] if gaps else [])
    told = []
    for state in states_of([(100, 182)]):
        for module in MODULES:
            finder.hear(module, state)
        told += finder.take(state.t_ns, 1.0) if state.t_ns > ms(180) else []
    (stall,) = told
    assert (stall.who, stall.stolen_ms) == (MACHINE, 70.0)
    assert stall.words == "the machine stood still for 84 ms, 70 ms taken by its host"


def test_in_slow_motion_a_stall_is_as_long_as_the_fleets_clock_says() -> None:
    gaps = [Gap(ms(1000), ms(80), ANY_CORE, 0)]
    finder = StallFinder(2, lambda: [gaps.pop()] if gaps else [])
    assert finder.take(ms(500), 0.5) == []
    (stall,) = finder.take(ms(500) + MERGE_NS, 0.5)
    assert stall == Stall(ms(460), ms(500), MACHINE)


def test_the_live_line_tells_who_held_by_a_stall_and_forgets_it_after_moments() -> None:
    live = LiveStalls()
    track, hold = [int(Mode.TRACK)] * 6, [int(Mode.HOLD)] * 6
    assert live.words(hold) == ""
    now = now_ns()
    live.found.append(Stall(now - ms(63), now, MACHINE))
    words = "the machine stood still for 63 ms"
    assert live.words([]) == words, "they hold for another reason"
    assert live.words(track) == words
    assert live.words([*hold[:2], *track[2:]]) == f"{words}: 2 hold"
    assert live.words(hold) == f"{words}: all six hold"
    assert live.words(track) == f"{words}: all six held"
    live.found.append(Stall(now - 3 * NS_PER_S, now - round(2.5 * NS_PER_S), MACHINE))
    assert live.words(hold) == ""


def test_what_stands_still_before_the_modules_track_is_no_stall() -> None:
    live = LiveStalls()
    for state in states_of([(100, 250)]):
        for module in MODULES:
            live.hear(module, state)
    assert live.take() == []
    live.begin()
    now = now_ns()
    for module in MODULES:
        for after_ns, cycle in ((0, 1), (ms(80), 2)):
            live.hear(module, sample(JointState, t_ns=now + after_ns, seq=cycle, cycle=cycle))
    deadline = time.monotonic() + 10.0
    while not live.found and time.monotonic() < deadline:
        live.take()
    assert [stall.who for stall in live.found] == [SERVICES]


def test_how_the_machine_carries_the_fleet_is_told_with_its_stalls() -> None:
    live = LiveStalls()
    assert live.describe_machine(0.24) == f"{live.cores} cores, 24 % idle beside the fleet"
    live.found += [Stall(0, ms(41), MACHINE), Stall(ms(60), ms(90), MACHINE)]
    words = live.describe_machine(0.31)
    assert words.endswith("; 2 stalls so far, 41 ms at most")


@pytest.mark.parametrize(
    ("real_time", "idle", "told"), [(True, 0.19, True), (True, 0.2, False), (False, 0.1, False)]
)
def test_a_nearly_full_machine_says_that_the_kernel_stops_a_core_that_real_time_fills(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, real_time: bool, idle: float, told: bool
) -> None:
    monkeypatch.setattr(scheduling, "has_real_time", lambda _pid: real_time)
    monkeypatch.setattr(scheduling, "real_time_pause_ms", lambda: 50.0)
    live = LiveStalls()
    with live.watched(tmp_path / "gaps"):
        words = live.describe_machine(idle)
    assert ("the kernel stops for 50 ms in each second: `sudo sysctl kernel." in words) == told


@given(
    st.integers(ms(1e5), ms(1e9)),
    st.integers(ms(20), ms(9e4)),
    st.sampled_from([MACHINE, "core 3"]),
)
def test_an_event_in_the_record_gives_the_stall_again(end_ns: int, long_ns: int, who: str) -> None:
    stall = Stall(end_ns - long_ns, end_ns, who, 30.0)
    (found,) = stalls_of([stall.event(1, 0)])
    assert found.begin_ns == pytest.approx(stall.begin_ns, abs=ms(0.051))
    assert found[1:] == stall[1:]


@pytest.mark.parametrize(
    "detail",
    ["", "63 ms", "x ms, stolen 0 ms", "inf ms, stolen 0 ms", "-5 ms, stolen 0 ms",
     "63 ms, stolen nan ms"],
)  # fmt: skip
def test_a_stall_in_other_words_is_left_out(detail: str) -> None:
    event = A.event(1, 0)
    assert stalls_of([sample(RunEvent, kind=int(RunEventKind.STALLED), detail=detail)]) == []
    assert len(stalls_of([event])) == 1


@dataclass
class Log:
    """The events of a run."""

    run: list[RunEvent]
    joints: dict[str, list[JointEvent]] = field(default_factory=dict)
    planner: list[PlannerStatus] = field(default_factory=list)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        if topic is topics.PLANNER_STATUS:
            return self.planner
        return self.run if topic is topics.RUN_EVENT else self.joints.get(module, [])


def change(t_ms: float, before: Mode, after: Mode) -> JointEvent:
    cause = Cause.COMMAND_STALE if before is Mode.TRACK else Cause.COMMANDS_FRESH
    return sample(
        JointEvent, t_ns=ms(t_ms), mode_before=int(before), mode_after=int(after), cause=int(cause)
    )


def held(from_ms: float, to_ms: float) -> list[JointEvent]:
    return [change(from_ms, Mode.TRACK, Mode.HOLD), change(to_ms, Mode.HOLD, Mode.TRACK)]


def lines(log: Any, rows: list[Disturbance]) -> list[str]:
    return drop_outs(log, rows, 0, 0, 5 * NS_PER_S)


def test_a_hold_by_a_stall_is_apart_until_the_robot_has_caught_up() -> None:
    log: Any = Log([A.event(1, 0)], {MODULES[0]: held(170, 600), MODULES[1]: held(172, 640)})
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert (row.begin_ns, row.held_until_ns, row.held) == (A.begin_ns, ms(640), 2)
    assert row.end_ns == ms(640) + CATCH_UP_NS
    assert lines(log, [row]) == []


@pytest.mark.parametrize(
    ("event", "changes"),
    [
        (A.event(1, 0), held(900, 1400)),
        (A._replace(begin_ns=ms(135)).event(1, 0), held(170, 600)),
        (A._replace(who=SERVICES).event(1, 0), held(170, 600)),
    ],
    ids=["long after it", "it was too short", "the joint services stood still alone"],
)
def test_a_hold_that_no_stall_explains_is_judged_and_told(
    event: RunEvent, changes: list[JointEvent]
) -> None:
    log: Any = Log([event], dict.fromkeys(MODULES, changes))
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert (row.held_until_ns, row.held) == (None, 0)
    assert row.end_ns < ms(200)
    (line,) = lines(log, [row])
    assert line.endswith("s: all six held without a stall; the planner sent nothing any more")


@pytest.mark.parametrize("into", [Mode.FAULT, Mode.DAMP])
def test_a_fault_or_a_stop_right_after_a_stall_is_not_its_doing(into: Mode) -> None:
    log: Any = Log([A.event(1, 0)], {MODULES[0]: [change(170, Mode.TRACK, into)]})
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert row.held == 0


def test_a_request_of_the_planner_to_hold_alone_is_not_a_stalls_doing() -> None:
    """It may have tripped."""
    asked = structs.replace(change(170, Mode.TRACK, Mode.HOLD), cause=int(Cause.HOLD_ALL))
    log: Any = Log([A.event(1, 0)], {MODULES[0]: [asked]})
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert row.held == 0
    log.joints[MODULES[1]] = held(172, 640)
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert row.held == 2, "one got no command in time, so the others were asked"


def test_a_second_hold_while_the_robot_catches_up_is_told() -> None:
    log: Any = Log([A.event(1, 0)], {MODULES[0]: [*held(170, 600), *held(900, 1400)]})
    rows = disturbances(log, 0, 5 * NS_PER_S)
    (line,) = lines(log, rows)
    assert line.startswith("0.90 s: ")


def test_modules_that_do_not_track_again_are_excused_for_some_seconds_only() -> None:
    log: Any = Log([A.event(1, 0)], {MODULES[0]: [change(170, Mode.TRACK, Mode.HOLD)]})
    (row,) = disturbances(log, 0, 60 * NS_PER_S)
    assert (row.held_until_ns, row.held) == (None, 1)
    assert row.end_ns == A.end_ns + EXCUSED_MAX_NS


@pytest.mark.parametrize(
    ("sent_ms", "words"),
    [
        ((800, 804, 808, 871, 875), "the planner sent nothing for 63 ms"),
        ((400, 804, 1300), "the planner sent nothing for 496 ms"),
        ((800, 804), "the planner sent nothing any more"),
        ((852, 856, 860, 864, 868), "no stall was measured then"),
    ],
)
def test_a_planner_that_was_silent_is_named_and_not_excused(
    sent_ms: tuple[int, ...], words: str
) -> None:
    sent = [sample(PlannerStatus, t_ns=ms(t)) for t in sent_ms]
    log: Any = Log([], {MODULES[2]: held(862, 1400)}, sent)
    assert lines(log, []) == [f"0.86 s: {MODULES[2]} held without a stall; {words}"]


@pytest.mark.parametrize("kind", [RunEventKind.KILLED, RunEventKind.FAULTED])
@pytest.mark.parametrize("at_ms", [95, 165])
def test_after_a_kill_or_a_fault_nothing_is_excused(kind: RunEventKind, at_ms: int) -> None:
    event = sample(RunEvent, t_ns=ms(at_ms), kind=int(kind))
    log: Any = Log([A.event(1, 0), event], {MODULES[0]: held(170, 900)})
    (row,) = disturbances(log, 0, 5 * NS_PER_S)
    assert row.held == 0


def test_what_a_stall_made_is_apart_in_the_next_part_of_a_run_too() -> None:
    log: Any = Log([A.event(1, 0)], {MODULES[0]: held(170, 600)})
    (row,) = disturbances(log, ms(700), 5 * NS_PER_S)
    assert row.end_ns == ms(600) + CATCH_UP_NS
    assert disturbances(log, 3 * NS_PER_S, 5 * NS_PER_S) == []


def test_figures_leave_out_what_a_stall_made_of_a_run_and_a_line_tells_it(log: RunLog) -> None:
    """The planner is dead from 1 to 1.8 s while the hand leads down: as if all had stood still."""
    until_s = (verdict.course(log).zero_ns - log.began_ns()) / 1e9 + 3.15  # before the fault
    part = RunLog(log.index, RunPart(0.0, until_s))
    events = part.messages(topics.RUN_EVENT)
    (stop,) = (row for row in events if row.kind == RunEventKind.KILLED)
    kept = [row for row in events if row.kind == RunEventKind.STARTED]
    zero_ns = round(stop.t_ns - stop.scenario_s * NS_PER_S)
    stall = Stall(stop.t_ns, stop.t_ns + ms(80), MACHINE)
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
    assert apart.drop_outs == []
    (row,) = apart.stalls
    assert row["modules_held"] == 6
    assert row["operator_peak_n"] == pytest.approx(without.operator_peak_n)
    assert "the machine stood still for 80 ms: all six held until" in row["said"]
    words = shown(apart)
    assert row["said"] in words
    assert "leave out what a stall made of the run" in words


@pytest.mark.parametrize(
    ("factor", "late_s", "stalls_ms", "kept_up"),
    [
        (1.0, 0.0, [], True),
        (0.98, 0.2, [], False),
        (0.98, 0.2, [200], True),  # 10 s of the world in 10.2 s of the clock
        (0.98, 0.2, [60], False),
        (0.999, 0.01, [25], True),
    ],
)
def test_a_world_that_stood_still_kept_up_while_it_ran(
    factor: float, late_s: float, stalls_ms: list[int], kept_up: bool
) -> None:
    last = sample(SimTruth, scenario_s=10.0, real_time_factor=factor, late_s=late_s)
    stalls = [Stall(0, ms(lasted), MACHINE) for lasted in stalls_ms]
    assert verdict._in_real_time(last, stalls) is kept_up


def test_messages_lost_in_a_stall_name_it_and_stalls_without_effect_share_a_line() -> None:
    row = {"said": "6.58 s: x", "modules_held": 0, "messages_lost": 2, "lasted_ms": 63.0}
    quiet = [row | {"messages_lost": 0, "lasted_ms": length} for length in (21.0, 34.0)]
    summary = judged(sequence_gaps=2, stalls=[row, *quiet], across_stalls=["sequence_gaps"])
    words = shown(summary)
    assert re.search(r"messages lost on the way .* in a stall", words)
    assert "6.58 s: x\n2 more stalls were without consequence: 34 ms at most\n" in words
    assert "does not decide" not in words
