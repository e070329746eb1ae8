"""Random plants for the sweeps: every error of `deploy/plants/ranges.toml`, drawn together."""

from __future__ import annotations

import hashlib
import math
import random
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

import msgspec

from services.simulator.physics.plant import PlantConfig, changed
from shared.exceptions import ConfigError
from shared.places import FILES
from shared.toml_file import Section, read_toml

RANGES_FILE: Final = FILES / "plants" / "ranges.toml"
LEAST_SHARE: Final = 0.5
"""Fraction of a range's low end below which a wider draw does not go."""


class ErrorRange(Section, frozen=True):
    """One error of the plant."""

    key: str
    """Key of the plant, such as `drivetrain.play`; every number below it is drawn by itself."""
    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"


class Ranges(Section, frozen=True):
    """The whole file."""

    error: tuple[ErrorRange, ...]


@cache
def shipped() -> Ranges:
    """Return the ranges of this checkout."""
    return load(RANGES_FILE)


def load(path: Path) -> Ranges:
    """Read ranges.

    Raises:
        ConfigError: a key is none of the plant's, or its range makes no sense.
    """
    ranges = read_toml(path, Ranges)
    for row in ranges.error:
        if not row.low < row.high or (row.scale == "log" and row.low <= 0.0):
            raise ConfigError(str(path), row.key, f"{row.low:g} to {row.high:g}", "low below high")
    draw("check", ranges)
    return ranges


def digest() -> str:
    """Return the SHA-256 of the shipped ranges."""
    return hashlib.sha256(RANGES_FILE.read_bytes()).hexdigest()


def draw(seed: str, ranges: Ranges | None = None, beyond: float = 1.0) -> PlantConfig:
    """Return a plant: the same text draws the same one; `beyond` widens the ranges.

    Raises:
        ConfigError: a key is none of the plant's, or a drawn value is impossible.
    """
    dice = random.Random(f"plant {seed}")
    table = msgspec.to_builtins(PlantConfig())
    values: dict[str, Any] = {"seed": dice.randrange(1 << 30)}
    for row in (ranges or shipped()).error:
        section, _, name = row.key.rpartition(".")
        nominal = table.get(section, {}).get(name)
        if isinstance(nominal, (list, tuple)):
            values[row.key] = [_drawn(dice, row, beyond) for _ in nominal]
        else:
            values[row.key] = _drawn(dice, row, beyond)
    return changed(PlantConfig(), values)


def errors_of(plant: PlantConfig) -> dict[str, float]:
    """Return each drawn error as one number: its value, or the largest of several, absolute."""
    table = msgspec.to_builtins(plant)
    found = {}
    for row in shipped().error:
        section, _, name = row.key.rpartition(".")
        value = table[section][name]
        several = isinstance(value, (list, tuple))
        found[row.key] = max(abs(x) for x in value) if several else float(value)
    return found


def _drawn(dice: random.Random, row: ErrorRange, beyond: float) -> float:
    logarithmic = row.scale == "log"
    low, high = (math.log(row.low), math.log(row.high)) if logarithmic else (row.low, row.high)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * beyond
    value = dice.uniform(middle - half, middle + half)
    value = math.exp(value) if logarithmic else value
    if row.low >= 0.0:  # what cannot be negative, or nothing, comes no nearer to it than this
        value = max(LEAST_SHARE * row.low, value)
    return float(f"{value:.6g}")
