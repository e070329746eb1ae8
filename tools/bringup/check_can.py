"""Checks of the CAN buses' traffic: both axes of each module, and the load cells. Pure."""

from __future__ import annotations

import errno
import os
from typing import Any, Final

from shared.can.cansimple import AxisError
from shared.can.drive_settings import AXES
from shared.config.robot_config import RobotConfig
from tools.bringup.boards import describe_firmware
from tools.bringup.can_monitor import BusTraffic, NodeTraffic, SensorTraffic, mean_ms, period_ms
from tools.bringup.check_board import FIND_CAUSE, describe_flags, state_row
from tools.bringup.check_host import up_command
from tools.bringup.findings import Finding, advised, judged, warning, wrong
from tools.fleet.process_table import SIMULATED_CAN

PERIOD_SHARE: Final = 0.2
"""A measured period may differ by this much: more is a setting, and not a busy machine."""
TWICE: Final = 0.65
"""Fraction of the wanted period below which two axes share one node id."""
RATE_SHARE: Final = 0.2


def drive_rows(
    robot: RobotConfig, module: str, traffic: BusTraffic, *, services_up: bool
) -> list[Finding]:
    """Judge a module's two axes by what came on its bus."""
    bus, node_ids = robot.module_named(module).bus, robot.module_named(module).node_ids
    if traffic.trouble:
        return [_closed(robot, module, bus, traffic)]
    if not any(traffic.nodes[node].heartbeat for node in node_ids if node in traffic.nodes):
        heard = (node for node, other in traffic.nodes.items() if other.heartbeat)
        strangers = ", ".join(map(str, sorted(set(heard) - set(node_ids))))
        fix = (
            f"nodes {strangers} are heard: set `node_ids`, or the drive's"
            if strangers
            else "supply, wires, 120 ohm at both ends; the drive's baud rate must be 1000000"
        )
        found = f"{traffic.frames} frames, {traffic.error_frames} errors"
        return [wrong(module, "heartbeats", found, f"nodes {node_ids[0]}, {node_ids[1]}", fix)]
    rows = []
    for axis, node in zip(AXES, node_ids, strict=True):
        known = traffic.nodes.get(node, NodeTraffic())
        rows += _axis_rows(robot, f"{module}.{axis}", node, known, services_up=services_up)
    if traffic.error_frames:
        fix = "wires, 120 ohm at both ends, one baud rate"
        found = f"{traffic.error_frames} in {traffic.seconds:.1f} s"
        rows.append(warning(module, "CAN error frames", found, "none", fix))
    return rows


