"""A load that the file does not know is found from the torques of one that stands, or moves."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from services.planner.law.load import FRICTION_BAND, RESUME_FRACTION, WEIGHING_S, Load, LoadState
from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY, RobotConfig
from tests.planner.conftest import Closed
from tests.planner.states import DT, Kept, Law, wrench

LARGEST = (8.0, 20.0)


WEIGHT, MASS, INERTIA = 700.0, 40.0, 0.5


STRAIGHT_UP = np.array((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))


Push = Callable[[float], float]


def found(
    load: Kept,
    kg: float,
    a: float = 0.0,
    b: float = 0.0,
    *,
    seconds: float = 8.0,
    pitch: Push = lambda _: 0.0,
) -> Kept:
    """Feed it what a robot at rest holds up that carries so much more."""
    for tick in range(round(seconds / DT)):
        at = pitch(tick * DT)
        moment = a * math.cos(at) + b * math.sin(at)
        F = np.array((0.0, 0.0, WEIGHT + GRAVITY * kg, 0.0, moment, 0.0))
        load.advance(F, STRAIGHT_UP, at, (0.0, 0.0), DT, led=False)
    return load


def bears(
    load: Kept, share: float, seconds: float, *, led: bool = False, rates: Pair = (0.0, 0.0)
) -> None:
    """Let the feet bear a share of the file's weight for a while."""
    F = share * WEIGHT * STRAIGHT_UP
    for _ in range(round(seconds / DT)):
        load.advance(F, STRAIGHT_UP, 0.0, rates, DT, led=led)


@pytest.fixture
def load() -> Kept:
    return Kept(Load(LARGEST, WEIGHT, MASS, INERTIA), LoadState())


@pytest.mark.parametrize("kg", [-7.0, 0.0, 4.0])
@pytest.mark.parametrize("moment", [-12.0, 0.0, 18.0])
def test_what_rests_on_it_is_found(load: Kept, kg: float, moment: float) -> None:
    found(load, kg, moment)
    assert (load.state.kg, load.state.a) == pytest.approx((kg, moment), abs=0.05)
    assert not load.state.blocks


def test_how_high_it_lies_shows_as_the_torso_pitches(load: Kept) -> None:
    found(load, 0.0, 10.0, -8.0, seconds=300.0, pitch=lambda t: 0.7 + 0.7 * math.sin(t))
    assert (load.state.a, load.state.b) == pytest.approx((10.0, -8.0), abs=0.3)


def test_a_robot_that_falls_freely_upwards_or_whose_torso_turns_shows_it_too(load: Kept) -> None:
    """Torques that hold the file's weight and moment look right: the motion gives it away."""
    kg, a, v, rate = -5.0, 6.0, 0.0, 0.0
    for _ in range(500):
        load.advance(WEIGHT * STRAIGHT_UP, STRAIGHT_UP, 0.0, (v, rate), DT, led=False)
        v += DT * -kg * GRAVITY / MASS
        rate += DT * -a / INERTIA
    assert load.state.kg == pytest.approx(kg, abs=0.1)
    assert load.state.a == pytest.approx(a, abs=0.1)


def standing(robot: RobotConfig, kinematics: Kinematics, closed: Closed) -> Law:
    """Return a law that stands at 0.95 m, and have the kinematics there too."""
    law, q = Law(robot), closed(height=0.95)
    law.tick(q, np.zeros(12), 0.0, DT, align=True)
    kinematics.update(q)
    return law


def test_a_person_who_presses_on_it_is_no_load(
    robot: RobotConfig, kinematics: Kinematics, closed: Closed
) -> None:
    """The torques of a stand under the file's weight and 60 N and 10 N m of a hand."""
    law = standing(robot, kinematics, closed)
    tau = robot.total_mass * GRAVITY * kinematics.J[2]
    tau = tau + 60.0 * kinematics.J_harness[2] - 10.0 * kinematics.J[4]
    hand = wrench(-60.0, moment=(0.0, 10.0, 0.0))
    for kg in (0.0, 3.0):  # and 3 kg at the harness point are one, whatever the hand does
        carried = tau + kg * GRAVITY * kinematics.J_harness[2]
        for _ in range(2000):
            law.hocca.weigh(law.state.load, carried, np.zeros(12), hand, DT, led=False)
        found = law.state.load
        assert (found.kg, found.a, found.b) == pytest.approx((kg, 0.0, 0.0), abs=0.05)


def test_without_a_harness_what_was_found_stands(
    robot: RobotConfig, kinematics: Kinematics, closed: Closed
) -> None:
    law = standing(robot, kinematics, closed)
    tau = (robot.total_mass + 5.0) * GRAVITY * kinematics.J[2]
    for _ in range(1000):
        law.hocca.weigh(law.state.load, tau, np.zeros(12), None, DT, led=False)
    assert law.state.load.kg == law.state.load.a == law.state.load.b == 0.0


