"""Checks of a robot file's values against each other (`shared.config.robot_config`)."""

from __future__ import annotations

import difflib
import ipaddress
import math
import re
from collections.abc import Iterable, Iterator
from importlib.metadata import entry_points
from typing import Any, Final, TypeAlias

import msgspec

from shared.config.can_load import check_buses
from shared.config.endpoints import PORT_MAX, ROBOT, RUN, is_endpoint, stray_braces
from shared.config.robot_config import ENDPOINTS_OF_MODE, SERVICES, RobotConfig
from shared.config.sections import LimitConfig
from shared.exceptions import ConfigError
from shared.joints import KINDS, MODULES

Problems: TypeAlias = Iterator[tuple[str, str, str]]
"""Key, found value and right value of each problem; only the first is reported."""

INTERFACES: Final = (
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys", "neovi",
    "nican", "nixnet", "pcan", "robotell", "seeedstudio", "serial", "slcan", "socketcan",
    "socketcand", "systec", "udp_multicast", "usb2can", "vector", "virtual", "xrl_unix",
)  # fmt: skip
"""Interfaces of python-can and of this package; other packages may declare more."""

ROS2_DISTRIBUTIONS: Final = ("jazzy", "kilted", "lyrical")
"""Distributions whose Zenoh messages the gateway supports (`services.ros2_gateway`)."""
CURRENT_RANGE: Final = 60.0
"""Maximum current that a drive measures, A: the firmware's default of
`motor.config.requested_current_range`."""
LEADABLE: Final = (2, 4)
"""Rows of p that a person may lead: height and pitch."""
_POWER_UP_TURNS: Final = 1.0
"""Maximum count of an encoder at power-up, turns."""


def check(file: str, config: RobotConfig) -> None:
    """Check values against each other: duplicates, crossed limits, dangling names.

    The range of each value is already checked. The ConfigError names `file`.
    """
    for problems in (_names, _interfaces, _physics, _drive, _timing):
        _refuse(file, problems(config))
    check_buses(file, config)


def check_security(file: str, config: RobotConfig) -> None:
    """Check that the endpoints fit `bus.security.mode`; not for a robot from a log.

    Raises ConfigError, for example, if anyone could reach a port although the mode is not `open`.
    """
    _refuse(file, _security(config))


def _refuse(file: str, problems: Problems) -> None:
    for problem in problems:
        raise ConfigError(file, *problem)


def _security(config: RobotConfig) -> Problems:
    security = config.bus.security
    if not re.match(r"[~/]", security.keys):
        found = f"{security.keys!r} depends on the directory in which a service starts"
        yield "bus.security.keys", found, "must start with / or ~"
    yield from _placeholders("bus.security.keys", security.keys, ROBOT)
    for index, host in enumerate(security.allow):
        if not _is_address(host):
            right = (
                "use an IP address without a port: a name might be unknown when a service starts"
            )
            yield f"bus.security.allow[{index}]", f"{host!r} is not an IP address", right
    for service, endpoint in config.bus.endpoints.items():
        if not endpoint.startswith(ENDPOINTS_OF_MODE[security.mode]):
            words = _words(f"{start}..." for start in ENDPOINTS_OF_MODE[security.mode])
            found = f"{endpoint!r} is not allowed if bus.security.mode = {security.mode!r}"
            right = f"use {words}; or set mode = " + _OTHER_MODE[endpoint.partition("/")[0]]
            yield f"bus.endpoints.{service}", found, right


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


_OTHER_MODE: Final = {
    "unixsock-stream": '"local", for one host',
    "tls": '"mtls", with `xrl keys make`',
    "tcp": '"open": anyone who reaches the port can then command the robot (docs/security.md)',
}
"""Right mode for each kind of endpoint."""


