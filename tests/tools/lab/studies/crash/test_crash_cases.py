"""The crash matrix as data: nothing is left out, and nothing is excused that need not be."""

from __future__ import annotations

import re
from itertools import product

import pytest

from shared.config import scenarios
from shared.config.robot_config import OPTIONAL, SERVICES
from shared.config.scenarios import FAULT_KINDS, Fault, Kill
from shared.joints import MODULES
from shared.robot.fault_table import DRIVE_FAULTS
from tools.lab.studies.crash import matrix
from tools.lab.studies.crash.cases import (
    BACK_S,
    CASES,
    CRASH_S,
    REQUEST_S,
    CrashCase,
    CrashVerdict,
    scenario_of,
)

BY_NAME = {case.name: case for case in CASES}


ALONE = [case.crash[0] for case in CASES if len(case.crash) == 1 and case.triggered_kill is None]


def test_every_service_but_the_world_is_lost_alone_and_every_drive_has_these_faults_alone() -> None:
    lost = [(row.service, row.signal) for row in ALONE if isinstance(row, Kill)]
    services = set(SERVICES) - {"simulator", *OPTIONAL}
    assert set(lost) == set(product(services, ("KILL", "STOP")))
    faulted = {(row.module, row.kind) for row in ALONE if isinstance(row, Fault)}
    assert faulted >= set(product(MODULES, ("disarmed", "link_lost", "encoder")))


def test_every_kind_of_fault_is_tried() -> None:
    tried = {row.kind for case in CASES for row in case.crash if isinstance(row, Fault)}
    assert tried == set(FAULT_KINDS)


def test_pairs_all_joint_services_and_the_planner_coming_back_are_tried() -> None:
    assert sum(case.kind == "pair" and len(case.crash) == 2 for case in CASES) >= 10
    assert BY_NAME["kill-all-joints"].hit == set(MODULES)
    assert BY_NAME["kill-all-joints"].others == ()
    chased = [case.triggered_kill for case in CASES if case.triggered_kill is not None]
    assert {triggered_kill.service for triggered_kill in chased} == {"planner"}


def test_the_short_run_has_one_of_each_kind_in_five_minutes() -> None:
    quick = [case for case in CASES if case.quick]
    assert {case.kind for case in quick} == {case.kind for case in CASES}
    assert len(quick) * matrix.CASE_S <= 300.0


def test_names_are_their_own_and_can_be_folders() -> None:
    assert len(BY_NAME) == len(CASES)
    assert all(re.fullmatch(r"[a-z_-]+", name) for name in BY_NAME)


def test_any_one_process_that_dies_has_to_leave_the_robot_standing() -> None:
    deaths = [case for case in CASES if all(isinstance(row, Kill) for row in case.crash)]
    assert len(deaths) > 2 * (len(SERVICES) - 1)
    assert {case.expected for case in deaths} == {CrashVerdict.STOOD}


def test_a_robot_may_fall_only_where_a_module_is_limp() -> None:
    for case in CASES:
        limp = [r for r in case.crash if isinstance(r, Fault) and DRIVE_FAULTS[r.kind].limp]
        assert limp or case.expected is CrashVerdict.STOOD, case.name


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_is_a_scenario_that_asks_back_whatever_was_lost(case: CrashCase) -> None:
    scenario = scenario_of(case)
    scenarios.check(case.name, scenario)
    assert {row.service for row in scenario.restart if row.at == BACK_S} == case.hit
    assert case.why
    for row in scenario.fault:
        assert row.at + row.lasts_s < REQUEST_S, "over before it is asked for"


def test_the_crash_comes_on_the_way_down_and_the_pushes_before_the_request() -> None:
    scenario = scenario_of(BY_NAME["kill-planner"])
    hand = scenarios.lead(scenario, CRASH_S)
    assert hand.height == pytest.approx(1.0, abs=0.02)
    assert hand.height_rate < -0.05
    assert all(CRASH_S + 0.5 < push.at < REQUEST_S - 0.5 for push in scenario.push)