def harness_rows(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    """Judge the load cells by what came on their bus."""
    subject, what, harness, cells = "harness", "load cells", robot.harness, traffic.cells
    if traffic.trouble:
        return [_closed(robot, subject, harness.bus, traffic)]
    if not cells.samples:
        fix = "the amplifier's supply and wires; its frames are in shared/can/sensor_frames.py"
        why = "no assist force, no easing, no stop at overload"
        found, wanted = f"{traffic.frames} other frames", f"{harness.rate_hz:g} Hz"
        return [wrong(subject, what, found, wanted, fix, why)]
    largest = max(abs(force) for sample in cells.samples for force in sample)
    good = largest < harness.leg_force_max  # NaN is not
    fix = "unload the harness; a cell that stays there is broken, or its wire"
    found, limit = f"{largest:.0f} N", f"< {harness.leg_force_max:g} N"
    rate_fix = "the amplifier's rate, or `harness.rate_hz`"
    return [
        _rate_row(subject, what, cells, harness.rate_hz, rate_fix),
        judged(good, subject, "largest force", found, limit, fix, "saturated, not valid"),
        *_lost_frames(subject, traffic),
    ]


def imu_rows(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    """Judge the IMU by what came on its bus."""
    subject, what, imu, samples = "IMU", "samples", robot.imu, traffic.imu.samples
    if traffic.trouble:
        return [_closed(robot, subject, imu.bus, traffic)]
    why = "the planner assumes a level floor"
    if not samples:
        fix = "its supply and wires, its CAN output; its frames are in shared/can/sensor_frames.py"
        found = f"{traffic.frames} frames that give no attitude"
        return [wrong(subject, what, found, f"{imu.rate_hz:g} Hz", fix, why)]
    known = sum(sample.valid for sample in samples)
    found, good = f"{known} of {len(samples)} samples", known == len(samples)
    fix = "leave it still for a minute; its status word says that its filter has not settled"
    return [
        _rate_row(subject, what, traffic.imu, imu.rate_hz, "its output rate, or `imu.rate_hz`"),
        judged(good, subject, "orientation valid", found, "all", fix, why),
        *_lost_frames(subject, traffic),
    ]


def _closed(robot: RobotConfig, subject: str, name: str, traffic: BusTraffic) -> Finding:
    """Return the row of a bus that cannot be listened to."""
    bus, trouble = robot.can[name], traffic.trouble
    if bus.interface == SIMULATED_CAN:
        fix = "the simulator of this fleet is not there: `xrl status`, or `xrl down`, `xrl up`"
    elif bus.interface != "socketcan":
        fix = f"python-can's {bus.interface} on {bus.channel}: its adapter, its driver"
    elif os.strerror(errno.EAFNOSUPPORT) in trouble:
        fix = "`sudo modprobe can_raw`: this kernel has no CAN (a container, a small kernel)"
    else:
        fix = up_command(bus.channel)
    return wrong(subject, "CAN bus", trouble, "open", fix)


def _rate_row(
    subject: str, what: str, sensor: SensorTraffic[Any], wanted_hz: float, fix: str
) -> Finding:
    period = period_ms(sensor.times_s, 1e3 / wanted_hz)
    rate_hz = 1e3 / period if period else 0.0
    near = abs(rate_hz / wanted_hz - 1.0) <= RATE_SHARE
    return advised(near, subject, what, f"{rate_hz:.0f} Hz", f"{wanted_hz:g} Hz", fix)


def _lost_frames(subject: str, traffic: BusTraffic) -> list[Finding]:
    """Tell of a sensor's frames that were out of order: others were lost."""
    if not traffic.malformed:
        return []
    fix = "frames are lost: wires, 120 ohm at both ends"
    return [warning(subject, "frames out of order", str(traffic.malformed), "none", fix)]


def positions(robot: RobotConfig, module: str, traffic: BusTraffic) -> tuple[float, float] | None:
    """Return both motors' positions in turns, as the drive counts them; None without a reply.

    From the count where the estimate is 0, as in firmware 0.5.6 until its first closed loop: where
    the count was not answered nothing is known.
    """
    first, second = (
        _turns(traffic.nodes.get(node, NodeTraffic()), robot.joint.encoder_counts_per_turn)
        for node in robot.module_named(module).node_ids
    )
    return None if first is None or second is None else (first, second)


def _turns(traffic: NodeTraffic, counts_per_turn: int) -> float | None:
    if traffic.pos_turns != 0.0 or traffic.version is not None:
        return traffic.pos_turns
    return None if traffic.shadow_count is None else traffic.shadow_count / counts_per_turn


def _axis_rows(
    robot: RobotConfig, subject: str, node: int, traffic: NodeTraffic, *, services_up: bool
) -> list[Finding]:
    if traffic.heartbeat is None:
        fix = f"node {node} in `node_ids`, or the drive's config.can.node_id and heartbeat_rate_ms"
        return [wrong(subject, "heartbeat", f"node {node} silent", "traffic", fix)]
    if traffic.version is not None:
        found = describe_firmware(traffic.version.firmware)
        fix = "the settings of firmware 0.6 are not read back yet: check them in its web GUI"
        return [warning(subject, "firmware", found, "0.5.6", fix, "other settings, other errors")]
    drive = robot.drive
    # Errors by the flags too: `axis_error` alone can stay 0.
    errors = traffic.heartbeat.errors & ~AxisError.WATCHDOG_TIMER_EXPIRED
    words = describe_flags(AxisError, errors) if errors else "none"
    beats, estimates = traffic.heartbeats_s, traffic.estimates_s
    return [
        _period(subject, "heartbeat", beats, drive.heartbeat_period_ms, "heartbeat_rate_ms"),
        _period(subject, "encoder frames", estimates, drive.encoder_period_ms, "encoder_rate_ms"),
        judged(not errors, subject, "errors", words, "none", FIND_CAUSE),
        state_row(subject, traffic.heartbeat.axis_state, services_up=services_up),
    ]


def _period(
    subject: str, what: str, times_s: list[float], wanted_ms: float, setting: str
) -> Finding:
    module = subject.partition(".")[0]
    measured = period_ms(times_s, wanted_ms)
    if len(times_s) > 2 and mean_ms(times_s) < TWICE * wanted_ms:
        measured = mean_ms(times_s)  # two senders: gaps of 1 and 19 ms have a median like one's
    wanted = f"{wanted_ms:g} ms"
    fix = f"config.can.{setting}: `xrl drive configure --apply --module {module}`"
    if measured is None and not times_s:
        return wrong(subject, what, "none", wanted, fix, "they are the joint service's clock")
    if measured is None:
        return warning(subject, what, f"{len(times_s)} heard", wanted, fix)
    why = "or this machine is too busy"
    if measured < TWICE * wanted_ms:
        why = "or a second axis on this bus has the same node id"
    good = abs(measured / wanted_ms - 1.0) <= PERIOD_SHARE
    return advised(good, subject, what, f"{measured:.1f} ms", wanted, fix, why)
