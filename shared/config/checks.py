"""Checks that the values of a robot file fit each other (`shared.config.robot_config`)."""

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
"""Key, what stands there, what would be right; the first one is what the file is refused for."""

INTERFACES: Final = (
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys", "neovi",
    "nican", "nixnet", "pcan", "robotell", "seeedstudio", "serial", "slcan", "socketcan",
    "socketcand", "systec", "udp_multicast", "usb2can", "vector", "virtual", "xrl_unix",
)  # fmt: skip
"""What python-can brings itself, and this package; other packages may declare more."""

ROS2_DISTRIBUTIONS: Final = ("jazzy", "kilted", "lyrical")
"""Those whose messages on Zenoh the gateway knows (`services.ros2_gateway`)."""
CURRENT_RANGE: Final = 60.0
"""A; the firmware's default of `motor.config.requested_current_range`: the largest current that a
drive measures."""
LEADABLE: Final = (2, 4)
"""Rows of p that a person may lead: height and pitch."""
_POWER_UP_TURNS: Final = 1.0
"""An encoder that has just got power knows its motor within a turn."""


def check(file: str, config: RobotConfig) -> None:
    """Check what no single number shows: duplicates, crossings, dangling names.

    Each value of the robot is in its range; `file` names it in the ConfigError.
    """
    for problems in (_names, _interfaces, _physics, _drive, _timing):
        _refuse(file, problems(config))
    check_buses(file, config)


def check_security(file: str, config: RobotConfig) -> None:
    """Check that the endpoints are those of `bus.security.mode`; not done for a robot of a log.

    Raises ConfigError if a port would be open to anyone, and the file does not say so.
    """
    _refuse(file, _security(config))


def _refuse(file: str, problems: Problems) -> None:
    for problem in problems:
        raise ConfigError(file, *problem)


def _security(config: RobotConfig) -> Problems:
    security = config.bus.security
    if not re.match(r"[~/]", security.keys):
        found = f"{security.keys!r} depends on where a service is started"
        yield "bus.security.keys", found, "a path that begins with / or ~"
    yield from _placeholders("bus.security.keys", security.keys, ROBOT)
    for index, host in enumerate(security.allow):
        if not _is_address(host):
            right = "an IP address, without a port: a name may not be known when a service starts"
            yield f"bus.security.allow[{index}]", f"{host!r}", right
    for service, endpoint in config.bus.endpoints.items():
        if not endpoint.startswith(ENDPOINTS_OF_MODE[security.mode]):
            words = _words(f"{start}..." for start in ENDPOINTS_OF_MODE[security.mode])
            found = f"{endpoint!r} is not one of bus.security.mode = {security.mode!r}"
            right = f"{words}; or mode = " + _OTHER_MODE[endpoint.partition("/")[0]]
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
    "tcp": '"open", and anyone who reaches the port commands the robot (docs/security.md)',
}
"""By the kind of an endpoint: the mode in which it would be right."""


def _names(config: RobotConfig) -> Problems:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", config.name):
        yield "name", f"{config.name!r}", "use letters, digits, _ and - only"
    names = [module.name for module in config.module]
    for index, name in enumerate(names):
        if name in names[:index]:
            yield f"module[{index}].name", f"{name!r} stands twice", "each module once"
        if name not in MODULES:
            yield f"module[{index}].name", f"{name!r} is no module", f"one of {_words(MODULES)}"
    absent = [name for name in MODULES if name not in names]
    if absent:
        yield "module", f"no entry for {_words(absent)}", "six modules in all"
    buses = f"one of {_words(config.can)}"
    nodes: dict[tuple[str, int], str] = {}
    for index, module in enumerate(config.module):
        if module.bus not in config.can:
            yield f"module[{index}].bus", f"{module.bus!r}", buses
        for node in module.node_ids:
            other = nodes.setdefault((config.can[module.bus].channel, node), module.name)
            if other != module.name or len(set(module.node_ids)) < 2:
                yield (
                    f"module[{index}].node_ids",
                    f"node {node} is taken on this bus",
                    "a free node",
                )
    yield from _serial_numbers(config)
    supply = config.supply
    if supply.sit_v > supply.low_v:
        yield "supply.sit_v", f"{supply.sit_v:g} V", f"at most supply.low_v, {supply.low_v:g} V"
    if config.harness.bus not in config.can:
        yield "harness.bus", f"{config.harness.bus!r}", buses
    yield from _imu(config)
    yield from _ros2(config)
    yield from _endpoints(config)
    table = msgspec.to_builtins(config)
    for index, key in enumerate(config.assumed):
        value: Any = table
        for part in key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is None:
            yield f"assumed[{index}]", f"{key!r} is no key", "a dotted key"


