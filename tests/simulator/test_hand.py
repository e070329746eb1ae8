"""The hand: how it moves when led, and its force as a clipped spring-damper at the harness."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics import operator as hands
from services.simulator.physics.body import body_of
from services.simulator.physics.operator import LedHand, Operator, Wearer
from services.simulator.physics.plant import IDEAL, Person
from services.simulator.physics.world import World
from shared.bus.messages import HandLead
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Act, Lead
from tests.lockstep.runs import still

DT = 0.001
NOW = Lead(1.1, -0.05, 0.1, 0.02, 30.0)
NUMBER = st.floats(allow_nan=True, allow_infinity=True)


def asked(**fields: object) -> HandLead:
    rest = {"t_ns": 1, "seq": 1, "leads": True, "height": 0.0, "pitch": 0.0, "push": (0, 0, 0)}
    return msgspec.convert(rest | fields, HandLead)


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=20))
def test_it_never_jumps_and_never_leaves_its_limits(places: list[tuple[float, float]]) -> None:
    hand = LedHand()
    hand.request(asked(height=NOW.height, pitch=NOW.pitch), NOW)
    before = hand.over(NOW)
    assert before[:4] == NOW[:4], "it begins where the hand is"
    for height, pitch in places:
        hand.request(asked(height=height, pitch=pitch), NOW)
        for _ in range(20):
            hand.advance(DT)
            now = hand.over(NOW)
            assert abs(now.height - before.height) <= hands.HEIGHT_MAX_RATE * DT + 1e-12
            assert abs(now.pitch - before.pitch) <= hands.PITCH_MAX_RATE * DT + 1e-12
            before = now
    for _ in range(400):
        hand.advance(50 * DT)
    low, high = hands.HEIGHTS
    assert low - 1e-6 <= hand.over(NOW).height <= high + 1e-6
    assert hand.over(NOW).assist == NOW.assist, "the assist stays the scenario's"


def test_a_hand_stays_where_it_was_led_and_its_push_expires() -> None:
    hand = LedHand()
    hand.request(asked(height=0.95, pitch=0.3), NOW)
    for _ in range(5000):
        hand.advance(DT)
    assert hand.over(NOW).height == pytest.approx(0.95, abs=1e-4)
    assert hand.over(NOW).pitch == pytest.approx(0.3, abs=1e-4)
    hand = LedHand()
    hand.request(asked(leads=False, push=(0.0, 1e6, -3.0)), NOW)
    assert hand.push == (0.0, hands.PUSH_MAX, -3.0)
    assert hand.over(NOW) == NOW
    for _ in range(math.ceil(hands.PUSH_EXPIRES_S / DT) + 1):
        hand.advance(DT)
    assert hand.push is None


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["height", "pitch", "push"])
def test_what_is_no_number_is_ignored(field: str, wrong: float) -> None:
    hand = LedHand()
    hand.request(asked(height=1.0, pitch=0.0, push=(1.0, 0.0, 0.0)), NOW)
    before = hand.numbers()
    given = (wrong, 0.0, 0.0) if field == "push" else wrong
    hand.request(asked(**{"height": 0.9, "pitch": 0.5, field: given}), NOW)
    assert hand.numbers() == before


LEVEL = Lead(height=1.1, height_rate=0.0, pitch=0.0, pitch_rate=0.0, assist=0.0)


@pytest.fixture
def operator(robot: RobotConfig) -> Operator:
    return Operator(robot.simulation.operator, robot.geometry.harness_point)


def harness_height(robot: RobotConfig, height: float, pitch: float) -> float:
    x, _, z = robot.geometry.harness_point
    return height - x * math.sin(pitch) + z * math.cos(pitch)


@pytest.mark.parametrize("pitch", [-0.2, 0.0, 0.6, 1.2])
def test_the_hand_rests_where_it_leads_and_does_not_drag(
    robot: RobotConfig, operator: Operator, pitch: float
) -> None:
    wanted = LEVEL._replace(pitch=pitch)
    hand = operator.force(wanted, harness_height(robot, 1.1, pitch), 0.0, pitch, 0.0)
    assert hand == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_hand_moving_with_its_path_does_not_drag(
    robot: RobotConfig, operator: Operator
) -> None:
    """The harness point's own rate, from the path's height and pitch, by difference."""
    dt, pitch, rates = 1e-6, 0.7, (-0.2, 0.3)
    ahead = harness_height(robot, 1.1 + rates[0] * dt, pitch + rates[1] * dt)
    rate = (ahead - harness_height(robot, 1.1, pitch)) / dt
    wanted = Lead(height=1.1, height_rate=rates[0], pitch=pitch, pitch_rate=rates[1], assist=0.0)
    hand = operator.force(wanted, harness_height(robot, 1.1, pitch), rate, pitch, rates[1])
    assert hand == pytest.approx((0.0, 0.0), abs=1e-4)


def test_the_hand_is_a_spring_and_a_damper_in_each_direction_it_holds(
    robot: RobotConfig, operator: Operator
) -> None:
    hand, at = robot.simulation.operator, 1.1 + robot.geometry.harness_point[2]
    assert operator.force(LEVEL, at - 0.02, 0.0, 0.0, 0.0).force_z == pytest.approx(0.02 * hand.k_z)
    assert operator.force(LEVEL, at, 0.1, 0.0, 0.0).force_z == pytest.approx(-0.1 * hand.b_z)
    turned = operator.force(LEVEL, at, 0.0, 0.1, 0.0)
    assert turned.moment_pitch == pytest.approx(-0.1 * hand.k_pitch)
    turning = operator.force(LEVEL, at, 0.0, 0.0, 0.1)
    assert turning.moment_pitch == pytest.approx(-0.1 * hand.b_pitch)
    hand, held = robot.simulation.operator, LEVEL._replace(side=0.03, side_rate=0.1)
    assert operator.force_side(held, 0.01, 0.1) == pytest.approx(0.02 * hand.k_y)
    assert operator.force_side(held, 0.03, 0.0) == pytest.approx(0.1 * hand.b_y)
    assert operator.force_side(held, -1.0, 0.0) == hand.force_max
    assert operator.force_side(LEVEL, 0.5, 1.0) == 0.0, "nothing holds it"


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("far", [0.2, 10.0])
def test_the_hand_is_no_stronger_than_a_person(
    robot: RobotConfig, operator: Operator, sign: float, far: float
) -> None:
    hand = robot.simulation.operator
    got = operator.force(LEVEL, 1.1 - sign * far, 0.0, -2 * sign * far, 0.0)
    assert got == (sign * hand.force_max, sign * hand.moment_max)


def worn(person: Person, force: float, assist: float = 0.0, seconds: float = 5.0) -> Wearer:
    wearer = Wearer(person)
    for _ in range(round(seconds / 1e-3)):
        wearer.step(1e-3, force, assist)
    return wearer


def test_the_wearer_gives_way_by_weight_on_springs_and_rests_later_and_less_than_asked() -> None:
    person = Person(mass=80.0, leg_frequency_hz=2.5)
    stiffness = 80.0 * (2.0 * math.pi * 2.5) ** 2
    assert worn(person, -60.0).above == pytest.approx(60.0 / stiffness, rel=1e-3)
    assert worn(person, 0.0).above == 0.0
    assert worn(IDEAL.person, 150.0).above == 0.0
    person = Person(load_scale=0.9, load_lag_s=0.2)
    assert worn(person, 0.0, 200.0, 0.2).load_n == pytest.approx(0.9 * 200.0 * 0.632, rel=0.01)
    assert worn(person, 0.0, 200.0).load_n == pytest.approx(180.0, rel=1e-3)
    assert worn(IDEAL.person, 0.0, 200.0, 1e-3).load_n == 200.0


def act(kind: str, force: float = 0.0, **more: float) -> Act:
    return msgspec.convert({"kind": kind, "at": 1.0, "duration": 2.0, "force": force} | more, Act)


@pytest.mark.parametrize(
    ("kind", "grip"), [("rest", 1.0), ("relax", hands.RELAXED), ("limp", 0.0), ("let_go", 0.0)]
)
def test_a_weight_comes_and_goes_within_its_ramp_and_the_hand_holds_as_its_kind_says(
    kind: str, grip: float
) -> None:
    acts = [act(kind, 100.0, ramp=0.5)]
    for t, share in ((0.99, 0.0), (1.25, 0.5), (1.6, 1.0), (2.4, 1.0), (2.75, 0.5), (3.0, 0.0)):
        found = hands.acting(acts, t)
        assert found.load == pytest.approx(0.0 if kind == "let_go" else share * 100.0)
        held = 1.0 + share * (grip - 1.0)
        inside = 1.0 <= t < 3.0
        assert found.grip == pytest.approx(float(not inside) if grip == 0.0 else held)


def test_a_weight_may_go_faster_than_it_came() -> None:
    acts = [act("rest", 100.0, ramp=1.0, release=0.2)]
    assert hands.acting(acts, 1.5).load == pytest.approx(50.0)
    assert hands.acting(acts, 2.9).load == pytest.approx(50.0)


def test_bumps_tremor_and_a_pull_are_forces_and_add_up() -> None:
    assert hands.acting([act("bump", 60.0, duration=0.04)], 1.02).up == pytest.approx(60.0)
    assert hands.acting([act("bump", 60.0, duration=0.04)], 1.041) == hands.NO_ACT
    quarter = 1.0 + 1.25 / hands.TREMOR_HZ
    assert hands.acting([act("tremor", 8.0)], quarter).up == pytest.approx(8.0)
    both = [act("pull", -30.0), act("rest", 50.0), act("rest", 20.0)]
    assert hands.acting(both, 2.0) == hands.Acting(load=70.0, ahead=-30.0)


def test_a_harness_that_softens_gives_no_more_than_its_limit(robot: RobotConfig) -> None:
    at = 1.1 + robot.geometry.harness_point[2]
    soft = msgspec.structs.replace(robot.simulation.operator, soft_n=50.0)
    linear = Operator(robot.simulation.operator, robot.geometry.harness_point)
    softens = Operator(soft, robot.geometry.harness_point)
    for below in (0.001, 0.09):
        spring = linear.force(LEVEL, at - below, 0.0, 0.0, 0.0).force_z
        found = softens.force(LEVEL, at - below, 0.0, 0.0, 0.0).force_z
        assert found == pytest.approx(spring * 50.0 / (50.0 + spring))


def test_the_harness_feels_a_pull_where_the_person_is(robot: RobotConfig) -> None:
    scenario = msgspec.structs.replace(still(2.0), act=(act("pull", 40.0, at=0.0, ramp=0.0),))
    world = World(body_of(robot, IDEAL), scenario)
    world.remove_hoist()
    world.start()
    world.step(np.zeros(12))
    outside = world.outside
    assert outside.harness_force[0] == pytest.approx(40.0, abs=0.1)
    assert world.data.xfrc_applied[world.model.body("torso").id][0] == pytest.approx(40.0)
    turns = world.data.xfrc_applied[world.model.body("torso").id][4] - outside.hand.moment_pitch
    x, _, z = robot.geometry.harness_point
    lifts = outside.hand.force_z - outside.wearer.load_n
    assert turns == pytest.approx(z * 40.0 - x * lifts, rel=0.01)
