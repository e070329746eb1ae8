"""A TCP link that is given up must not hold up the thread that all links share."""

from __future__ import annotations

import socket
import struct
import time
from pathlib import Path

from shared.bus import sockets
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.places import DEFAULT_CONFIG
from tests.certified import opened

ON_FOR_10_S = struct.pack("ii", 1, 10)


def resets(connection: socket.socket) -> bool:
    """Return True if `close` resets the connection, and so does not wait for the other side."""
    option = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(ON_FOR_10_S))
    return struct.unpack("ii", option) == (1, 0)


def connections() -> list[bool]:
    """Return for each TCP connection of this process whether it is closed by a reset."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if not str(entry.readlink()).startswith("socket:"):
                continue
            connection = socket.socket(fileno=int(entry.name))
        except OSError:
            continue
        try:
            connection.getpeername()
            if connection.family == socket.AF_INET:
                found.append(resets(connection))
        except OSError:
            pass
        finally:
            connection.detach()
    return found


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_only_the_connection_between_the_two_addresses_is_changed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        with (
            socket.create_connection(server.getsockname()) as one,
            socket.create_connection(server.getsockname()) as other,
        ):
            for connection in (one, other):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, ON_FOR_10_S)
            assert sockets.reset_on_close(one.getsockname(), one.getpeername())
            assert resets(one)
            assert not resets(other)
        assert not sockets.reset_on_close(("127.0.0.1", 1), ("127.0.0.1", 2))


def test_no_tcp_link_of_the_bus_lingers_when_it_is_given_up(tmp_path: Path) -> None:
    robot = config_file.load(DEFAULT_CONFIG)
    endpoints = {name: f"tcp/127.0.0.1:{free_port()}" for name in robot.bus.endpoints}
    robot = opened(robot, endpoints)
    with open_session(robot, "knee_left", tmp_path), open_session(robot, "planner", tmp_path):
        deadline = time.monotonic() + 10.0
        # both ends of the one link are in this process
        while (found := connections()) != [True, True] and time.monotonic() < deadline:
            time.sleep(0.01)
        assert found == [True, True]
