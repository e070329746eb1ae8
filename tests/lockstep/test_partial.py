"""Partial failures in a squat: any subset of the modules cut off or frozen, the others well.

All 64 subsets of each kind are 256 runs of 1.1 s: XRL_ALL_SUBSETS=1 runs them. By default a
sample of each kind, drawn by a fixed seed, and all six modules at once. The push is to the
front left, so a subset is not its own mirror image, and no symmetry is counted on.
"""

from __future__ import annotations

import os
import random

import pytest

from services.planner.engagement import GRACE_NS, WAITS_NS
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import RobotConfig
from shared.joints import MODULES
from shared.links import DIRECTIONS, directions_of
from tools.runs import partial
from tools.runs.partial import KINDS, SUBSETS, Case, Start, run_case

SAMPLE = 2


def sample(kind: partial.FailureKind) -> list[Case]:
    if os.environ.get("XRL_ALL_SUBSETS"):
        return [Case(kind, modules) for modules in SUBSETS[1:]]
    drawn = random.Random(f"partial {kind}").sample(SUBSETS[1:-1], SAMPLE)
    return [Case(kind, modules) for modules in (*drawn, SUBSETS[-1])]


def words(case: Case) -> str:
    return f"{case.kind}-{'+'.join(case.modules)}"


@pytest.fixture(scope="module")
def start(robot: RobotConfig) -> Start:
    return partial.start_of(robot)


@pytest.mark.parametrize("case", [case for kind in KINDS for case in sample(kind)], ids=words)
def test_with_any_subset_failed_all_hold_at_once_nothing_falls_and_all_six_lead_again(
    case: Case, robot: RobotConfig, start: Start
) -> None:
    outcome = run_case(case, robot, start)
    age_ms = robot.joint_service.max_command_age_ms
    assert outcome.stood
    assert outcome.hold_shown_ms is not None
    assert outcome.hold_shown_ms <= age_ms + 10.0, "hold_all is in the planner's status"
    all_frozen = case.kind == "frozen" and len(case.modules) == len(MODULES)
    if not all_frozen:  # then no service is left that could leave TRACK
        assert outcome.tracked_ms is not None
        assert outcome.tracked_ms <= age_ms + GRACE_NS / NS_PER_MS
    assert outcome.led_again_s is not None
    assert outcome.led_again_s <= WAITS_NS[1] / NS_PER_S
    assert outcome.torque_step_nm <= 5.0


def test_with_nothing_failed_nobody_holds(robot: RobotConfig, start: Start) -> None:
    outcome = run_case(Case("links", ()), robot, start)
    assert outcome.stood
    assert outcome.hold_shown_ms is None
    assert outcome.tracked_ms is None
    assert outcome.torque_step_nm == 0.0


def test_there_are_64_subsets_and_each_kind_fails_what_it_says() -> None:
    assert len(SUBSETS) == len(set(SUBSETS)) == 64
    assert len(list(partial.cases())) == 64 * len(KINDS)
    cut = {
        kind: {
            direction
            for row in partial.story_of(Case(kind, MODULES)).inject
            for direction in directions_of(row.link)
        }
        for kind in KINDS
    }
    assert cut["links"] == cut["commands"] | cut["states"]
    assert cut["links"] == set(DIRECTIONS) - {"harness->planner"}
    assert not cut["commands"] & cut["states"]
    frozen = partial.story_of(Case("frozen", MODULES))
    assert {row.service for row in frozen.kill if row.signal == "STOP"} == set(MODULES)
    assert not cut["frozen"]


def test_a_case_gone_on_with_is_the_same_each_time(robot: RobotConfig, start: Start) -> None:
    case = Case("states", ("knee_left",))
    assert run_case(case, robot, start) == run_case(case, robot, start)
