"""The shipped robot with its drives on USB: a robot file of its own, with its gain schedule."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Final

import msgspec
import tomli_w

from shared.config import files as config_file
from shared.config import gain_schedule
from tests.conftest import ROBOT_FILE

CHANGES: Final[dict[str, dict[str, object]]] = {
    "joint_service": {"driver": "odrive_usb", "rate_hz": 200.0, "state_rate_hz": 200.0},
    "planner": {"rate_hz": 200.0},
    "simulation": {"encoder_rate_hz": 200.0},
    "drive": {"encoder_period_ms": 5},
}
"""A v3 board's USB carries 200 Hz."""


def write(folder: Path) -> Path:
    """Write robot.toml and robot.gains.json into a folder; return the robot file.

    The gains are the shipped ones: `xrl gains --damping-of deploy/robot.gains.json` finds the same
    at these rates, with 6 dB and 48 ms in hand, but takes most of a minute for it.
    """
    raw = tomllib.loads(ROBOT_FILE.read_text(encoding="utf-8"))
    for section, changes in CHANGES.items():
        raw[section] |= changes
    path = folder / ROBOT_FILE.name
    path.write_text(tomli_w.dumps(raw), encoding="utf-8")
    shipped = gain_schedule.read(gain_schedule.path_beside(ROBOT_FILE))
    assert shipped is not None
    inputs = gain_schedule.inputs_of(config_file.load_without_schedule(path))
    schedule = msgspec.structs.replace(
        shipped, inputs=inputs, digest=gain_schedule.digest_of(inputs)
    )
    gain_schedule.write(gain_schedule.path_beside(path), schedule)
    return path
