"""Sockets that are waited for, dialled and listened on; batches of Zenoh cut out of a stream."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.network_proxy.connection import Splitter, carries_messages
from services.network_proxy.sockets import (
    SocketListener,
    address_of,
)  # fmt: skip
from shared.exceptions import BusError
from tests.network_proxy.rig import MESSAGE, WAIT_S, Rig, batch, heard, listening


@pytest.mark.parametrize(
    ("endpoint", "address"),
    [
        ("unixsock-stream//run/knee.zenoh", (socket.AF_UNIX, "/run/knee.zenoh")),
        ("tcp/127.0.0.1:7447", (socket.AF_INET, ("127.0.0.1", 7447))),
        ("tcp/[::1]:7447", (socket.AF_INET6, ("::1", 7447, 0, 0))),
        ("tcp/127.0.0.1:7447?rel=1#iface=lo", (socket.AF_INET, ("127.0.0.1", 7447))),
    ],
)
def test_an_endpoint_is_an_address(endpoint: str, address: object) -> None:
    assert address_of(endpoint) == address


HOSTS = [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")]


@pytest.fixture(params=HOSTS, ids=["IPv4", "IPv6"])
def tcp(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    family, host = request.param
    try:
        beyond = listening(family, (host, 0))
    except OSError:
        pytest.skip(f"this machine has no {host}")
    with closing(Rig(tmp_path, beyond)) as made:
        yield made


def receive(rig: Rig, end: socket.socket, size: int) -> bytes:
    got = b""
    for _ in range(500):
        rig.turn()
        got += heard(end) or b""
        if len(got) >= size or not rig.relay.links:
            break
    return got


def test_over_tcp_everything_passes_both_ways_to_the_end(tcp: Rig) -> None:
    planner, knee = tcp.link()
    sent = b"".join(batch(MESSAGE + bytes(500), n) for n in range(100))
    planner.send(sent)
    knee.send(batch(MESSAGE, 7))
    assert receive(tcp, knee, len(sent)) == sent
    assert receive(tcp, planner, 1) == batch(MESSAGE, 7)
    planner.close()
    tcp.turn()
    knee.settimeout(WAIT_S)
    assert knee.recv(10) == b""


def test_a_place_is_refused_by_name_or_cleared_of_what_a_killed_proxy_left_and_left_clear(
    tmp_path: Path,
) -> None:
    with pytest.raises(BusError, match="not there/t"):
        SocketListener(tmp_path / "not there" / "t")
    path = tmp_path / "t"
    path.write_text("left")
    listener = SocketListener(path)
    with socket.socket(socket.AF_UNIX) as dialling:
        dialling.connect(str(path))
    listener.close()
    assert not path.exists()


INIT = "81 09 f1 31 a2 df 8b 99 09"
OPEN = "42 01 81 9c ca 4a 31 30 79"
KEEP_ALIVE = "04"
CLOSE = "03 00"
DECLARE = "a5 dd e6 82 33 31 00 9e 21 08 20 01 00 18"
PUSH_REAL_TIME = "a5 dd e6 82 33 31 01 9d 01 21 01 01 d1 01 7b"
PUSH_DATA = "25 dd e6 82 33 9d 01 21 01 01 d1 01 7b"
PUSH_BEHIND_A_LONG_EXTENSION = "a5 05 c2 03 01 02 03 31 05 3d 01"


def packet(text: str) -> bytes:
    body = bytes.fromhex(text)
    return struct.pack("<H", len(body)) + body


@pytest.mark.parametrize("text", [INIT, OPEN, KEEP_ALIVE, CLOSE, DECLARE])
def test_control_messages_of_the_link_must_not_be_lost(text: str) -> None:
    assert not carries_messages(packet(text))


@pytest.mark.parametrize("text", [PUSH_REAL_TIME, PUSH_DATA, PUSH_BEHIND_A_LONG_EXTENSION])
def test_messages_of_the_application_may_be(text: str) -> None:
    assert carries_messages(packet(text))


@given(st.binary(max_size=40))
def test_what_cannot_be_read_is_never_lost_and_nothing_breaks(body: bytes) -> None:
    whole = struct.pack("<H", len(body)) + body
    assert carries_messages(whole) in (True, False)
    assert not carries_messages(packet("a5 ff ff ff"))
    assert not carries_messages(packet(""))


@given(st.lists(st.binary(max_size=300), max_size=20), st.lists(st.integers(1, 50), min_size=1))
def test_a_stream_cut_anywhere_gives_back_every_packet(
    bodies: list[bytes], cuts: list[int]
) -> None:
    batches = [struct.pack("<H", len(body)) + body for body in bodies]
    stream, splitter, found = b"".join(batches), Splitter(), []
    at = turn = 0
    while at < len(stream):
        size = cuts[turn % len(cuts)]
        found += splitter.feed(stream[at : at + size])
        at, turn = at + size, turn + 1
    assert found == batches
