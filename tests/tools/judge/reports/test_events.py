"""Events of a run: what was done to it, changes of state, silences, exceeded limits."""

from __future__ import annotations

import itertools
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import DriveStatus, PlannerMode, Trip
from shared.bus.traces import LinkEvent
from tests.messages import sample
from tests.tools.judge.reports import runs
from tools.judge.reports.events import TimelineEvent, events_of
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog

T_S = 2.5
"""Time of the changes in these logs, scenario time."""


def events(log: RunLog, name: str = "", change: runs.Change | None = None) -> list[TimelineEvent]:
    """Return the events of a log after a change of one key's messages."""
    changes = {} if change is None else {name: change}
    return events_of(RunData(runs.changed(log, changes)))


def violations(log: RunLog, name: str, change: runs.Change) -> list[TimelineEvent]:
    return [row for row in events(log, name, change) if row.kind == "limit"]


def test_the_kill_the_hold_and_the_recovery_are_there_in_order(log: RunLog) -> None:
    rows = events(log)
    assert [row.t for row in rows] == sorted(row.t for row in rows)
    texts = [row.text for row in rows]
    kill = next(row for row in rows if row.kind == "kill")
    assert (kill.mark, kill.t) == ("planner KILL", pytest.approx(1.0, abs=0.01))
    hold = next(row for row in rows if "TRACK to HOLD, PLANNER_ENDED" in row.text)
    assert hold.text.startswith("all six: ")
    assert 0.0 < hold.t - kill.t < 0.065
    assert any(text.startswith("planner/status silent for 0.") for text in texts)
    assert not any("state silent" in text for text in texts), "its drive was, not the service"
    assert any(text.startswith("drive of hip_left: ARMED to ") for text in texts)
    assert {row.kind for row in rows if row.mark} == {"kill", "restart", "push", "fault"}
    again = [text for text in texts if "HOLD to TRACK, COMMANDS_FRESH" in text]
    assert len(again) >= 2, "at the start and after the restart"
    assert not [row for row in rows if row.kind == "limit"], "it is within its limits"


def test_drives_that_start_together_share_one_row_and_are_no_alarm(log: RunLog) -> None:
    def coming_up(t: float, state: dict[str, Any]) -> None:
        if t < -2.0:
            state["drive"] = int(DriveStatus.LOST if t < -2.1 else DriveStatus.IDLE)

    def idle(t: float, state: dict[str, Any]) -> None:
        if 3.0 <= t < 3.1:
            state["drive"] = int(DriveStatus.IDLE)

    idling = runs.changed(log, {"joint/knee_left/state": idle})
    kinds = {row.text: row.kind for row in events(idling, "joint/*/state", coming_up)}
    assert kinds["drive of all six: LOST to IDLE"] == "note"
    assert kinds["drive of all six: IDLE to ARMED"] == "note"
    assert kinds["drive of knee_left: ARMED to IDLE"] == "bad"


@pytest.mark.parametrize(
    ("changes", "text", "kind"),
    [
        ({"mode": int(PlannerMode.TRIPPED), "trip": int(Trip.SAGGING)},
         "planner: LEADING to TRIPPED, SAGGING", "bad"),
        ({"wait_s": 3.0}, "planner: LEADING to LEADING (waits after dropouts", "note"),
        ({"heat": 1}, "heat: NONE to ", "bad"),
    ],
)  # fmt: skip
def test_a_change_of_the_planner_is_named(
    log: RunLog, changes: dict[str, int], text: str, kind: str
) -> None:
    def change(t: float, status: dict[str, Any]) -> None:
        if t >= T_S:
            status |= changes

    (row,) = [row for row in events(log, "planner/status", change) if row.text.startswith(text)]
    assert (row.t, row.kind) == (pytest.approx(T_S, abs=0.01), kind)


