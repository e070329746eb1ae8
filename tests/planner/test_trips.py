"""What the planner trips on: in time, and on nothing that is unknown; and what the soles bear."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from services.planner.law.feet import Soles
from services.planner.law.hocca import LawOutput
from services.planner.law.kinematics import Measured
from services.planner.watch.trips import CALM_NS, PlannerTrips, TripsState, values_of
from shared.arrays import Array
from shared.bus.messages import Pair, Trip
from shared.clock import NS_PER_MS
from shared.config.robot_config import GRAVITY
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS
from tests.planner import oracle
from tests.planner.states import ROBOT, STILL, TICK_NS, closed

T0 = 5_000_000_000
CALM = tuple(200.0 if trip is Trip.UNLOADED else 0.0 for trip in PLANNER_TRIPS)
TRIPS = list(PLANNER_TRIPS)
Values = tuple[float, ...]
each_trip = pytest.mark.parametrize("trip", TRIPS)


def but(trip: Trip, value: float) -> Values:
    """Return calm values but one."""
    return tuple(value if each is trip else x for each, x in zip(TRIPS, CALM, strict=True))


def beyond(trip: Trip, by: float = 1.001) -> Values:
    """Return calm values but one, beyond its limit."""
    row = PLANNER_TRIPS[trip]
    limit = getattr(ROBOT.trips, row.key).limit
    return but(trip, limit / by if row.least else limit * by)


class Watched:
    """The trips of a planner; one that has tripped leads no more."""

    def __init__(self, first: Values | None = CALM) -> None:
        """Lead a robot that stands for one tick; None: it has not led yet."""
        self.trips, self.state, self.now_ns = PlannerTrips(ROBOT), TripsState(), T0
        if first is not None:
            self.run(first, 1)

    def at(self, now_ns: int, values: Values, *, leads: bool = True) -> Trip:
        self.trips.advance(self.state, now_ns, values, leads=leads)
        return self.state.tripped

    def run(self, values: Values, ticks: int = 100, *, leads: bool = True) -> Trip:
        """Go on with these values; return what has tripped."""
        for _ in range(ticks):
            self.at(self.now_ns, values, leads=leads and self.state.tripped is Trip.NONE)
            self.now_ns += TICK_NS
        return self.state.tripped


def test_table_robot_file_and_enumerations_name_the_same() -> None:
    keys = [row.key for row in (*JOINT_TRIPS.values(), *PLANNER_TRIPS.values())]
    assert sorted(keys) == sorted(ROBOT.trips.__struct_fields__)
    assert {*PLANNER_TRIPS, Trip.NONE} == set(Trip)


@each_trip
def test_each_trips_once_it_has_lasted(trip: Trip) -> None:
    watched, values, row = Watched(), beyond(trip), PLANNER_TRIPS[trip]
    config, t0 = getattr(ROBOT.trips, row.key), watched.now_ns
    lasted_ns = round(config.after_ms * NS_PER_MS)
    for at_ns, tripped in ((0, Trip.NONE), (lasted_ns - 1, Trip.NONE), (lasted_ns, trip)):
        assert watched.at(t0 + at_ns, values) is tripped
    value = f"{values[TRIPS.index(trip)]:.3g} {row.unit}"
    assert watched.state.why == f"{row.measured}: {value} (limit {config.limit:g})"


@each_trip
def test_nothing_trips_at_its_limit_nor_on_what_comes_back_nor_unless_it_leads(trip: Trip) -> None:
    assert Watched().run(beyond(trip, by=1.0), 1000) is Trip.NONE
    back, held = Watched(), Watched(None)
    for tick in range(1000):
        assert back.run(CALM if tick % 3 == 2 else beyond(trip), 1) is Trip.NONE
    held.run(beyond(trip), 1000, leads=False)
    assert held.run(beyond(trip), 1) is Trip.NONE


def test_what_is_not_known_is_no_reason_nor_a_leg_on_the_hoist() -> None:
    for values in ((math.nan,) * len(CALM), beyond(Trip.UNLOADED)):
        assert Watched(None).run(values, 1000) is Trip.NONE
    hung = Watched()
    hung.run(beyond(Trip.UNLOADED), 1, leads=False)
    assert hung.run(beyond(Trip.UNLOADED), 1000) is Trip.NONE, "it was put back on the hoist"


@pytest.mark.parametrize("known", [True, False], ids=["it lasts", "it is not known"])
@each_trip
def test_it_ends_after_a_calm_second(trip: Trip, known: bool) -> None:
    """A harness that falls silent takes no load off the person."""
    watched = Watched()
    watched.run(beyond(trip))
    other = beyond(Trip.LEGS if trip is Trip.REACH else Trip.REACH)
    watched.run(other if known else but(trip, math.nan), 2000, leads=False)
    t0 = watched.now_ns
    for at_ns, tripped in ((0, trip), (CALM_NS - 1, trip), (CALM_NS, Trip.NONE)):
        assert watched.at(t0 + at_ns, CALM, leads=False) is tripped
    assert watched.state.why == ""


def test_a_legs_load_is_the_force_that_its_torques_hold() -> None:
    """By the oracle: closure is what the left leg says less what the right one does."""
    q, wrench = closed(height=0.948), np.array((5.0, -7.0, 230.0, 3.0, 9.0, -2.0))
    tau = oracle.derivative(lambda near: oracle.closure(ROBOT, near), q).T @ wrench
    tau[:6] *= -1.0
    measured = Measured(ROBOT)
    measured.update(q, np.zeros(12))
    assert measured.leg_loads(tau) == pytest.approx((230.0, 230.0), abs=0.1)
    tau[6:] = 0.0
    assert measured.leg_loads(tau) == pytest.approx((230.0, 0.0), abs=0.1)
    q[:6] = 0.0  # a straight leg measures nothing
    measured.update(q, np.zeros(12))
    right, left = measured.leg_loads(np.ones(12))
    assert math.isnan(right)
    assert math.isfinite(left)


def measured(
    lifted: float | None = None, assist: float = 0.0, rate: float = 0.0, *, leads: bool,
    soles: Pair = (200.0, 200.0), q: Array = STILL, edge: float = 0.0, drift: float = 0.0,
    moves: bool = False, **output: Any,
) -> dict[Trip, float]:  # fmt: skip
    """Return the values of a law at rest, with what is named."""
    zeros = dict.fromkeys(LawOutput._fields, np.zeros(12)) | {"ik_residual": 0.0}
    law = LawOutput(**(zeros | {"assist": assist} | output))  # type: ignore[arg-type]
    values = values_of(law, q, soles, edge, lifted, rate, drift, leads=leads, moves=moves)
    return dict(zip(TRIPS, values, strict=True))


@pytest.mark.parametrize(
    ("lifted", "assist", "leads", "found"),
    [
        (-200.0, 200.0, True, 0.0), (0.0, 200.0, True, 200.0), (0.0, 200.0, False, 0.0),
        (-300.0, 100.0, True, 200.0), (-300.0, 100.0, False, 200.0), (160.0, 0.0, False, 160.0),
    ],
)  # fmt: skip
def test_in_hold_only_a_load_beyond_what_was_asked_or_a_pull_upwards_counts(
    lifted: float, assist: float, leads: bool, found: float
) -> None:
    """A request of 200 N with nobody there tripped for ever."""
    assert measured(lifted, assist, leads=leads)[Trip.HARNESS] == pytest.approx(found)


@pytest.mark.parametrize(
    ("lifted", "rate", "leads", "watts"),
    [
        (-240.0, -0.1, True, 10.0), (-240.0, 0.1, True, 0.1), (-130.0, -0.3, True, 0.0),
        (60.0, -0.3, True, 0.0), (-240.0, 0.0, False, 100.0), (-130.0, 0.0, False, 0.0),
    ],
)  # fmt: skip
def test_sagging_is_the_power_of_a_load_beyond_assist_and_lead_as_it_sinks(
    lifted: float, rate: float, leads: bool, watts: float
) -> None:
    """The assist is 100 N, a lead 40 N. In HOLD nothing sinks, and the load itself is judged."""
    assert measured(lifted, 100.0, rate, leads=leads)[Trip.SAGGING] == pytest.approx(watts)


def test_a_hand_that_was_held_up_may_catch_up() -> None:
    """It presses from the first tick on; once it has not, the same load is a person who sags."""
    watched, sagging = Watched(None), beyond(Trip.SAGGING)
    assert watched.run(sagging) is Trip.NONE
    watched.run(CALM, 1)
    assert watched.run(sagging) is Trip.SAGGING


@pytest.mark.parametrize("loads", [(math.nan, 5.0), (5.0, math.nan)])
def test_with_one_leg_unknown_none_is_unloaded(loads: Pair) -> None:
    assert math.isnan(measured(leads=True, soles=loads)[Trip.UNLOADED])


@each_trip
def test_one_that_stood_as_it_tripped_is_not_led_on_one_leg(trip: Trip) -> None:
    watched = Watched()
    watched.run(beyond(trip))
    assert watched.run(beyond(Trip.UNLOADED), 1000, leads=False) is trip


def test_both_legs_have_borne_it_once_each_bears_three_times_the_least() -> None:
    least = ROBOT.trips.unloaded.limit
    for borne, tripped in ((3.0 * least, Trip.NONE), (3.0 * least + 0.1, Trip.UNLOADED)):
        assert Watched(but(Trip.UNLOADED, borne)).run(beyond(Trip.UNLOADED), 500) is tripped


def test_the_first_trip_is_reported() -> None:
    first, last = Watched(), Watched()
    first.run(beyond(Trip.LEGS))
    assert first.run(beyond(Trip.REACH)) is Trip.LEGS
    assert PLANNER_TRIPS[Trip.LEGS].measured in first.state.why
    last.run(beyond(TRIPS[-1]))
    for tick in range(100):  # it should lead no more, and what comes is first in the table
        assert last.at(last.now_ns + tick * TICK_NS, beyond(TRIPS[0])) is TRIPS[-1]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(12))
def test_each_value_is_the_tables(joint: int, sign: float) -> None:
    found = measured(
        leads=True, soles=(90.0, 80.0), edge=0.6, drift=0.07, q=0.2 * sign * np.eye(12)[joint],
        closure=np.array((0.01, -0.02, 0.02, 9.0, 9.0, 9.0)), ik_residual=0.004,
        pdot=np.array((0.1, 0.2, 0.3 * sign, 0.4, 0.5 * sign, 0.6)),
        p=np.array((0.02 * sign, *5 * [0.3])), p_ref=np.array((-0.01 * sign, *5 * [9.0])),
    )  # fmt: skip
    expected = {
        Trip.LEGS: 0.03, Trip.REACH: 0.004, Trip.TRACKING: 0.2, Trip.UNLOADED: 80.0,
        Trip.SINKING: 0.3, Trip.TURNING: 0.5, Trip.HARNESS: math.nan, Trip.SAGGING: math.nan,
        Trip.UNATTENDED: 0.07, Trip.EDGE: 0.6, Trip.TIPPING: 0.6,
        Trip.OFF_BALANCE: 0.03,
    }  # fmt: skip
    assert found == pytest.approx(expected, nan_ok=True)


def off(metres: float) -> Values:
    return but(Trip.OFF_BALANCE, metres)


def test_a_com_that_hold_left_off_its_place_is_brought_back_and_trips_if_it_goes_on() -> None:
    most, watched = ROBOT.trips.balance.limit, Watched(None)
    for metres in (most + 0.03, most + 0.049, 0.01, most):
        assert watched.run(off(metres)) is Trip.NONE
    back = msgspec.structs.replace(watched.state)
    assert watched.run(off(1.001 * most)) is Trip.OFF_BALANCE
    watched.state = back
    watched.run(CALM, 1, leads=False)
    assert watched.run(off(0.2)) is Trip.NONE
    assert watched.run(off(0.221)) is Trip.OFF_BALANCE


def test_a_com_that_hold_leaves_off_its_place_lets_a_trip_end() -> None:
    watched = Watched()
    assert watched.run(beyond(Trip.EDGE), 200) is Trip.EDGE
    assert watched.run(off(0.06), CALM_NS // TICK_NS + 2, leads=False) is Trip.NONE


def test_while_the_planner_moves_it_for_heat_nothing_sags_and_nothing_drifts() -> None:
    led, moved = (
        measured(-300.0, 0.0, -0.2, leads=True, edge=0.6, drift=0.07, moves=moves)
        for moves in (False, True)
    )
    apart = {trip: moved[trip] for trip in TRIPS if led[trip] != moved[trip]}
    assert apart == {Trip.SAGGING: 0.0, Trip.UNATTENDED: 0.0}


# ---- how far out its soles bear it


def test_a_sole_bears_its_legs_force_and_its_leg() -> None:
    right, left = Soles(ROBOT).loads((190.0, math.nan))
    assert right == pytest.approx(190.0 + 2.0 * ROBOT.mass.module * GRAVITY)
    assert math.isnan(left)


@pytest.mark.parametrize("ankle", [0, 6])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_sole_is_at_its_edge_when_its_load_there_balances_the_ankles_torque(
    ankle: int, sign: float
) -> None:
    soles, tau = Soles(ROBOT), np.full(12, 5.0)
    tau[ankle] = sign * 300.0 * ROBOT.geometry.w_foot / 2.0
    assert soles.edge(tau, (300.0, 300.0)) == pytest.approx(1.0)


def test_a_load_that_is_not_known_is_half_of_the_weight_and_none_makes_no_edge_infinite() -> None:
    soles, tau = Soles(ROBOT), np.zeros(12)
    half = 0.5 * (ROBOT.total_mass + 2.0 * ROBOT.mass.module) * GRAVITY
    tau[0] = half * ROBOT.geometry.w_foot / 2.0
    assert soles.edge(tau, (math.nan, math.nan)) == pytest.approx(1.0)
    assert math.isfinite(soles.edge(tau, (0.0, -100.0)))
