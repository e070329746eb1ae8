"""Sockets by the kernel: short queues, links given up at once, who is linked."""

from __future__ import annotations

import ipaddress
import os
import socket
import struct
from contextlib import ExitStack
from pathlib import Path

from shared.bus import sockets
from shared.bus.session import open_session
from shared.bus.sockets import (
    addresses_of,
    established,
)
from shared.config.robot_config import RobotConfig
from tests.certified import opened, tls_endpoints
from tests.waiting import comes_true


def links_taken(listener: socket.socket, tried: int = 8) -> int:
    """Return how many connections the kernel takes before the process accepts one."""
    with ExitStack() as stack:
        for count in range(tried):
            one = stack.enter_context(socket.socket())
            one.settimeout(0.2)
            try:
                one.connect(listener.getsockname())
            except OSError:
                return count
        return tried


def test_a_port_of_the_bus_holds_hardly_any_connection_that_waits() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as own,
        socket.create_server(("127.0.0.1", 0)) as other,
    ):
        sockets.shorten_queues({own.getsockname()[1]})
        assert links_taken(own) <= 2
        assert links_taken(other) == 8


def test_names_are_looked_up_and_unknown_ones_have_no_address() -> None:
    assert ipaddress.ip_address("127.0.0.1") in addresses_of("localhost")
    assert addresses_of("10.0.0.1") == {ipaddress.ip_address("10.0.0.1")}
    assert addresses_of("no-such-host.invalid") == set()


# ---- links that are given up

ON_FOR_10_S = struct.pack("ii", 1, 10)


def resets(connection: socket.socket) -> bool:
    """Return True if `close` resets the connection, and so does not wait for the other side."""
    option = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(ON_FOR_10_S))
    return struct.unpack("ii", option) == (1, 0)


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


def test_no_tcp_link_of_the_bus_lingers_when_it_is_given_up(
    robot: RobotConfig, tmp_path: Path
) -> None:
    """Both ends of the one link are in this process."""
    over_tcp = {name: at.replace("tls/", "tcp/") for name, at in tls_endpoints().items()}
    robot = opened(robot, over_tcp)

    def links() -> list[bool]:
        found = []
        for own in sockets._own_sockets():
            try:
                own.getpeername()
            except OSError:
                continue
            found.append(resets(own))
        return found

    with open_session(robot, "knee_left", tmp_path), open_session(robot, "planner", tmp_path):
        assert comes_true(lambda: links() == [True, True])


def test_the_other_ends_of_a_process_are_those_of_the_kernel() -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        one = stack.enter_context(socket.create_connection(listener.getsockname()))
        inode = os.fstat(one.fileno()).st_ino
        assert established({inode}) == {listener.getsockname()}
        assert established({os.fstat(listener.fileno()).st_ino}) == set()
