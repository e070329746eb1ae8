"""The robot that a log was made with."""

from __future__ import annotations

import msgspec

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.robot.gain_table import GainSchedule
from tools.runs.run_index import RunIndex
from tools.runs.run_log import RunLog


def robot_of(log: RunLog | RunIndex) -> RobotConfig:
    """Return the robot that a log was made with.

    Raises:
        RunError: the log does not hold it.
        ConfigError: it is of another version.
    """
    try:
        raw = log.attachments["robot.toml"].decode()
    except KeyError:
        raise RunError(f"{log.path}: holds no robot.toml; a run of this project has one") from None
    robot = config_file.parse(raw, f"{log.path}: robot.toml")
    schedule = log.attachments.get("robot.gains.json")
    if schedule is None:
        return robot
    return msgspec.structs.replace(
        robot, gain_schedule=msgspec.json.decode(schedule, type=GainSchedule)
    )
