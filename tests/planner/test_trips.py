"""What the planner trips on, and how far it drifts without a hand: in time, and nothing unknown."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from services.planner.law.hocca import LawOutput
from services.planner.law.kinematics import Measured
from services.planner.watch.soles import Soles
from services.planner.watch.trips import CALM_NS, PlannerTrips, TripsState, values_of
from shared.bus.messages import Pair, Trip
from shared.clock import NS_PER_MS
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS
from tests.planner import oracle
from tests.planner.conftest import Closed
from tests.planner.states import TICK_NS, Kept

T0 = 5_000_000_000


CALM = tuple(200.0 if trip is Trip.UNLOADED else 0.0 for trip in PLANNER_TRIPS)


TRIPS = list(PLANNER_TRIPS)


def beyond(robot: RobotConfig, trip: Trip, by: float = 1.001) -> tuple[float, ...]:
    """Return calm values but one, beyond its limit."""
    row = PLANNER_TRIPS[trip]
    limit = getattr(robot.trips, row.key).limit
    values = list(CALM)
    values[TRIPS.index(trip)] = limit / by if row.least else limit * by
    return tuple(values)


def led(robot: RobotConfig) -> Kept:
    """Return the trips of a planner that leads a robot which stands."""
    trips = Kept(PlannerTrips(robot), TripsState())
    trips.advance(T0 - TICK_NS, CALM, leads=True)
    return trips


def go_on(trips: Kept, values: tuple[float, ...], ticks: range, *, leads: bool = True) -> Kept:
    """Go on with these values; one that has tripped leads no more."""
    for tick in ticks:
        trips.advance(T0 + tick * TICK_NS, values, leads=leads and trips.state.tripped is Trip.NONE)
    return trips


def test_table_robot_file_and_enumerations_name_the_same(robot: RobotConfig) -> None:
    keys = [row.key for row in (*JOINT_TRIPS.values(), *PLANNER_TRIPS.values())]
    assert sorted(keys) == sorted(robot.trips.__struct_fields__)
    assert {*PLANNER_TRIPS, Trip.NONE} == set(Trip)


@pytest.mark.parametrize("trip", TRIPS)
def test_each_trips_once_it_has_lasted(robot: RobotConfig, trip: Trip) -> None:
    trips, values = led(robot), beyond(robot, trip)
    lasted_ns = round(getattr(robot.trips, PLANNER_TRIPS[trip].key).after_ms * NS_PER_MS)
    for at_ns, tripped in ((0, Trip.NONE), (lasted_ns - 1, Trip.NONE), (lasted_ns, trip)):
        trips.advance(T0 + at_ns, values, leads=True)
        assert trips.state.tripped is tripped
    row, limit = PLANNER_TRIPS[trip], getattr(robot.trips, PLANNER_TRIPS[trip].key).limit
    value = f"{values[TRIPS.index(trip)]:.3g} {row.unit}"
    assert trips.state.why == f"{row.measured}: {value} (limit {limit:g})"


@pytest.mark.parametrize("trip", TRIPS)
def test_what_comes_back_in_between_does_not(robot: RobotConfig, trip: Trip) -> None:
    trips = led(robot)
    for tick in range(1000):
        go_on(trips, CALM if tick % 3 == 2 else beyond(robot, trip), range(tick, tick + 1))
    assert trips.state.tripped is Trip.NONE


@pytest.mark.parametrize("trip", TRIPS)
def test_at_its_limit_nothing_trips_yet(robot: RobotConfig, trip: Trip) -> None:
    assert go_on(led(robot), beyond(robot, trip, by=1.0), range(1000)).state.tripped is Trip.NONE


@pytest.mark.parametrize("trip", TRIPS)
def test_a_planner_that_does_not_lead_trips_on_nothing(robot: RobotConfig, trip: Trip) -> None:
    trips = go_on(
        Kept(PlannerTrips(robot), TripsState()), beyond(robot, trip), range(1000), leads=False
    )
    assert go_on(trips, beyond(robot, trip), range(1000, 1001)).state.tripped is Trip.NONE


def test_what_is_not_known_is_no_reason_nor_a_leg_on_the_hoist(robot: RobotConfig) -> None:
    for values in ((math.nan,) * len(CALM), beyond(robot, Trip.UNLOADED)):
        assert (
            go_on(Kept(PlannerTrips(robot), TripsState()), values, range(1000)).state.tripped
            is Trip.NONE
        )


@pytest.mark.parametrize("known", [True, False], ids=["it lasts", "it is not known"])
@pytest.mark.parametrize("trip", TRIPS)
def test_it_ends_after_a_calm_second(robot: RobotConfig, trip: Trip, known: bool) -> None:
    """A harness that falls silent takes no load off the person."""
    trips = go_on(led(robot), beyond(robot, trip), range(100))
    other = beyond(robot, Trip.LEGS if trip is Trip.REACH else Trip.REACH)
    unknown = tuple(math.nan if each is trip else x for each, x in zip(TRIPS, CALM, strict=True))
    go_on(trips, other if known else unknown, range(100, 2100), leads=False)
    calm_from = T0 + 2100 * TICK_NS
    for at_ns, tripped in ((0, trip), (CALM_NS - 1, trip), (CALM_NS, Trip.NONE)):
        trips.advance(calm_from + at_ns, CALM, leads=False)
        assert trips.state.tripped is tripped
    assert trips.state.why == ""


def test_a_legs_load_is_the_force_that_its_torques_hold(robot: RobotConfig, closed: Closed) -> None:
    """By the oracle: closure is what the left leg says less what the right one does."""
    q, wrench = closed(height=0.948), np.array((5.0, -7.0, 230.0, 3.0, 9.0, -2.0))
    tau = oracle.derivative(lambda near: oracle.closure(robot, near), q).T @ wrench
    tau[:6] *= -1.0
    measured = Measured(robot)
    measured.update(q, np.zeros(12))
    assert measured.leg_loads(tau) == pytest.approx((230.0, 230.0), abs=0.1)
    tau[6:] = 0.0
    assert measured.leg_loads(tau) == pytest.approx((230.0, 0.0), abs=0.1)


def test_a_straight_leg_measures_nothing(robot: RobotConfig, closed: Closed) -> None:
    measured, q = Measured(robot), closed(height=0.948)
    q[:6] = 0.0
    measured.update(q, np.zeros(12))
    right, left = measured.leg_loads(np.ones(12))
    assert math.isnan(right)
    assert math.isfinite(left)


def output_of(assist: float) -> LawOutput:
    """Return what a law at rest says, with an assist force, N."""
    zeros = dict.fromkeys(LawOutput._fields, np.zeros(12))
    return LawOutput(**(zeros | {"assist": assist, "ik_residual": 0.0}))  # type: ignore[arg-type]


def value_of(
    trip: Trip, assist: float = 0.0, lifted: float | None = None, rate: float = 0.0,
    *, leads: bool, soles: Pair = (200.0, 200.0),
) -> float:  # fmt: skip
    """Return what is measured for a trip, of a law at rest."""
    output, zeros = output_of(assist), np.zeros(12)
    values = values_of(output, zeros, soles, 0.0, lifted, rate, 0.0, leads=leads)
    return values[TRIPS.index(trip)]


@pytest.mark.parametrize(
    ("lifted", "assist", "leads", "found"),
    [
        (-200.0, 200.0, True, 0.0),
        (0.0, 200.0, True, 200.0),
        (0.0, 200.0, False, 0.0),
        (-300.0, 100.0, True, 200.0),
        (-300.0, 100.0, False, 200.0),
        (160.0, 0.0, False, 160.0),
    ],
)
def test_in_hold_only_a_load_beyond_what_was_asked_or_a_pull_upwards_counts(
    lifted: float, assist: float, leads: bool, found: float
) -> None:
    """A request of 200 N with nobody there tripped for ever."""
    assert value_of(Trip.HARNESS, assist, lifted, leads=leads) == pytest.approx(found)


@pytest.mark.parametrize(
    ("lifted", "rate", "leads", "watts"),
    [
        (-240.0, -0.1, True, 10.0),
        (-240.0, 0.1, True, 0.1),
        (-130.0, -0.3, True, 0.0),
        (60.0, -0.3, True, 0.0),
        (-240.0, 0.0, False, 100.0),
        (-130.0, 0.0, False, 0.0),
    ],
)
def test_sagging_is_the_power_of_a_load_beyond_assist_and_lead_as_it_sinks(
    lifted: float, rate: float, leads: bool, watts: float
) -> None:
    """The assist is 100 N, a lead 40 N. In HOLD nothing sinks, and the load itself is judged."""
    assert value_of(Trip.SAGGING, 100.0, lifted, rate, leads=leads) == pytest.approx(watts)


def test_a_hand_that_was_held_up_may_catch_up(robot: RobotConfig) -> None:
    """It presses from the first tick on; once it has not, the same load is a person who sags."""
    sagging = beyond(robot, Trip.SAGGING)
    trips = go_on(Kept(PlannerTrips(robot), TripsState()), sagging, range(100))
    assert trips.state.tripped is Trip.NONE
    go_on(trips, CALM, range(100, 101))
    assert go_on(trips, sagging, range(101, 200)).state.tripped is Trip.SAGGING


@pytest.mark.parametrize("loads", [(math.nan, 5.0), (5.0, math.nan)])
def test_with_one_leg_unknown_none_is_unloaded(loads: Pair) -> None:
    assert math.isnan(value_of(Trip.UNLOADED, leads=True, soles=loads))


def test_one_that_was_put_back_on_the_hoist_misses_no_leg(robot: RobotConfig) -> None:
    trips, hanging = led(robot), beyond(robot, Trip.UNLOADED)
    trips.advance(T0, hanging, leads=False)
    assert go_on(trips, hanging, range(1, 1000)).state.tripped is Trip.NONE


@pytest.mark.parametrize("trip", TRIPS)
def test_one_that_stood_as_it_tripped_is_not_led_on_one_leg(robot: RobotConfig, trip: Trip) -> None:
    trips = go_on(led(robot), beyond(robot, trip), range(100))
    go_on(trips, beyond(robot, Trip.UNLOADED), range(100, 1100), leads=False)
    assert trips.state.tripped is trip


def test_both_legs_have_borne_it_once_each_bears_three_times_the_least(robot: RobotConfig) -> None:
    least = robot.trips.unloaded.limit
    for borne, tripped in ((3.0 * least, Trip.NONE), (3.0 * least + 0.1, Trip.UNLOADED)):
        values = list(CALM)
        values[TRIPS.index(Trip.UNLOADED)] = borne
        trips = go_on(Kept(PlannerTrips(robot), TripsState()), tuple(values), range(1))
        assert go_on(trips, beyond(robot, Trip.UNLOADED), range(1, 500)).state.tripped is tripped


def test_the_first_trip_is_reported(robot: RobotConfig) -> None:
    trips = go_on(led(robot), beyond(robot, Trip.LEGS), range(100))
    go_on(trips, beyond(robot, Trip.REACH), range(100, 200))
    assert trips.state.tripped is Trip.LEGS
    assert PLANNER_TRIPS[Trip.LEGS].measured in trips.state.why
    trips = go_on(led(robot), beyond(robot, TRIPS[-1]), range(100))
    for tick in range(100, 200):  # it should lead no more, and what comes is first in the table
        trips.advance(T0 + tick * TICK_NS, beyond(robot, TRIPS[0]), leads=True)
    assert trips.state.tripped is TRIPS[-1]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(12))
def test_each_value_is_the_tables(joint: int, sign: float) -> None:
    q = np.zeros(12)
    q[joint] = 0.2 * sign
    pdot = np.array((0.1, 0.2, 0.3 * sign, 0.4, 0.5 * sign, 0.6))
    output = output_of(0.0)._replace(
        closure=np.array((0.01, -0.02, 0.02, 9.0, 9.0, 9.0)), ik_residual=0.004, pdot=pdot,
        p=np.array((0.02 * sign, *5 * [0.3])), p_ref=np.array((-0.01 * sign, *5 * [9.0])),
    )  # fmt: skip
    values = values_of(output, q, (90.0, 80.0), 0.6, None, 0.0, 0.07, leads=True)
    expected = {
        Trip.LEGS: 0.03, Trip.REACH: 0.004, Trip.TRACKING: 0.2, Trip.UNLOADED: 80.0,
        Trip.SINKING: 0.3, Trip.TURNING: 0.5, Trip.HARNESS: math.nan, Trip.SAGGING: math.nan,
        Trip.UNATTENDED: 0.07, Trip.EDGE: 0.6, Trip.TIPPING: 0.6,
        Trip.OFF_BALANCE: 0.03,
    }  # fmt: skip
    assert values == pytest.approx([expected[trip] for trip in TRIPS], nan_ok=True)


def off(robot: RobotConfig, metres: float) -> tuple[float, ...]:
    return beyond(robot, Trip.OFF_BALANCE, metres / robot.trips.balance.limit)


def test_a_com_that_hold_left_off_its_place_is_brought_back_and_trips_if_it_goes_on(
    robot: RobotConfig,
) -> None:
    most = robot.trips.balance.limit
    trips = Kept(PlannerTrips(robot), TripsState())
    assert go_on(trips, off(robot, most + 0.03), range(100)).state.tripped is Trip.NONE
    assert go_on(trips, off(robot, most + 0.049), range(100, 200)).state.tripped is Trip.NONE
    assert go_on(trips, off(robot, 0.01), range(200, 300)).state.tripped is Trip.NONE
    assert go_on(trips, off(robot, most), range(300, 400)).state.tripped is Trip.NONE
    back = msgspec.structs.replace(trips.state)
    assert go_on(trips, off(robot, 1.001 * most), range(400, 500)).state.tripped is Trip.OFF_BALANCE
    trips.state = back
    trips.advance(T0 + 500 * TICK_NS, CALM, leads=False)
    assert go_on(trips, off(robot, 0.2), range(501, 600)).state.tripped is Trip.NONE
    assert go_on(trips, off(robot, 0.221), range(600, 700)).state.tripped is Trip.OFF_BALANCE


def test_a_com_that_hold_leaves_off_its_place_lets_a_trip_end(robot: RobotConfig) -> None:
    trips = go_on(led(robot), beyond(robot, Trip.EDGE), range(200))
    assert trips.state.tripped is Trip.EDGE
    for tick in range(200, 200 + CALM_NS // TICK_NS + 2):
        trips.advance(T0 + tick * TICK_NS, off(robot, 0.06), leads=False)
    assert trips.state.tripped is Trip.NONE


def test_while_the_planner_moves_it_for_heat_nothing_sags_and_nothing_drifts() -> None:
    given = output_of(0.0), np.zeros(12), (90.0, 80.0), 0.6, -300.0, -0.2, 0.07
    led, moved = (values_of(*given, leads=True, moves=moves) for moves in (False, True))
    apart = {
        TRIPS[i]: pair for i, pair in enumerate(zip(led, moved, strict=True)) if len({*pair}) > 1
    }
    assert set(apart) == {Trip.SAGGING, Trip.UNATTENDED}
    assert {now for _, now in apart.values()} == {0.0}


# ---- how far out its soles bear it


def test_a_sole_bears_its_legs_force_and_its_leg(robot: RobotConfig) -> None:
    leg = 2.0 * robot.mass.module * GRAVITY
    right, left = Soles(robot).loads((190.0, math.nan))
    assert right == pytest.approx(190.0 + leg)
    assert math.isnan(left)


@pytest.mark.parametrize("ankle", [0, 6])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_sole_is_at_its_edge_when_its_load_there_balances_the_ankles_torque(
    robot: RobotConfig, ankle: int, sign: float
) -> None:
    soles, tau = Soles(robot), np.full(12, 5.0)
    tau[ankle] = sign * 300.0 * robot.geometry.w_foot / 2.0
    assert soles.edge(tau, (300.0, 300.0)) == pytest.approx(1.0)


def test_a_load_that_is_not_known_is_half_of_the_weight_and_none_makes_no_edge_infinite(
    robot: RobotConfig,
) -> None:
    soles, tau = Soles(robot), np.zeros(12)
    half = 0.5 * (robot.total_mass + 2.0 * robot.mass.module) * GRAVITY
    tau[0] = half * robot.geometry.w_foot / 2.0
    assert soles.edge(tau, (math.nan, math.nan)) == pytest.approx(1.0)
    assert math.isfinite(soles.edge(tau, (0.0, -100.0)))
