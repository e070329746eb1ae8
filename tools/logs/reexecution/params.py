"""`--param NAME=VALUE`: the recorded robot with another value."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from typing import Any, Final

import msgspec
import tomli_w

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

DIRECTIONS: Final = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the six rows of K_p and B_p."""
_GAIN: Final = re.compile(r"gains\.([kb])_p_(\w+)")


def with_params(robot: RobotConfig, texts: Sequence[str], file: str) -> RobotConfig:
    """Return a robot with keys of its file changed; its gain schedule stays as it was.

    A text is NAME=VALUE: NAME is a dotted key as in the robot file, with an index or a direction
    for one value of a row: law.K_p.x=2000, joint_service.blend_ms=100. gains.k_p_x is law.K_p.x.
    """
    table = msgspec.json.decode(msgspec.json.encode(robot))  # with lists, which can be changed
    del table["gain_schedule"]
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError("--param", text, "no value", "NAME=VALUE")
        _set(table, _GAIN.sub(r"law.\1_p.\2", name.strip()), value.strip(), file)
    changed = config_file.parse(tomli_w.dumps(table), f"{file}, with --param")
    return msgspec.structs.replace(changed, gain_schedule=_kept(robot, changed))


def _kept(robot: RobotConfig, changed: RobotConfig) -> GainSchedule | None:
    """Return the recorded schedule for the changed robot, whose changes then take effect."""
    if robot.gain_schedule is None:
        return None
    inputs = gain_schedule.inputs_of(changed)
    digest = gain_schedule.digest_of(inputs)
    return msgspec.structs.replace(robot.gain_schedule, inputs=inputs, digest=digest)


def _set(table: dict[str, Any], name: str, text: str, file: str) -> None:
    *path, last = _resolved(table, name, file)
    node: Any = table
    for part in path:
        node = node[part]
    if isinstance(node[last], dict):
        raise ConfigError(file, name, "a table", "one key of it")
    node[last] = _value(node[last], text, name, file)


def _resolved(table: dict[str, Any], name: str, file: str) -> Iterator[Any]:
    """Yield the keys and indices that lead to a value; letters' case does not matter."""
    node: Any = table
    for part in name.split("."):
        if isinstance(node, dict):
            fitting = [key for key in node if key.lower() == part.lower()]
            if not fitting:
                near = difflib.get_close_matches(part, node, n=1)
                right = f"{near[0]}, perhaps" if near else f"one of {', '.join(node)}"
                raise ConfigError(file, f"--param {name}", f"no key {part!r}", right)
            yield fitting[0]
            node = node[fitting[0]]
        elif isinstance(node, list | tuple):
            index = DIRECTIONS.index(part) if part in DIRECTIONS else -1
            index = int(part) if part.isdecimal() else index
            if not 0 <= index < len(node):
                right = f"an index below {len(node)}, or one of {', '.join(DIRECTIONS)}"
                raise ConfigError(file, f"--param {name}", f"no {part!r} in this row", right)
            yield index
            node = node[index]
        else:
            raise ConfigError(file, f"--param {name}", f"{part!r} is below a value", "leave it out")


def _value(before: Any, text: str, name: str, file: str) -> Any:
    """Parse a text as a value of the type that it replaces."""
    try:
        if isinstance(before, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(before, int | float):
            return int(text) if isinstance(before, int) else float(text)
        if isinstance(before, str):
            return text
        return msgspec.json.decode(text, type=type(before))
    except (KeyError, ValueError, msgspec.DecodeError):
        found = f"{text!r}, where {before!r} stands"
        raise ConfigError(file, f"--param {name}", found, "a value of the same kind") from None
