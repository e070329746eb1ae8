"""Leading by deflections: within limits, and none within the dead zone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics.operator import HEIGHTS, PITCHES
from tools.pads.pilot import ASSIST_RATE, DEAD_ZONE, HEIGHT_RATE, PITCH_RATE, Deflection, Pilot

ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(ANY, ANY, ANY, st.floats(0.0, 0.1)), max_size=30))
def test_whatever_is_done_it_stays_within_the_limits_and_makes_no_jump(
    done: list[tuple[float, float, float, float]],
) -> None:
    pilot = Pilot(1.0, 0.1, 150.0)
    for *sticks, dt in done:
        before = pilot.led
        led = pilot.integrate(Deflection(*sticks), dt)
        assert HEIGHTS[0] <= led.height <= HEIGHTS[1]
        assert PITCHES[0] <= led.pitch <= PITCHES[1]
        assert 0.0 <= led.assist_n <= 150.0
        for now, then, rate in zip(
            led, before, (HEIGHT_RATE, PITCH_RATE, ASSIST_RATE), strict=True
        ):
            assert abs(now - then) <= rate * dt + 1e-12


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_stick_near_its_middle_is_none_and_a_whole_one_is_the_whole_rate(sign: float) -> None:
    pilot = Pilot(1.0, 0.0, 100.0)
    assert pilot.integrate(Deflection(height=sign * DEAD_ZONE), 1.0).height == 1.0
    assert pilot.integrate(Deflection(height=sign), 0.1).height == pytest.approx(
        1.0 + sign * 0.1 * HEIGHT_RATE
    )


def test_it_begins_where_the_robot_is_or_at_the_nearest_that_it_may_lead() -> None:
    assert Pilot(0.95, 0.2, 100.0).led == (0.95, 0.2, 0.0)
    assert Pilot(2.0, -3.0, 100.0).led == (HEIGHTS[1], PITCHES[0], 0.0)
