"""Nobody's hand on it, and a load that the robot file does not know: it stays where it was.

Led on, it went to straight legs (payload -15 %), to the knees' stop with the torso over by 2.3 rad
(+20 %), and fell (COM 5 cm back and 10 cm up). A drift that trips came too late for a torso on
which a person rested: it turned by up to 2 rad.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import PlannerMode
from shared.bus.traces import SimTruth
from tests.lockstep.runs import Run, led_to, run, status_of, variant
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep

LET_GO_S = 3.0

REFUSED_ROWS = 300
"""Rows of the simulated world, which come at 100 Hz: 3 s, the last 1.5 without the hoist."""


def let_go(errors: dict[str, Any], *pose: float, duration: float = 8.0) -> Run:
    """Return the run from letting go on, at a height, pitch and assist."""

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s >= LET_GO_S:
            fleet.world.let_go()

    plant = changed(PlantConfig(), errors)
    outcome = run(ROBOT, led_to((2.0, *pose), duration=duration), plant=plant, each=look)
    assert outcome.stood
    return outcome._replace(rows=[row for row in outcome.rows if row.scenario_s >= LET_GO_S])


def not_led(errors: dict[str, Any]) -> tuple[Lockstep, list[float]]:
    """Return the fleet after it was refused for so long, and the torso's heights until then."""
    fleet = Lockstep(ROBOT, variant("stand"), plant=changed(PlantConfig(), errors))
    heights, refused = [], 0
    for row in fleet.run():
        assert not row.fallen
        assert row.scenario_s < 0.0, "the scenario waits for six that track"
        heights.append(row.torso[2])
        refused += status_of(fleet).mode == PlannerMode.MISLOADED
        if refused == REFUSED_ROWS:
            assert row.hoist == 0.0
            return fleet, heights
    raise AssertionError(status_of(fleet))


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("errors", "kg"),
    [
        ({"body.payload_scale": 0.85}, -3.06),
        ({"body.payload_scale": 1.2}, 4.08),
        ({"body.com_offset": [0.03, 0.0, 0.0]}, 0.0),
    ],
)
@pytest.mark.parametrize("height", [1.1, 0.9])
def test_let_go_of_it_stays(height: float, errors: dict[str, Any], kg: float) -> None:
    outcome = let_go(errors, height)
    assert np.ptp(outcome.height) < 0.04
    assert turned(outcome) < 0.12
    assert outcome.status.mode == PlannerMode.LEADING
    assert outcome.status.load[0] == pytest.approx(kg, abs=0.7)


def turned(outcome: Run) -> float:
    """Return how far the torso turned at most from where it was let go, rad."""
    pitch = outcome.angles[:, 1]
    return float(np.abs(pitch - pitch[0]).max())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("rests", [0.6, 1.0, 1.4])
@pytest.mark.parametrize("payload", [0.85, 1.2])
def test_a_pitched_torso_stays_whatever_the_person_rests_on_it(
    rests: float, payload: float
) -> None:
    """60 N of assist are requested, and the person's weight differs from them by up to 24 N."""
    errors = {"body.payload_scale": payload, "person.load_scale": rests}
    assert turned(let_go(errors, 1.05, 0.7, 60.0, duration=6.0)) < 0.15


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ({"body.com_offset": [-0.05, 0.0, 0.1]}, "lies too far behind"),
        ({"body.payload_scale": 0.0}, "kg less than the robot file says"),
        ({"body.payload_scale": 0.5}, "kg less than the robot file says"),
        ({"body.payload_scale": 1.5}, "kg more than the robot file says"),
    ],
)
def test_half_a_payload_too_much_or_too_little_or_too_far_back_is_not_led(
    errors: dict[str, Any], words: str
) -> None:
    """It went to straight legs, or to the knees' stop, at 0.4 m/s.

    Without its payload, led on the hoist, it rose by 0.1 m, where torques tell nothing.
    """
    fleet, heights = not_led(errors)
    status, scale = status_of(fleet), errors.get("body.payload_scale")
    if scale:
        assert status.load[0] == pytest.approx((scale - 1.0) * ROBOT.mass.payload, abs=1.0)
    assert scale != 0.0 or max(heights) - min(heights) < 0.01
    assert words in status.why


def test_a_hand_that_comes_back_leads_again() -> None:
    """Nobody holds it for 2.5 s, and its payload pulls it down."""
    modes: list[tuple[float, int]] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        fleet.world.outside.holds = not LET_GO_S <= row.scenario_s < LET_GO_S + 2.5
        modes.append((row.scenario_s, status_of(fleet).mode))

    heavy = changed(PlantConfig(), {"body.payload_scale": 1.2})
    outcome = run(ROBOT, led_to((2.0, 1.1), duration=8.0), plant=heavy, each=look)
    assert outcome.stood
    assert {mode for t, mode in modes if t < LET_GO_S} == {PlannerMode.LEADING}
    assert {mode for t, mode in modes if t >= LET_GO_S} == {PlannerMode.LEADING}
    assert outcome.height[-1] == pytest.approx(1.1, abs=0.02), "the hand leads on"
