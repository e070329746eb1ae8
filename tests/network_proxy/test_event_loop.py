"""Waiting for sockets: whom it calls, and for how long it waits."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

from services.network_proxy.sockets import READ, WRITE, SocketWatch


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ends = socket.socketpair()
    yield ends
    for end in ends:
        end.close()


def test_each_socket_calls_its_own_function_for_its_own_events(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    near, far = pair
    watch, heard = SocketWatch(), list[tuple[int, int]]()

    def ready(events: int, now_ns: int) -> None:
        heard.append((events, now_ns))

    def turn() -> list[tuple[int, int]]:
        heard.clear()
        for call, events in watch.wait(0.0):
            call(events, 7)
        return list(heard)

    watch.want(near, READ, ready)
    assert turn() == []
    far.send(b"x")
    assert turn() == [(READ, 7)]
    watch.want(near, READ | WRITE, ready)
    assert turn() == [(READ | WRITE, 7)]
    watch.want(near, WRITE, ready)
    assert turn() == [(WRITE, 7)]
    watch.want(near, 0, ready)
    watch.want(near, 0, ready)
    assert turn() == []
    watch.close()


def test_it_waits_by_parts_of_a_millisecond(pair: tuple[socket.socket, socket.socket]) -> None:
    """What is asked to be late by 0.2 ms is not late by a whole one."""
    watch, took_s = SocketWatch(), []
    watch.want(pair[0], READ, lambda _events, _now_ns: None)
    for _ in range(200):
        begun = time.perf_counter()
        assert watch.wait(0.0002) == []
        took_s.append(time.perf_counter() - begun)
    assert 0.0002 <= min(took_s) < 0.0009
    watch.close()
