"""The simulated robot that hangs still, feet in the air, in virtual time; each drive a `Drive`."""

from __future__ import annotations

from typing import Final

import numpy as np

from services.joint.drivers.base import DriveReading
from services.joint.drivers.wired_drive import MotorFrame, WiredDrive
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.world import World
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from shared.joints import MODULES
from tools.bringup.hanging_leg import leg_of
from tools.sim.virtual_drive import VirtualDrive

STEP_NS = NS_PER_S // 1000
STAND = Scenario("stand", "nothing", 10.0, (Keyframe(0.0, 1.188),))
RIGHT: Final = (0.1, 0.2, 0.0, -0.0506, 0.0, 0.0337)
LEFT: Final = (-0.1, *RIGHT[1:])
"""rad; where legs hang at rest, their knees on the stop: friction holds the ankles anywhere."""
SETTLED: Final = 300
"""ms until every drive has spoken."""


class HungRobot:
    """World and axes; whoever reads a drive moves time on."""

    def __init__(self, robot: RobotConfig, plant: PlantConfig) -> None:
        self.now_ns = NS_PER_S
        self.world = World(body_of(robot, plant), STAND, lifted=0.2)
        self.bank = AxisBank(
            robot.drive,
            encoder_counts_per_turn=robot.joint.encoder_counts_per_turn,
            motor_signs=robot.motor_signs(),
        )
        counts = robot.joint.encoder_counts_per_turn
        self.drives = {
            name: HungDrive(
                self,
                VirtualDrive(self.bank, index, robot.drive, self.clock, counts_per_turn=counts),
                MotorFrame(robot.drive.zero_mark_turns, robot.module_named(name).motor_signs),
            )
            for index, name in enumerate(MODULES)
        }
        world, hanging = self.world, np.array(RIGHT + LEFT)
        world.data.qpos[world.joints.q_index] = hanging
        world.actuation.settle(hanging)
        self.wait(1e-3 * SETTLED)

    def step(self) -> None:
        """Move on by a millisecond."""
        self.torque = self.bank.step(self.world.time, *self.world.motor_turns())
        self.world.step(self.torque)
        self.now_ns += STEP_NS

    def wait(self, seconds: float) -> None:
        for _ in range(round(1e3 * seconds)):
            self.step()

    def leg(self, module: str) -> dict[str, HungDrive]:
        """Return the drives of a module's leg."""
        return {name: self.drives[name] for name in leg_of(module)}

    def clock(self) -> int:
        return self.now_ns


class HungDrive(WiredDrive):
    """One drive of it (`services.joint.drivers.base.Drive`)."""

    def __init__(self, robot: HungRobot, drive: VirtualDrive, frame: MotorFrame) -> None:
        super().__init__(drive, frame)
        self._robot = robot
        self.never_arms = self.deaf = False

    def read(self, timeout_s: float) -> DriveReading | None:
        for _ in range(2 if timeout_s > 0.0 else 0):
            self._robot.step()
        return super().read(timeout_s)

    def arm(self, *, onboard: bool) -> None:
        assert onboard
        if not self.never_arms:
            super().arm(onboard=True)

    def idle(self) -> None:
        if not self.deaf:
            super().idle()

    def write_torque(self, torque: Pair) -> None:
        raise AssertionError(torque)