@pytest.mark.parametrize("newtons", [-50.0, 50.0])
@pytest.mark.parametrize(("led", "seconds"), [(True, 2.0), (False, 0.25)])
def test_while_it_is_led_it_is_found_eight_times_as_slowly(
    load: Kept, led: bool, seconds: float, newtons: float
) -> None:
    bears(load, 1.0 + newtons / WEIGHT, DT + seconds, led=led)
    assert load.state.kg == pytest.approx((1.0 - math.exp(-1.0)) * newtons / GRAVITY, rel=0.02)


def test_after_a_long_gap_it_is_found_at_once_and_no_more(load: Kept) -> None:
    for dt in (DT, 10.0):
        load.advance((WEIGHT + 50.0) * STRAIGHT_UP, STRAIGHT_UP, 0.0, (0.0, 0.0), dt, led=False)
    assert load.state.kg == pytest.approx(50.0 / GRAVITY)


def test_a_robot_that_is_led_and_falls_shows_nothing(load: Kept) -> None:
    bears(load, 1.0, 1.0)
    bears(load, 0.2, 4.0, led=True)
    assert (load.state.kg, load.state.a, load.state.b) == pytest.approx((0.0, 0.0, 0.0))
    assert not load.state.blocks


@pytest.mark.parametrize(("share", "led"), [(0.3, True), (0.5, False)])
def test_one_that_is_led_already_or_bears_half_of_it_does_not_hang(
    load: Kept, share: float, led: bool
) -> None:
    bears(load, share, DT, led=led)
    assert not load.state.blocks


def test_one_that_hangs_is_refused_at_once_and_weighed_before_it_is_led(load: Kept) -> None:
    bears(load, 0.3, DT)
    assert load.state.blocks
    assert "hangs" in load.refusal()
    bears(load, 1.0, 0.5)
    assert load.state.blocks, "its load is not known yet"
    bears(load, 1.0, 0.6 + WEIGHING_S)
    assert (load.state.blocks, load.refusal()) == (False, "")
    assert load.state.kg == pytest.approx(0.0, abs=0.5)


def test_weighing_is_reported_while_it_lasts(load: Kept) -> None:
    bears(load, 0.3, DT)
    while load.state.kg < -RESUME_FRACTION * LARGEST[0]:
        bears(load, 1.0, DT)
    bears(load, 1.0, DT)
    assert load.refusal() == "its load is being weighed"


def test_its_load_is_weighed_from_when_it_is_within_the_limits(load: Kept) -> None:
    bears(load, 0.3, DT)
    bears(load, 0.85, 3.0)
    while load.state.refused:
        bears(load, 1.0, DT)
    bears(load, 1.0, WEIGHING_S - 2 * DT)
    assert load.state.blocks
    bears(load, 1.0, 2 * DT)
    assert not load.state.blocks


def test_a_refused_load_of_a_robot_that_never_hung_is_accepted_without_weighing(load: Kept) -> None:
    found(load, 10.0)
    while load.state.refused:
        found(load, 0.0, seconds=DT)
    assert not load.state.blocks


def test_one_that_is_taken_up_while_it_holds_is_weighed_again(load: Kept) -> None:
    for share, seconds, refused in ((1.0, 2.0, False), (0.0, 1.0, True), (1.0, 0.7, True)):
        bears(load, share, seconds)
        assert load.state.blocks is refused
    bears(load, 1.0, 2.0)
    assert not load.state.blocks


def test_a_dip_of_some_hundredths_of_a_second_is_no_hoist(load: Kept) -> None:
    """A robot that catches a sagging person bounces."""
    bears(load, 1.0, 2.0)
    bears(load, 0.4, 0.04)
    assert not load.state.blocks


@pytest.mark.parametrize("led", [False, True])
def test_one_that_hangs_without_a_harness_is_not_led(load: Kept, led: bool) -> None:
    load.advance_without_harness(0.3 * WEIGHT, DT, led=led)
    assert load.state.blocks is not led, "what is led already is let down again, or falls"
    for _ in range(250):
        load.advance_without_harness(WEIGHT - 100.0, DT, led=led)
    assert not load.state.blocks
    assert (load.state.kg, load.state.a, load.state.b) == (0.0, 0.0, 0.0), (
        "a hand may lift it: nothing is known"
    )


