"""Lockstep of the centralised control, and the controls by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.robot.trip_table import untripped
from tools.sim.centralised.control import CentralPlanner, PassThrough
from tools.sim.lockstep import Lockstep


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

    def __init__(self, config: RobotConfig, *args: Any, **how: Any) -> None:
        """Put the robot on the hoist; arguments as for `Lockstep`."""
        super().__init__(torques_only(config), *args, **how)


SHIPPED: Final = "distributed"
CONTROLS: Final[Mapping[str, type[Lockstep]]] = {
    SHIPPED: Lockstep,
    "centralised": CentralisedLockstep,
}
"""By who computes the torques."""
