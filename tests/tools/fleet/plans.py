"""Fleets that are planned and not started."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shared.places import DEFAULT_CONFIG
from tools.fleet.process_table import TABLE, FleetOptions, FleetPlan, make_plan


def plan(run_dir: Path, config: Path = DEFAULT_CONFIG, **options: Any) -> FleetPlan:
    return make_plan(config, run_dir, FleetOptions(**options))


def robot_file(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the shipped robot file with texts replaced."""
    return _changed(DEFAULT_CONFIG, folder / "robot.toml", changes)


def table_file(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the process table with the first of each text replaced."""
    return _changed(TABLE, folder / "processes.toml", changes, count=1)


def _changed(file: Path, to: Path, changes: tuple[tuple[str, str], ...], count: int = -1) -> Path:
    text = file.read_text(encoding="utf-8")
    for was, becomes in changes:
        assert was in text, was
        text = text.replace(was, becomes, count)
    to.write_text(text, encoding="utf-8")
    return to
