"""What was done to the network, read from a log; how the verdict and the live line tell it."""

from __future__ import annotations

import io

import msgspec
import numpy as np
import pytest

from shared.bus.messages import PlannerMode, PlannerStatus
from shared.bus.traces import LinkEvent, SimTruth
from shared.clock import NS_PER_S
from shared.config.impairment import Direction, Impairment
from shared.config.scenarios import Inject
from shared.links import DIRECTIONS, directions_of
from shared.network.impairment_schedule import ImpairmentSchedule
from tests.shared.mcap_log.runs import sample
from tools.judge import verdict, verdict_table
from tools.judge.standing import LIMITS
from tools.judge.verdict import Summary
from tools.live.live_view import LiveView, active, said_by
from tools.live.scenario_runner import LiveSnapshot
from tools.logs.impairment_intervals import impairments, touches
from tools.terminal import Console

LATE = Impairment(delay_ms=30.0, jitter_ms=10.0)
CUT = Impairment(partition=True)


def told(*asked: tuple[str, Impairment, float, float], until_s: int = 10) -> list[LinkEvent]:
    """Return the events of (link, what, begin, end), with a message a second on every link."""
    directions = {name: Direction(name, 0) for name in DIRECTIONS}
    events: list[LinkEvent] = []
    impairments = ImpairmentSchedule(directions, events.append)
    for link, what, begins, ends in asked:
        impairments.plan(link, what, begins, ends)
    for s in range(until_s):
        impairments.advance(float(s), s * NS_PER_S)
        for direction in directions.values():
            direction.passes(s * NS_PER_S, 1)
    return events


def test_an_impairment_of_many_directions_is_one_with_the_sum_of_their_counts() -> None:
    (row,) = impairments(told(("planner->left", CUT, 3.0, 7.0)))
    assert row.directions == set(directions_of("planner->left"))
    assert (row.passed, row.lost) == (0, 3 * 4)
    assert verdict.shown(row, NS_PER_S) == (
        "planner->left partition: 2.00 to 6.00 s; 0 messages passed, 12 lost"
    )


def test_impairments_that_overlap_keep_each_its_own_begin_and_end() -> None:
    rows = impairments(told(("planner->joints", LATE, 1.0, 6.0), ("all", CUT, 2.0, 4.0)))
    assert [row.when(0) for row in rows] == ["1.00 to 6.00 s", "2.00 to 4.00 s"]
    assert [row.at(3 * NS_PER_S) for row in rows] == [True, True]
    assert [row.at(5 * NS_PER_S) for row in rows] == [True, False]


def test_an_impairment_without_an_end_in_the_log_is_reported_so() -> None:
    (row,) = impairments(told(("all", LATE, 3.0, 99.0)))
    assert row.when(0) == "from 3.00 s on"
    assert "its end is not in the log" in verdict.shown(row, 0)
    assert row.at(1 << 60)


def test_a_new_injector_that_counts_from_one_again_does_not_join_two_impairments() -> None:
    first = told(("planner->left", LATE, 1.0, 99.0))
    second = told(("planner->right", CUT, 5.0, 7.0))
    rows = impairments([*first, *second])
    assert [row.link for row in rows] == ["planner->left", "planner->right"]
    assert [row.when(0) for row in rows] == ["1.00 to 5.00 s", "5.00 to 7.00 s"]
    assert (rows[0].passed, rows[1].lost) == (None, 6)


def test_a_module_is_touched_by_its_own_links_only() -> None:
    rows = impairments(told(("planner->left", LATE, 3.0, 5.0)))
    times_ns = np.array([2, 3, 4, 5]) * NS_PER_S
    assert touches(rows, "knee_left", times_ns).tolist() == [False, True, True, False]
    assert not touches(rows, "knee_right", times_ns).any()


def judged(**figures: object) -> Summary:
    begin: dict[str, object] = {"stood": True, "sound": True, "began": True, "duration_s": 8.0}
    return msgspec.convert(begin | figures, Summary)


def shown(summary: Summary) -> str:
    text = io.StringIO()
    verdict_table.show(summary, Console(file=text, width=120, color_system=None))
    return text.getvalue()


def test_a_limit_passed_with_links_impaired_is_marked_and_otherwise_not() -> None:
    (row,) = (row for row in LIMITS if row.key == "alive_com_y_max_mm")
    over = judged(alive_com_y_max_mm=row.limit + 1.0)
    assert verdict_table.mark(row, over) == "over"
    assert (
        verdict_table.mark(row, msgspec.structs.replace(over, links_impaired=1))
        == "over, links impaired"
    )
    cpu = next(row for row in LIMITS if row.key == "fleet_cpu_pct")
    busy = judged(fleet_cpu_pct=cpu.limit + 1.0, links_impaired=1)
    assert verdict_table.mark(cpu, busy) == "over, a busy machine", "no link makes it busy"
    good = judged(alive_com_y_max_mm=row.limit, links_impaired=1)
    assert verdict_table.mark(row, good) == "ok"