def _ros2(config: RobotConfig) -> Problems:
    ros2 = config.ros2
    if ros2.distribution not in ROS2_DISTRIBUTIONS:
        found = f"{ros2.distribution!r}"
        if ros2.distribution == "humble":
            found += ", whose topics have no type hash, so that nobody would find these"
        yield "ros2.distribution", found, f"one of {_words(ROS2_DISTRIBUTIONS)}"
    if ros2.router.startswith("unixsock") or not is_endpoint(ros2.router):
        yield "ros2.router", f"{ros2.router!r}", "such as tcp/localhost:7447"
    if not re.fullmatch(r"([A-Za-z]\w*(/[A-Za-z]\w*)*)?", ros2.namespace):
        right = "letters, digits and _, such as legs; or nothing"
        yield "ros2.namespace", f"{ros2.namespace!r}", right


def _imu(config: RobotConfig) -> Problems:
    imu = config.imu
    if not imu.fitted:
        return
    if imu.bus not in config.can:
        yield "imu.bus", f"{imu.bus!r}", f"one of {_words(config.can)}"
    channel = config.can[imu.bus].channel
    for module in config.module:
        if config.can[module.bus].channel == channel:
            right = "one without drives: the IMU's frames 0x11, 0x21 and 0x32 are nodes 0 and 1"
            yield "imu.bus", f"{imu.bus!r} is {module.name}'s bus too", right


def _serial_numbers(config: RobotConfig) -> Problems:
    """Check USB and CAN settings, whichever driver is used: a drive has both."""
    wanted = config.joint_service.driver == "odrive_usb"
    seen: set[str] = set()
    for index, module in enumerate(config.module):
        where, serial = f"module[{index}].serial_number", module.serial_number.upper()
        if not serial and not wanted:
            continue
        if not re.fullmatch(r"[0-9A-F]{12}", serial):
            found = f"{module.serial_number!r} of {module.name}"
            yield where, found, "12 hexadecimal digits, as `odrivetool` shows"
        if serial in seen:
            yield where, f"{serial} stands twice", "each drive once"
        seen.add(serial)


def _endpoints(config: RobotConfig) -> Problems:
    endpoints = config.bus.endpoints
    for service in config.services:
        if service not in endpoints:
            yield f"bus.endpoints.{service}", "missing", "one for each service"
    seen: dict[str, str] = {}
    for service, endpoint in endpoints.items():
        where = f"bus.endpoints.{service}"
        if service not in SERVICES:
            yield where, "no such service", f"one of {_words(SERVICES)}"
        if not is_endpoint(endpoint):
            right = "unixsock-stream/PATH (no ? and no #), tcp/HOST:PORT or tls/HOST:PORT"
            yield where, f"{endpoint!r}", f"{right}, with a port from 1 to {PORT_MAX}"
        yield from _placeholders(where, endpoint, RUN)
        if endpoint in seen:
            yield where, f"{endpoint!r} is {seen[endpoint]}'s too", "one for each service"
        seen[endpoint] = service


def _placeholders(where: str, text: str, placeholder: str) -> Problems:
    stray = stray_braces(text, [placeholder])
    if stray:
        found = f"{text!r}: {stray} is no placeholder"
        yield where, found, f"only {placeholder} is filled in"


def _physics(config: RobotConfig) -> Problems:
    mass, geometry, height = config.mass, config.geometry, config.simulation.stand_height
    if mass.payload > mass.payload_max:
        found = f"{mass.payload:g} kg is more than payload_max"
        yield "mass.payload", found, f"at most {mass.payload_max:g} kg"
    for kind in KINDS:
        limit: LimitConfig = getattr(config.limits, kind)
        for axis, (low, high) in (("phi", limit.phi), ("theta", limit.theta)):
            if low >= high:
                found = f"[{low:g}, {high:g}] is crossed"
                yield f"limits.{kind}.{axis}", found, "low below high"
    if config.limits.knee.theta[1] >= 0.0:
        found = f"{config.limits.knee.theta[1]:g} rad lets the knee straighten"
        yield "limits.knee.theta[1]", found, "negative: a straight knee (0) is singular"
    least, reach = abs(geometry.l1 - geometry.l2), geometry.l1 + geometry.l2
    if not least < height < reach:
        right = f"inside the legs' reach, {least:.3f} to {reach:.3f} m"
        yield "simulation.stand_height", f"{height:g} m", right
    if geometry.l1 >= geometry.l2:
        found = f"{geometry.l1:g} m is not below l2 = {geometry.l2:g} m"
        yield "geometry.l1", found, "a thigh shorter than the shin"
    for index, selected in enumerate(config.law.S):
        if selected and index not in LEADABLE:
            found = "1: nobody would balance this direction"
            yield f"law.S[{index}]", found, "0; only z and pitch can be led"
        if not selected and config.law.K_p[index] <= 0.0:
            yield f"law.K_p[{index}]", "0 in a direction the robot balances", "positive"


