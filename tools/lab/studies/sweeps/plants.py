"""Random draws of the studies: plants with errors from `deploy/plants/ranges.toml`, and pushes."""

from __future__ import annotations

import math
import random
from functools import cache
from typing import Annotated, Any, Final, Literal

import msgspec

from services.simulator.physics.plant import PlantConfig, changed
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Push
from shared.exceptions import ConfigError, RunError
from shared.places import FILES
from shared.toml_file import Range, Section, read_toml
from tools.flags import Arg, Flags
from tools.lab.design.poses import Poses
from tools.lab.design.push_limit import LoadedStand, stand_at

RANGES_FILE: Final = FILES / "plants" / "ranges.toml"
LEAST_SHARE: Final = 0.5
"""Fraction of a range's low end that a wider draw does not go below."""
DIGITS: Final = 3
REACHED_M: Final = 1e-4
SHARE: Final = 0.75
"""Default of --push: the largest push as a fraction of the limit."""
SHARE_MAX: Final = 3.0


class _ErrorRange(Section, frozen=True):
    """One error of the plant."""

    key: str
    """Key of the plant, such as `drivetrain.play`; each of its numbers is drawn separately."""
    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"


class _Ranges(Section, frozen=True):
    """The whole file."""

    error: tuple[_ErrorRange, ...]


@cache
def shipped() -> _Ranges:
    """Return the shipped ranges.

    Raises:
        ConfigError: a range is invalid.
    """
    ranges = read_toml(RANGES_FILE, _Ranges)
    for row in ranges.error:
        if not row.low < row.high or (row.scale == "log" and row.low <= 0.0):
            found = f"{row.low:g} to {row.high:g}"
            raise ConfigError(
                str(RANGES_FILE), row.key, found, "low must be below high, above 0 on a log scale"
            )
    return ranges


def draw(seed: str, beyond: float = 1.0) -> PlantConfig:
    """Return the plant that a seed determines; `beyond` widens the ranges.

    Raises:
        ConfigError: a key does not exist in the plant, or a drawn value is impossible.
    """
    dice = random.Random(f"plant {seed}")
    table = msgspec.to_builtins(PlantConfig())
    values: dict[str, Any] = {"seed": dice.randrange(1 << 30)}
    for row in shipped().error:
        section, _, name = row.key.rpartition(".")
        nominal = table.get(section, {}).get(name)
        if isinstance(nominal, (list, tuple)):
            values[row.key] = [_drawn(dice, row, beyond) for _ in nominal]
        else:
            values[row.key] = _drawn(dice, row, beyond)
    return changed(PlantConfig(), values)


def errors_of(plant: PlantConfig) -> dict[str, float]:
    """Return each drawn error as one number: its value, or the largest of several by magnitude."""
    table = msgspec.to_builtins(plant)
    found = {}
    for row in shipped().error:
        section, _, name = row.key.rpartition(".")
        value = table[section][name]
        several = isinstance(value, (list, tuple))
        found[row.key] = max(abs(x) for x in value) if several else float(value)
    return found


def _drawn(dice: random.Random, row: _ErrorRange, beyond: float) -> float:
    logarithmic = row.scale == "log"
    low, high = (math.log(row.low), math.log(row.high)) if logarithmic else (row.low, row.high)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * beyond
    value = dice.uniform(middle - half, middle + half)
    value = math.exp(value) if logarithmic else value
    if row.low >= 0.0:  # keeps a wider draw positive
        value = max(LEAST_SHARE * row.low, value)
    return float(f"{value:.6g}")


class PushRange:
    """The largest constant push that a standing robot withstands, by direction.

    It is the physical limit under any control (`LoadedStand.limit_of_body`): 76 to 158 N for the
    shipped robot. Forwards and back, the limit is smallest in the stand. Sideways, the squat
    withstands about as much as the stand, and the crawl a quarter more.
    """

    def __init__(self, robot: RobotConfig, most: float = SHARE) -> None:
        """Compute the stand on a level floor; `draw` goes up to a fraction `most` of the limit."""
        self._most = most
        self._stand, _ = torso_at(robot, robot.simulation.stand_height, 0.0)

    def limit_n(self, angle: float) -> float:
        """Return the limit, N, along an angle, rad from x (forwards) to y (left)."""
        return self._stand.limit_of_body((math.cos(angle), math.sin(angle))).force_n

    def push(self, at: float, duration: float, share: float, angle: float) -> Push:
        """Return a push with a fraction of the limit, along an angle as for `limit_n`."""
        force = share * self.limit_n(angle)
        x, y = (round(force * axis, DIGITS) for axis in (math.cos(angle), math.sin(angle)))
        return Push(at=round(at, DIGITS), duration=duration, force=(x, y, 0.0))

    def draw(
        self, dice: random.Random, shares: tuple[float, float], at: float, duration: float
    ) -> Push:
        """Return a push in a random direction; `shares` bounds its fraction of the largest push."""
        share, angle = self._most * dice.uniform(*shares), dice.uniform(-math.pi, math.pi)
        return self.push(at, duration, share, angle)


def uniform(dice: random.Random, low: float, high: float) -> float:
    """Return a random number, rounded so that a table stores it exactly."""
    return round(dice.uniform(low, high), DIGITS)


class PushFlags(Flags):
    """Strength of a study's pushes."""

    push: Annotated[
        float,
        Range(1e-3, SHARE_MAX, ""),
        Arg(
            metavar="SHARE",
            help="largest push, as a fraction of what soles and motors withstand in the stand: 1 "
            "is 76 N forwards and 158 N sideways for the shipped robot",
        ),
    ] = SHARE


def describe(flags: PushFlags) -> str:
    """Return the strength of a study's pushes, for its picture."""
    return f"pushed with up to {flags.push:.0%} of what soles and motors withstand"


def torso_at(robot: RobotConfig, torso: float, pitch: float) -> tuple[LoadedStand, float]:
    """Return the stand with the torso's origin at a height, m, and its COM height, by bisection.

    Raises:
        RunError: the robot does not reach that stand.
    """
    poses = Poses(robot)
    low, high = poses.reach()
    while high - low > REACHED_M:
        z = 0.5 * (low + high)
        found = poses.node(z, pitch)
        if found is None or poses.kinematics.r_torso[2] > torso:
            high = z
        else:
            low = z
    stand = stand_at(robot, poses, low, pitch)
    if stand is None:
        where = f"the torso at {torso:g} m, pitch {pitch:g} rad"
        raise RunError(f"a stand with {where} is out of this robot's reach")
    return stand, low
