"""Floods a fleet's bus until it is ended: what `test_floods` starts.

    python -m tests.system.flooder KIND CONFIG RUN_DIR

As somebody who can link would: by a Zenoh of his own, without any of our rules, with whatever
certificate CONFIG's keys have.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import zenoh

from shared.bus.codec import encode
from shared.bus.messages import RunEvent, RunEventKind
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig, expand
from shared.joints import MODULES
from tests.certified import identity, stranger

PER_S: Final = 10_000
HELD: Final = 500
STRANGER: Final = "127.0.0.66"
"""Address of somebody without a key, where the fleet is at 127.0.0.1."""
CONNECTS_PER_S: Final = 640
CONNECTS_MAX: Final = 60_000
"""Connections of one flood; it then ends by itself."""
VICTIMS: Final = ("planner", *MODULES, "recorder")


def link(robot: RobotConfig, run_dir: Path, name: str = "operator") -> zenoh.Session:
    """Link to every process of the fleet."""
    endpoints = [expand(endpoint, run_dir) for endpoint in robot.bus.endpoints.values()]
    return stranger(endpoints, identity(Path(robot.bus.security.keys), name))


def steadily(work: Callable[[], object], per_s: int = PER_S) -> Iterator[None]:
    """Do it so many times a second, in bursts of 5 ms."""
    burst, due = per_s // 200, time.monotonic()
    while True:
        for _ in range(burst):
            work()
        due = max(due + 0.005, time.monotonic() - 0.1)
        time.sleep(max(0.0, due - time.monotonic()))
        yield


def messages(robot: RobotConfig, run_dir: Path) -> Iterator[None]:
    """Put messages that are right in every way, on a key that an operator may use."""
    session = link(robot, run_dir)
    key = f"xrl/{robot.name}/run/event"
    publisher = session.declare_publisher(key)
    seq = itertools.count()

    def put() -> None:
        t_ns, words = time.monotonic_ns(), "x" * 200
        publisher.put(
            encode(
                RunEvent(
                    t_ns=t_ns,
                    seq=next(seq),
                    kind=RunEventKind.RESTARTED,
                    subject="flood",
                    detail=words,
                    scenario_s=0.0,
                )
            ),
            attachment=key.encode(),
        )

    yield from steadily(put)


def connect(endpoint: str, source: str = STRANGER) -> socket.socket:
    """Open a bare connection to an endpoint of the bus."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=0.2, source_address=(source, 0))


def held(robot: RobotConfig, run_dir: Path) -> Iterator[None]:
    """Hold connections, and say nothing; each that is closed is opened again."""
    endpoints = itertools.cycle(expand(robot.bus.endpoints[name], run_dir) for name in VICTIMS)
    kept: list[socket.socket] = []
    for endpoint in endpoints:
        try:
            kept.append(connect(endpoint))
        except OSError:
            time.sleep(0.001)
        if len(kept) > HELD:
            kept.pop(0).close()
        if len(kept) % 20 == 0:
            time.sleep(0.005)
        yield


def rubbish(robot: RobotConfig, run_dir: Path) -> Iterator[None]:
    """As somebody at an allowed address, the fleet's own: connect, say nonsense, and leave."""
    victims, said = [robot.bus.endpoints[name] for name in VICTIMS], random.randbytes(500)
    kept: deque[socket.socket] = deque()
    due = time.monotonic()
    for number in range(CONNECTS_MAX):
        address = victims[number % len(victims)].partition("/")[2].rpartition(":")
        one = socket.socket()
        one.setblocking(False)
        one.connect_ex((address[0], int(address[2])))
        kept.append(one)
        if len(kept) > 20:
            kept.popleft().close()
        if len(kept) > 10:
            with contextlib.suppress(OSError):  # refused: nothing listens there
                kept[-10].send(said)
        due = max(due + 1 / CONNECTS_PER_S, time.monotonic() - 0.1)
        time.sleep(max(0.0, due - time.monotonic()))
        yield


KINDS: Final = {"messages": messages, "held": held, "rubbish": rubbish}


def main() -> None:
    """Flood until the process is ended."""
    kind, config, run_dir = sys.argv[1:]
    for number, _ in enumerate(KINDS[kind](config_file.load(Path(config)), Path(run_dir))):
        if number == 0:
            sys.stdout.write("flooding\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