def test_an_impairment_has_a_mark_for_its_begin_and_one_for_its_end(log: RunLog) -> None:
    run, more = RunData(log), []
    for number, cut, begin, end in ((1, False, 0.5, 2.0), (2, True, 1.0, 1.5)):
        for t, begins in ((begin, True), (end, False)):
            for module in ("ankle_left", "knee_left", "hip_left"):
                event = LinkEvent(
                    t_ns=run.zero_ns + round(t * 1e9), seq=number, link=f"planner->{module}",
                    requested="planner->left", number=number, active=begins,
                    delay_ms=0.0 if cut else 5.0, jitter_ms=0.0, loss=0.0, partition=cut,
                    detail="partition" if cut else "delay=5",
                    passed=0 if begins else 20, lost=0 if begins else 7,
                )  # fmt: skip
                more.append((event.t_ns, topics.LINK_EVENT.name, msgspec.json.encode(event)))
    rows = events_of(RunData(runs.changed(log, more=more)))
    assert [row.mark for row in rows if row.kind == "network"] == [
        "planner->left delay=5", "planner->left partition", "planner->left ends",
        "planner->left ends",
    ]  # fmt: skip
    assert "network, planner->left partition ends; 60 messages passed, 21 lost" in [
        row.text for row in rows
    ]


def test_a_figure_beyond_its_limit_has_a_row_with_first_time_and_duration(log: RunLog) -> None:
    """The planner is killed at 1 s: from then on the COM has the limit of a robot that holds."""

    def lean(t: float, truth: dict[str, Any]) -> None:
        led = 0.5 <= t < 0.7 or 0.9 <= t < 0.95
        truth["com"][0] = 0.021 if led else 0.079 if T_S <= t < T_S + 0.5 else 0.0
        if t >= T_S + 0.5:
            truth["com"][0] = 0.081

    led, held = violations(log, "sim/truth", lean)
    assert (led.t, led.mark) == (pytest.approx(0.5, abs=0.011), "")
    assert led.text == "COM, x: over 20 mm while led for the first time; 0.25 s in total"
    assert held.t == pytest.approx(T_S + 0.5, abs=0.011)
    assert "over 80 mm while held" in held.text


@pytest.mark.parametrize(("duration_s", "reported"), [(0.012, False), (0.1, True)])
def test_a_torque_at_its_limit_has_a_row_unless_it_was_short(
    log: RunLog, duration_s: float, reported: bool
) -> None:
    def push(t: float, state: dict[str, Any]) -> None:
        if T_S <= t < T_S + duration_s:
            state["tau"] = [-100.0, 15.6]

    found = violations(log, "joint/knee_left/state", push)
    assert bool(found) is reported
    if reported:
        assert found[0].text.startswith("Torque of each module, knee_left: at the limit of 115.6")


def test_a_margin_below_the_least_has_a_row(log: RunLog) -> None:
    def soften(t: float, status: dict[str, Any]) -> None:
        if T_S <= t < T_S + 0.1:
            status["margin"] = -0.25

    (found,) = violations(log, "planner/status", soften)
    assert found.text.startswith("Certificate margin, joint services alone: under 0.5")


@pytest.mark.parametrize("on_purpose", [True, False])
def test_hold_has_the_other_limits_only_if_the_network_was_impaired_on_purpose(
    log: RunLog, on_purpose: bool
) -> None:
    """Rule of the verdict: a module that drops out for another reason changes no limit."""
    zero_ns = RunData(log).zero_ns
    event = sample(LinkEvent, t_ns=zero_ns, link="planner->ankle_right")
    more = [(zero_ns, topics.LINK_EVENT.name, msgspec.json.encode(event))]

    def spared(_t: float, event: dict[str, Any]) -> None:
        """No service is killed; hip_left's drive is lost at 3.2 s, and then all six hold."""
        event |= {"scenario_s": 9.0, "t_ns": zero_ns + 9_000_000_000}

    def led(t: float, truth: dict[str, Any]) -> None:
        truth["operator_force"][2] = -90.0 if t > 3.5 else 0.0

    changes = {"run/event": spared, "sim/truth": led}
    again = runs.changed(log, changes, more=more if on_purpose else ())
    texts = " ".join(row.text for row in events_of(RunData(again)))
    assert ("hand, z: over 40 N while led" in texts) is not on_purpose


def test_of_very_many_events_the_marked_ones_stay(log: RunLog) -> None:
    seen = itertools.count()

    def changes(_t: float, state: dict[str, Any]) -> None:
        state["drive_error"] = next(seen)

    rows = events(log, "joint/knee_left/state", changes)
    assert len(rows) <= 501
    assert rows[-1].text.endswith("more events are left out")
    assert {"kill", "restart", "push", "fault"} <= {row.kind for row in rows}
