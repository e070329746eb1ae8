"""Services that die and come back at a bad moment: falls that a wide search found, each once."""

from __future__ import annotations

import pytest

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Push, Restart
from shared.joints import MODULES
from tests.lockstep.runs import push, run, variant
from tools.lab.studies.sweeps.figures import Ending, ending_of


def killed(at: float, *services: str) -> tuple[Kill, ...]:
    return tuple(Kill(service=service, at=at) for service in services)


def test_all_six_dead_stand_through_two_pushes_in_step_with_the_sway(robot: RobotConfig) -> None:
    """With TRACK's gains left on the drives sway was hardly damped: 7 of 26 such pairs fell."""
    pushes = (push(0.354, -24.5, 31.6, 0.0), push(2.074, -2.3, 39.9, 0.0))
    kills = killed(0.313, "planner", *MODULES)
    result = run(robot, variant("squat", duration=4.5, kill=kills, push=pushes))
    assert result.stood
    assert abs(result.com_mm[:, :2]).max() < 45.0


@pytest.mark.parametrize(
    ("back", "away", "pushes"),
    [
        (("knee_left", 2.221, 2.271), ("ankle_right", 2.432), (push(3.575, 39.7, 5.0, 0.0),)),
        (
            ("hip_right", 2.047, 2.347),
            ("planner", 2.027),
            (push(2.072, 0.9, 40.0, 0.0), push(3.509, -33.5, 21.9, 0.0)),
        ),
    ],
    ids=["one stays dead", "no planner"],
)
def test_a_service_that_comes_back_while_all_hold_is_no_stiffer_than_they_are(
    robot: RobotConfig,
    back: tuple[str, float, float],
    away: tuple[str, float],
    pushes: tuple[Push, ...],
) -> None:
    """With stand gains on one, and a hand that leads on, one leg gave and the other did not."""
    name, dies, returns = back
    scenario = variant(
        "squat",
        duration=5.2,
        kill=(*killed(dies, name), *killed(away[1], away[0])),
        restart=(Restart(service=name, at=returns),),
        push=pushes,
    )
    result = run(robot, scenario)
    assert ending_of(result.rows[-1], 5.2, robot) is Ending.STOOD
    assert max(max(row.foot_left_tilt, row.foot_right_tilt) for row in result.rows) < 0.03


def test_a_service_that_comes_back_takes_its_drive_over_without_a_step(robot: RobotConfig) -> None:
    """In the middle of the squat, while five hold."""
    scenario = variant(
        "squat",
        duration=2.0,
        kill=killed(1.2, "knee_left"),
        restart=(Restart(service="knee_left", at=1.5),),
        push=(),
    )
    result = run(robot, scenario, stands=False)
    taken = [
        event
        for module, event in result.lockstep.events
        if module == "knee_left" and event.mode_before == Mode.DISARMED
    ]
    assert len(taken) == 2, "at power-up, and as it came back"
    carried = result.lockstep.controllers[MODULES.index("knee_right")].tau
    assert taken[1].tau_after[1] == pytest.approx(carried[1], abs=15.0), "what the other one has"
    assert result.lockstep.controllers[MODULES.index("knee_left")].failsafe.mode is Mode.TRACK
