from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.imu.attitude import AttitudeLaw
from services.simulator.fronts.sensor_fronts import ImuFront
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import ImuErrors, PlantConfig, changed
from services.simulator.physics.world import World
from shared.bus.messages import Vector3
from shared.can.imu_can import ImuAssembler
from shared.config.robot_config import RobotConfig
from tests.imu.robots import with_imu
from tests.lockstep.runs import still
from tools.sim.virtual_services import VirtualCan

EXACT = ImuErrors(tilt=(0.0, 0.0), noise=0.0)


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.5), (3.1, 0.0, 0.4)])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.0873, -0.05)])
def test_however_the_sensor_is_mounted_the_service_finds_up_and_the_torsos_rates(
    robot: RobotConfig, mounting: Vector3, slope: tuple[float, float]
) -> None:
    fitted = with_imu(robot, mounting=mounting)
    plant = changed(PlantConfig(), {"floor.slope": list(slope)})
    world = World(body_of(fitted, plant), still(1.0))
    torso = Rotation.from_euler("ZXY", (0.4, 0.1, -0.3))
    x, y, z, w = torso.as_quat().tolist()
    world.data.qpos[3:7] = w, x, y, z
    world.data.qvel[3:6] = 0.5, -1.0, 0.25
    frames = VirtualCan(ImuAssembler())
    ImuFront(fitted.imu, EXACT, frames, 1).send(world)
    reading = AttitudeLaw(fitted.imu).step(1, frames.newest(1))
    gravity = world.model.opt.gravity
    np.testing.assert_allclose(
        reading.up, torso.inv().apply(-gravity / np.linalg.norm(gravity)), atol=2e-4
    )
    np.testing.assert_allclose(reading.rate, (0.5, -1.0, 0.25), atol=4e-3)


@pytest.mark.parametrize("slope", [(0.0873, 0.0), (0.0, -0.0873), (0.05, 0.05)])
def test_on_a_slope_the_hoist_holds_the_com_over_the_ankles_by_gravity(
    robot: RobotConfig, slope: tuple[float, float]
) -> None:
    level = World(body_of(robot, PlantConfig()), still(1.0)).truth(0, 1.0, 0.0)
    plant = changed(PlantConfig(), {"floor.slope": list(slope)})
    truth = World(body_of(robot, plant), still(1.0)).truth(0, 1.0, 0.0)
    assert truth.over == pytest.approx(level.com[:2], abs=1e-3)
    assert max(truth.foot_left_tilt, truth.foot_right_tilt) < 1e-6
    assert math.hypot(truth.com[0] - level.com[0], truth.com[1] - level.com[1]) > 0.05
