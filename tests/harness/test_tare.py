"""The tare: on request, and refused while the forces move."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.harness.filter import TARE_DEVIATION_MAX, WrenchFilter, initial_state
from shared.bus.messages import Tare
from tests.harness.helpers import (
    HARNESS,
    PERIOD_NS,
    T0,
    TARE_CYCLES,
    ZERO,
    Asked,
    cycles,
    legs,
    make_loop,
    sample,
)  # fmt: skip

LAW = WrenchFilter(HARNESS)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_tare_is_taken_up_to_the_limit_of_the_forces_deviation(leg: int, share: float) -> None:
    """Alternating between two values, the deviation is half their distance, whatever the bias."""
    state, t_ns, bias = initial_state(), T0, 1000.0
    for n in range(TARE_CYCLES + 1):
        forces = [bias] * 6
        forces[leg] += 2.0 * share * TARE_DEVIATION_MAX * (n % 2)
        state, reading = LAW.step(state, t_ns, sample(t_ns, forces))
        t_ns += PERIOD_NS
    assert reading.valid is (share < 1.0)
    assert state.tare is (Tare.DONE if share < 1.0 else Tare.UNSTEADY)


def test_a_tare_on_request_makes_the_present_wrench_the_zero_and_is_reported_until_it_is_done() -> (
    None
):
    asked = Asked()
    loop, sensor, _ = make_loop(asked)
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    sensor.forces = legs((0.0, 0.0, 30.0, 0.0, 0.0, 0.0))
    message, t_ns = cycles(loop, t_ns, 100)
    assert message.force[2] == pytest.approx(30.0, abs=1e-3)
    asked.asked = True
    message, t_ns = cycles(loop, t_ns, TARE_CYCLES)
    assert (message.valid, message.tare) == (False, Tare.RUNNING)
    message, t_ns = cycles(loop, t_ns, 1)
    assert (message.valid, message.tare) == (True, Tare.DONE)
    message, _ = cycles(loop, t_ns, 10)
    np.testing.assert_allclose([*message.force, *message.moment], 0.0, atol=1e-9)


def test_a_repeated_request_does_not_delay_the_running_tare() -> None:
    asked = Asked()
    loop, _, _ = make_loop(asked)
    t_ns = T0
    for _ in range(TARE_CYCLES + 1):
        asked.asked = True
        message, t_ns = cycles(loop, t_ns, 1)
    assert message.valid


def test_a_tare_that_shakes_is_reported_and_stays_invalid_until_it_is_still() -> None:
    loop, sensor, _ = make_loop()
    t_ns, tares = T0, []
    for n in range(3 * TARE_CYCLES):
        sensor.forces = legs((0.0, 0.0, 30.0 * math.sin(0.3 * n), 0.0, 0.0, 0.0))
        message, t_ns = cycles(loop, t_ns, 1)
        assert not message.valid
        tares.append(message.tare)
    assert tares[0] == Tare.RUNNING
    assert set(tares[TARE_CYCLES + 1 :]) == {Tare.UNSTEADY}
    sensor.forces = ZERO
    message, _ = cycles(loop, t_ns, 2 * TARE_CYCLES + 2)
    assert (message.valid, message.tare) == (True, Tare.DONE)
