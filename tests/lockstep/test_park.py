"""A person rests on a parked robot, gets up, lets go, goes limp; a sensor that drifts; a kill."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from shared.bus.messages import Mode, Wearing
from shared.bus.traces import SimTruth
from shared.config.scenarios import Act, Kill, Scenario
from tests.lockstep.runs import Run, led_to, modes_of, run, status_of
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep

PARKED = msgspec.structs.replace(ROBOT, park=msgspec.structs.replace(ROBOT.park, enabled=True))
AT_S = 3.5
"""In the crouch, parked."""


def crouch(*acts: Act, duration: float = 8.0, **happens: Any) -> Scenario:
    return led_to((2.0, 0.95, 0.0), duration=duration, act=acts, **happens)


def rest(force: float, lasts_s: float, ramp_s: float) -> Act:
    return Act("rest", AT_S, lasts_s, force, ramp_s, 0.5)


def between(outcome: Run, begin_s: float, end_s: float) -> list[SimTruth]:
    return [row for row in outcome.rows if begin_s <= row.scenario_s <= end_s]


def sinks(rows: list[SimTruth]) -> float:
    """Return how far the torso goes down from the first row, m."""
    return rows[0].torso[2] - min(row.torso[2] for row in rows)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("force", "ramp_s"), [(140.0, 2.5), (60.0, 1.5)])
def test_it_carries_a_person_who_rests_and_lifts_nobody_who_gets_up(
    force: float, ramp_s: float
) -> None:
    """With the height open it sank by 13 cm, and carried a twentieth.

    Every command is inside the envelope that the gains of a led robot were certified with.
    """
    outcome = run(PARKED, crouch(rest(force, 5.0, ramp_s), duration=AT_S + 7.0))
    assert outcome.stood
    assert outcome.believed
    rests = between(outcome, AT_S, AT_S + 4.5)
    borne = [row.load_n - row.operator_force[2] for row in rests if row.scenario_s > AT_S + 3.5]
    assert np.mean(borne) > 0.85 * force
    assert sinks(rests) < 0.01
    after = between(outcome, AT_S + 5.0, AT_S + 7.0)
    assert max(abs(row.operator_force[2]) for row in after) < 40.0


def test_a_squat_that_does_not_stop_is_led_as_with_park_off() -> None:
    scenario = led_to((2.0, 0.95, 0.0), (4.0, 1.188, 0.0), duration=5.0)
    hands = [np.abs(run(robot, scenario).operator_n).max() for robot in (ROBOT, PARKED)]
    assert hands[1] == pytest.approx(hands[0], abs=0.5)


def test_bumps_neither_open_it_nor_move_it() -> None:
    bumps = (Act("bump", AT_S, 0.04, 120.0), Act("bump", AT_S + 1.0, 0.03, -150.0))
    seen: set[int] = set()

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s > AT_S:
            seen.add(status_of(fleet).wearer)

    outcome = run(PARKED, crouch(*bumps, duration=AT_S + 2.0), each=look)
    assert Wearing.LEADS not in seen
    assert Wearing.BUMPED in seen
    assert np.ptp([row.torso[2] for row in between(outcome, AT_S, AT_S + 2.0)]) < 0.01


def test_going_limp_on_a_parked_robot_makes_it_hold() -> None:
    """Without the trip, because it was parked, it sank by 10 to 14 cm."""
    outcome = run(PARKED, crouch(Act("limp", AT_S, 5.0, 200.0, 0.2), duration=AT_S + 3.0))
    assert outcome.stood
    assert set(modes_of(outcome.lockstep)) == {Mode.HOLD}
    assert sinks(between(outcome, AT_S, AT_S + 3.0)) < 0.05


def test_twenty_newtons_of_drift_become_no_assist_for_long() -> None:
    assists: list[float] = []

    def drift(fleet: Lockstep, row: SimTruth) -> None:
        since_s = row.scenario_s - AT_S
        if 0.0 <= since_s < 1.0:  # each of the six cells by 1 % of 20 N over its part in the height
            front = fleet.harness._robot.harness
            front.bias = np.add(front.bias, front._G_inverse @ (0.0, 0.0, -0.2, 0.0, 0.0, 0.0))
        if since_s >= 6.0:
            assists.append(status_of(fleet).assist_n)

    outcome = run(PARKED, crouch(duration=AT_S + 7.0), each=drift)
    assert outcome.stood
    assert max(assists) < 5.0


def test_killed_while_somebody_rests_on_it_it_stands_and_lifts_them_little() -> None:
    """HOLD keeps the assist in its feedforward, and its springs give way to that by 3 mm."""
    kills = (Kill(service="planner", at=AT_S + 3.5),)
    outcome = run(PARKED, crouch(rest(150.0, 5.0, 2.0), duration=AT_S + 7.0, kill=kills))
    assert outcome.stood
    assert set(modes_of(outcome.lockstep)) == {Mode.HOLD}
    after = between(outcome, AT_S + 4.5, AT_S + 7.0)
    lifts = max(row.torso[2] for row in after) - after[0].torso[2]
    assert lifts < 0.01
    assert max(abs(row.operator_force[2]) for row in after) < 20.0