def test_without_a_harness_one_that_hangs_is_weighed_until_it_stands(load: Kept) -> None:
    for share in (0.3, 0.3):
        load.advance_without_harness(share * WEIGHT, DT, led=False)
        assert load.state.blocks
    load.advance_without_harness(0.2 * WEIGHT, 10.0, led=False)
    assert load.state.kg == pytest.approx(-0.8 * WEIGHT / GRAVITY), "at once after a gap"
    load.advance_without_harness(WEIGHT, DT, led=False)
    assert load.state.blocks, "a moment on its feet is none"
    for _ in range(250):
        load.advance_without_harness(WEIGHT, DT, led=False)
    for dt in (DT, 10.0):
        load.advance_without_harness(0.1 * WEIGHT, dt, led=False)
    assert (load.state.blocks, load.state.kg) == (False, 0.0), "what a hand lifts afterwards"


@pytest.mark.parametrize("rates", [(0.06, 0.0), (-0.06, 0.0), (0.0, 0.11), (0.0, -0.11)])
def test_in_motion_it_is_sought_only_if_not_led(load: Kept, rates: Pair) -> None:
    for led, found_n in ((True, 0.0), (False, 50.0)):
        bears(load, 1.0 + 50.0 / WEIGHT, 4.0, led=led, rates=rates)
        assert load.state.kg == pytest.approx(found_n / GRAVITY, abs=0.05 * (not led))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_friction_is_left_to_the_hand_and_the_rest_capped(load: Kept, sign: float) -> None:
    for newtons, given in (
        (0.9 * FRICTION_BAND[0], 0.0),
        (FRICTION_BAND[0] + 10.0, 10.0),
        (500.0, 8 * GRAVITY),
    ):
        found(load, sign * newtons / GRAVITY)
        assert load.force() == pytest.approx(sign * given, abs=0.05)
    found(load, 0.0, sign * 9.0)
    assert load.moment(0.0) == pytest.approx(sign * (9.0 - FRICTION_BAND[1]), abs=0.05)
    assert load.moment(math.pi / 2) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("kg", "a", "said"),
    [
        (-10.0, 0.0, "10.0 kg less than its file says"),
        (9.0, 0.0, "9.0 kg more"),
        (0.0, 30.0, "too far behind, by 30 N m"),
        (0.0, -30.0, "too far ahead, by 30 N m"),
    ],
)
def test_far_from_the_file_it_is_refused(load: Kept, kg: float, a: float, said: str) -> None:
    found(load, kg, a)
    assert load.state.blocks
    assert said in load.refusal()
    within = 1.05 * RESUME_FRACTION
    found(load, math.copysign(8.0 * within, kg) if kg else 0.0, 20.0 * within if a else 0.0)
    assert load.state.blocks or a < 0.0, "it does not flap at the limit"
    found(load, 0.0)
    assert (load.state.blocks, load.refusal()) == (False, "")


@pytest.mark.parametrize(
    ("kg", "a", "b", "words"),
    [
        (9.0, 0.0, 0.0, ["9.0 kg more"]),
        (-0.5, 25.0, 0.0, ["too far behind, by 25 N m"]),
        (0.0, 0.5, 25.0, ["too far low, by 25 N m"]),
        (0.0, -0.5, -25.0, ["too far high, by 25 N m"]),
        (-9.0, -25.0, 0.0, ["9.0 kg less", "too far ahead, by 25 N m"]),
        (6.0, 17.0, 0.5, ["too far behind, by 17 N m"]),
    ],
)
def test_each_reason_is_reported_and_no_other(
    load: Kept, kg: float, a: float, b: float, words: list[str]
) -> None:
    load.state = LoadState(kg, a, b, None, refused=True)
    reason = load.refusal()
    assert reason.count("carries") + reason.count("lies") == len(words)
    assert [reason.index(said) for said in words] == sorted(reason.index(said) for said in words)
    assert "; the load" in reason or len(words) == 1


@pytest.mark.parametrize(
    ("kg", "a", "text"),
    [
        (
            9.0, 0.0,
            ("the robot carries 9.0 kg more than its file says, or its harness measures wrongly: "
            "at most 8 kg are accepted (6.4 once refused); tare the unloaded harness "
            "(`xrl drive tare`) first; if that changes nothing, set mass.payload, "
            "then `xrl gains`"),
        ),
        (
            -9.0, 25.0,
            ("the robot carries 9.0 kg less than its file says, or its harness measures wrongly: "
            "at most 8 kg are accepted (6.4 once refused); tare the unloaded harness "
            "(`xrl drive tare`) first; if that changes nothing and nothing holds it up, "
            "set mass.payload, then `xrl gains`; the load lies too far behind, by 25 N m: "
            "at most 20 N m are accepted "
            "(16 once refused)"),
        ),
        (
            -50.0, 0.0,
            ("it hangs: lower it until its feet bear its weight; or, on its feet, it carries "
            "50 kg less than its file says: set mass.payload, then `xrl gains`"),
        ),
    ],
)  # fmt: skip
def test_a_refusal_says_what_is_and_what_would_be_right(
    load: Kept, kg: float, a: float, text: str
) -> None:
    load.state = LoadState(kg, a, refused=True)
    assert load.refusal() == text
