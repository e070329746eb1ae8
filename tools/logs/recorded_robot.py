"""The robot that a log was made with."""

from __future__ import annotations

import msgspec

from services.planner.controller_file import ATTACHED
from shared.config import files as config_file
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.text_file import decoded
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog


def robot_of(log: RunLog | RunIndex) -> RobotConfig:
    """Return the robot that a log was made with.

    Raises:
        RunError: the log does not hold it.
        ConfigError: it is of another version.
    """
    raw = text_of(log, "robot.toml")
    robot = config_file.parse(raw, f"{log.path}: robot.toml")
    schedule = log.attachments.get("robot.gains.json")
    if schedule is None:
        return robot
    try:
        table = msgspec.json.decode(decoded(schedule), type=GainSchedule)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise RunError(f"{log.path}: robot.gains.json in it is no gain schedule: {error}") from None
    return msgspec.structs.replace(robot, gain_schedule=table)


def text_of(log: RunLog | RunIndex, name: str) -> str:
    """Return a text file that is in a log.

    Raises:
        RunError: the log does not hold it, or it is no text.
    """
    try:
        return decoded(log.attachments[name])
    except KeyError:
        raise RunError(f"{log.path}: holds no {name}; a run of this project has one") from None
    except UnicodeError as error:
        raise RunError(f"{log.path}: {name} in it {error}") from None


def has_own_controller(log: RunLog | RunIndex) -> bool:
    """Return True if a controller of somebody's own led in the law's place."""
    return ATTACHED in log.attachments


def refuse_own_controller(log: RunLog | RunIndex) -> None:
    """Refuse a log whose planner was led by a controller of somebody's own.

    Raises:
        RunError: the shipped law would be computed in its place.
    """
    if has_own_controller(log):
        raise RunError(
            f"{log.path}: a controller of somebody's own led ({ATTACHED} in it), and this computes "
            "the shipped law; `xrl log resim --controller FILE` runs it again"
        )
