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


# ---- floods

HEAD = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  inode\n"


def row(number: int, local: str, remote: str, state: str, inode: int) -> str:
    queues = "00000000:00000000 00:00000000 00000000  1000        0"
    return f"{number:4}: {local} {remote} {state} {queues} {inode} 1\n"


def kernel(folder: Path, drops: int, rows: list[str], rows6: list[str]) -> Path:
    """Write what Linux has in /proc/net."""
    (folder / "tcp").write_text(HEAD + "".join(rows))
    (folder / "tcp6").write_text(HEAD + "".join(rows6))
    words = f"TcpExt: SyncookiesSent ListenOverflows ListenDrops Other\nTcpExt: 1 2 {drops} 4\n"
    (folder / "netstat").write_text(words + "IpExt: InOctets\nIpExt: 7\n")
    return folder


LISTENS = row(0, "0100007F:1D17", "00000000:0000", "0A", 5)
LINK = row(1, "0100007F:1D17", "0200007F:C001", "01", 6)
FLOOD = [row(n, "0100007F:1D17", f"4200007F:{0xD000 + n:04X}", "01", 0) for n in range(2, 9)]
FLOOD6 = [row(1, "0" * 24 + "01000000:1D17", "0" * 24 + "02000000:D001", "08", 0)]
ELSEWHERE = [row(9, "0100007F:0050", "0900007F:D009", "01", 0)]


def test_a_flood_is_told_with_its_rate_and_who_begins_connections(tmp_path: Path) -> None:
    arrivals = Arrivals({7447}, kernel(tmp_path, 100, [LISTENS, LINK], []))
    assert arrivals.flood(0) == ""
    kernel(tmp_path, 420, [LISTENS, LINK, *FLOOD, *ELSEWHERE], FLOOD6)
    words = arrivals.flood(NS_PER_S // 2)
    assert words == (
        "flood: 640 connections/s to this host turned away; connections begun by "
        "127.0.0.66 (7), ::2 (1)"
    )
    assert arrivals.flood(NS_PER_S) == "", "it is over"


@pytest.mark.parametrize(("ports", "drops"), [({7447}, 105), (set(), 900)])
def test_a_start_of_the_fleet_or_a_host_without_ports_is_no_flood(
    tmp_path: Path, ports: set[int], drops: int
) -> None:
    arrivals = Arrivals(ports, kernel(tmp_path, 100, [LISTENS], []))
    assert arrivals.flood(0) == ""
    kernel(tmp_path, drops, [LISTENS, *FLOOD], [])
    assert arrivals.flood(NS_PER_S) == ""


def test_the_other_ends_of_a_process_are_those_of_the_kernel() -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        one = stack.enter_context(socket.create_connection(listener.getsockname()))
        inode = os.fstat(one.fileno()).st_ino
        assert established({inode}) == {listener.getsockname()}
        assert established({os.fstat(listener.fileno()).st_ino}) == set()
