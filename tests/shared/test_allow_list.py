"""The filter that keeps strange addresses off a listening socket: its program, and the kernel."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus.sockets import ADDRESSES_MAX, Instruction, IpAddress, program, resolved, restrict
from shared.exceptions import BusError

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
