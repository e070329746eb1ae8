"""`--param NAME=VALUE`: the recorded robot with changed values."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any, Final

import msgspec
import tomli_w

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

DIRECTIONS: Final = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the six values of K_p and B_p."""


def with_params(robot: RobotConfig, texts: Sequence[str], file: str) -> RobotConfig:
    """Return a robot with values of its file changed.

    Each text is NAME=VALUE. NAME is a dotted key as in the robot file, with an index or a direction
    for one value of a row: law.K_p.x=2000, joint_service.blend_ms=100. The gain schedule remains
    as recorded, and is treated as made for the changed robot.
    """
    table = msgspec.json.decode(msgspec.json.encode(robot))  # with lists, which are mutable
    del table["gain_schedule"]
    for text in texts:
        name, _, value = text.partition("=")
        *path, last = name.strip().split(".")
        node: Any = table
        try:
            for part in path:
                node = node[part]
            key: Any = last
            if isinstance(node, list):
                key = DIRECTIONS.index(last) if last in DIRECTIONS else int(last)
            is_text = isinstance(node[key], str)
            node[key] = value.strip() if is_text else tomllib.loads(f"value = {value}")["value"]
        except (LookupError, TypeError, ValueError):
            right = "NAME=VALUE: a dotted key of the robot file, with x to yaw or an index in a row"
            raise ConfigError(file, f"--param {text}", "no such key, or no value", right) from None
    changed = config_file.parse(tomli_w.dumps(table), f"{file}, with --param")
    schedule = robot.gain_schedule
    if schedule is not None:
        inputs = gain_schedule.inputs_of(changed)
        digest = gain_schedule.digest_of(inputs)
        schedule = msgspec.structs.replace(schedule, inputs=inputs, digest=digest)
    return msgspec.structs.replace(changed, gain_schedule=schedule)