def _interfaces(config: RobotConfig) -> Problems:
    """Check that python-can knows each bus's interface, and what is filled into its channel."""
    known = set(INTERFACES)
    for name, bus in config.can.items():
        yield from _placeholders(f"can.{name}.channel", bus.channel, RUN)
        if bus.interface not in known:
            known |= {entry.name for entry in entry_points(group="can.interface")}
        if bus.interface not in known:
            near = difflib.get_close_matches(bus.interface, known, n=1)
            right = f"did you mean {near[0]!r}?" if near else f"one of {_words(sorted(known))}"
            found = f"{bus.interface!r} is no interface of python-can"
            yield f"can.{name}.interface", found, right


def _drive(config: RobotConfig) -> Problems:
    """Check the drives' limits against the joints' needs."""
    drive, turns_per_rad = config.drive, config.joint.gear_ratio / (2 * math.pi)
    tau_per_ampere = 2 * config.joint.gear_ratio * drive.torque_constant
    if tau_per_ampere * drive.current_lim < config.joint.tau_module_max:
        found = f"{drive.current_lim:g} A gives less than tau_module_max"
        right = f"at least {config.joint.tau_module_max / tau_per_ampere:.1f} A"
        yield "drive.current_lim", found, right
    if drive.current_lim > CURRENT_RANGE:
        found = f"{drive.current_lim:g} A is more than an ODrive v3 measures"
        right = f"at most {CURRENT_RANGE:g} A, its requested_current_range"
        yield "drive.current_lim", found, right
    # Up to vel_limit_tolerance times vel_limit remain for the other axis.
    speed = config.joint_service.v_max * turns_per_rad
    if drive.vel_limit < speed:
        found = f"{drive.vel_limit:g} turn/s is slower than joint_service.v_max"
        right = f"at least {speed:.1f} turn/s, v_max at the motor; beyond vel_limit a drive disarms"
        yield "drive.vel_limit", found, right
    kind, turns = max(((kind, _turns(config, kind)) for kind in KINDS), key=lambda row: row[1])
    least = 2 * (turns + _POWER_UP_TURNS)
    if drive.zero_mark_turns < least:
        found = f"{drive.zero_mark_turns:g} turns: the {kind} comes to half of it"
        if drive.zero_mark_turns == 0.0:
            found = "0 turns: a drive that had no power would be armed wherever its joint is"
        right = f"at least {math.ceil(least)} turns, twice a joint's range"
        yield "drive.zero_mark_turns", found, right


def _turns(config: RobotConfig, kind: str) -> float:
    """Return how far from q = 0, or from where it got power, a joint's motors can be, turns.

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
            yield key, f"{value:g} is too large", f"at most {limit:g}"
    period_ms = 1e3 / service.rate_hz
    if abs(simulation.encoder_rate_hz - service.rate_hz) > 1e-6:
        found = f"{simulation.encoder_rate_hz:g} Hz is not joint_service.rate_hz"
        yield "simulation.encoder_rate_hz", found, f"{service.rate_hz:g} Hz: they are its clock"
    if abs(drive.encoder_period_ms - period_ms) > 1e-6:
        found = f"{drive.encoder_period_ms} ms is not the period of joint_service.rate_hz"
        yield "drive.encoder_period_ms", found, f"{period_ms:g} ms"
    periods = round(service.rate_hz / service.state_rate_hz)
    if abs(periods * service.state_rate_hz - service.rate_hz) > 1e-6:
        found = f"{service.state_rate_hz:g} Hz does not divide joint_service.rate_hz"
        right = f"{service.rate_hz:g} Hz divided by a whole number"
        yield "joint_service.state_rate_hz", found, right
    if service.loop == "onboard" and drive.watchdog_timeout > 0.0:
        found = f"{drive.watchdog_timeout:g} s disarms what the onboard loop is to hold"
        yield "drive.watchdog_timeout", found, "0 s: off"
    if service.loop == "service" and drive.watchdog_timeout < 10e-3 * period_ms:
        found = f"{drive.watchdog_timeout:g} s is under ten control periods"
        right = f"at least {10e-3 * period_ms:g} s, or a hiccup disarms the drive"
        yield "drive.watchdog_timeout", found, right
    command_period_ms = 1e3 / config.planner.rate_hz
    if service.max_command_age_ms < 3 * command_period_ms:
        found = f"{service.max_command_age_ms:g} ms is under three planner periods"
        right = f"at least {3 * command_period_ms:g} ms, or every hiccup is a drop-out"
        yield "joint_service.max_command_age_ms", found, right


def _words(names: Iterable[str]) -> str:
    return ", ".join(names)
