"""Ways between processes of one host that `xrl bench bus` runs the fleet's pattern over."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import socket
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from shared.bus.session import open_session
from shared.config import files as config_file
from shared.extras import late
from shared.places import DEFAULT_CONFIG

iox2, lcm, zmq = late("iceoryx2"), late("lcm"), late("zmq")
dds, dds_domain, dds_topic = (late(f"cyclonedds.{part}") for part in ("core", "domain", "topic"))
dds_pub, dds_sub = late("cyclonedds.pub"), late("cyclonedds.sub")
dds_idl, dds_types = late("cyclonedds.idl"), late("cyclonedds.idl.types")

Put = Callable[[bytes], object]
"""Sends a payload; never blocks."""
Take = Callable[[], "bytes | None"]
"""Returns the newest payload if it was not taken before; never blocks."""

PAYLOAD_MAX: Final = 65_536
"""Bytes of a payload."""
DDS_DOMAINS: Final = 200


class Transport(NamedTuple):
    """One process's end; keys are `state/MODULE` and `command/MODULE`."""

    publisher: Callable[[str], Put]
    """Returns how to send on a key."""
    latest: Callable[[str], Take]
    """Returns how to take a key's newest payload."""
    close: Callable[[], object] = lambda: None
    """Leaves; without it, what is open ends with the process."""


def over_zenoh(process: str, folder: Path) -> Transport:
    """Join the fleet's own bus: peers, fixed endpoints, one ring of depth 1 for each key."""
    session = open_session(config_file.load(DEFAULT_CONFIG), process, folder)

    def latest(key: str) -> Take:
        stream = session.stream([f"bench/{key}"], capacity=1)

        def take() -> bytes | None:
            sample = stream.take()
            return None if sample is None else sample[1]

        return take

    return Transport(
        lambda key: session.raw_publisher(f"bench/{key}", patient=False).put, latest, session.close
    )


