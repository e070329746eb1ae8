"""`xrl bench bus`: the fleet's message pattern over every installed transport.

Six modules and a planner, each a process at the services' rates and priority, without their laws.
"""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import multiprocessing
import os
import socket
import struct
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final

import numpy as np
from rich.progress import track

from shared import scheduling
from shared.bus.session import open_session
from shared.clock import NS_PER_S, NS_PER_US, sleep_until
from shared.config import files as config_file
from shared.exceptions import RunError
from shared.extras import late
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tools.flags import Arg, Duration
from tools.fleet.status_table import warn_of_others
from tools.lab.bench.table import BenchFlags, print_table, write_rows
from tools.terminal import Console

iox2, zmq = late("iceoryx2"), late("zmq")
PARTS: Final = ("core", "domain", "topic", "pub", "sub", "idl", "idl.types")
dds, dds_domain, dds_topic, pub, sub, idl, dds_types = (late(f"cyclonedds.{p}") for p in PARTS)

Put = Callable[[bytes], object]
Take = Callable[[], "bytes | None"]
End = tuple[Callable[[str], Put], Callable[[str], Take]]
"""A process's publisher and its reader of the newest payload, by key; neither blocks."""

CYCLE_NS, TICK_NS, POLL_NS = 2_000_000, 4_000_000, 400 * NS_PER_US
WARM_UP_S: Final = 1.5  # until all links are up; not counted
PLANNER: Final = "planner"
MESSAGE: Final = struct.Struct("q440x")
"""Send time, padded to the size of the fleet's states and commands."""


def _over_zenoh(process: str, folder: Path) -> End:
    """Join the fleet's own bus: peers, fixed endpoints, one ring of depth 1 for each key."""
    session = open_session(config_file.load(DEFAULT_CONFIG), process, folder)

    def latest(key: str) -> Take:
        stream = session.stream([f"bench/{key}"], capacity=1)
        return lambda: None if (sample := stream.take()) is None else sample[1]

    return lambda key: session.raw_publisher(f"bench/{key}", patient=False).put, latest


def over_datagrams(_process: str, folder: Path) -> End:
    """Connect by UNIX datagrams: the reader of each key drains its socket in the folder."""

    def publisher(key: str) -> Put:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

        def put(payload: bytes) -> None:
            with suppress(OSError):  # no reader yet, or its socket is full
                end.sendto(payload, socket.MSG_DONTWAIT, str(folder / key))

        return put

    def latest(key: str) -> Take:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        end.bind(str(folder / key))

        def take() -> bytes | None:
            newest = None
            with suppress(BlockingIOError):
                while True:
                    newest = end.recv(65_536, socket.MSG_DONTWAIT)
            return newest

        return take

    return publisher, latest


def _over_zmq(_process: str, folder: Path) -> End:
    """Connect by ZeroMQ: PUB and SUB over ipc, a socket for each key; CONFLATE keeps the newest."""
    context = zmq.Context()

    def publisher(key: str) -> Put:
        end = context.socket(zmq.PUB)
        end.bind(f"ipc://{folder / key!s}")
        return lambda payload: end.send(payload, zmq.NOBLOCK)

    def latest(key: str) -> Take:
        end = context.socket(zmq.SUB)
        end.setsockopt(zmq.CONFLATE, 1)
        end.setsockopt(zmq.SUBSCRIBE, b"")
        end.connect(f"ipc://{folder / key!s}")
        return lambda: bytes(end.recv(zmq.NOBLOCK)) if end.poll(0) else None

    return publisher, latest


def _over_iceoryx2(_process: str, folder: Path) -> End:
    """Connect by iceoryx2: bytes in shared memory for each key, with a buffer of one sample."""
    iox2.set_log_level(iox2.LogLevel.Fatal)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

    def service(key: str) -> Any:
        name = iox2.ServiceName.new(f"{folder.name}/{key}")  # keeps two runs apart
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
            if (sample := end.receive()) is None:
                return None
            payload = sample.payload()
            taken = ctypes.string_at(payload.data_ptr, payload.len())
            sample.delete()
            return taken

        return take

    return publisher, latest


def _over_cyclonedds(_process: str, folder: Path) -> End:
    """Join a DDS domain for this folder only: best effort, keep last 1, UDP on the loopback."""
    os.environ["CYCLONEDDS_URI"] = (
        "<CycloneDDS><Domain><General><Interfaces>"
        '<NetworkInterface name="lo" multicast="false"/></Interfaces></General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        '<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
    )
    qos = dds.Qos(dds.Policy.Reliability.BestEffort, dds.Policy.History.KeepLast(1))
    octets = {"data": dds_types.sequence[dds_types.uint8]}
    kind = idl.make_idl_struct("DdsPayload", "xrl.Payload", octets)
    participant = dds_domain.DomainParticipant(zlib.crc32(str(folder).encode()) % 200)

    def topic(key: str) -> Any:
        return dds_topic.Topic(participant, key, kind, qos=qos)

    def publisher(key: str) -> Put:
        end = pub.DataWriter(participant, topic(key), qos=qos)
        return lambda payload: end.write(kind(data=payload))

    def latest(key: str) -> Take:
        end = sub.DataReader(participant, topic(key), qos=qos)

        def take() -> bytes | None:
            found = [sample for sample in end.take() if sample.sample_info.valid_data]
            return bytes(found[-1].data) if found else None

        return take

    return publisher, latest


