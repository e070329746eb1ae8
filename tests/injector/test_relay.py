"""The relay between two ends, on real sockets and a clock of the test's."""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.injector.flow import PENDING_MAX
from services.injector.relay import Place, Relay
from shared.clock import NS_PER_MS
from shared.impairment import Direction, Impairment
from shared.links import Pair

PAIR = Pair("planner", "knee_left")
MESSAGE = bytes.fromhex("25 05 9d 01 21")
DECLARE = bytes.fromhex("a5 05 31 00 9e 21")
WAIT_S = 5.0


def batch(body: bytes, number: int = 0) -> bytes:
    whole = body + struct.pack("<I", number)
    return struct.pack("<H", len(whole)) + whole


class Rig:
    """A relay with the two ends of a link, in virtual time."""

    def __init__(self, folder: Path) -> None:
        self.now_ns = 0
        self.there, self.back = Direction(PAIR.there, 0), Direction(PAIR.back, 0)
        through, beyond = folder / "t", folder / "b"
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(through))
        listener.listen()
        listener.setblocking(False)
        self.beyond = socket.socket(socket.AF_UNIX)
        self.beyond.bind(str(beyond))
        self.beyond.listen()
        names = {PAIR.there: self.there, PAIR.back: self.back}
        self.relay = Relay([Place(PAIR, listener, str(beyond))], names)
        self.through = str(through)
        self.ends: list[socket.socket] = [self.beyond]

    def link(self) -> tuple[socket.socket, socket.socket]:
        dialling = socket.socket(socket.AF_UNIX)
        dialling.connect(self.through)
        self.turn()
        self.beyond.settimeout(WAIT_S)
        answering, _ = self.beyond.accept()
        for end in (dialling, answering):
            end.setblocking(False)
        self.ends += [dialling, answering]
        return dialling, answering

    def turn(self) -> None:
        """Take in what is there, and let out what is due."""
        while True:
            ready, room, _ = select.select(self.relay.readers(), self.relay.writers(), [], 0.02)
            for end in ready:
                self.relay.readable(end, self.now_ns)
            for end in room:
                self.relay.writable(end)
            if not ready:
                break
        self.relay.let_out_due(self.now_ns)

    def at(self, ms: float) -> None:
        self.now_ns = round(ms * NS_PER_MS)
        self.turn()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    try:
        yield made
    finally:
        made.relay.close()
        for end in made.ends:
            end.close()


def heard(end: socket.socket) -> bytes | None:
    """Return what there is; None if there is nothing, empty if it has ended."""
    try:
        return end.recv(1 << 20)
    except BlockingIOError:
        return None


def test_unimpaired_everything_passes_at_once_both_ways(rig: Rig) -> None:
    planner, knee = rig.link()
    planner.send(batch(MESSAGE, 1))
    knee.send(batch(DECLARE, 2))
    rig.turn()
    assert heard(knee) == batch(MESSAGE, 1)
    assert heard(planner) == batch(DECLARE, 2)


def test_a_delay_is_of_its_direction_only_and_holds_messages_and_declarations(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=30.0))
    planner.send(batch(DECLARE, 1))
    planner.send(batch(MESSAGE, 2))
    knee.send(batch(MESSAGE, 3))
    rig.turn()
    assert heard(planner) == batch(MESSAGE, 3)
    rig.at(29.9)
    assert heard(knee) is None
    rig.at(30.0)
    assert heard(knee) == batch(DECLARE, 1) + batch(MESSAGE, 2)


def test_only_messages_are_lost(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(loss=1.0))
    for number in range(20):
        planner.send(batch(MESSAGE, number))
    planner.send(batch(DECLARE, 99))
    rig.turn()
    assert heard(knee) == batch(DECLARE, 99)
    ended = rig.there.end(1)
    assert ended is not None
    assert (ended.passed, ended.lost) == (0, 20)


@pytest.mark.parametrize("ordered", [True, False])
def test_a_partition_holds_what_a_stream_would_and_loses_datagrams(rig: Rig, ordered: bool) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(partition=True, ordered=ordered))
    planner.send(batch(MESSAGE, 1))
    planner.send(batch(DECLARE, 2))
    rig.at(5000.0)
    assert heard(knee) is None
    rig.there.end(1)
    rig.relay.release()
    assert heard(knee) == (batch(MESSAGE, 1) if ordered else b"") + batch(DECLARE, 2)


def test_the_end_of_a_link_is_seen_as_late_as_what_was_said_before_it(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=10.0))
    planner.send(batch(MESSAGE, 1))
    rig.turn()
    planner.close()
    rig.at(9.0)
    assert heard(knee) is None
    rig.at(20.0)
    assert heard(knee) == batch(MESSAGE, 1)
    assert heard(knee) == b"", "ended"


def test_a_link_to_a_process_that_is_not_there_ends_at_once(rig: Rig) -> None:
    rig.beyond.close()
    dialling = socket.socket(socket.AF_UNIX)
    rig.ends.append(dialling)
    dialling.connect(rig.through)
    rig.turn()
    dialling.settimeout(WAIT_S)
    assert dialling.recv(10) == b""
    assert rig.relay.refused == 1


def test_a_receiver_that_takes_nothing_stops_the_sender_and_loses_nothing(rig: Rig) -> None:
    planner, knee = rig.link()
    sent = b""
    body = batch(MESSAGE + bytes(4000))
    for _ in range(10_000):
        rest = body
        try:
            while rest:
                rest = rest[planner.send(rest) :]
        except BlockingIOError:
            sent += body[: len(body) - len(rest)]
            rig.turn()
            if len(sent) > 4 * PENDING_MAX or planner not in select.select([], [planner], [], 0)[1]:
                break
            continue
        sent += body
    else:
        pytest.fail("the sender was never stopped")
    got = b""
    for _ in range(1000):
        rig.turn()
        more = heard(knee)
        got += more or b""
        if more is None and len(got) >= len(sent) - len(body):
            break
    assert got == sent[: len(got)]
    assert len(got) > len(sent) - len(body), "every whole batch has come"


def test_a_process_that_dials_again_is_linked_again(rig: Rig) -> None:
    planner, knee = rig.link()
    planner.close()
    rig.turn()
    assert heard(knee) == b""
    planner, knee = rig.link()
    planner.send(batch(MESSAGE, 7))
    rig.turn()
    assert heard(knee) == batch(MESSAGE, 7)
