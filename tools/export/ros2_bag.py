"""A run as a ROS 2 bag: the gateway's messages, in an MCAP file with CDR encoding."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Final

import msgspec
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from services.ros2_gateway.conversions import TIME_FIRST_NS, TIME_LAST_NS, Conversions, RosTypes
from services.ros2_gateway.gateway import INPUTS, Gateway
from services.ros2_gateway.rmw import RosTopic
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES
from shared.mcap_log.recover import clock_time
from tools.export.tables import stamped
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, RunLog, RunPart, parts_of

_EVER: Final = QosTime(9223372036, 854775807)


def write_bag(
    index: RunIndex,
    part: RunPart,
    robot: RobotConfig,
    folder: Path,
    rate_hz: float,
    done: Callable[[float], None],
) -> int:
    """Write a bag with the log's times; return its number of messages.

    `rate_hz` is the rate of joint states, transforms and wrench. `done` receives the time of the
    run that has been written, s.
    """
    if not TIME_FIRST_NS <= index.began_ns <= index.ended_ns <= TIME_LAST_NS:
        raise RunError(
            f"{index.path}: its times, {clock_time(index.began_ns)} to "
            f"{clock_time(index.ended_ns)}, are outside the range of ROS 2, which ends on "
            "2038-01-19; use --csv"
        )
    rates = {"joint_states_hz": rate_hz, "tf_hz": rate_hz, "wrench_hz": rate_hz}
    ros2 = msgspec.structs.replace(robot.ros2, **rates)
    config = msgspec.structs.replace(robot, ros2=ros2)
    types = RosTypes(ros2.distribution)
    gateway = Gateway(config, Conversions(config, types), simulated=False)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    count = 0
    with writer:
        connections = {topic: _connection(writer, topic, types) for topic in gateway.sent_topics}
        description = gateway.description()
        for log in parts_of(index, part, done=done):
            for at_ns, topic, module, message in _in_order(log):
                unix_ns = max(at_ns + log.offset_ns, TIME_FIRST_NS)
                if not count:
                    writer.write(connections[description.topic], unix_ns, description.payload)
                    count += 1
                gateway.receive(topic, module, message, at_ns)
                for outgoing in gateway.due(at_ns, unix_ns):
                    writer.write(connections[outgoing.topic], unix_ns, outgoing.payload)
                    count += 1
    if not count:
        raise RunError(f"{index.path}: no message for a bag in this part; {SEE_INFO}")
    return count


def _in_order(log: RunLog) -> Iterator[tuple[int, Topic, str, Message]]:
    keys = [(t, m) for t in INPUTS for m in (MODULES if t.per_module else ("",))]
    streams = [
        sorted(
            ((at_ns, topic, module, message) for at_ns, message in stamped(log, topic, module)),
            key=itemgetter(0),
        )
        for topic, module in keys
    ]
    return heapq.merge(*streams, key=itemgetter(0))


def _connection(writer: Writer, topic: RosTopic, types: RosTypes) -> Connection:
    qos = topic.qos
    profile = Qos(
        QosHistory.KEEP_LAST,
        qos.depth,
        QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if qos.transient_local else QosDurability.VOLATILE,
        _EVER,
        _EVER,
        QosLiveliness.AUTOMATIC,
        _EVER,
        avoid_ros_namespace_conventions=False,
    )
    return writer.add_connection(
        topic.name,
        topic.type,
        msgdef=types.definition(topic.type),
        rihs01=types.hash(topic.type),
        offered_qos_profiles=[profile],
    )