def _names(config: RobotConfig) -> Problems:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", config.name):
        yield "name", f"{config.name!r} is not a valid name", "use letters, digits, _ and - only"
    names = [module.name for module in config.module]
    for index, name in enumerate(names):
        if name in names[:index]:
            yield f"module[{index}].name", f"{name!r} is listed twice", "list each module once"
        if name not in MODULES:
            yield (
                f"module[{index}].name",
                f"{name!r} is not a valid module",
                f"use one of {_words(MODULES)}",
            )
    absent = [name for name in MODULES if name not in names]
    if absent:
        yield "module", f"no entry for {_words(absent)}", "all six modules are required"
    buses = f"use one of {_words(config.can)}"
    nodes: dict[tuple[str, int], str] = {}
    for index, module in enumerate(config.module):
        if module.bus not in config.can:
            yield f"module[{index}].bus", f"{module.bus!r} is not in [can]", buses
        for node in module.node_ids:
            other = nodes.setdefault((config.can[module.bus].channel, node), module.name)
            if other != module.name or len(set(module.node_ids)) < 2:
                yield (
                    f"module[{index}].node_ids",
                    f"node {node} is already used on this bus",
                    "use a free node",
                )
    yield from _serial_numbers(config)
    supply = config.supply
    if supply.sit_v > supply.low_v:
        yield (
            "supply.sit_v",
            f"{supply.sit_v:g} V",
            f"must be at most supply.low_v, {supply.low_v:g} V",
        )
    if config.harness.bus not in config.can:
        yield "harness.bus", f"{config.harness.bus!r} is not in [can]", buses
    yield from _imu(config)
    yield from _ros2(config)
    yield from _endpoints(config)
    table = msgspec.to_builtins(config)
    for index, key in enumerate(config.assumed):
        value: Any = table
        for part in key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is None:
            yield f"assumed[{index}]", f"{key!r} is not a key of this file", "use a dotted key"


def _ros2(config: RobotConfig) -> Problems:
    ros2 = config.ros2
    if ros2.distribution not in ROS2_DISTRIBUTIONS:
        found = f"{ros2.distribution!r} is not supported"
        if ros2.distribution == "humble":
            found += ": its topics have no type hash, so its nodes would not find the gateway's"
        yield "ros2.distribution", found, f"use one of {_words(ROS2_DISTRIBUTIONS)}"
    if ros2.router.startswith("unixsock") or not is_endpoint(ros2.router):
        yield (
            "ros2.router",
            f"{ros2.router!r} is not valid",
            "use an endpoint such as tcp/localhost:7447",
        )
    if not re.fullmatch(r"([A-Za-z]\w*(/[A-Za-z]\w*)*)?", ros2.namespace):
        right = "use letters, digits and _, such as legs; or leave it empty"
        yield "ros2.namespace", f"{ros2.namespace!r} is not a valid namespace", right


def _imu(config: RobotConfig) -> Problems:
    imu = config.imu
    if not imu.fitted:
        return
    if imu.bus not in config.can:
        yield "imu.bus", f"{imu.bus!r} is not in [can]", f"use one of {_words(config.can)}"
    channel = config.can[imu.bus].channel
    for module in config.module:
        if config.can[module.bus].channel == channel:
            right = (
                "use a bus without drives: the IMU's ids 0x11, 0x21 and 0x32 are those of nodes "
                "0 and 1"
            )
            yield "imu.bus", f"{imu.bus!r} is also the bus of {module.name}", right


def _serial_numbers(config: RobotConfig) -> Problems:
    """Check the drives' USB serial numbers, which only the USB driver requires."""
    wanted = config.joint_service.driver == "odrive_usb"
    seen: set[str] = set()
    for index, module in enumerate(config.module):
        where, serial = f"module[{index}].serial_number", module.serial_number.upper()
        if not serial and not wanted:
            continue
        if not re.fullmatch(r"[0-9A-F]{12}", serial):
            found = f"{module.serial_number!r} of {module.name} is not valid"
            yield where, found, "use the 12 hexadecimal digits that `odrivetool` shows"
        if serial in seen:
            yield where, f"{serial} is listed twice", "list each drive once"
        seen.add(serial)


