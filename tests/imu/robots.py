"""Robots with an IMU."""

from __future__ import annotations

import msgspec

from shared.config.robot_config import RobotConfig


def with_imu(robot: RobotConfig, **changes: object) -> RobotConfig:
    """Return the robot with an IMU fitted, and keys of `[imu]` changed."""
    imu = msgspec.structs.replace(robot.imu, fitted=True, **changes)
    return msgspec.structs.replace(robot, imu=imu)