def test_beside_a_figure_over_its_limit_it_is_told_what_decides() -> None:
    (row,) = (row for row in LIMITS if row.key == "operator_peak_n")
    words = "Only these decide the verdict: standing to the end"
    assert words in shown(judged(operator_peak_n=row.limit + 1.0))
    assert words not in shown(judged(operator_peak_n=row.limit))
    fell = {"stood": False, "sound": False, "began": True, "fallen_at_s": 3.0}
    assert words not in shown(judged(operator_peak_n=row.limit + 1.0, **fell))


def test_the_verdict_has_a_line_for_each_impairment_and_one_of_ages() -> None:
    rows = impairments(told(("planner->joints", LATE, 3.0, 7.0), ("all", CUT, 8.0, 9.0)))
    summary = judged(
        links_impaired=2,
        impairments=[verdict.shown(row, 0) for row in rows],
        command_age_impaired_ms={"median": 32.0, "p99": 40.0},
        command_age_otherwise_ms={"median": 4.0, "p99": 4.5},
    )
    text = shown(summary)
    assert "planner->joints delay=30ms jitter=10ms: 3.00 to 7.00 s; 24 messages passed, 0" in text
    assert "all partition: 8.00 to 9.00 s" in text
    assert "32 ms, 99 % within 40 ms while impaired; 4 ms, 99 % within 4.5 ms otherwise" in text
    assert "median age" not in shown(judged(command_age_otherwise_ms={"median": 4.0, "p99": 5.0}))


@pytest.mark.parametrize(
    ("value", "words"),
    [(3.94e-12, "0.00"), (-4e-4, "0.00"), (0, "0"), (0.0136, "0.0136"), (1540.2, "1540")],
)
def test_next_to_nothing_is_shown_without_a_power_of_ten(value: float, words: str) -> None:
    assert verdict_table.digits(value) == words


INJECTS = (
    Inject(link="planner->joints", at=3.0, duration=4.0, delay_ms=30.0),
    Inject(link="all", at=5.0, partition=True),
)


@pytest.mark.parametrize(
    ("scenario_s", "words"),
    [
        (-1.0, ""),
        (2.9, ""),
        (3.0, "planner->joints delay=30ms"),
        (6.0, "planner->joints delay=30ms, all partition"),
        (7.0, "all partition"),
    ],
)
def test_only_what_is_done_now_is_named(scenario_s: float, words: str) -> None:
    assert active(INJECTS, scenario_s) == words


def waits(wait_s: float, why: str = "") -> PlannerStatus:
    found: PlannerStatus = sample(
        PlannerStatus, seq=1, t_ns=1, mode=int(PlannerMode.ALIGNING), wait_s=wait_s, why=why, trip=0
    )
    return found


def test_a_planner_that_waits_after_drop_outs_reports_how_long() -> None:
    assert said_by(waits(3.4)) == ("", "leads again in 3 s")
    assert said_by(waits(0.3)) == ("", "leads again soon")
    assert said_by(waits(0.0, "knee_left is hot")) == ("knee_left is hot", "")
    assert said_by(waits(0.0, "a controller's\ntrouble")) == ("a controller's\\ntrouble", "")
    assert said_by(None) == ("", "")


class Planner:
    """Says one thing once."""

    def __init__(self) -> None:
        self.said: list[PlannerStatus] = [waits(3.4, "knee_left is hot")]

    def take(self) -> PlannerStatus | None:
        return self.said.pop() if self.said else None


def test_the_line_shows_what_is_done_what_the_planner_says_and_how_long_it_waits() -> None:
    text = io.StringIO()
    view = LiveView(Console(file=text, width=300), INJECTS, Planner())
    with view:
        for hoist in (0.2, 0.0):  # what the planner says of a hanging robot is left out
            truth = sample(SimTruth, seq=1, t_ns=1, scenario_s=3.5, hoist=hoist)
            view._next_s = 0.0
            view.show(LiveSnapshot(truth, ("T",) * 6, "push"))
    hangs, stands = text.getvalue().strip().splitlines()
    assert hangs.endswith("TTTTTT  push; planner->joints delay=30ms")
    assert stands.endswith(
        "TTTTTT  push; planner->joints delay=30ms; knee_left is hot; leads again in 3 s"
    )
