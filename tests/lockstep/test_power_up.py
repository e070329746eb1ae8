"""Power-up without a planner: the second tier stands by itself."""

from __future__ import annotations

import msgspec
import numpy as np

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import Mode, SimTruth
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import push, run, still
from tools.sim.lockstep import Lockstep


def stand_without_planner(robot: RobotConfig, seconds: float) -> tuple[Lockstep, SimTruth]:
    """Power up, let the hoist down, start the scenario after 2 s, go on."""
    fleet = Lockstep(robot, still(seconds, push=(push(0.5, 30, 0, 0), push(1.5, 0, 30, 0))))
    fleet.planner = None
    steps = round(seconds / robot.simulation.timestep)
    for step in range(steps):
        fleet.advance()
        if step == round(2.5 / robot.simulation.timestep):
            fleet.world.start()
    return fleet, fleet.world.truth(0, 1.0, 0.0)


def test_the_robot_stands_through_pushes_with_no_planner_at_all(robot: RobotConfig) -> None:
    fleet, truth = stand_without_planner(robot, 7.0)
    assert truth.hoist == 0.0, "it must stand on its own feet"
    assert not truth.fallen
    assert truth.torso[2] > 1.1
    assert max(truth.foot_left_tilt, truth.foot_right_tilt) < 0.02
    assert all(controller.failsafe.mode is Mode.HOLD for controller in fleet.controllers)


def test_which_way_a_motor_counts_is_not_seen_at_the_joint(robot: RobotConfig) -> None:
    mirrored = tuple(
        msgspec.structs.replace(module, motor_signs=(-1, 1 if "left" in module.name else -1))
        for module in robot.module
    )
    other = msgspec.structs.replace(robot, module=mirrored)
    # cogging and noise belong to a motor, whichever way it counts
    quiet = changed(PlantConfig(), {"drivetrain.cogging": 0.0, "encoder.noise_counts": 0.0})
    plain, signed = (
        run(config, still(0.5), plant=quiet, stands=False) for config in (robot, other)
    )
    assert signed.stood
    # an encoder's counts are rounded down, whichever way it counts: 0.8 mm of play and friction
    np.testing.assert_allclose(signed.com_mm, plain.com_mm, atol=1.5)
