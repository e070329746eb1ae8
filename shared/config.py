"""The robot's configuration, read from `deploy/robot.toml` into typed structs.

Unknown keys, wrong sizes and impossible values are refused with the file, the key,
the value and what would be right (`shared.exceptions.ConfigError`).
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import tomli_w

from shared.exceptions import ConfigError
from shared.joints import KINDS, MODULES, kind_of

S = TypeVar("S", bound=msgspec.Struct)

SERVICES = ("planner", "harness", "recorder", "simulator", *MODULES)
"""Every service of the fleet; each has an endpoint on the bus."""

GRAVITY = 9.81
"""m/s^2"""


class Range(NamedTuple):
    """What a number may be, in words that an error can use."""

    low: float
    high: float
    unit: str


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file; unknown keys are refused."""


Mass = Annotated[float, Range(0.0, 200.0, "kg")]
Length = Annotated[float, Range(0.005, 2.0, "m")]
Share = Annotated[float, Range(0.0, 1.0, "1")]
Rate = Annotated[float, Range(1.0, 8000.0, "Hz")]
Milliseconds = Annotated[float, Range(0.1, 10_000.0, "ms")]
Seconds = Annotated[float, Range(0.001, 60.0, "s")]
Angle = Annotated[float, Range(-2 * math.pi, 2 * math.pi, "rad")]


class MassConfig(Section, frozen=True):
    """Masses, paper Table I."""

    module: Annotated[float, Range(0.1, 50.0, "kg")]
    battery: Mass
    payload: Mass
    payload_max: Mass


class GeometryConfig(Section, frozen=True):
    """Lengths, paper Table I."""

    l1: Length
    l2: Length
    w_hip: Length
    w_base: Length
    l_foot: Length
    w_foot: Length
    foot_height: Length
    harness_point: tuple[
        Annotated[float, Range(-1.0, 1.0, "m")],
        Annotated[float, Range(-1.0, 1.0, "m")],
        Annotated[float, Range(-1.0, 1.0, "m")],
    ]
    torso_size: tuple[Length, Length, Length]


class JointConfig(Section, frozen=True):
    """The 2-DOF module: motors, gear and differential."""

    gear_ratio: Annotated[float, Range(1.0, 200.0, "1")]
    armature: Annotated[float, Range(0.001, 5.0, "kg m^2")]
    damping: Annotated[float, Range(0.0, 50.0, "N m s/rad")]
    friction_loss: Annotated[float, Range(0.0, 20.0, "N m")]
    encoder_counts_per_turn: Annotated[int, Range(64, 1 << 24, "counts")]
    tau_module_max: Annotated[float, Range(1.0, 1000.0, "N m")]


class ContactConfig(Section, frozen=True):
    """Sole on floor."""

    friction: Annotated[float, Range(0.05, 2.0, "1")]


class LimitConfig(Section, frozen=True):
    """Joint range of one kind of module, and why it is so."""

    phi: tuple[Angle, Angle]
    theta: tuple[Angle, Angle]
    why: str


class LimitsConfig(Section, frozen=True):
    """Joint ranges by kind."""

    ankle: LimitConfig
    knee: LimitConfig
    hip: LimitConfig


class ModuleConfig(Section, frozen=True):
    """One module: which bus, which two CAN nodes."""

    name: str
    bus: str
    node_ids: tuple[Annotated[int, Range(0, 62, "1")], Annotated[int, Range(0, 62, "1")]]


Stiffness6 = tuple[
    Annotated[float, Range(0.0, 1e5, "N/m")],
    Annotated[float, Range(0.0, 1e5, "N/m")],
    Annotated[float, Range(0.0, 1e5, "N/m")],
    Annotated[float, Range(0.0, 1e5, "N m/rad")],
    Annotated[float, Range(0.0, 1e5, "N m/rad")],
    Annotated[float, Range(0.0, 1e5, "N m/rad")],
]
Selection = Literal[0, 1]


class LawConfig(Section, frozen=True):
    """Gains and choices of the law (design section 3)."""

    K_p: Stiffness6
    B_p: Stiffness6
    K_0: Annotated[float, Range(0.0, 1e4, "N m/rad")]
    B_0: Annotated[float, Range(0.0, 1e3, "N m s/rad")]
    S: tuple[Selection, Selection, Selection, Selection, Selection, Selection]
    damping_lambda: Annotated[float, Range(1e-6, 0.5, "m")]
    jacobian: Literal["load_sharing", "average"]
    split: Literal["diagonal"]
    local_damping_share: Annotated[float, Range(0.0, 1.0, "1")]
    load_sharing_moment_arms: tuple[Share, Share, Annotated[float, Range(0.001, 0.5, "m")]]
    recentre_s: Seconds


