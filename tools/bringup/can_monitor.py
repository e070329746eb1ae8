"""Monitor a CAN bus of the robot for a moment, and judge its drives, load cells and IMU.

Nothing is sent on a bus whose services are up, because any frame feeds a drive's watchdog and would
hide a dead service. Otherwise three requests are sent to each axis: for its version, which only
firmware 0.6 answers, its encoder count, which only 0.5 answers, and its supply voltage.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any, Final, Generic, TypeVar

import can
import msgspec

from shared.bus.messages import Vector6
from shared.can import cansimple
from shared.can.can_sensor import is_data_frame
from shared.can.cansimple import AxisError, Command, Heartbeat
from shared.can.cansimple_06 import Command06, Version, unpack_version
from shared.can.drive_settings import AXES
from shared.can.sensor_frames import IMU_IDS, LOADCELL_IDS, ImuAssembler, ImuSample, SampleAssembler
from shared.clock import keep_pace, machine_s, pace
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import CanConfig
from shared.exceptions import DriveError
from tools.bringup.boards import describe_firmware
from tools.bringup.check_board import FIND_CAUSE, describe_flags, state_row
from tools.bringup.check_host import up_command
from tools.bringup.findings import Finding, advised, judged, warning, wrong
from tools.fleet.process_table import SIMULATED_CAN

LISTEN_S: Final = 0.5
LISTEN_MAX_S: Final = 3.0
HEARTBEATS: Final = 3.0
"""Minimum time to listen, in heartbeat periods."""

QUESTIONS: Final = (Command06.GET_VERSION, Command.GET_ENCODER_COUNT, Command.GET_VBUS)
_WAIT_S = 0.05
_FRAME_BYTES = 8
_GAPS_MIN = 3


class NodeTraffic(msgspec.Struct):
    """Contents and arrival times of the frames from one axis."""

    heartbeat: Heartbeat | None = None
    """Newest heartbeat, decoded as in firmware 0.5."""
    heartbeats_s: list[float] = []
    """Arrival times, s."""
    estimates_s: list[float] = []
    pos_turns: float | None = None
    """Newest position estimate; firmware 0.5.6 reports 0 until its first closed loop."""
    shadow_count: int | None = None
    """Encoder count, which only firmware 0.5 sends."""
    version: Version | None = None
    """Version, which only firmware 0.6 sends."""
    vbus_voltage: float | None = None


S = TypeVar("S")


class SensorTraffic(msgspec.Struct, Generic[S]):
    """Samples of a sensor, and their arrival times."""

    samples: list[S] = []
    times_s: list[float] = []


class BusTraffic(msgspec.Struct):
    """Traffic on one bus."""

    trouble: str = ""
    """Reason why the bus could not be monitored, or ""."""
    seconds: float = 0.0
    frames: int = 0
    error_frames: int = 0
    nodes: dict[int, NodeTraffic] = {}
    """By node id: expected nodes, and others that send heartbeats."""
    cells: SensorTraffic[Vector6] = msgspec.field(default_factory=SensorTraffic)
    imu: SensorTraffic[ImuSample] = msgspec.field(default_factory=SensorTraffic)
    malformed: int = 0
    """Number of sensor frames that were out of order or too short."""


def listen(
    config: CanConfig,
    nodes: Sequence[int],
    *,
    poll_nodes: bool,
    cells: bool = False,
    imu: bool = False,
    seconds: float = LISTEN_S,
) -> BusTraffic:
    """Listen on a bus for axes, load cells and an IMU. Poll axes only if no services are up."""
    traffic = BusTraffic(nodes={node: NodeTraffic() for node in nodes})
    try:
        with _bus(config) as bus:
            for node in nodes if poll_nodes else ():
                for command in QUESTIONS:
                    question = can.Message(
                        arbitration_id=cansimple.arbitration_id(node, command),
                        is_remote_frame=True, dlc=_FRAME_BYTES, is_extended_id=False,
                    )  # fmt: skip
                    bus.send(question, timeout=_WAIT_S)
            _receive(bus, traffic, seconds, cells=cells, imu=imu)
    except DriveError as error:
        traffic.trouble = str(error)
    return traffic


def listen_to(
    robot: RobotConfig, name: str, run_dir: Path, *, poll_nodes: bool, seconds: float | None = None
) -> BusTraffic:
    """Listen to all expected senders on a bus of a robot; the default time is `long_enough`.

    Times are on the clock of the fleet in `run_dir`, so no frame appears late in slow motion.
    """
    keep_pace(run_dir)
    nodes = bus_nodes(robot)[name]
    return listen(
        bus_config(robot, name, run_dir), nodes, poll_nodes=poll_nodes,
        cells=name == robot.harness.bus, imu=robot.imu.fitted and name == robot.imu.bus,
        seconds=seconds or long_enough(robot.drive.heartbeat_period_ms if nodes else 0),
    )  # fmt: skip


def bus_config(robot: RobotConfig, name: str, run_dir: Path) -> CanConfig:
    """Return a bus of a robot, with `{run}` expanded in its channel."""
    bus = robot.can[name]
    return CanConfig(interface=bus.interface, channel=expand(bus.channel, run_dir))


def bus_nodes(robot: RobotConfig) -> Mapping[str, tuple[int, ...]]:
    """Return the expected nodes of each bus; buses without drives have none."""
    nodes: dict[str, tuple[int, ...]] = dict.fromkeys(robot.buses, ())
    for module in robot.module:
        nodes[module.bus] = (*nodes[module.bus], *module.node_ids)
    return nodes


@contextlib.contextmanager
def _bus(config: CanConfig) -> Iterator[can.BusABC]:
    """Open a bus; raise every error as a DriveError."""
    try:
        with can.Bus(interface=config.interface, channel=config.channel, ignore_config=True) as bus:
            yield bus
    except (can.CanError, OSError, ValueError, NotImplementedError) as error:
        raise DriveError(str(error) or type(error).__name__) from None


def long_enough(heartbeat_period_ms: int) -> float:
    """Return the time to listen for heartbeats of this period, s."""
    return min(LISTEN_MAX_S, max(LISTEN_S, HEARTBEATS * 1e-3 * heartbeat_period_ms))


def period_ms(times_s: Sequence[float], wanted_ms: float) -> float | None:
    """Return the period of frames, ms; None if there are too few.

    The result is the median or the mean of the gaps, whichever is nearer to the wanted period. A
    stalled reader shifts only the mean, a sender that catches up only the median, and a wrong
    setting shifts both.
    """
    gaps = [after - before for before, after in pairwise(times_s)]
    if len(gaps) < _GAPS_MIN:
        return None
    return min((1e3 * median(gaps), 1e3 * fmean(gaps)), key=lambda ms: abs(ms - wanted_ms))


def _mean_ms(times_s: Sequence[float]) -> float:
    """Return the mean period of at least two frames, ms."""
    return 1e3 * (times_s[-1] - times_s[0]) / (len(times_s) - 1)


def _receive(
    bus: can.BusABC, traffic: BusTraffic, seconds: float, *, cells: bool, imu: bool
) -> None:
    assembler, orientation = SampleAssembler(), ImuAssembler()
    begun = time.monotonic()
    while (left := begun + machine_s(seconds) - time.monotonic()) > 0.0:
        message = bus.recv(min(left, _WAIT_S))
        if message is None:
            continue
        message.timestamp *= pace()
        if message.is_error_frame:
            traffic.error_frames += 1
        elif is_data_frame(message):
            traffic.frames += 1
            if cells and message.arbitration_id in LOADCELL_IDS:
                _add(traffic.cells, assembler.add(message.arbitration_id, message.data), message)
            elif imu and message.arbitration_id in IMU_IDS:
                _add(traffic.imu, orientation.add(message.arbitration_id, message.data), message)
            elif len(message.data) == _FRAME_BYTES:
                _of_node(message, traffic.nodes)
    traffic.seconds = pace() * (time.monotonic() - begun)
    traffic.malformed = assembler.malformed + orientation.malformed


def _add(sensor: SensorTraffic[S], sample: S | None, message: can.Message) -> None:
    if sample is not None:
        sensor.samples.append(sample)
        sensor.times_s.append(message.timestamp)


def _of_node(message: can.Message, nodes: dict[int, NodeTraffic]) -> None:
    """Store a frame from an axis; a heartbeat also adds an unexpected node."""
    node, command = cansimple.split_id(message.arbitration_id)
    data = bytes(message.data)
    if command == Command.HEARTBEAT:
        axis = nodes.setdefault(node, NodeTraffic())
        axis.heartbeat = cansimple.unpack_heartbeat(data)
        axis.heartbeats_s.append(message.timestamp)
        return
    known = nodes.get(node)
    if known is None:
        return
    if command == Command.GET_ENCODER_ESTIMATES:
        known.pos_turns = cansimple.unpack_two_floats(data)[0]
        known.estimates_s.append(message.timestamp)
    elif command == Command.GET_ENCODER_COUNT:
        known.shadow_count = cansimple.unpack_two_ints(data)[0]
    elif command == Command.GET_VBUS:
        known.vbus_voltage = cansimple.unpack_two_floats(data)[0]
    elif command == Command06.GET_VERSION:
        known.version = unpack_version(data)


PERIOD_SHARE: Final = 0.2
"""Maximum relative error of a measured period; a busy machine stays below it."""
TWICE: Final = 0.65
"""Fraction of the wanted period; below it, two axes probably share one node id."""
RATE_SHARE: Final = 0.2


def drive_rows(
    robot: RobotConfig, module: str, traffic: BusTraffic, *, services_up: bool
) -> list[Finding]:
    """Judge a module's two axes from the traffic on its bus."""
    bus, node_ids = robot.module_named(module).bus, robot.module_named(module).node_ids
    if traffic.trouble:
        return [_closed(robot, module, bus, traffic)]
    if not any(traffic.nodes[node].heartbeat for node in node_ids if node in traffic.nodes):
        heard = (node for node, other in traffic.nodes.items() if other.heartbeat)
        strangers = ", ".join(map(str, sorted(set(heard) - set(node_ids))))
        fix = (
            f"heartbeats come from other nodes ({strangers}): correct `node_ids` or the drive's ids"
            if strangers
            else "check supply, wires, 120 ohm at both ends, and the drive's baud rate, 1000000"
        )
        found = f"{traffic.frames} frames, {traffic.error_frames} errors"
        return [wrong(module, "heartbeats", found, f"nodes {node_ids[0]}, {node_ids[1]}", fix)]
    rows = []
    for axis, node in zip(AXES, node_ids, strict=True):
        known = traffic.nodes.get(node, NodeTraffic())
        rows += _axis_rows(robot, f"{module}.{axis}", node, known, services_up=services_up)
    if traffic.error_frames:
        fix = "check wires, 120 ohm at both ends, and that all baud rates are equal"
        found = f"{traffic.error_frames} in {traffic.seconds:.1f} s"
        rows.append(warning(module, "CAN error frames", found, "none", fix))
    return rows


