"""The robot's configuration as typed structs; `shared.config.files` reads it."""

from __future__ import annotations

from pathlib import Path

from shared.config import sections
from shared.config.endpoints import RUN, filled, stray_braces
from shared.config.gain_table import GainSchedule
from shared.exceptions import BusError
from shared.joints import MODULES, kind_of
from shared.run_directory import live_dir
from shared.toml_file import Section

SERVICES = ("planner", "harness", "imu", "recorder", "simulator", *MODULES)
"""Every service that a fleet can have; each has an endpoint on the bus."""
OPTIONAL = ("imu",)
"""Services that only some robots have (`RobotConfig.services`)."""

ENDPOINTS_OF_MODE = {
    "local": ("unixsock-stream/",),
    "mtls": ("tls/",),
    "open": ("unixsock-stream/", "tcp/"),
}
"""Prefixes of the bus's endpoints under each `bus.security.mode` (docs/security.md)."""

GRAVITY = 9.81
"""m/s^2"""


class RobotConfig(Section, frozen=True):
    """The whole robot file."""

    name: str
    assumed: tuple[str, ...]
    """Keys whose values the paper does not give: measure them, then remove them from this list."""
    mass: sections.MassConfig
    geometry: sections.GeometryConfig
    joint: sections.JointConfig
    limits: sections.LimitsConfig
    module: tuple[sections.ModuleConfig, ...]
    law: sections.LawConfig
    certificate: sections.CertificateConfig
    robustness: sections.RobustnessConfig
    assist: sections.AssistConfig
    stand: sections.StandConfig
    joint_service: sections.JointServiceConfig
    planner: sections.PlannerConfig
    harness: sections.HarnessConfig
    drive: sections.DriveConfig
    can: dict[str, sections.CanConfig]
    bus: sections.BusConfig
    recorder: sections.RecorderConfig
    simulation: sections.SimulationConfig
    imu: sections.ImuConfig = sections.ImuConfig()
    envelope: sections.EnvelopeConfig = sections.EnvelopeConfig()
    trips: sections.TripsConfig = sections.TripsConfig()
    heat: sections.HeatConfig = sections.HeatConfig()
    supply: sections.SupplyConfig = sections.SupplyConfig()
    park: sections.ParkConfig = sections.ParkConfig()
    ros2: sections.Ros2Config = sections.Ros2Config()
    gain_schedule: GainSchedule | None = None
    """From the file beside the robot file; None if it is missing."""

    @property
    def services(self) -> tuple[str, ...]:
        """Every service of this robot's fleet."""
        return tuple(name for name in SERVICES if name not in OPTIONAL or self.imu.fitted)

    @property
    def buses(self) -> tuple[str, ...]:
        """Names of the CAN buses that this robot uses, each once."""
        names = [module.bus for module in self.module] + [self.harness.bus]
        return tuple(dict.fromkeys([*names, *([self.imu.bus] if self.imu.fitted else [])]))

    def module_named(self, name: str) -> sections.ModuleConfig:
        """Return a module by its name."""
        return next(module for module in self.module if module.name == name)

    def motor_signs(self) -> tuple[int, ...]:
        """Return the counting directions of the 12 motors, axis0 and axis1 of each module."""
        return tuple(s for name in MODULES for s in self.module_named(name).motor_signs)

    def joint_limits(self) -> tuple[tuple[float, float], ...]:
        """Return (low, high) in rad for each of the 12 joints, in `JOINTS` order."""
        rows = []
        for module in MODULES:
            limit: sections.LimitConfig = getattr(self.limits, kind_of(module))
            rows += [limit.phi, limit.theta]
        return tuple(rows)

    def stand_gains(self, module: str) -> sections.StandGains:
        """Return the power-up gains of a module."""
        gains: sections.StandGains = getattr(self.stand, kind_of(module))
        return gains

    def hold_gains(self, module: str) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return (k_p, k_d) to which a module's gains rise when tau_coupled is off.

        (phi, theta), N m/rad and N m s/rad: the stand gains for every phi, and for the theta of the
        kinds in `hold_stiffens_theta` (reasons in `deploy/robot.toml`); zero elsewhere. With the
        commanded gains unchanged, the operator's pitch moment of 60 N m in the crawl leaned the COM
        back by 42 mm, and the soles tipped; sideways pushes tipped them in 15 of 500 random cases.
        With the knees' theta soft, the robot withstood a sideways push of only 25 N for 3 s.

        TRACK without tau_coupled uses the same gains: the certified gains carry the robot, but damp
        its sway by only 0.055, and two sideways pushes of 40 N, 2 s apart, made it fall.
        """
        stand = self.stand_gains(module)
        theta = float(kind_of(module) in self.joint_service.hold_stiffens_theta)
        return (stand.k_p[0], theta * stand.k_p[1]), (stand.k_d[0], theta * stand.k_d[1])

    def support_gains(self, module: str) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return (k_p, k_d) of a module that stiffens because another one is limp.

        These are the stand gains, except for a hip's theta: `joint_service.limp_leg_hip_theta`
        holds the torso on a leg that is a strut. (phi, theta), N m/rad and N m s/rad.
        """
        stand = self.stand_gains(module)
        if kind_of(module) != "hip":
            return stand.k_p, stand.k_d
        theta = self.joint_service.limp_leg_hip_theta
        return (stand.k_p[0], theta.k_p), (stand.k_d[0], theta.k_d)

    @property
    def torso_mass(self) -> float:
        """m_torso of the paper in kg: two hip modules, two batteries, the payload."""
        return 2 * self.mass.module + 2 * self.mass.battery + self.mass.payload

    @property
    def torso_com(self) -> tuple[float, float, float]:
        """Centre of mass of torso and payload, m, torso axes; without payload it is 0."""
        fraction = self.mass.payload / self.torso_mass
        x, y, z = self.mass.payload_com
        return fraction * x, fraction * y, fraction * z

    @property
    def total_mass(self) -> float:
        """m_total of the paper in kg."""
        return self.torso_mass + 4 * self.mass.module

    @property
    def leg_weight(self) -> float:
        """Weight of a leg's knee and ankle modules, N: the sole carries it, not the joints."""
        return 2.0 * self.mass.module * GRAVITY


def expand(text: str, run_dir: Path) -> str:
    """Return a path or endpoint with `{run}` replaced by the live directory of a run directory.

    Raises BusError for any other text in braces, which would stay unchanged.
    """
    stray = stray_braces(text, [RUN])
    if stray:
        raise BusError(f"{text}: {stray} is not a valid placeholder; only {RUN} is replaced")
    return filled(text, {RUN: str(live_dir(run_dir))})