def over_datagrams(_process: str, folder: Path) -> Transport:
    """Join UNIX datagrams: each key's reader has a socket in the folder, and drains it."""
    sockets: list[socket.socket] = []

    def opened() -> socket.socket:
        sockets.append(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        return sockets[-1]

    def publisher(key: str) -> Put:
        end, path = opened(), str(_file(folder, key))

        def put(payload: bytes) -> None:
            with suppress(OSError):  # nobody reads yet, or the reader's socket is full
                end.sendto(payload, socket.MSG_DONTWAIT, path)

        return put

    def latest(key: str) -> Take:
        end = opened()
        end.bind(str(_file(folder, key)))

        def take() -> bytes | None:
            newest = None
            with suppress(BlockingIOError):
                while True:
                    newest = end.recv(PAYLOAD_MAX, socket.MSG_DONTWAIT)
            return newest

        return take

    def close() -> None:
        for end in sockets:
            end.close()

    return Transport(publisher, latest, close)


def over_zmq(_process: str, folder: Path) -> Transport:
    """Join ZeroMQ: PUB and SUB over ipc, a socket for each key; CONFLATE keeps the newest."""
    context = zmq.Context()

    def publisher(key: str) -> Put:
        end = context.socket(zmq.PUB)
        end.bind(f"ipc://{_file(folder, key)}")
        return lambda payload: end.send(payload, zmq.NOBLOCK)

    def latest(key: str) -> Take:
        end = context.socket(zmq.SUB)
        end.setsockopt(zmq.CONFLATE, 1)
        end.setsockopt(zmq.SUBSCRIBE, b"")
        end.connect(f"ipc://{_file(folder, key)}")

        def take() -> bytes | None:
            try:
                return bytes(end.recv(zmq.NOBLOCK))
            except zmq.Again:
                return None

        return take

    return Transport(publisher, latest, lambda: context.destroy(linger=0))


def over_iceoryx2(_process: str, folder: Path) -> Transport:
    """Join iceoryx2: for each key bytes in shared memory, with a buffer of one sample.

    Services carry the folder's name, so two runs do not meet.
    """
    iox2.set_log_level(iox2.LogLevel.Fatal)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

    def service(key: str) -> Any:
        name = iox2.ServiceName.new(f"{folder.name}/{key}")
        builder = node.service_builder(name).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        return builder.subscriber_max_buffer_size(1).enable_safe_overflow(True).open_or_create()

    def publisher(key: str) -> Put:
        end = service(key).publisher_builder().initial_max_slice_len(4096).create()

        def put(payload: bytes) -> None:
            sample = end.loan_slice_uninit(len(payload))
            ctypes.memmove(sample.payload_ptr, payload, len(payload))
            sample.assume_init().send()

        return put

    def latest(key: str) -> Take:
        end = service(key).subscriber_builder().buffer_size(1).create()

        def take() -> bytes | None:
            sample = end.receive()
            if sample is None:
                return None
            payload = sample.payload()
            taken = ctypes.string_at(payload.data_ptr, payload.len())
            sample.delete()
            return taken

        return take

    return Transport(publisher, latest)


def over_cyclonedds(_process: str, folder: Path) -> Transport:
    """Join a DDS domain of the folder's own: best effort, keep last 1, UDP on the loopback."""
    os.environ["CYCLONEDDS_URI"] = (
        "<CycloneDDS><Domain><General><Interfaces>"
        '<NetworkInterface name="lo" multicast="false"/></Interfaces></General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        '<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
    )
    qos = dds.Qos(dds.Policy.Reliability.BestEffort, dds.Policy.History.KeepLast(1))
    octets = {"data": dds_types.sequence[dds_types.uint8]}
    payload_type = dds_idl.make_idl_struct("DdsPayload", "xrl.Payload", octets)
    participant = dds_domain.DomainParticipant(zlib.crc32(str(folder).encode()) % DDS_DOMAINS)

    def topic(key: str) -> Any:
        return dds_topic.Topic(participant, key.replace("/", "_"), payload_type, qos=qos)

    def publisher(key: str) -> Put:
        end = dds_pub.DataWriter(participant, topic(key), qos=qos)
        return lambda payload: end.write(payload_type(data=payload))

    def latest(key: str) -> Take:
        end = dds_sub.DataReader(participant, topic(key), qos=qos)

        def take() -> bytes | None:
            found = [sample for sample in end.take() if sample.sample_info.valid_data]
            return bytes(found[-1].data) if found else None

        return take

    return Transport(publisher, latest)


def over_lcm(_process: str, folder: Path) -> Transport:
    """Join LCM on a port of the folder's own: UDP multicast that stays on this host (ttl=0)."""
    newest: dict[str, bytes] = {}
    port = 20_000 + zlib.crc32(str(folder).encode()) % 20_000
    ends = lcm.LCM(f"udpm://239.255.76.67:{port}?ttl=0")

    def latest(key: str) -> Take:
        ends.subscribe(key, newest.__setitem__)

        def take() -> bytes | None:
            while ends.handle_timeout(0):
                pass
            return newest.pop(key, None)

        return take

    return Transport(lambda key: lambda payload: ends.publish(key, payload), latest)


def _file(folder: Path, key: str) -> Path:
    return folder / key.replace("/", ".")


class TransportRow(NamedTuple):
    """One row of the table of transports."""

    name: str
    join: Callable[[str, Path], Transport]
    """Takes the process, `planner` or a module, and a folder that all processes of a run share."""
    package: str = ""
    """Package that it needs; "" for none beyond the fleet's."""


TRANSPORTS: Final = (
    TransportRow("zenoh", over_zenoh),
    TransportRow("datagrams", over_datagrams),
    TransportRow("zmq", over_zmq, "zmq"),
    TransportRow("iceoryx2", over_iceoryx2, "iceoryx2"),
    TransportRow("cyclonedds", over_cyclonedds, "cyclonedds"),
    TransportRow("lcm", over_lcm, "lcm"),
)


def installed() -> dict[str, TransportRow]:
    """Return the transports whose package is installed, by name."""
    return {
        row.name: row
        for row in TRANSPORTS
        if not row.package or importlib.util.find_spec(row.package) is not None
    }