def _endpoints(config: RobotConfig) -> Problems:
    endpoints = config.bus.endpoints
    for service in config.services:
        if service not in endpoints:
            yield f"bus.endpoints.{service}", "missing", "each service needs an endpoint"
    seen: dict[str, str] = {}
    for service, endpoint in endpoints.items():
        where = f"bus.endpoints.{service}"
        if service not in SERVICES:
            yield where, "not a valid service", f"use one of {_words(SERVICES)}"
        if not is_endpoint(endpoint):
            right = "use unixsock-stream/PATH (without ? and #), tcp/HOST:PORT or tls/HOST:PORT"
            yield where, f"{endpoint!r} is not valid", f"{right}, with a port from 1 to {PORT_MAX}"
        yield from _placeholders(where, endpoint, RUN)
        if endpoint in seen:
            yield where, f"{endpoint!r} is also used by {seen[endpoint]}", "use another endpoint"
        seen[endpoint] = service


def _placeholders(where: str, text: str, placeholder: str) -> Problems:
    stray = stray_braces(text, [placeholder])
    if stray:
        found = f"{text!r}: {stray} is not a valid placeholder"
        yield where, found, f"only {placeholder} is replaced"


def _physics(config: RobotConfig) -> Problems:
    mass, geometry, height = config.mass, config.geometry, config.simulation.stand_height
    if mass.payload > mass.payload_max:
        found = f"{mass.payload:g} kg is more than payload_max"
        yield "mass.payload", found, f"must be at most {mass.payload_max:g} kg"
    for kind in KINDS:
        limit: LimitConfig = getattr(config.limits, kind)
        for axis, (low, high) in (("phi", limit.phi), ("theta", limit.theta)):
            if low >= high:
                found = f"[{low:g}, {high:g}] is not a valid range"
                yield (
                    f"limits.{kind}.{axis}",
                    found,
                    "the lower limit must be below the upper limit",
                )
    if config.limits.knee.theta[1] >= 0.0:
        found = f"{config.limits.knee.theta[1]:g} rad lets the knee straighten"
        yield "limits.knee.theta[1]", found, "must be negative: a straight knee (0) is singular"
    least, reach = abs(geometry.l1 - geometry.l2), geometry.l1 + geometry.l2
    if not least < height < reach:
        right = f"must be inside the legs' reach, {least:.3f} to {reach:.3f} m"
        yield "simulation.stand_height", f"{height:g} m", right
    if geometry.l1 >= geometry.l2:
        found = f"{geometry.l1:g} m is not below l2 = {geometry.l2:g} m"
        yield "geometry.l1", found, "the thigh must be shorter than the shin"
    for index, selected in enumerate(config.law.S):
        if selected and index not in LEADABLE:
            found = "1: the robot would not balance in this direction"
            yield f"law.S[{index}]", found, "must be 0: only z and pitch can be led"
        if not selected and config.law.K_p[index] <= 0.0:
            yield (
                f"law.K_p[{index}]",
                "0 in a direction that the robot balances",
                "must be positive",
            )


def _interfaces(config: RobotConfig) -> Problems:
    """Check each bus's python-can interface and the placeholders in its channel."""
    known = set(INTERFACES)
    for name, bus in config.can.items():
        yield from _placeholders(f"can.{name}.channel", bus.channel, RUN)
        if bus.interface not in known:
            known |= {entry.name for entry in entry_points(group="can.interface")}
        if bus.interface not in known:
            near = difflib.get_close_matches(bus.interface, known, n=1)
            right = f"did you mean {near[0]!r}?" if near else f"use one of {_words(sorted(known))}"
            found = f"{bus.interface!r} is not a python-can interface"
            yield f"can.{name}.interface", found, right


