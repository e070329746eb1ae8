"""Batches of Zenoh, cut out of a stream and told apart; bytes as eclipse-zenoh 1.10.2 sends."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.network_proxy.wire import Splitter, carries_messages

INIT = "81 09 f1 31 a2 df 8b 99 09"
OPEN = "42 01 81 9c ca 4a 31 30 79"
KEEP_ALIVE = "04"
CLOSE = "03 00"
DECLARE = "a5 dd e6 82 33 31 00 9e 21 08 20 01 00 18"
PUSH_REAL_TIME = "a5 dd e6 82 33 31 01 9d 01 21 01 01 d1 01 7b"
PUSH_DATA = "25 dd e6 82 33 9d 01 21 01 01 d1 01 7b"
PUSH_BEHIND_A_LONG_EXTENSION = "a5 05 c2 03 01 02 03 31 05 3d 01"


def batch(text: str) -> bytes:
    body = bytes.fromhex(text)
    return struct.pack("<H", len(body)) + body


@pytest.mark.parametrize("text", [INIT, OPEN, KEEP_ALIVE, CLOSE, DECLARE])
def test_control_messages_of_the_link_must_not_be_lost(text: str) -> None:
    assert not carries_messages(batch(text))


@pytest.mark.parametrize("text", [PUSH_REAL_TIME, PUSH_DATA, PUSH_BEHIND_A_LONG_EXTENSION])
def test_messages_of_the_application_may_be(text: str) -> None:
    assert carries_messages(batch(text))


@given(st.binary(max_size=40))
def test_what_cannot_be_read_is_never_lost_and_nothing_breaks(body: bytes) -> None:
    whole = struct.pack("<H", len(body)) + body
    assert carries_messages(whole) in (True, False)
    assert not carries_messages(batch("a5 ff ff ff"))
    assert not carries_messages(batch(""))


@given(st.lists(st.binary(max_size=300), max_size=20), st.lists(st.integers(1, 50), min_size=1))
def test_a_stream_cut_anywhere_gives_back_every_batch(bodies: list[bytes], cuts: list[int]) -> None:
    batches = [struct.pack("<H", len(body)) + body for body in bodies]
    stream, splitter, found = b"".join(batches), Splitter(), []
    at = turn = 0
    while at < len(stream):
        size = cuts[turn % len(cuts)]
        found += splitter.feed(stream[at : at + size])
        at, turn = at + size, turn + 1
    assert found == batches
