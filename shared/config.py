"""The robot's configuration, read from `deploy/robot.toml` into typed structs.

Unknown keys, wrong sizes and impossible values are refused with the file, the key,
the value and what would be right (`shared.exceptions.ConfigError`).
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import tomli_w

from shared import config_check, gain_schedule
from shared.config_sections import (
    AssistConfig,
    BusConfig,
    CanConfig,
    CertificateConfig,
    ContactConfig,
    DriveConfig,
    GeometryConfig,
    HarnessConfig,
    JointConfig,
    JointServiceConfig,
    LawConfig,
    LimitConfig,
    LimitsConfig,
    MassConfig,
    ModuleConfig,
    PlannerConfig,
    RecorderConfig,
    SimulationConfig,
    StandConfig,
    StandGains,
)
from shared.exceptions import ConfigError
from shared.gain_schedule import GainSchedule
from shared.joints import MODULES, kind_of
from shared.toml_file import Section, parse_toml, read_toml

SERVICES = ("planner", "harness", "recorder", "simulator", *MODULES)
"""Every service of the fleet; each has an endpoint on the bus."""

GRAVITY = 9.81
"""m/s^2"""


class RobotConfig(Section, frozen=True):
    """The whole file."""

    name: str
    assumed: tuple[str, ...]
    mass: MassConfig
    geometry: GeometryConfig
    joint: JointConfig
    contact: ContactConfig
    limits: LimitsConfig
    module: tuple[ModuleConfig, ...]
    law: LawConfig
    certificate: CertificateConfig
    assist: AssistConfig
    stand: StandConfig
    joint_service: JointServiceConfig
    planner: PlannerConfig
    harness: HarnessConfig
    drive: DriveConfig
    can: dict[str, CanConfig]
    bus: BusConfig
    recorder: RecorderConfig
    simulation: SimulationConfig
    gain_schedule: GainSchedule | None = None
    """Not in this file but beside it; None if it has not been made."""

    def module_named(self, name: str) -> ModuleConfig:
        """Return a module by its name."""
        return next(module for module in self.module if module.name == name)

    def motor_signs(self) -> tuple[int, ...]:
        """Return which way each of the 12 motors counts, axis0 and axis1 of each module."""
        return tuple(s for name in MODULES for s in self.module_named(name).motor_signs)

    def joint_limits(self) -> tuple[tuple[float, float], ...]:
        """Return (low, high) in rad for each of the 12 joints, in `JOINTS` order."""
        rows = []
        for module in MODULES:
            limit: LimitConfig = getattr(self.limits, kind_of(module))
            rows += [limit.phi, limit.theta]
        return tuple(rows)

    def stand_gains(self, module: str) -> StandGains:
        """Return the power-up gains of a module."""
        gains: StandGains = getattr(self.stand, kind_of(module))
        return gains

    @property
    def torso_mass(self) -> float:
        """m_torso of the paper in kg: two hip modules, two batteries, the payload."""
        return 2 * self.mass.module + 2 * self.mass.battery + self.mass.payload

    @property
    def total_mass(self) -> float:
        """m_total of the paper in kg."""
        return self.torso_mass + 4 * self.mass.module


def load(path: Path) -> RobotConfig:
    """Read and check a robot file, and the gain schedule beside it if there is one.

    Raises:
        ConfigError: a file cannot be read, or a key or value is not as it should be.
    """
    config = load_without_schedule(path)
    schedule = gain_schedule.read(gain_schedule.path_beside(path))
    return msgspec.structs.replace(config, gain_schedule=schedule)


def load_without_schedule(path: Path) -> RobotConfig:
    """Read and check a robot file alone.

    Raises:
        ConfigError: the file cannot be read, or a key or value is not as it should be.
    """
    return _checked(read_toml(path, RobotConfig), str(path))


def parse(text: str, file: str) -> RobotConfig:
    """Return the robot that a TOML text describes, without a gain schedule.

    Raises:
        ConfigError: a key or value is not as it should be; `file` names the text.
    """
    return _checked(parse_toml(text, file, RobotConfig), file)


def _checked(config: RobotConfig, file: str) -> RobotConfig:
    if config.gain_schedule is not None:
        right = "remove it: the schedule is a file of its own, made by `xrl gains`"
        raise ConfigError(file, "gain_schedule", "unknown key", right)
    config_check.check(file, config, SERVICES)
    return config


def to_toml(config: RobotConfig) -> str:
    """Return the robot as TOML that `load` reads back; comments are not kept."""
    table = msgspec.to_builtins(config)
    del table["gain_schedule"]
    return tomli_w.dumps(table)


def expand(text: str, run_dir: Path) -> str:
    """Return a path or endpoint with `{run}` replaced by the run directory."""
    return text.replace("{run}", str(run_dir))
