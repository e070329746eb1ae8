"""Tier 3 in virtual time: joint services die, and the drives' own loops hold the robot."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Restart
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.lockstep.runs import push, run, variant
from tools.sim.lockstep import Lockstep

PUSHES = (push(3.6, 30.0, 0.0, 0.0), push(4.6, 0.0, 30.0, 0.0))


def dead(at: float, *services: str) -> tuple[Kill, ...]:
    return tuple(Kill(service=service, at=at) for service in services)


@pytest.mark.parametrize("at", [0.4, 1.25, 2.5, 3.3])
def test_all_six_services_dead_at_any_phase_of_a_squat_stand_through_pushes(
    robot: RobotConfig, at: float
) -> None:
    result = run(robot, variant("squat", duration=7.0, kill=dead(at, *MODULES), push=PUSHES))
    assert result.stood
    after = result.t > at
    assert np.abs(result.com_mm[after, :2]).max() < 80.0


@pytest.mark.parametrize("module", ["ankle_left", "knee_right", "hip_left"])
def test_one_dead_service_stands_and_its_successor_leads_again(
    robot: RobotConfig, module: str
) -> None:
    """Taken over without a step: no module's torque jumps, and all six track in the end."""
    result = run(
        robot,
        variant(
            "squat",
            duration=7.5,
            kill=dead(2.2, module),
            restart=(Restart(service=module, at=5.0),),
            push=PUSHES,
        ),
    )
    assert result.stood
    assert {c.failsafe.mode for c in result.lockstep.controllers} == {Mode.TRACK}
    begun = result.lockstep.now_ns - 7.5e9  # what came before is the power-up
    for _, event in result.lockstep.events:
        step = np.abs(np.subtract(event.tau_after, event.tau_before)).max()
        assert event.t_ns < begun or event.mode_before == Mode.DISARMED or step < 5.0


def test_a_successor_carries_on_with_what_its_drive_carries(robot: RobotConfig) -> None:
    fleet = Lockstep(
        robot,
        variant(
            "squat",
            duration=4.0,
            kill=dead(2.2, "knee_right"),
            restart=(Restart(service="knee_right", at=3.0),),
            push=(),
        ),
    )
    torques = [
        fleet.bank.torque[2:4].copy() for truth in fleet.run() if 2.9 < truth.scenario_s < 3.1
    ]
    assert np.abs(torques).max() > 1.5  # N m at the motor: it lifts against the operator
    assert np.abs(np.diff(torques, axis=0)).max() < 0.3  # in 10 ms
    (event,) = [
        event
        for module, event in fleet.events
        if module == "knee_right" and event.mode_before == Mode.DISARMED and event.seq == 1
    ][1:]
    assert event.tau_after == pytest.approx(event.tau_before, abs=0.1)


def test_with_torques_only_a_dead_service_cannot_be_run(robot: RobotConfig) -> None:
    service = msgspec.structs.replace(robot.joint_service, loop="service")
    torques_only = msgspec.structs.replace(robot, joint_service=service)
    with pytest.raises(RunError, match="only the planner"):
        Lockstep(torques_only, variant("squat", kill=dead(1.0, "knee_left"), restart=()))
