"""Monitors a CAN bus of the robot for a moment: drives' heartbeats, load cells.

Nothing is sent to a bus whose services are up: any frame feeds a drive's watchdog, and would hide a
dead service. Else each axis gets three requests: its version, which only firmware 0.6 answers, its
encoder's count, which only 0.5 does, and its supply's voltage.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Final, Generic, TypeVar

import can
import msgspec

from shared.bus.messages import Vector6
from shared.can import cansimple
from shared.can.can_sensor import is_data_frame
from shared.can.cansimple import Command, Heartbeat
from shared.can.cansimple_06 import Command06, Version, unpack_version
from shared.can.sensor_frames import IMU_IDS, LOADCELL_IDS, ImuAssembler, ImuSample, SampleAssembler
from shared.clock import keep_pace, machine_s, pace
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import CanConfig
from shared.exceptions import DriveError

LISTEN_S: Final = 0.5
LISTEN_MAX_S: Final = 3.0
HEARTBEATS: Final = 3.0
"""Periods of the heartbeat that are listened for, at least."""

QUESTIONS: Final = (Command06.GET_VERSION, Command.GET_ENCODER_COUNT, Command.GET_VBUS)
_WAIT_S = 0.05
_FRAME_BYTES = 8
_GAPS_MIN = 3


class NodeTraffic(msgspec.Struct):
    """Frames of one axis."""

    heartbeat: Heartbeat | None = None
    """The newest, as firmware 0.5 means it."""
    heartbeats_s: list[float] = []
    """When they came."""
    estimates_s: list[float] = []
    pos_turns: float | None = None
    """The newest estimate; firmware 0.5.6 says 0 until its first closed loop."""
    shadow_count: int | None = None
    """Where its encoder is, in counts: the answer of firmware 0.5."""
    version: Version | None = None
    """The answer of firmware 0.6; 0.5 gives none."""
    vbus_voltage: float | None = None


S = TypeVar("S")


class SensorTraffic(msgspec.Struct, Generic[S]):
    """Samples of a sensor, and when they came."""

    samples: list[S] = []
    times_s: list[float] = []


class BusTraffic(msgspec.Struct):
    """Traffic of one bus."""

    trouble: str = ""
    """Why it could not be listened to."""
    seconds: float = 0.0
    frames: int = 0
    error_frames: int = 0
    nodes: dict[int, NodeTraffic] = {}
    """By node id: those that should be there, and whoever else sends heartbeats."""
    cells: SensorTraffic[Vector6] = msgspec.field(default_factory=SensorTraffic)
    imu: SensorTraffic[ImuSample] = msgspec.field(default_factory=SensorTraffic)
    malformed: int = 0
    """Frames of a sensor that were out of order or too short."""


def listen(
    config: CanConfig,
    nodes: Sequence[int],
    *,
    poll_nodes: bool,
    cells: bool = False,
    imu: bool = False,
    seconds: float = LISTEN_S,
) -> BusTraffic:
    """Listen to a bus for axes, load cells and an IMU; ask axes only where no services are up."""
    traffic = BusTraffic(nodes={node: NodeTraffic() for node in nodes})
    try:
        with _bus(config) as bus:
            for node in nodes if poll_nodes else ():
                for command in QUESTIONS:
                    bus.send(_question(node, command), timeout=_WAIT_S)
            _receive(bus, traffic, seconds, cells=cells, imu=imu)
    except DriveError as error:
        traffic.trouble = str(error)
    return traffic


def listen_to(
    robot: RobotConfig, name: str, run_dir: Path, *, poll_nodes: bool, seconds: float | None = None
) -> BusTraffic:
    """Listen to a bus of a robot for all that should be on it; without a time, long enough.

    All times are of the fleet's clock in `run_dir`: in slow motion no frame is late.
    """
    keep_pace(run_dir)
    nodes = bus_nodes(robot)[name]
    return listen(
        bus_config(robot, name, run_dir), nodes, poll_nodes=poll_nodes,
        cells=name == robot.harness.bus, imu=robot.imu.fitted and name == robot.imu.bus,
        seconds=seconds or long_enough(robot.drive.heartbeat_period_ms if nodes else 0),
    )  # fmt: skip


def bus_config(robot: RobotConfig, name: str, run_dir: Path) -> CanConfig:
    """Return a bus of a robot, `{run}` in its channel expanded."""
    bus = robot.can[name]
    return CanConfig(interface=bus.interface, channel=expand(bus.channel, run_dir))


def bus_nodes(robot: RobotConfig) -> Mapping[str, tuple[int, ...]]:
    """Return the nodes that should be on each bus, also where there are none."""
    nodes: dict[str, tuple[int, ...]] = dict.fromkeys(robot.buses, ())
    for module in robot.module:
        nodes[module.bus] = (*nodes[module.bus], *module.node_ids)
    return nodes


@contextlib.contextmanager
def _bus(config: CanConfig) -> Iterator[can.BusABC]:
    """Open a bus; all that goes wrong with it is a DriveError."""
    try:
        with can.Bus(interface=config.interface, channel=config.channel, ignore_config=True) as bus:
            yield bus
    except (can.CanError, OSError, ValueError, NotImplementedError) as error:
        raise DriveError(str(error) or type(error).__name__) from None


def _question(node: int, command: Command | Command06) -> can.Message:
    return can.Message(
        arbitration_id=cansimple.arbitration_id(node, command),
        is_remote_frame=True, dlc=_FRAME_BYTES, is_extended_id=False,
    )  # fmt: skip


def long_enough(heartbeat_period_ms: int) -> float:
    """Return how long to listen for heartbeats of this period, s."""
    return min(LISTEN_MAX_S, max(LISTEN_S, HEARTBEATS * 1e-3 * heartbeat_period_ms))


def period_ms(times_s: Sequence[float], wanted_ms: float) -> float | None:
    """Return the period of frames, ms; None if there are too few.

    It is the median gap or the mean, whichever is nearer to the wanted one: a reader that stalls
    shifts the mean, a sender that catches up the median, another setting both.
    """
    gaps = [after - before for before, after in pairwise(times_s)]
    if len(gaps) < _GAPS_MIN:
        return None
    return min((1e3 * median(gaps), 1e3 * fmean(gaps)), key=lambda ms: abs(ms - wanted_ms))


def mean_ms(times_s: Sequence[float]) -> float:
    """Return the mean period of two frames or more, ms."""
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
    """Take in a frame as an axis sends it; a heartbeat makes a node known that was not."""
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
