"""The random cases of `xrl study kill`, and what is measured in one."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config import gain_schedule, scenarios
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Push, lead
from shared.robot.robot_model import stand_pose
from tests.messages import filled
from tools.lab.design import split_program
from tools.lab.studies.sweeps import kill as cases
from tools.lab.studies.sweeps.figures import CaseRun, Ending, Observer
from tools.lab.studies.sweeps.kill import KillCase, KillCases, robots_of, run_case, with_payload
from tools.lab.studies.sweeps.plants import PushRange
from tools.sim import lockstep
from tools.terminal import Console

DRAWN = 200


@pytest.fixture(scope="module")
def drawn(robot: RobotConfig) -> list[KillCase]:
    some = KillCases(robot)
    return [some.draw(1, number) for number in range(DRAWN)]


@pytest.fixture(scope="module")
def diagonal(robot: RobotConfig) -> RobotConfig:
    """The paper's split: it needs no gain schedule, whatever the payload."""
    law = msgspec.structs.replace(robot.law, split="diagonal")
    return msgspec.structs.replace(robot, law=law)


def test_each_payload_gets_a_schedule_that_fits_and_the_papers_split_needs_none(
    robot: RobotConfig,
    diagonal: RobotConfig,
    drawn: list[KillCase],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(split_program, "N_HEIGHTS", 2)
    two = [msgspec.structs.replace(drawn[0], payload_kg=kg) for kg in (robot.mass.payload, 10.2)]
    ready = robots_of(two, robot, 1, Console(quiet=True))
    assert ready[0] == robot, "its schedule was made for it"
    assert [gain_schedule.why_stale(one) for one in ready] == ["", ""]
    assert ready[1].mass.payload == 10.2
    bare = robots_of(two[1:], diagonal, 1, Console(quiet=True))
    assert bare == [with_payload(diagonal, 10.2)]


def test_no_draw_is_beyond_the_study(robot: RobotConfig, drawn: list[KillCase]) -> None:
    borne = {kg: PushRange(with_payload(robot, kg)) for kg in cases.payloads(robot)}
    for case in drawn:
        assert case.payload_kg in (0.0, 5.1, 10.2, 15.3, 20.4)
        assert 0.0 <= case.delay_ms <= 20.0
        assert case.let_go_s is None or 0.0 <= case.let_go_s <= case.kill_s
        assert 1 <= len(case.pushes) <= 3
        for push in case.pushes:
            limit = borne[case.payload_kg].limit_n(math.atan2(push.force[1], push.force[0]))
            assert 0.074 * limit <= math.hypot(*push.force) <= 0.751 * limit
            assert push.force[2] == 0.0
            assert push.duration == 0.3
        assert all(b.at >= a.at + a.duration for a, b in pairwise(case.pushes))
        assert case.end_s >= case.kill_s + 2.999
        assert case.end_s >= case.pushes[-1].at + 1.99
        assert case.let_go_s is not None or case.end_s >= case.way_end_s + 1.99
        assert all(0.0 <= pose.assist <= robot.assist.force_max for pose in case.way)


def test_every_kind_of_case_is_drawn(drawn: list[KillCase]) -> None:
    share = {
        "moving": sum(case.moving for case in drawn),
        "hand off": sum(case.let_go_s is not None for case in drawn),
        "hand off at the kill": sum(case.let_go_s == case.kill_s for case in drawn),
        "pushed before the kill": sum(case.pushes[0].at < case.kill_s for case in drawn),
        "three pushes": sum(len(case.pushes) == 3 for case in drawn),
        "two poses": sum(len(case.way) == 3 for case in drawn),
        "upright": sum(case.way[-1].pitch == 0.0 for case in drawn),
        "crawling": sum(case.way[-1].height < 0.9 and case.way[-1].pitch > 0.6 for case in drawn),
        "assist": sum(case.way[-1].assist > 50.0 for case in drawn),
        "no assist": sum(case.way[-1].assist == 0.0 for case in drawn),
    }
    assert min(share.values()) >= 0.05 * DRAWN, share
    quadrants = {
        (push.force[0] > 0.0, push.force[1] > 0.0) for case in drawn for push in case.pushes
    }
    assert len(quadrants) == 4


def test_a_case_is_a_scenario(robot: RobotConfig, drawn: list[KillCase]) -> None:
    for case in drawn:
        scenario = case.scenario(robot)
        scenarios.check("case", scenario)
        assert [row.at for row in scenario.kill] == [case.kill_s]
        there = scenario.keyframe[-1].at
        assert (case.kill_s < there) if case.moving else (case.kill_s >= there + 0.3)
        assert scenario.push == case.pushes
        for pose in case.way:
            led = lead(scenario, pose.at)
            assert (led.height, led.pitch, led.assist) == (pose.height, pose.pitch, pose.assist)


@pytest.mark.parametrize(("height", "pitch"), [(0.79, 1.2), (0.85, 0.0), (1.2, 0.6)])
def test_pitch_is_taken_by_the_hips_alone(robot: RobotConfig, height: float, pitch: float) -> None:
    """What `reachable` rests on: the COM stays over the ankles when the torso pitches."""
    assert cases.reachable(robot, height, pitch)
    q = np.array(stand_pose(robot, height))
    q[[5, 11]] += pitch
    kinematics = Kinematics(robot)
    kinematics.update(q)
    assert kinematics.p[0] == pytest.approx(0.0, abs=2e-3)
    assert kinematics.p[4] == pytest.approx(pitch, abs=1e-9)


@pytest.mark.parametrize(("height", "pitch"), [(0.75, 0.0), (1.30, 0.0), (0.79, 1.8), (1.2, -2.0)])
def test_what_the_joint_limits_forbid_is_not_drawn(
    robot: RobotConfig, height: float, pitch: float
) -> None:
    assert not cases.reachable(robot, height, pitch)


@pytest.mark.usefixtures("on_its_feet")
def test_the_hand_is_off_from_the_time_in_the_case(
    diagonal: RobotConfig, drawn: list[KillCase], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "AFTER_KILL_S", 0.2)
    monkeypatch.setattr(cases, "AFTER_LEAD_S", 0.2)
    case = msgspec.structs.replace(drawn[0], kill_s=0.9, let_go_s=0.8, delay_ms=1.0, pushes=())
    rows: list[SimTruth] = []
    run_case(case, with_payload(diagonal, case.payload_kg), Observer(watch=rows.append))
    on = [row.operator_force[2] for row in rows if 0.6 < row.scenario_s < 0.79]
    off = [row.operator_force[2] for row in rows if row.scenario_s > 0.82]
    assert max(abs(force) for force in on) > 1.0
    assert 0.0 not in on
    assert set(off) == {0.0}


AT_REST: SimTruth = filled(SimTruth, {bool: False, int: 0, float: 0.0})


def test_a_robot_that_falls_before_it_can_begin_has_fallen(
    robot: RobotConfig, drawn: list[KillCase]
) -> None:
    row = msgspec.structs.replace(AT_REST, scenario_s=-1.0, fallen=True)
    outcome = cases.measure(drawn[0], CaseRun([row], [], []), robot)
    assert (outcome.ending, outcome.fell_at_s, outcome.stood) == (Ending.FELL, None, False)


@pytest.mark.usefixtures("on_its_feet")
def test_a_case_that_ends_in_mid_fall_is_a_fall(
    diagonal: RobotConfig, drawn: list[KillCase], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A push that nothing withstands, and the end right behind it."""
    for name, seconds in (("KILL", 0.5), ("PUSH", 0.05), ("LEAD", 0.5)):
        monkeypatch.setattr(cases, f"AFTER_{name}_S", seconds)
    push = Push(at=0.7, duration=0.25, force=(300.0, 0.0, 0.0))
    for pushes, ending in (((), Ending.STOOD), ((push,), Ending.TIPPING)):
        case = msgspec.structs.replace(
            drawn[0], kill_s=0.5, let_go_s=None, way_end_s=0.5, delay_ms=1.0, pushes=pushes
        )
        outcome = run_case(case, with_payload(diagonal, case.payload_kg))
        assert outcome.ending == ending
        assert outcome.fell_at_s is None


def test_a_robot_that_never_tracks_is_no_stand(
    diagonal: RobotConfig, drawn: list[KillCase], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 30 ms each way every command is older than 50 ms: it holds, and nothing can begin."""
    monkeypatch.setattr(lockstep, "READY_NS", 4 * NS_PER_S)
    case = msgspec.structs.replace(drawn[0], delay_ms=30.0)
    outcome = run_case(case, with_payload(diagonal, case.payload_kg))
    assert outcome.ending == Ending.UNREADY
    assert not outcome.stood
