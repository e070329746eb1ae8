"""The certified gain schedule, a file beside the robot file that `xrl gains` writes.

It contains local joint stiffnesses over COM height and torso pitch (docs/law.md#gain-split), and
the parameters from which it was computed. A robot with other parameters is refused until `xrl
gains` runs again.
"""

from __future__ import annotations

import hashlib
import shlex
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import msgspec

from shared.atomic_file import replace_file
from shared.config.gain_table import GainSchedule, ModuleBounds
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from shared.joints import KINDS, MODULES, kind_of
from shared.toml_file import check_ranges, read_text

VERSION = 2
"""Version of the file and of its program; `xrl gains` remakes a file of any other version."""


_INPUTS: Final[dict[str, tuple[str, ...]]] = {
    "mass": (),
    "geometry": (),
    "certificate": ("K_required", "onboard_fraction", "k_q_fraction_max"),
    "law": (
        "K_p",
        "K_0",
        "B_p",
        "S",
        "jacobian",
        "damping_lambda",
        "load_sharing_moment_arms",
        "push_integral_s",
    ),
    "robustness": (),
    "stand": KINDS,
    "joint": ("armature",),
    "planner": ("rate_hz",),
    "harness": ("low_pass_hz",),
    "drive": ("encoder_bandwidth",),
    "assist": ("force_max",),
    "joint_service": ("k_p_max", "rate_hz", "hold_stiffens_theta"),
    "limits": KINDS,
}
"""Keys of each section on which the schedule depends; empty: all. Gains and limits by kind become
one row of numbers."""


def inputs_of(config: RobotConfig) -> dict[str, Any]:
    """Return the inputs of the schedule, by dotted key."""
    flat: dict[str, Any] = {}
    for section, keys in _INPUTS.items():
        table: dict[str, Any] = msgspec.to_builtins(getattr(config, section))
        for key in keys or table:
            value = table[key]
            if isinstance(value, dict):
                value = [
                    number for row in value.values() if not isinstance(row, str) for number in row
                ]
            flat[f"{section}.{key}"] = value
    if not any(config.mass.payload_com):
        del flat["mass.payload_com"]  # schedules without this key remain valid
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(flat))
    return plain


def digest_of(inputs: dict[str, Any]) -> str:
    """Return the SHA-256 of the inputs."""
    return hashlib.sha256(msgspec.json.encode(inputs, order="sorted")).hexdigest()


def path_beside(robot_file: Path) -> Path:
    """Return the path of a robot file's gain schedule: lab.toml -> lab.gains.json."""
    return robot_file.with_suffix(".gains.json")


def read(path: Path) -> GainSchedule | None:
    """Read a schedule; return None if the file is missing, raise ConfigError if it is invalid."""
    again = "make the file again with `xrl gains`"
    try:
        schedule = msgspec.json.decode(read_text(path), type=GainSchedule)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(str(path), "(file)", f"cannot be read: {error}", again) from None
    except (msgspec.DecodeError, UnicodeError) as error:
        raise ConfigError(str(path), "(file)", f"is not a gain schedule: {error}", again) from None
    for name, nodes in (("z", schedule.z), ("pitch", schedule.pitch)):
        if len(nodes) < 2 or any(b <= a for a, b in pairwise(nodes)):
            found = "has fewer than two nodes, or they do not increase"
            raise ConfigError(str(path), name, found, again)
    try:
        check_ranges(str(path), schedule)
    except ConfigError as error:
        expected = f"{error.expected}; {again}"
        raise ConfigError(error.file, error.key, error.found, expected) from None
    sizes = {len(row) for row in schedule.D}
    if len(schedule.D) != len(schedule.z) or sizes != {len(schedule.pitch)}:
        raise ConfigError(str(path), "D", "does not match the nodes", again)
    if schedule.bounds is not None:
        _check_bounds(path, schedule.bounds, again)
    return schedule


def _check_bounds(path: Path, bounds: dict[str, ModuleBounds], again: str) -> None:
    kinds = sorted(set(map(kind_of, MODULES)))
    if sorted(bounds) != kinds:
        found = f"are for {', '.join(sorted(bounds)) or 'nothing'}"
        raise ConfigError(str(path), "bounds", found, f"must be for {', '.join(kinds)}; {again}")
    for kind, row in bounds.items():
        if not (row.theta[0] < row.theta[1] and row.tau_ff):
            raise ConfigError(str(path), f"bounds.{kind}", "theta or tau_ff is empty", again)


def write(path: Path, schedule: GainSchedule) -> None:
    """Write a schedule atomically, one node per line."""
    parts = [
        f'"{name}": {msgspec.json.encode(getattr(schedule, name)).decode()}'
        for name in GainSchedule.__struct_fields__
        if name != "D"
    ]
    rows = ",\n".join(
        "[" + ",\n ".join(msgspec.json.encode(node).decode() for node in row) + "]"
        for row in schedule.D
    )
    parts.append(f'"D": [\n{rows}\n]')
    text = "{" + ",\n".join(parts) + "}\n"
    try:
        replace_file(path, text.encode())
    except OSError as error:
        found = f"cannot be written: {error.strerror}"
        raise ConfigError(
            str(path), "(file)", found, "use a folder that you can write to"
        ) from None


def why_stale(config: RobotConfig) -> str:
    """Return why the gain schedule does not fit the robot; "" if it fits."""
    schedule = config.gain_schedule
    if schedule is None:
        return "the gain schedule is missing"
    if schedule.version == VERSION and config.law.lead_easing > schedule.lead_easing:
        most, asked = schedule.lead_easing, config.law.lead_easing
        return f"the gain schedule was made for law.lead_easing up to {most}, not {asked}"
    if schedule.version != VERSION:
        return f"the gain schedule has version {schedule.version}, not {VERSION}"
    inputs = inputs_of(config)
    if schedule.digest == digest_of(inputs):
        return ""
    for key, value in inputs.items():
        if schedule.inputs.get(key) != value:
            return f"the gain schedule was made for {key} = {schedule.inputs.get(key)}, not {value}"
    return "the gain schedule's digest does not match its inputs"


def believing(config: RobotConfig) -> RobotConfig:
    """Return the robot without the command bounds of its gain schedule.

    Its joint services then accept any command within their limits. Use it for commands that the
    shipped law never sends: those of another controller, or with gains under study.
    """
    if config.gain_schedule is None:
        return config
    schedule = msgspec.structs.replace(config.gain_schedule, bounds=None)
    return msgspec.structs.replace(config, gain_schedule=schedule)


def require(config: RobotConfig, robot_file: Path) -> None:
    """Raise ConfigError if the robot's gain split needs a schedule that is missing or stale."""
    if config.law.split != "certified":
        return
    stale = why_stale(config)
    schedule = config.gain_schedule
    if not stale and schedule is not None and schedule.bounds is None:
        stale = "has no bounds with which the joint services can check commands"
    if stale:
        right = f"run `xrl gains --config {shlex.quote(str(robot_file))}`"
        raise ConfigError(str(path_beside(robot_file)), "(file)", stale, right)