def _drive(config: RobotConfig) -> Problems:
    """Check the drives' limits against the joints' needs."""
    drive, turns_per_rad = config.drive, config.joint.gear_ratio / (2 * math.pi)
    tau_per_ampere = 2 * config.joint.gear_ratio * drive.torque_constant
    if tau_per_ampere * drive.current_lim < config.joint.tau_module_max:
        found = f"{drive.current_lim:g} A gives less than tau_module_max"
        right = f"must be at least {config.joint.tau_module_max / tau_per_ampere:.1f} A"
        yield "drive.current_lim", found, right
    if drive.current_lim > CURRENT_RANGE:
        found = f"{drive.current_lim:g} A is more than an ODrive v3 can measure"
        right = f"must be at most {CURRENT_RANGE:g} A, its requested_current_range"
        yield "drive.current_lim", found, right
    # The range up to vel_limit_tolerance times vel_limit is left for the other axis's speed.
    speed = config.joint_service.v_max * turns_per_rad
    if drive.vel_limit < speed:
        found = f"{drive.vel_limit:g} turn/s is slower than joint_service.v_max"
        right = f"must be at least {speed:.1f} turn/s, v_max at the motor; a faster drive disarms"
        yield "drive.vel_limit", found, right
    kind, turns = max(((kind, _turns(config, kind)) for kind in KINDS), key=lambda row: row[1])
    least = 2 * (turns + _POWER_UP_TURNS)
    if drive.zero_mark_turns < least:
        found = f"{drive.zero_mark_turns:g} turns: the {kind} can reach half of it"
        if drive.zero_mark_turns == 0.0:
            found = "0 turns: a drive that lost power would be armed in any position of its joint"
        right = f"must be at least {math.ceil(least)} turns, twice a joint's range"
        yield "drive.zero_mark_turns", found, right


def _turns(config: RobotConfig, kind: str) -> float:
    """Return the maximum distance of a joint's motors from q = 0 or from power-up, turns.

    A motor turns by gear_ratio (theta +- phi).
    """
    limit: LimitConfig = getattr(config.limits, kind)
    pairs = (limit.phi, limit.theta)
    span = sum(high - low for low, high in pairs)
    farthest = sum(max(abs(low), abs(high)) for low, high in pairs)
    return config.joint.gear_ratio * max(span, farthest) / (2 * math.pi)


def _timing(config: RobotConfig) -> Problems:
    service, drive, simulation = config.joint_service, config.drive, config.simulation
    for key, value, limit in (
        ("joint_service.state_rate_hz", service.state_rate_hz, service.rate_hz),
        ("planner.rate_hz", config.planner.rate_hz, service.state_rate_hz),
        ("joint_service.command_aging_max_ms", service.command_aging_max_ms,
         service.max_command_age_ms),
        ("joint_service.engage_after_ms", service.engage_after_ms, service.engage_after_max_ms),
    ):  # fmt: skip
        if value > limit:
            yield key, f"{value:g} is too large", f"must be at most {limit:g}"
    period_ms = 1e3 / service.rate_hz
    if abs(simulation.encoder_rate_hz - service.rate_hz) > 1e-6:
        found = f"{simulation.encoder_rate_hz:g} Hz differs from joint_service.rate_hz"
        yield (
            "simulation.encoder_rate_hz",
            found,
            f"must be {service.rate_hz:g} Hz, the loop's clock",
        )
    if abs(drive.encoder_period_ms - period_ms) > 1e-6:
        found = f"{drive.encoder_period_ms} ms differs from the period of joint_service.rate_hz"
        yield "drive.encoder_period_ms", found, f"must be {period_ms:g} ms"
    periods = round(service.rate_hz / service.state_rate_hz)
    if abs(periods * service.state_rate_hz - service.rate_hz) > 1e-6:
        found = f"{service.state_rate_hz:g} Hz does not divide joint_service.rate_hz"
        right = f"must be {service.rate_hz:g} Hz divided by a whole number"
        yield "joint_service.state_rate_hz", found, right
    if service.loop == "onboard" and drive.watchdog_timeout > 0.0:
        found = f"{drive.watchdog_timeout:g} s would disarm a drive while its onboard loop holds"
        yield "drive.watchdog_timeout", found, "must be 0 s (off)"
    if service.loop == "service" and drive.watchdog_timeout < 10e-3 * period_ms:
        found = f"{drive.watchdog_timeout:g} s is under ten control periods"
        right = f"must be at least {10e-3 * period_ms:g} s, or a short delay disarms the drive"
        yield "drive.watchdog_timeout", found, right
    command_period_ms = 1e3 / config.planner.rate_hz
    if service.max_command_age_ms < 3 * command_period_ms:
        found = f"{service.max_command_age_ms:g} ms is under three planner periods"
        right = f"must be at least {3 * command_period_ms:g} ms, or a short delay is a dropout"
        yield "joint_service.max_command_age_ms", found, right


def _words(names: Iterable[str]) -> str:
    return ", ".join(names)
