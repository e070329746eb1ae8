"""Rows of the timeline for the first violation of each limit."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.traces import LinkEvent
from tests.messages import sample
from tests.tools.judge.reports import runs
from tools.judge.reports.limit_violations import LimitViolations, first_violation
from tools.judge.reports.page_model import TimelineEvent
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog

T_S = 2.5
"""Time of the changes in these logs, scenario time."""


def violations_in(log: RunLog) -> list[TimelineEvent]:
    found = LimitViolations()
    found.add(RunData(log))
    return list(found.events())


def violations(log: RunLog, name: str, change: runs.Change) -> list[TimelineEvent]:
    """Return the violations in a log after a change of one key's messages."""
    return violations_in(runs.changed(log, {name: change}))


def test_a_run_within_its_limits_has_no_violation(log: RunLog) -> None:
    assert violations_in(log) == []


def test_a_tilted_sole_has_a_row_with_first_time_and_duration(log: RunLog) -> None:
    def tip(t: float, truth: dict[str, Any]) -> None:
        if T_S <= t < T_S + 0.2 or T_S + 0.5 <= t < T_S + 0.6:
            truth["foot_left_tilt"] = 0.05

    # the planner is killed at 1 s: from then on a tilt has no limit
    assert violations(log, "sim/truth", tip) == []
    begin_s = T_S - 2.0

    def tip_early(t: float, truth: dict[str, Any]) -> None:
        tip(t + 2.0, truth)

    (found,) = violations(log, "sim/truth", tip_early)
    assert (found.kind, found.mark) == ("limit", "")
    assert found.t == pytest.approx(begin_s, abs=0.011)
    assert found.text.startswith(
        "left sole's tilt: over 0.02 rad, the limit while the planner leads"
    )
    assert "0.20 s in total" in found.text, "the second interval is after the kill"


def test_after_the_kill_the_com_has_the_limit_without_a_leading_planner(log: RunLog) -> None:
    def lean(t: float, truth: dict[str, Any]) -> None:
        if t >= T_S:
            truth["com"][0] = 0.079 if t < T_S + 0.5 else 0.081

    (found,) = violations(log, "sim/truth", lean)
    assert found.t == pytest.approx(T_S + 0.5, abs=0.011)
    assert "COM x: over 80 mm, the limit while the planner does not lead" in found.text


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
        assert found[0].text.startswith("knee_left: torque at its limit of 115.6 N m")


def test_a_joint_beyond_its_stop_has_a_row_once_the_drives_are_armed(log: RunLog) -> None:
    armed_s = RunData(log).armed_s()

    def bend(t: float, state: dict[str, Any]) -> None:
        if t < armed_s or T_S <= t < T_S + 0.05:
            state["q"] = [0.0, 0.1]

    (found,) = violations(log, "joint/knee_right/state", bend)
    assert found.t == pytest.approx(T_S, abs=0.005)
    assert found.text.startswith("knee_right_theta: beyond a soft stop")


def test_a_margin_below_the_least_has_a_row_with_its_minimum(log: RunLog) -> None:
    def soften(t: float, status: dict[str, Any]) -> None:
        if T_S <= t < T_S + 0.1:
            status["margin"] = -0.25

    (found,) = violations(log, "planner/status", soften)
    assert "margin of the joint services alone: under 0.5, down to -0.25" in found.text


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
    texts = " ".join(row.text for row in violations_in(again))
    assert ("operator's force: over 40 N" in texts) is not on_purpose


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_the_duration_of_a_violation_is_that_of_its_samples(beyond: list[bool]) -> None:
    t = np.arange(len(beyond)) * 0.01
    found = first_violation("over 1", "x", t, np.array(beyond))
    if not any(beyond):
        assert found is None
        return
    assert found is not None
    assert found.t == pytest.approx(0.01 * beyond.index(True))
    assert found.duration_s == pytest.approx(0.01 * sum(beyond[:-1]))
