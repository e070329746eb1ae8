"""A harness sensor that lies is reported before the load is, and the assist goes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from services.simulator.fronts.sensor_fronts import HarnessFront
from shared.bus.messages import PlannerMode
from shared.bus.traces import SimTruth
from tests.lockstep.runs import Run, led_to, run, status_of
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep

FAILS_S = 3.0
ASSIST_N = 80.0


def drift(front: HarnessFront, _since_s: float) -> None:
    """Let one cell drift by 20 N/s; the world is seen at 100 Hz."""
    front.bias = np.add(front.bias, (0.0, 0.0, 0.2, 0.0, 0.0, 0.0))


def invert(front: HarnessFront, since_s: float) -> None:
    """Turn the sign of every cell round."""
    if since_s < 0.01:
        front._G_inverse = -front._G_inverse


def stick_at_zero(front: HarnessFront, _since_s: float) -> None:
    """Have one cell measure nothing but noise."""
    front._G_inverse[3], front.bias[3] = 0.0, 0.0


def carry(fail: Callable[[HarnessFront, float], None]) -> tuple[Run, list[str]]:
    """Carry a person in a crouch while the sensor fails; return also what the planner says then."""
    said: list[str] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s >= FAILS_S:
            fail(fleet.harness._front, row.scenario_s - FAILS_S)
            said.append(status_of(fleet).why)

    scenario = led_to((2.0, 1.0, 0.0, ASSIST_N), duration=FAILS_S + 9.0)
    return run(ROBOT, scenario, each=look), said


@pytest.mark.parametrize("fail", [drift, invert, stick_at_zero])
def test_a_sensor_that_begins_to_lie_is_named_and_the_load_is_not_learnt(
    fail: Callable[[HarnessFront, float], None],
) -> None:
    """It said that the robot carried 8 to 12 kg more than its file, and led on with the force."""
    outcome, said = carry(fail)
    assert outcome.stood
    first = next(i for i, why in enumerate(said) if "harness and joints disagree" in why)
    assert first < 500, "within 5 s"
    assert "mass.payload" not in said[-1]
    assert abs(outcome.status.load[0]) < 1.0
    led = outcome.status.mode == PlannerMode.LEADING
    assert not led or outcome.status.assist_n < 0.7 * ASSIST_N, "the assist goes"


def test_a_sensor_that_is_right_is_believed_through_a_squat_with_assist() -> None:
    outcome, said = carry(lambda _front, _since_s: None)
    assert not any("disagree" in why for why in said)
    assert outcome.status.assist_n == pytest.approx(ASSIST_N, abs=50.0)
    assert np.ptp(outcome.height[-500:]) < 0.01