class AssistConfig(Section, frozen=True):
    """Assist force on the operator."""

    force_max: Annotated[float, Range(0.0, 500.0, "N")]
    rate_max: Annotated[float, Range(1.0, 5000.0, "N/s")]


LocalStiffness = Annotated[float, Range(0.0, 1e4, "N m/rad")]
LocalDamping = Annotated[float, Range(0.0, 1e3, "N m s/rad")]


class StandGains(Section, frozen=True):
    """Local gains of HOLD at power-up, (phi, theta)."""

    k_p: tuple[LocalStiffness, LocalStiffness]
    k_d: tuple[LocalDamping, LocalDamping]


class StandConfig(Section, frozen=True):
    """Stand gains by kind."""

    ankle: StandGains
    knee: StandGains
    hip: StandGains


class JointServiceConfig(Section, frozen=True):
    """Timing and limits of the joint service (design section 4)."""

    driver: Literal["odrive_can"]
    rate_hz: Rate
    state_rate_hz: Rate
    max_command_age_ms: Milliseconds
    command_aging_max_ms: Milliseconds
    coupled_ramp_ms: Milliseconds
    engage_after_ms: Milliseconds
    engage_after_max_ms: Milliseconds
    dropout_forget_s: Seconds
    blend_ms: Milliseconds
    damp_fade_s: Seconds
    damp_k_d: LocalDamping
    torque_rate_max: Annotated[float, Range(100.0, 1e6, "N m/s")]
    soft_stop_k_p: LocalStiffness
    k_p_max: LocalStiffness
    k_d_max: LocalDamping
    v_max: Annotated[float, Range(0.1, 100.0, "rad/s")]


class PlannerConfig(Section, frozen=True):
    """Planner timing."""

    rate_hz: Rate
    state_stale_ms: Milliseconds


class HarnessConfig(Section, frozen=True):
    """Six-axis harness sensor: a Stewart platform of six load cells."""

    bus: str
    rate_hz: Rate
    base_radius: Length
    platform_radius: Length
    height: Length
    leg_force_max: Annotated[float, Range(1.0, 1e5, "N")]
    low_pass_hz: Annotated[float, Range(0.1, 500.0, "Hz")]
    stale_ms: Milliseconds
    tare_s: Seconds


class DriveConfig(Section, frozen=True):
    """ODrive settings that the joint service relies on (design section 5)."""

    torque_constant: Annotated[float, Range(0.001, 5.0, "N m/A")]
    current_lim: Annotated[float, Range(1.0, 200.0, "A")]
    vel_limit: Annotated[float, Range(0.1, 500.0, "turn/s")]
    watchdog_timeout: Annotated[float, Range(0.005, 10.0, "s")]
    encoder_period_ms: Annotated[int, Range(1, 100, "ms")]
    heartbeat_period_ms: Annotated[int, Range(1, 10_000, "ms")]


class CanConfig(Section, frozen=True):
    """A CAN bus as python-can takes it."""

    interface: str
    channel: str


class BusConfig(Section, frozen=True):
    """The Zenoh bus: fixed endpoints, no scouting."""

    lease_ms: Annotated[int, Range(100, 60_000, "ms")]
    endpoints: dict[str, str]


class RecorderConfig(Section, frozen=True):
    """MCAP file parameters (design section 10)."""

    chunk_kib: Annotated[int, Range(1, 65_536, "KiB")]
    flush_ms: Milliseconds
    fsync_s: Seconds


class OperatorConfig(Section, frozen=True):
    """The simulated operator's hand: a clipped spring-damper (design section 8)."""

    k_z: Annotated[float, Range(0.0, 1e5, "N/m")]
    b_z: Annotated[float, Range(0.0, 1e4, "N s/m")]
    force_max: Annotated[float, Range(0.0, 1e4, "N")]
    k_pitch: Annotated[float, Range(0.0, 1e5, "N m/rad")]
    b_pitch: Annotated[float, Range(0.0, 1e4, "N m s/rad")]
    moment_max: Annotated[float, Range(0.0, 1e4, "N m")]


class SimulationConfig(Section, frozen=True):
    """The simulated world."""

    timestep: Annotated[float, Range(1e-5, 0.005, "s")]
    stand_height: Length
    hoist_s: Seconds
    encoder_rate_hz: Rate
    truth_rate_hz: Rate
    harness_noise: Annotated[float, Range(0.0, 100.0, "N")]
    late_slip_ms: Milliseconds
    operator: OperatorConfig


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

    def module_named(self, name: str) -> ModuleConfig:
        """Return a module by its name."""
        return next(module for module in self.module if module.name == name)

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
    """Read and check a robot file.

    Raises:
        ConfigError: the file cannot be read, or a key or value is not as it should be.
    """
    config = read_toml(path, RobotConfig)
    _check_sense(str(path), config)
    return config


