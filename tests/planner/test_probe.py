"""Known offsets of a row of the reference: small, slow enough for the joint services, then gone."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.planner.intents import Intents
from services.planner.law.probe import NO_ROW, PROBE_S, ReferenceProbe
from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.messages import JointState, Message, OperatorIntent, PlannerStatus
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from shared.state import copied
from tools.bringup.tune.excitation import Excitation, SinePart
from tools.bringup.tune.pose_probe import DIRECTIONS, ProbedLockstep, course_of
from tools.sim.standing_start import begin_standing

Array = NDArray[np.float64]
MOST = (0.01, 0.01, 0.01, 0.02, 0.05, 0.0)
DT = 0.004
LED = (0, 0, 1, 0, 1, 0)
P = np.array([0.0, 0.0, 0.9, 0.0, 0.1, 0.0])
REST = np.zeros(6)


@given(
    course=st.lists(
        st.tuples(st.integers(NO_ROW, 5), st.floats(-1.0, 1.0), st.sampled_from([DT, 0.02])),
        max_size=80,
    )
)
def test_an_offset_is_never_larger_nor_faster_than_it_may_be(
    course: list[tuple[int, float, float]],
) -> None:
    probe, last = ReferenceProbe(MOST, LED), (NO_ROW, 0.0)
    for row, wanted, dt in course:
        probe.advance(row, wanted, P, REST, dt)
        if probe.state.row == NO_ROW:
            assert probe.state.offset == 0.0
        else:
            most = MOST[probe.state.row]
            assert abs(probe.state.offset) <= most
            before = last[1] if last[0] == probe.state.row else 0.0
            assert abs(probe.state.offset - before) <= dt * most / PROBE_S * (1.0 + 1e-9)
        last = (probe.state.row, probe.state.offset)


def test_another_row_begins_only_when_the_first_is_back() -> None:
    probe = ReferenceProbe(MOST, LED)
    for _ in range(20):
        probe.advance(0, 0.01, P, REST, DT)
    rows = []
    for _ in range(30):
        probe.advance(3, 0.02, P, REST, DT)
        rows.append((probe.state.row, probe.state.offset))
    assert rows[0][0] == 0
    assert rows[-1] == (3, pytest.approx(0.02))
    switch = [row for row, _ in rows].index(NO_ROW)
    assert rows[switch][1] == 0.0


def test_a_row_that_the_robot_file_forbids_is_never_probed() -> None:
    probe = ReferenceProbe(MOST, LED)
    probe.advance(5, 0.01, P, REST, DT)
    assert probe.state.row == NO_ROW


def test_a_probe_goes_on_from_its_state() -> None:
    probe, other = ReferenceProbe(MOST, LED), ReferenceProbe(MOST, LED)
    for _ in range(160):
        probe.advance(2, 0.01, P, REST, DT)
    other.state = copied(probe.state)
    for _ in range(9):
        probe.advance(2, -0.01, P, REST, DT)
        other.advance(2, -0.01, P, REST, DT)
        assert other.state == probe.state
    assert probe.state.held == 0.9


def referred(probe: ReferenceProbe, p: Array, pdot: Array) -> tuple[Array, Array]:
    """Return what becomes of the reference of a robot at p."""
    p_ref, pdot_ref = p.copy(), pdot.copy()
    probe.apply(p_ref, pdot_ref, p, pdot)
    return p_ref, pdot_ref


def test_a_led_row_is_taken_only_at_rest() -> None:
    probe, moving = ReferenceProbe(MOST, LED), np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    for _ in range(50):
        probe.advance(2, 0.01, P, moving, DT)
    assert probe.state.row == NO_ROW
    probe.advance(2, 0.01, P, REST, DT)
    assert probe.state.row == 2


def test_a_led_row_is_held_and_given_back_without_a_step() -> None:
    """However the person moves it meanwhile: the reference moves by little from tick to tick."""
    probe = ReferenceProbe(MOST, LED)
    p, last, largest, offset_step = P.copy(), P[2], 0.0, DT * MOST[2] / PROBE_S
    pdot = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    seen = []
    for tick in range(600):
        if tick > 0:
            p[2] += 0.1 * DT
        probe.advance(2 if tick < 300 else NO_ROW, 0.01, p, pdot if tick else REST, DT)
        p_ref, pdot_ref = referred(probe, p, pdot)
        largest = max(largest, abs(p_ref[2] - last) - 0.1 * DT)
        last = p_ref[2]
        seen.append((probe.state.row, p_ref[2] - p[2], pdot_ref[2]))
    # the deviation of 0.12 m that is held goes back over half a second
    assert largest <= offset_step + 0.15 * DT / 0.5 + 1e-9
    assert seen[250][0] == 2
    assert seen[250][2] == pytest.approx(0.0, abs=1e-12), "held"
    assert seen[-1] == (NO_ROW, 0.0, pytest.approx(0.1)), "the person's again"


def intent(row: int, offset: float) -> OperatorIntent:
    return OperatorIntent(t_ns=1, seq=1, assist_n=0.0, source="a test", probe_row=row, probe=offset)


@pytest.mark.parametrize("bad", [intent(6, 0.0), intent(-2, 0.0), intent(0, float("inf"))])
def test_an_intent_with_an_impossible_probe_is_ignored(
    robot: RobotConfig, bad: OperatorIntent
) -> None:
    intents = Intents(robot.assist)
    intents.receive(intent(1, 0.005), 1)
    intents.receive(bad, 2)
    assert (intents.request(3).probe_row, intents.request(3).probe) == (1, 0.005)


def test_a_probe_that_is_not_repeated_ends_while_the_rest_of_an_intent_fades(
    robot: RobotConfig,
) -> None:
    intents = Intents(robot.assist)
    intents.receive(msgspec.structs.replace(intent(1, 0.005), assist_n=80.0), 1)
    late = intents.request(round((robot.assist.stale_ms + 100.0) * NS_PER_MS))
    assert late.probe_row == NO_ROW
    assert late.assist_n > 70.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("row", range(6), ids=DIRECTIONS)
def test_the_largest_probe_of_each_direction_is_led_without_a_refused_command_or_a_trip(
    robot: RobotConfig, row: int
) -> None:
    """On the realistic plant; a led row is held while it is probed and led again afterwards."""
    size = robot.law.probe_max[row]
    plan = Excitation(size, (SinePart(9.0, 2.0, 4),))
    scenario = Scenario("probe", "", plan.duration_s + 1.0, (Keyframe(0.0, 1.188),))
    statuses: list[PlannerStatus] = []
    refused: dict[str, int] = {}

    def record(topic: Topic, module: str, message: Message) -> None:
        if fleet.world.scenario_s < 0.0:
            return
        if isinstance(message, PlannerStatus):
            statuses.append(message)
        elif isinstance(message, JointState):
            refused[module] = message.refused
            assert topic is topics.JOINT_STATE

    fleet = ProbedLockstep(robot, scenario, record=record, plant=PlantConfig())
    fleet.row, fleet.excitation = row, plan
    assert begin_standing(fleet)
    assert not any(truth.fallen for truth in fleet.run())
    assert {status.trip for status in statuses} == {0}
    assert not any(status.hold for status in statuses)
    assert set(refused.values()) == {0}
    course = course_of(statuses, row)
    assert course.r.max() == pytest.approx(size, rel=0.05)
    assert course.r.min() == pytest.approx(-size, rel=0.05)
    at_top = (course.t_s > 4.0) & (course.t_s < 5.0)
    assert 0.03 * size < course.y[at_top].mean() < 1.3 * size


def test_a_hand_that_moves_a_probed_height_meets_no_refused_command(robot: RobotConfig) -> None:
    """It is led down by 0.12 m from before the probe ends until after it: HOLD would be a step."""
    keys = (Keyframe(0.0, 1.188), Keyframe(2.0, 1.188), Keyframe(5.0, 1.15), Keyframe(8.0, 1.07))
    plan = Excitation(robot.law.probe_max[2], (SinePart(3.0, 2.0, 4),))
    scenario = Scenario("probe", "", 9.0, keys)
    refused: dict[str, int] = {}
    trips: set[int] = set()

    def record(topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointState) and topic is topics.JOINT_STATE:
            refused[module] = message.refused
        elif isinstance(message, PlannerStatus):
            trips.add(message.trip)
            if fleet.world.scenario_s > 5.5:
                fleet.excitation = None

    fleet = ProbedLockstep(robot, scenario, record=record, plant=PlantConfig())
    fleet.row, fleet.excitation = 2, plan
    assert begin_standing(fleet)
    assert not any(truth.fallen for truth in fleet.run())
    assert set(refused.values()) == {0}
    assert trips == {0}