TRANSPORTS: Final = {
    "zenoh": (_over_zenoh, "zenoh"),
    "datagrams": (over_datagrams, "socket"),
    "zmq": (_over_zmq, "zmq"),
    "iceoryx2": (_over_iceoryx2, "iceoryx2"),
    "cyclonedds": (_over_cyclonedds, "cyclonedds"),
}
"""Function with which a process joins, and the package that it needs."""


Seen = tuple[list[float], int, float]
"""A process's figures after the warm-up: time from the planner's put to the module's take of each
command, us; commands that missed the first possible cycle; CPU time as a fraction of a core."""


def _run_module(end: End, name: str, begin_ns: int, end_ns: int) -> tuple[list[float], int]:
    """Send a state every other cycle, read a command every cycle; count from `begin_ns`."""
    put, take = end[0](f"state_{name}"), end[1](f"command_{name}")
    latencies, missed = list[float](), 0
    due, before_ns, cycle = time.monotonic_ns(), 0, 0
    while due < end_ns:
        now = time.monotonic_ns()
        if (payload := take()) is not None and now >= begin_ns:
            (sent_ns,) = MESSAGE.unpack(payload)
            latencies.append((now - sent_ns) * 1e-3)
            missed += sent_ns < before_ns
        cycle += 1
        if cycle % 2 == 0:
            put(MESSAGE.pack(now))
        before_ns = now
        due = max(due + CYCLE_NS, now)
        sleep_until(due)
    return latencies, missed


def _run_planner(end: End, _name: str, _begin: int, end_ns: int) -> tuple[list[float], int]:
    """Send six commands once six new states have arrived, or after 1.25 ticks."""
    takes = [end[1](f"state_{module}") for module in MODULES]
    puts = [end[0](f"command_{module}") for module in MODULES]
    fresh, last_ns = set[int](), 0
    while (now := time.monotonic_ns()) < end_ns:
        fresh |= {index for index, take in enumerate(takes) if take() is not None}
        if len(fresh) < len(MODULES) and now - last_ns < 1.25 * TICK_NS:
            sleep_until(now + POLL_NS)
            continue
        for put in puts:
            put(MESSAGE.pack(time.monotonic_ns()))
        fresh, last_ns = set(), now
        sleep_until(now + round(0.8 * TICK_NS))
    return [], 0


def measure(transport: str, seconds: float) -> dict[str, float]:
    """Run the pattern once, for `seconds` after the warm-up; return its figures."""
    names = (*MODULES, PLANNER)
    with (
        tempfile.TemporaryDirectory(prefix="xrl-bus-") as folder,
        ProcessPoolExecutor(len(names), multiprocessing.get_context("spawn")) as pool,
    ):
        running = [pool.submit(_run_process, transport, folder, name, seconds) for name in names]
        return figures(transport, [one.result() for one in running])


def _run_process(transport: str, folder: str, name: str, seconds: float) -> Seen:
    scheduling.raise_priority(20)
    end = TRANSPORTS[transport][0](name, Path(folder))
    gc.freeze()
    gc.disable()
    begin_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
    counted_ns = begin_ns + round(WARM_UP_S * NS_PER_S)
    end_ns = counted_ns + round(seconds * NS_PER_S)
    found = (_run_planner if name == PLANNER else _run_module)(end, name, counted_ns, end_ns)
    return *found, (time.process_time_ns() - cpu_ns) / (time.monotonic_ns() - begin_ns)


def figures(transport: str, seen: Sequence[Seen]) -> dict[str, float]:
    """Return a transport's figures, by heading, from those of its seven processes."""
    each, missed, cpu = zip(*seen, strict=True)
    latencies = np.concatenate(each)
    if not latencies.size:
        raise RunError(f"{transport}: no command arrived")
    p50, p99, p999 = (1e-3 * np.percentile(latencies, [50.0, 99.0, 99.9])).tolist()
    percents = {"missed %": 100.0 * sum(missed) / latencies.size, "CPU %": 100.0 * sum(cpu)}
    return {"p50 ms": p50, "p99 ms": p99, "p99.9 ms": p999} | percents


class BusFlags(BenchFlags):
    """Transports to measure, and for how long."""

    transport: Annotated[tuple[str, ...], Arg(choices=tuple(TRANSPORTS), metavar="NAME")] = ()
    """only this transport; repeatable (default: all installed; all but Zenoh and datagrams need the
    extra `bench`)"""
    seconds: Duration = 10.0
    """duration of each run"""


def run(flags: BusFlags) -> int:
    """Measure the transports in turn and print their medians."""
    console = Console()
    warn_of_others(console)  # these processes have a joint service's priority, and would delay it
    names = flags.transport or [
        name for name, (_, package) in TRANSPORTS.items() if importlib.util.find_spec(package)
    ]
    rounds = [
        [measure(name, flags.seconds) for name in names]
        for _ in track(range(flags.rounds or 3), "measuring", transient=True)
    ]
    rows = [
        {"transport": name} | {key: median(one[key] for one in column) for key in column[0]}
        for name, column in zip(names, zip(*rounds, strict=True), strict=True)
    ]
    columns = {key: [f"{row[key]:.2f}" for row in rows] for key in rows[0] if key != "transport"}
    print_table(
        console,
        {"": list(names)} | columns,
        "From the planner's put to a module's cycle, every 2 ms; medians of the rounds. Missed: a "
        "command arrived a cycle later than possible. CPU: of all processes, in % of one core.",
    )
    write_rows(flags.json, rows)
    return 0
