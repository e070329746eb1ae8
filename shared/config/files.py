"""Read and write a robot file, `deploy/robot.toml`, and the files beside it.

The gain schedule, `robot.gains.json`, and the wearer's thresholds, `robot.wearer.toml`, are
separate files: one is computed from the robot, the other belongs to a person.

Unknown keys, wrong sizes and impossible values are refused; the error names the file, the key, the
value and the right value (`shared.exceptions.ConfigError`).
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import tomli_w

from shared.config import checks as config_check
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.config.sections import WearerThresholds
from shared.exceptions import ConfigError
from shared.toml_file import parse_toml, read_toml


def load(path: Path) -> RobotConfig:
    """Read and check a robot file, with the gain schedule and the wearer's file beside it, if any.

    Raises ConfigError if a file cannot be read, or a key or value is invalid.
    """
    config = load_without_schedule(path)
    wearer = wearer_path(path)
    if wearer.exists():
        config = worn_by(config, read_toml(wearer, WearerThresholds))
    schedule = gain_schedule.read(gain_schedule.path_beside(path))
    return msgspec.structs.replace(config, gain_schedule=schedule)


def wearer_path(robot_file: Path) -> Path:
    """Return the path of a robot's wearer file: lab.toml -> lab.wearer.toml."""
    return robot_file.with_suffix(".wearer.toml")


def worn_by(config: RobotConfig, wearer: WearerThresholds) -> RobotConfig:
    """Return the robot with a person's thresholds."""
    park = msgspec.structs.replace(config.park, **msgspec.structs.asdict(wearer))
    return msgspec.structs.replace(config, park=park)


def load_without_schedule(path: Path) -> RobotConfig:
    """Read and check a robot file alone; raise ConfigError if it is invalid."""
    config = _checked(read_toml(path, RobotConfig), str(path))
    config_check.check_security(str(path), config)
    return config


def parse(text: str, file: str) -> RobotConfig:
    """Return the robot of a TOML text, without a schedule; raise ConfigError if it is invalid."""
    return _checked(parse_toml(text, file, RobotConfig), file)


def _checked(config: RobotConfig, file: str) -> RobotConfig:
    if config.gain_schedule is not None:
        right = "remove it: the schedule is a separate file, which `xrl gains` writes"
        raise ConfigError(file, "gain_schedule", "unknown key", right)
    config_check.check(file, config)
    return config


def to_toml(config: RobotConfig) -> str:
    """Return the robot as TOML that `load` reads back; comments are not kept."""
    table = msgspec.to_builtins(config)
    del table["gain_schedule"]
    return tomli_w.dumps(table)
