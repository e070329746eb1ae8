"""The shipped robot with its drives on USB: a robot file of its own, with its gain schedule."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Final

from tests.conftest import ROBOT_FILE

RATES: Final = (
    ("joint_service", "rate_hz", "125.0"),
    ("joint_service", "state_rate_hz", "125.0"),
    ("planner", "rate_hz", "125.0"),
    ("simulation", "encoder_rate_hz", "125.0"),
    ("drive", "encoder_period_ms", "8"),
)
"""A v3 board's USB gives 200 Hz (design section 5); two cores carry this much of it beside the
emulated drives."""


def write(folder: Path) -> Path:
    """Write robot.toml and robot.gains.json into a folder; return the robot file."""
    text = ROBOT_FILE.read_text(encoding="utf-8")
    for section, key, value in (("joint_service", "driver", '"odrive_usb"'), *RATES):
        text = _set(text, section, key, value)
    path = folder / ROBOT_FILE.name
    path.write_text(text, encoding="utf-8")
    shutil.copy(ROBOT_FILE.with_name("robot.gains.json"), folder)
    return path


def _set(text: str, section: str, key: str, value: str) -> str:
    """Return a robot file with another value of one key."""
    found = re.search(rf"^\[{section}\].*?^{key} = (\S+)", text, re.MULTILINE | re.DOTALL)
    assert found is not None, f"{section}.{key}"
    return text[: found.start(1)] + value + text[found.end(1) :]
