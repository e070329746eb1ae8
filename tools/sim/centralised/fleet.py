"""Lockstep of the centralised control, and the controls by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.config.gain_schedule import believing
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.robot.trip_table import untripped
from tools.logs.hand_path import HandRow
from tools.sim.centralised.control import CentralPlanner, PassThrough
from tools.sim.lockstep import Lockstep, forget
from tools.sim.virtual_time import Record


def torques_only(config: RobotConfig) -> RobotConfig:
    """Return the robot with drives that take torques and hold nothing by themselves.

    Its joint services accept any command, because this planner sends gains of zero.
    """
    service = msgspec.structs.replace(config.joint_service, loop="service")
    return msgspec.structs.replace(untripped(believing(config)), joint_service=service)


class CentralisedLockstep(Lockstep):
    """A whole fleet in virtual time, each torque computed by the planner."""

    planner_type = CentralPlanner
    module_type = PassThrough

    def __init__(
        self,
        config: RobotConfig,
        scenario: Scenario,
        network: Impairment | None = None,
        *,
        seed: int = 0,
        record: Record = forget,
        plant: PlantConfig | None = None,
        hand: Sequence[HandRow] = (),
    ) -> None:
        """Put the robot on the hoist; arguments as for `Lockstep`."""
        super().__init__(
            torques_only(config), scenario, network,
            seed=seed, record=record, plant=plant, hand=hand,
        )  # fmt: skip


SHIPPED: Final = "distributed"
CONTROLS: Final[Mapping[str, type[Lockstep]]] = {
    SHIPPED: Lockstep,
    "centralised": CentralisedLockstep,
}
"""By who computes the torques."""