def to_toml(config: RobotConfig) -> str:
    """Return the robot as TOML that `load` reads back; comments are not kept."""
    return tomli_w.dumps(msgspec.to_builtins(config))


def read_toml(path: Path, into: type[S]) -> S:
    """Read a TOML file into a struct, with every number inside its `Range`.

    Raises:
        ConfigError: naming the file, the key, what stands there and what would be right.
    """
    file = str(path)
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(file, "(file)", "not found", "give the path of a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(file, "(file)", f"cannot be read: {error}", "a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(file, "(syntax)", str(error), "TOML 1.0 is read") from None
    try:
        config = msgspec.convert(raw, into)
    except msgspec.ValidationError as error:
        raise _as_config_error(file, raw, str(error)) from None
    _check_ranges(file, "", config, into)
    return config


def expand(text: str, run_dir: Path) -> str:
    """Return a path or endpoint with `{run}` replaced by the run directory."""
    return text.replace("{run}", str(run_dir))


def _as_config_error(file: str, raw: dict[str, Any], message: str) -> ConfigError:
    """Turn msgspec's "Expected `float`, got `str` - at `$.mass.module`" into our words."""
    reason, _, place = message.partition(" - at `")
    key = place.rstrip("`").removeprefix("$").removeprefix(".")
    unknown = re.search(r"unknown field `(.*)`", reason)
    if unknown:
        full = f"{key}.{unknown[1]}".lstrip(".")
        return ConfigError(file, full, "unknown key", "remove it, or correct its spelling")
    missing = re.search(r"missing required field `(.*)`", reason)
    if missing:
        full = f"{key}.{missing[1]}".lstrip(".")
        return ConfigError(file, full, "missing", "this key is required")
    found = _value_at(raw, key)
    return ConfigError(file, key or "(file)", f"{found!r} does not fit", reason)


def _value_at(raw: Any, key: str) -> Any:
    """Return the value at a msgspec path such as `module[2].node_ids`, or the key itself."""
    value = raw
    for name, index in re.findall(r"([A-Za-z_]\w*)|\[(\d+)\]", key):
        try:
            value = value[name] if name else value[int(index)]
        except (KeyError, IndexError, TypeError):
            return key
    return value


def _check_ranges(file: str, key: str, value: Any, hint: Any) -> None:
    """Walk a struct by its type hints and check each number against its `Range`."""
    origin = get_origin(hint)
    if origin is Annotated:
        for note in hint.__metadata__:
            if isinstance(note, Range) and not note.low <= value <= note.high:
                allowed = f"must be from {note.low:g} to {note.high:g} {note.unit}"
                raise ConfigError(file, key, f"{value!r} is out of range", allowed)
        return
    if isinstance(value, msgspec.Struct):
        hints = get_type_hints(type(value), include_extras=True)
        for name in value.__struct_fields__:
            _check_ranges(file, f"{key}.{name}".lstrip("."), getattr(value, name), hints[name])
    elif origin is tuple:
        hints_of_items = get_args(hint)
        repeated = len(hints_of_items) == 2 and hints_of_items[1] is Ellipsis
        for index, item in enumerate(value):
            item_hint = hints_of_items[0 if repeated else index]
            _check_ranges(file, f"{key}[{index}]", item, item_hint)
    elif origin is dict:
        for name, item in value.items():
            _check_ranges(file, f"{key}.{name}", item, get_args(hint)[1])


def _check_sense(file: str, config: RobotConfig) -> None:
    """Check what no single number shows: duplicates, crossings, dangling names."""
    _check_names(file, config)
    _check_physics(file, config)
    _check_timing(file, config)


def _check_names(file: str, config: RobotConfig) -> None:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", config.name):
        raise ConfigError(file, "name", f"{config.name!r}", "use letters, digits, _ and - only")
    names = [module.name for module in config.module]
    for index, name in enumerate(names):
        where = f"module[{index}].name"
        if name in names[:index]:
            raise ConfigError(file, where, f"{name!r} stands twice", "each module once")
        if name not in MODULES:
            raise ConfigError(file, where, f"{name!r} is no module", f"one of {_words(MODULES)}")
    absent = [name for name in MODULES if name not in names]
    if absent:
        raise ConfigError(file, "module", f"no entry for {_words(absent)}", "six modules in all")
    nodes: dict[tuple[str, int], str] = {}
    for index, module in enumerate(config.module):
        if module.bus not in config.can:
            buses = _words(config.can)
            raise ConfigError(file, f"module[{index}].bus", f"{module.bus!r}", f"one of {buses}")
        for node in module.node_ids:
            other = nodes.setdefault((config.can[module.bus].channel, node), module.name)
            if other != module.name or len(set(module.node_ids)) < 2:
                where = f"module[{index}].node_ids"
                raise ConfigError(file, where, f"node {node} is taken on this bus", "a free node")
    if config.harness.bus not in config.can:
        buses = _words(config.can)
        raise ConfigError(file, "harness.bus", f"{config.harness.bus!r}", f"one of {buses}")
    _check_endpoints(file, config.bus.endpoints)
    for index, key in enumerate(config.assumed):
        value: Any = config
        for part in key.split("."):
            value = getattr(value, part, None)
        if value is None:
            raise ConfigError(file, f"assumed[{index}]", f"{key!r} is no key", "a dotted key")


def _check_endpoints(file: str, endpoints: dict[str, str]) -> None:
    for service in SERVICES:
        if service not in endpoints:
            raise ConfigError(file, f"bus.endpoints.{service}", "missing", "one for each service")
    seen: dict[str, str] = {}
    for service, endpoint in endpoints.items():
        where = f"bus.endpoints.{service}"
        if service not in SERVICES:
            raise ConfigError(file, where, "no such service", f"one of {_words(SERVICES)}")
        if not re.match(r"(unixsock-stream|tcp|tls)/.", endpoint):
            right = "unixsock-stream/PATH, tcp/HOST:PORT or tls/HOST:PORT"
            raise ConfigError(file, where, f"{endpoint!r}", right)
        if endpoint in seen:
            raise ConfigError(
                file, where, f"{endpoint!r} is {seen[endpoint]}'s too", "one for each service"
            )
        seen[endpoint] = service


def _check_physics(file: str, config: RobotConfig) -> None:
    mass, geometry = config.mass, config.geometry
    if mass.payload > mass.payload_max:
        found = f"{mass.payload:g} kg is more than payload_max"
        raise ConfigError(file, "mass.payload", found, f"at most {mass.payload_max:g} kg")
    for kind in KINDS:
        limit: LimitConfig = getattr(config.limits, kind)
        for axis, (low, high) in (("phi", limit.phi), ("theta", limit.theta)):
            if low >= high:
                where = f"limits.{kind}.{axis}"
                raise ConfigError(file, where, f"[{low:g}, {high:g}] is crossed", "low below high")
    if config.limits.knee.theta[1] >= 0.0:
        found = f"{config.limits.knee.theta[1]:g} rad lets the knee straighten"
        right = "negative: a straight knee (0) is singular"
        raise ConfigError(file, "limits.knee.theta[1]", found, right)
    reach = geometry.l1 + geometry.l2
    if not abs(geometry.l1 - geometry.l2) < config.simulation.stand_height < reach:
        found = f"{config.simulation.stand_height:g} m"
        right = f"inside the legs' reach, {abs(geometry.l1 - geometry.l2):.3f} to {reach:.3f} m"
        raise ConfigError(file, "simulation.stand_height", found, right)
    for index, selected in enumerate(config.law.S):
        if not selected and config.law.K_p[index] <= 0.0:
            where = f"law.K_p[{index}]"
            raise ConfigError(file, where, "0 in a direction the robot balances", "positive")


def _check_timing(file: str, config: RobotConfig) -> None:
    service = config.joint_service
    pairs = (
        ("joint_service.state_rate_hz", service.state_rate_hz, service.rate_hz),
        ("planner.rate_hz", config.planner.rate_hz, service.state_rate_hz),
        ("joint_service.command_aging_max_ms", service.command_aging_max_ms,
         service.max_command_age_ms),
        ("joint_service.engage_after_ms", service.engage_after_ms, service.engage_after_max_ms),
    )  # fmt: skip
    for key, value, limit in pairs:
        if value > limit:
            raise ConfigError(file, key, f"{value:g} is too large", f"at most {limit:g}")
    command_period_ms = 1e3 / config.planner.rate_hz
    if service.max_command_age_ms < 3 * command_period_ms:
        found = f"{service.max_command_age_ms:g} ms is under three planner periods"
        right = f"at least {3 * command_period_ms:g} ms, or every hiccup is a drop-out"
        raise ConfigError(file, "joint_service.max_command_age_ms", found, right)


def _words(names: Iterable[str]) -> str:
    return ", ".join(names)