def harness_rows(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    """Judge the load cells from the traffic on their bus."""
    subject, what, harness, cells = "harness", "load cells", robot.harness, traffic.cells
    if traffic.trouble:
        return [_closed(robot, subject, harness.bus, traffic)]
    if not cells.samples:
        fix = "check the amplifier's supply, wires and frames (shared/can/sensor_frames.py)"
        why = "no closed-loop assist, no eased lead, no stop at overload"
        found, wanted = f"{traffic.frames} other frames", f"{harness.rate_hz:g} Hz"
        return [wrong(subject, what, found, wanted, fix, why)]
    largest = max(abs(force) for sample in cells.samples for force in sample)
    good = largest < harness.leg_force_max  # False for NaN
    fix = "unload the harness; if the reading stays, a load cell or its wire is broken"
    found, limit = f"{largest:.0f} N", f"< {harness.leg_force_max:g} N"
    rate_fix = "set the amplifier's rate, or `harness.rate_hz`"
    return [
        _rate_row(subject, what, cells, harness.rate_hz, rate_fix),
        judged(good, subject, "largest force", found, limit, fix, "saturated, so it is invalid"),
        *_lost_frames(subject, traffic),
    ]


def imu_rows(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    """Judge the IMU from the traffic on its bus."""
    subject, what, imu, samples = "IMU", "samples", robot.imu, traffic.imu.samples
    if traffic.trouble:
        return [_closed(robot, subject, imu.bus, traffic)]
    why = "the planner assumes a level floor"
    if not samples:
        fix = "check its supply, wires, CAN output and frames (shared/can/sensor_frames.py)"
        found = f"{traffic.frames} frames without an attitude"
        return [wrong(subject, what, found, f"{imu.rate_hz:g} Hz", fix, why)]
    known = sum(sample.valid for sample in samples)
    found, good = f"{known} of {len(samples)} samples", known == len(samples)
    fix = "leave it at rest for a minute; its status word reports that its filter has not settled"
    return [
        _rate_row(subject, what, traffic.imu, imu.rate_hz, "set its output rate, or `imu.rate_hz`"),
        judged(good, subject, "orientation valid", found, "all", fix, why),
        *_lost_frames(subject, traffic),
    ]


def _closed(robot: RobotConfig, subject: str, name: str, traffic: BusTraffic) -> Finding:
    """Return the row for a bus that cannot be monitored."""
    bus, trouble = robot.can[name], traffic.trouble
    if bus.interface == SIMULATED_CAN:
        fix = "this fleet's simulator has ended: see `xrl status`, or run `xrl down` and `xrl up`"
    elif bus.interface != "socketcan":
        fix = f"check the adapter, and python-can's driver {bus.interface} on {bus.channel}"
    elif os.strerror(errno.EAFNOSUPPORT) in trouble:
        fix = "`sudo modprobe can_raw`: this kernel has no CAN (a container or a minimal kernel)"
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
    """Report sensor frames that were out of order, because others were lost."""
    if not traffic.malformed:
        return []
    fix = "frames are lost: check wires and 120 ohm at both ends"
    return [warning(subject, "frames out of order", str(traffic.malformed), "none", fix)]


def positions(robot: RobotConfig, module: str, traffic: BusTraffic) -> tuple[float, float] | None:
    """Return both motors' positions in turns, as the drive counts them; None if unknown.

    If the estimate is 0, as in firmware 0.5.6 until its first closed loop, the encoder count is
    used instead.
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
        fix = f"check {node} in `node_ids`, the drive's config.can.node_id and heartbeat_rate_ms"
        return [wrong(subject, "heartbeat", f"node {node} silent", "traffic", fix)]
    if traffic.version is not None:
        found = describe_firmware(traffic.version.firmware)
        fix = "settings of firmware 0.6 cannot be read here: check them in its web GUI"
        return [
            warning(
                subject,
                "firmware",
                found,
                "0.5.6",
                fix,
                "its settings and error codes differ from those of 0.5.6",
            )
        ]
    drive = robot.drive
    # `errors` includes the flags of the heartbeat, because `axis_error` alone can stay 0.
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
    if len(times_s) > 2 and _mean_ms(times_s) < TWICE * wanted_ms:
        measured = _mean_ms(times_s)  # gaps of two senders, such as 1 and 19 ms, fool the median
    wanted = f"{wanted_ms:g} ms"
    fix = f"set config.can.{setting}: `xrl drive configure --apply --module {module}`"
    if measured is None and not times_s:
        return wrong(subject, what, "none", wanted, fix, "encoder frames clock the service")
    if measured is None:
        return warning(subject, what, f"{len(times_s)} received", wanted, fix)
    why = "or this machine is too busy"
    if measured < TWICE * wanted_ms:
        why = "or a second axis on this bus has the same node id"
    good = abs(measured / wanted_ms - 1.0) <= PERIOD_SHARE
    return advised(good, subject, what, f"{measured:.1f} ms", wanted, fix, why)
