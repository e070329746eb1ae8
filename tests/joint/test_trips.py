"""What a joint service trips on by itself: in time, and on nothing that the law does."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.failsafe import TRIPS, Event
from services.joint.trips import JointTrips, limits_of
from shared.bus.messages import Cause, Mode, Pair
from shared.clock import NS_PER_MS
from shared.config.sections import TripLimit
from shared.robot.trip_table import JOINT_TRIPS
from tests.joint.helpers import ROBOT, T0, Bench

CYCLE_NS = 2 * NS_PER_MS

STILL: Pair = (0.0, 0.0)


def tripped_ms(taus: list[Pair], v: Pair = STILL) -> tuple[Event, float | None]:
    """Return the first trip and how long it took, ms, of these torques cycle by cycle."""
    trips, limits = JointTrips(), limits_of(ROBOT)
    trips.reset(taus[0])
    for cycle, tau in enumerate(taus):
        event = trips.judge(T0 + cycle * CYCLE_NS, tau, v, limits)
        if event is not Event.NONE:
            return event, cycle * CYCLE_NS / NS_PER_MS
    return Event.NONE, None


def sine(amplitude: float, hz: float, axis: int) -> list[Pair]:
    """Return two seconds of a torque that shakes about what a module carries."""
    waves = [amplitude * math.sin(2 * math.pi * hz * 0.002 * i) for i in range(1000)]
    return [(wave, 40.0) if axis == 0 else (10.0, 40.0 + wave) for wave in waves]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("hz", [15.0, 30.0, 60.0, 110.0])
def test_a_shaking_torque_trips_within_150_ms(hz: float, axis: int) -> None:
    event, ms = tripped_ms(sine(35.0, hz, axis))
    assert event is Event.SHAKING
    assert 0.0 < (ms or 0.0) < 150.0


def test_shaking_is_the_mean_square_above_its_band_of_either_axis() -> None:
    """One torque far from where the slow part is: (1 - share)^2 of its square counts."""
    limits = limits_of(ROBOT)
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            trips = JointTrips()
            trips.reset(STILL)
            jump = (sign * 9.0, 0.0) if axis == 0 else (0.0, sign * 9.0)
            trips.judge(T0, jump, STILL, limits)
            left = 9.0 * (1.0 - limits.slow_share)
            assert trips.mean[axis] == pytest.approx(limits.mean_share * left**2)
            assert trips.mean[1 - axis] == 0.0


def test_limits_are_the_robot_files_and_every_trip_has_its_row_and_its_cause() -> None:
    weaker = msgspec.structs.replace(ROBOT.trips, torque_limit=TripLimit(limit=0.8, after_ms=700.0))
    found = limits_of(msgspec.structs.replace(ROBOT, trips=weaker))
    assert found.slow_share == pytest.approx(1.0 - math.exp(-2.0 * math.pi * 8.0 * 0.002))
    assert found.mean_share == pytest.approx(1.0 - math.exp(-0.002 / 0.1))
    assert found.torque == pytest.approx(0.995 * 0.8 * ROBOT.joint.tau_module_max)
    assert (found.torque_ns, found.speed_ns) == (700_000_000, 20_000_000)
    assert (found.shaking, found.speed) == (15.0**2, ROBOT.trips.speed.limit)
    assert {event.name for event in TRIPS} == {cause.name for cause in JOINT_TRIPS}


def test_at_its_limit_shaking_and_speed_are_none_and_torque_is() -> None:
    limits = msgspec.structs.replace(limits_of(ROBOT), mean_share=0.0, shaking=4.0)
    trips = JointTrips(mean=(4.0, 4.0))
    at_limit = (0.25 * limits.torque, -0.75 * limits.torque)
    assert trips.judge(T0, at_limit, (limits.speed, -limits.speed), limits) is Event.NONE
    assert (trips.at_limit_ns, trips.fast_ns) == (T0, 0)


@given(hz=st.floats(0.05, 2.0), amplitude=st.floats(0.0, 50.0), noise=st.floats(0.0, 5.0))
def test_what_the_law_does_trips_nothing(hz: float, amplitude: float, noise: float) -> None:
    """Slow torques, however large, and the little that friction and encoders shake."""
    both = zip(sine(amplitude, hz, 0), sine(noise, 37.0, 0), strict=True)
    assert tripped_ms([(a + b, 40.0) for (a, _), (b, _) in both])[0] is Event.NONE


def test_one_step_of_30_nm_does_not_and_ten_of_60_in_half_a_second_do() -> None:
    """A state that comes 40 ms late makes a step of 31 N m."""
    step = [STILL] * 50 + [(31.0, 0.0)] * 500
    assert tripped_ms(step) == (Event.NONE, None)
    steps = [(60.0, 0.0) if (cycle // 25) % 2 else STILL for cycle in range(500)]
    assert tripped_ms(steps)[0] is Event.SHAKING


def test_motors_at_their_limit_trip_when_it_lasts_and_not_before() -> None:
    most, after_ms = ROBOT.joint.tau_module_max, ROBOT.trips.torque_limit.after_ms
    at_limit: list[Pair] = [(0.4 * most, -0.6 * most)] * 600
    assert tripped_ms(at_limit) == (Event.TORQUE_LIMIT, after_ms)
    cycles = round(after_ms / 2)
    with_a_break = [*at_limit[: cycles - 1], (0.39 * most, -0.59 * most), *at_limit[:cycles]]
    assert tripped_ms(with_a_break) == (Event.NONE, None)


@pytest.mark.parametrize("v", [(8.1, 0.0), (0.0, -8.1)])
def test_a_joint_that_turns_too_fast_trips(v: Pair) -> None:
    assert tripped_ms([STILL] * 50, v) == (Event.TOO_FAST, ROBOT.trips.speed.after_ms)
    assert tripped_ms([STILL] * 50, (7.9, -7.9)) == (Event.NONE, None)


@pytest.mark.parametrize(
    ("v", "tau_ff", "cause"),
    [
        pytest.param((1.2, 0.0), 1.0, Cause.SHAKING, id="shaking"),
        # it blends in: at once it would be shaking
        pytest.param((0.0, 0.0), -2.0, Cause.TORQUE_LIMIT, id="motors at their limit"),
    ],
)
def test_a_module_that_trips_holds_and_is_led_again_after_a_wait(
    v: Pair, tau_ff: float, cause: Cause
) -> None:
    bench = Bench(ROBOT)
    told = {"tau_ff": (0.0, tau_ff * ROBOT.joint.tau_module_max)} if tau_ff < 0.0 else {}
    bench.to_track(**told)
    causes = []
    for cycle in range(500):
        bench.v = v if cycle % 4 < 2 else (-v[0], -v[1])
        event = bench.run(1, fresh=True, **told)[-1].event
        if event is not None:
            causes.append(event.cause)
    assert causes[0] == cause
    assert bench.controller.failsafe.dropouts.count >= 1
    bench.v = (0.0, 0.0)
    events = [result.event for result in bench.run(2000, fresh=True)]
    assert [event.cause for event in events if event is not None][-1] == Cause.COMMANDS_FRESH
    assert bench.mode is Mode.TRACK
