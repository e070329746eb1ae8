"""Partial failures in a squat: any subset of the modules cut off or frozen, the others well.

Each of the four kinds has 63 subsets, at 1.2 s of CPU each: all 252 take five minutes of one core,

    XRL_ALL_SUBSETS=1 ./deploy/test tests/lockstep/test_partial.py

and by default 32 of them: of links cut and services frozen each module alone, each leg, four
drawn by a fixed seed and all six at once; of either direction alone two drawn and all six. The
push is to the front left, so a subset is not its own mirror image, and no symmetry is counted on.
"""

from __future__ import annotations

import os
import random

import pytest

from services.planner.watch.engagement_fsm import GRACE_NS, WAITS_NS
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, SIDES
from shared.links import ATTITUDES, DIRECTIONS, WRENCHES, directions_of
from tests.lockstep import partial
from tests.lockstep.partial import KINDS, SUBSETS, PartialCase, run_case
from tests.shared.mcap_log.runs import sample as sample_of
from tools.lab.studies.sweeps.figures import Ending, ending_of
from tools.sim.lockstep import FleetMoment

LEGS = [tuple(module for module in MODULES if module.endswith(side)) for side in SIDES]
ALWAYS = {"links": [*((module,) for module in MODULES), *LEGS]}
ALWAYS["frozen"] = ALWAYS["links"]
DRAWN = {"links": 4, "frozen": 4, "commands": 2, "states": 2}


def sample(kind: partial.FailureKind) -> list[PartialCase]:
    if os.environ.get("XRL_ALL_SUBSETS"):
        return [PartialCase(kind, modules) for modules in SUBSETS[1:]]
    always = [*ALWAYS.get(kind, []), SUBSETS[-1]]
    others = [modules for modules in SUBSETS[1:] if modules not in always]
    drawn = random.Random(f"partial {kind}").sample(others, DRAWN[kind])
    return [PartialCase(kind, modules) for modules in (*always, *drawn)]


def words(case: PartialCase) -> str:
    return f"{case.kind}-{'+'.join(case.modules)}"


@pytest.fixture(scope="module")
def start(robot: RobotConfig) -> FleetMoment:
    return partial.start_of(robot)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", [case for kind in KINDS for case in sample(kind)], ids=words)
def test_with_any_subset_failed_all_hold_at_once_nothing_falls_and_all_six_lead_again(
    case: PartialCase, robot: RobotConfig, start: FleetMoment
) -> None:
    outcome = run_case(case, robot, start)
    age_ms = robot.joint_service.max_command_age_ms
    assert outcome.stood
    assert outcome.hold_shown_ms is not None
    assert outcome.hold_shown_ms <= age_ms + 10.0, "hold_all is in the planner's status"
    all_frozen = case.kind == "frozen" and len(case.modules) == len(MODULES)
    if not all_frozen:  # then no service is left that could leave TRACK
        assert outcome.track_left_ms is not None
        assert outcome.track_left_ms <= age_ms + GRACE_NS / NS_PER_MS
    assert outcome.led_again_s is not None
    assert outcome.led_again_s <= WAITS_NS[1] / NS_PER_S
    assert outcome.torque_step_nm <= 5.0
    assert outcome.com_max_mm < 110.0, "90 measured with a leg frozen, of 127 to the sole's end"
    assert outcome.operator_end_n < 75.0, "44 to 50 measured: it leads, and is not at its limit"


def test_with_nothing_failed_no_module_holds(robot: RobotConfig, start: FleetMoment) -> None:
    outcome = run_case(PartialCase("links", ()), robot, start)
    assert outcome.stood
    assert outcome.hold_shown_ms is None
    assert outcome.track_left_ms is None
    assert outcome.torque_step_nm == 0.0
    assert outcome.operator_end_n < 20.0


@pytest.mark.parametrize(
    ("changes", "ending"),
    [
        ({}, Ending.STOOD),
        ({"fallen": True}, Ending.FELL),
        ({"foot_left_tilt": 0.06}, Ending.TIPPING),
        ({"com": (0.13, 0.0, 1.0)}, Ending.TIPPING),
        ({"scenario_s": partial.END_S - 0.5}, Ending.FELL),
    ],
)
def test_who_tips_at_the_end_or_does_not_come_so_far_has_not_stood(
    changes: dict[str, object], ending: Ending, robot: RobotConfig
) -> None:
    good = {"scenario_s": partial.END_S, "com": (0.0, 0.0, 1.0), "fallen": False}
    flat = {"foot_left_tilt": 0.0, "foot_right_tilt": 0.0, "lean": (0.0, 0.0)}
    row = sample_of(SimTruth, **(good | flat | changes))
    assert ending_of(row, partial.END_S, robot) is ending


def test_there_are_64_subsets_and_each_kind_fails_as_named() -> None:
    assert len(SUBSETS) == len(set(SUBSETS)) == 64
    cut = {
        kind: {
            direction
            for row in partial.scenario_of(PartialCase(kind, MODULES)).inject
            for direction in directions_of(row.link)
        }
        for kind in KINDS
    }
    assert cut["links"] == cut["commands"] | cut["states"]
    assert cut["links"] == set(DIRECTIONS) - {WRENCHES, ATTITUDES}
    assert not cut["commands"] & cut["states"]
    frozen = partial.scenario_of(PartialCase("frozen", MODULES))
    assert {row.service for row in frozen.kill if row.signal == "STOP"} == set(MODULES)
    assert not cut["frozen"]
