"""Timing panels, grouped rows of the timeline, network impairments."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.messages import DriveStatus, PlannerMode, Trip
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_S
from shared.config.impairment import Direction, Impairment
from shared.joints import MODULES
from shared.links import DIRECTIONS, WRENCHES
from shared.network.impairment_schedule import ImpairmentSchedule
from tests.tools.judge.reports import runs
from tools.judge.reports import times
from tools.judge.reports.page import render
from tools.judge.reports.panels import ImpairedLink, histories
from tools.judge.reports.run_data import RunData
from tools.judge.reports.timeline import timeline_events
from tools.logs.run_log import RunLog


def test_the_rate_of_control_cycles_is_that_of_the_service(page: str) -> None:
    for module in MODULES:
        _, rate = runs.line(runs.data_of(page), "Control cycles of each service", module)
        assert np.abs(rate - 500.0).max() < 10.0


def test_late_cycles_are_counted_from_arming_and_across_a_restart(log: RunLog) -> None:
    armed_s = RunData(log).armed_s()

    def late(t: float, state: dict[str, Any]) -> None:
        """40 late cycles at the start, then one in 0.1 s; a restart at 2 s resets the count."""
        since = max(0.0, t - armed_s)
        state["late"] = 40 + int(10.0 * since) if t < 2.0 else int(10.0 * (t - 2.0))

    data = runs.drawn(runs.changed(log, {"joint/hip_right/state": late}), times.times)
    _, counted = runs.line(data, "Late control cycles", "hip_right")
    assert counted[0] == 0.0
    assert counted[-1] == pytest.approx(10.0 * (4.0 - armed_s), abs=3.0)
    assert (np.diff(counted[np.isfinite(counted)]) >= 0.0).all()


def test_panels_without_data_are_left_out_and_listed_with_the_reason(page: str) -> None:
    for line in (
        "Injected network impairments: no impairment in this log",
        "Late control cycles: no cycle was late",
        "Planner tick: no real time in this log",
    ):
        assert f"<li>{line}</li>" in page


def test_a_machine_too_slow_for_real_time_is_named_with_the_verdict(log: RunLog, page: str) -> None:
    def slow(_t: float, truth: dict[str, Any]) -> None:
        truth["late_s"] = 1.5

    about = {key: value for key, value in log.metadata["run"].items() if key != "lockstep"}
    late = render(runs.changed(log, {"sim/truth": slow}, about=about))
    caution = late.partition('<p class="caution">')[2].partition("</p>")[0]
    assert "too slow for real time" in caution
    assert "1.50 s" in caution
    assert 'class="caution">' not in page, "virtual time is never too slow"


def test_drives_that_start_together_share_one_row_and_are_no_alarm(log: RunLog) -> None:
    def coming_up(t: float, state: dict[str, Any]) -> None:
        if t < -2.0:
            state["drive"] = int(DriveStatus.LOST if t < -2.1 else DriveStatus.IDLE)

    def idle(t: float, state: dict[str, Any]) -> None:
        if 3.0 <= t < 3.1:
            state["drive"] = int(DriveStatus.IDLE)

    idling = runs.changed(log, {"joint/knee_left/state": idle})
    rows = timeline_events(RunData(runs.changed(idling, {"joint/*/state": coming_up})))
    kinds = {row.text: row.kind for row in rows if "drive" in row.text}
    assert kinds["all six: drive LOST to IDLE"] == "note"
    assert kinds["all six: drive IDLE to ARMED"] == "note"
    assert kinds["knee_left: drive ARMED to IDLE"] == "bad"


def impairment(number: int, link: str, t_ns: int, *, begins: bool, cut: bool) -> LinkEvent:
    return LinkEvent(
        t_ns=t_ns, seq=number, link=link, requested="planner->left", number=number, active=begins,
        delay_ms=0.0 if cut else 5.0, jitter_ms=0.0, loss=0.0, partition=cut,
        detail="partition" if cut else "delay=5", passed=0 if begins else 20,
        lost=0 if begins else 7,
    )  # fmt: skip


def test_network_impairments_have_a_panel_marks_and_rows(log: RunLog) -> None:
    run = RunData(log)
    more: list[tuple[int, str, bytes]] = []
    for number, cut, begin, end in ((1, False, 0.5, 2.0), (2, True, 1.0, 1.5)):
        for t, begins in ((begin, True), (end, False)):
            for module in ("ankle_left", "knee_left", "hip_left"):
                t_ns = run.zero_ns + round(t * 1e9)
                event = impairment(number, f"planner->{module}", t_ns, begins=begins, cut=cut)
                more.append((t_ns, topics.LINK_EVENT.name, msgspec.json.encode(event)))
    impaired = runs.changed(log, more=more)
    data = runs.data_of(render(impaired))
    rows = [row.text for row in timeline_events(RunData(impaired))]
    titles = [panel["title"] for panel in data["panels"]]
    place = titles.index("Injected network impairments")
    assert titles[place + 1] == "Command age", "to be compared with it"
    (row,) = data["panels"][place]["rows"]
    assert row["label"] == "to left"
    starts, _, codes = zip(*row["spans"][1:], strict=True)
    assert starts == pytest.approx((0.5, 1.0, 1.5, 2.0), abs=1e-3)
    link = ImpairedLink
    assert codes == (link.IMPAIRED, link.CUT, link.IMPAIRED, link.CLEAR)
    assert [mark[2] for mark in data["marks"] if mark[1] == "network"] == [
        "planner->left delay=5", "planner->left partition", "planner->left ends",
        "planner->left ends",
    ]  # fmt: skip
    assert "network, planner->left partition ends; 60 messages passed, 21 lost" in rows


def test_ages_of_seconds_do_not_flatten_ages_of_milliseconds(log: RunLog) -> None:
    def cut_off(_t: float, status: dict[str, Any]) -> None:
        status["state_age_ns"] = [3_000_000_000] * 6

    data = runs.drawn(runs.changed(log, {"planner/status": cut_off}), times.ages)
    panel = runs.panel(data, "Age of the planner's inputs")
    assert panel["reach"] == pytest.approx(200.0)
    assert "The delay before the arrival is not included" in panel["note"]


def test_the_back_off_of_the_planner_is_in_the_timeline(log: RunLog) -> None:
    def waits(t: float, status: dict[str, Any]) -> None:
        status["wait_s"] = 3.5 - t if 2.5 <= t < 3.5 else 0.0

    found = timeline_events(RunData(runs.changed(log, {"planner/status": waits})))
    (row,) = [row for row in found if "backs off" in row.text]
    assert row.t == pytest.approx(2.5, abs=0.01)
    assert row.text.startswith("planner: backs off for 1.0 s or more")


def test_a_trip_of_the_planner_is_named_in_the_timeline(log: RunLog) -> None:
    def tripped(t: float, status: dict[str, Any]) -> None:
        if t >= 2.5:
            status |= {"mode": int(PlannerMode.TRIPPED), "trip": int(Trip.SAGGING)}

    found = timeline_events(RunData(runs.changed(log, {"planner/status": tripped})))
    assert any(row.text.startswith("planner: LEADING to TRIPPED, SAGGING") for row in found)


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 6), st.integers(1, 9)), max_size=8))
def test_the_state_is_cut_exactly_when_no_message_passes(
    requested: list[tuple[bool, int, int]],
) -> None:
    directions = {name: Direction(name, 0) for name in DIRECTIONS}
    events: list[LinkEvent] = []
    impairments = ImpairmentSchedule(directions, events.append)
    for cut, begin_s, duration_s in requested:
        what = Impairment(delay_ms=0.0 if cut else 5.0, partition=cut)
        impairments.plan(WRENCHES, what, float(begin_s), float(begin_s + duration_s))
    for s in range(20):
        impairments.advance(float(s), s * NS_PER_S)
        rows = histories(events, 0).get(WRENCHES, ())
        shown = rows[-1][1] if rows else ImpairedLink.CLEAR
        now_ns = s * NS_PER_S
        passed = directions[WRENCHES].passes(now_ns, 0)
        assert (shown is ImpairedLink.CUT) is (passed == ())
        assert (shown is ImpairedLink.CLEAR) is (passed == (now_ns,))
