"""Sockets by the kernel: strange addresses kept off, links given up at once, floods told."""

from __future__ import annotations

import ipaddress
import os
import socket
import struct
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import sockets
from shared.bus.session import open_session
from shared.bus.sockets import (
    ADDRESSES_MAX,
    Arrivals,
    Instruction,
    IpAddress,
    established,
    program,
    resolved,
    restrict,
)
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import BusError
from tests.certified import opened, tls_endpoints
from tests.waiting import comes_true

FOURS = st.ip_addresses(v=4)
SIXES = st.ip_addresses(v=6)
ALLOWED = st.lists(FOURS | SIXES, max_size=2 * ADDRESSES_MAX).filter(
    lambda found: max(sum(a.version == v for a in found) for v in (4, 6)) <= ADDRESSES_MAX
)


def header(source: IpAddress) -> bytes:
    """Return an IP header by RFC 791 and RFC 8200, with nothing in it but version and source."""
    if source.version == 4:
        return bytes([0x45]) + bytes(11) + source.packed + bytes(4)
    return bytes([0x60]) + bytes(7) + source.packed + bytes(16)


def keeps(code: list[Instruction], packet: bytes) -> bool:
    """Run a program as bpf(4) says."""
    accumulator, at = 0, 0
    while True:
        row = code[at]
        at += 1
        offset = row.value - 0xFFF00000
        if row.code == 0x20:
            accumulator = int.from_bytes(packet[offset : offset + 4], "big")
        elif row.code == 0x30:
            accumulator = packet[offset]
        elif row.code == 0x54:
            accumulator &= row.value
        elif row.code == 0x05:
            at += row.value
        elif row.code == 0x15:
            at += row.if_true if accumulator == row.value else row.if_false
        else:
            assert row.code == 0x06
            return row.value > 0


@given(allowed=ALLOWED, other=FOURS | SIXES)
def test_a_packet_is_kept_if_and_only_if_its_source_is_allowed(
    allowed: list[IpAddress], other: IpAddress
) -> None:
    code = program(allowed)
    for source in (*allowed, other):
        assert keeps(code, header(source)) is (source in allowed)


@given(address=SIXES, bit=st.integers(0, 127))
def test_every_bit_of_an_address_counts(address: ipaddress.IPv6Address, bit: int) -> None:
    near = ipaddress.IPv6Address(int(address) ^ (1 << bit))
    assert not keeps(program([address]), header(near))


def test_too_many_addresses_are_refused_in_words() -> None:
    many = [ipaddress.IPv4Address(number) for number in range(ADDRESSES_MAX + 1)]
    with pytest.raises(BusError, match="over 64 addresses"):
        program(many)


def reaches(listener: socket.socket, source: str) -> bool:
    with socket.socket(listener.family) as one:
        one.settimeout(0.3)
        one.bind((source, 0))
        try:
            one.connect(listener.getsockname()[:2])
        except OSError:
            return False
        accepted, _ = listener.accept()
        with accepted:
            one.sendall(b"x")
            return accepted.recv(1) == b"x"


@pytest.mark.parametrize(
    ("at", "allowed", "source", "reached"),
    [
        ("127.0.0.1", ["127.0.0.1"], "127.0.0.1", True),
        ("127.0.0.1", ["127.0.0.1"], "127.0.0.66", False),
        ("127.0.0.1", ["127.0.0.66", "::1"], "127.0.0.66", True),
        ("127.0.0.1", [], "127.0.0.1", False),
        ("::1", ["::1"], "::1", True),
        ("::1", ["127.0.0.1", "::2"], "::1", False),
    ],
)
def test_the_kernel_does_what_the_program_says(
    at: str, allowed: Collection[str], source: str, reached: bool
) -> None:
    family = socket.AF_INET6 if ":" in at else socket.AF_INET
    with socket.socket(family) as listener, socket.socket() as other:
        try:
            listener.bind((at, 0))
        except OSError:
            pytest.skip("no IPv6 here")
        listener.listen()
        other.bind(("127.0.0.1", 0))
        other.listen()
        restrict([listener.getsockname()[1]], [ipaddress.ip_address(each) for each in allowed])
        assert reaches(listener, source) is reached
        assert reaches(other, "127.0.0.77"), "another port of the process is as it was"


def test_a_port_at_which_nothing_listens_is_refused() -> None:
    with pytest.raises(BusError, match="nothing listens at"):
        restrict([1], [])


def test_names_are_looked_up_and_unknown_ones_told() -> None:
    found, unknown = resolved(["localhost", "10.0.0.1", "no-such-host.invalid"])
    assert {ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("10.0.0.1")} <= found
    assert unknown == ["no-such-host.invalid"]


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


def test_a_kernel_without_these_counters_tells_of_no_flood(tmp_path: Path) -> None:
    arrivals = Arrivals({7447}, tmp_path)
    assert arrivals.flood(0) == ""
    assert arrivals.flood(NS_PER_S) == ""


def test_the_other_ends_of_a_process_are_those_of_the_kernel() -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        one = stack.enter_context(socket.create_connection(listener.getsockname()))
        inode = os.fstat(one.fileno()).st_ino
        assert established({inode}) == {listener.getsockname()}
        assert established({os.fstat(listener.fileno()).st_ino}) == set()
