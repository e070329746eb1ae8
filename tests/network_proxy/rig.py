"""A relay with both ends of a link on real sockets, and a clock of the test's."""

from __future__ import annotations

import select
import socket
import struct
from pathlib import Path

from services.network_proxy.relay import Relay
from services.network_proxy.sockets import Address, ProxyEndpoint, SocketListener, SocketWatch
from shared.clock import NS_PER_MS
from shared.config.impairment import Direction
from shared.links import Pair

PAIR = Pair("planner", "knee_left")
MESSAGE = bytes.fromhex("25 05 9d 01 21")
DECLARE = bytes.fromhex("a5 05 31 00 9e 21")
WAIT_S = 5.0
QUIET_S = 0.002
LEASE_NS = 1_000_000_000


def batch(body: bytes, number: int = 0) -> bytes:
    whole = body + struct.pack("<I", number)
    return struct.pack("<H", len(whole)) + whole


def numbers_in(rest: bytes) -> list[int]:
    """Return the number of each whole batch."""
    found = []
    while rest:
        end = 2 + struct.unpack_from("<H", rest)[0]
        found.append(struct.unpack_from("<I", rest, end - 4)[0])
        rest = rest[end:]
    return found


def listening(family: socket.AddressFamily, where: str | tuple[str, int]) -> socket.socket:
    made = socket.socket(family)
    made.bind(where)
    made.listen()
    return made


class Rig:
    """In virtual time."""

    def __init__(self, folder: Path, beyond: socket.socket | None = None) -> None:
        self.now_ns = 0
        self.there, self.back = Direction(PAIR.there, 0), Direction(PAIR.back, 0)
        self.beyond = beyond or listening(socket.AF_UNIX, str(folder / "b"))
        self.through = folder / "t"
        self.watch = SocketWatch()
        where = Address(self.beyond.family, self.beyond.getsockname())
        self.endpoint = ProxyEndpoint(PAIR, SocketListener(self.through), where)
        names = {PAIR.there: self.there, PAIR.back: self.back}
        self.relay = Relay([self.endpoint], names, self.watch, LEASE_NS)
        self.ends: list[socket.socket] = [self.beyond]

    def dial(self) -> socket.socket:
        dialling = socket.socket(socket.AF_UNIX)
        dialling.connect(str(self.through))
        self.ends.append(dialling)
        self.turn()
        dialling.setblocking(False)
        return dialling

    def answer(self) -> socket.socket:
        self.beyond.settimeout(WAIT_S)
        answering, _ = self.beyond.accept()
        answering.setblocking(False)
        self.ends.append(answering)
        return answering

    def link(self) -> tuple[socket.socket, socket.socket]:
        return self.dial(), self.answer()

    def ended(self, number: int = 1) -> tuple[int, int]:
        """End an impairment there; return how many passed and were lost."""
        ended = self.there.end(number)
        assert ended is not None
        return ended.passed, ended.lost

    def turn(self) -> None:
        """Let out what is due, and take in what is there, until nothing more comes."""
        while True:
            ready = self.watch.wait(QUIET_S)
            self.relay.release_due(self.now_ns)
            for call, events in ready:
                call(events, self.now_ns)
            self.relay.part_stuck(self.now_ns)
            if not ready:
                return

    def at(self, ms: float) -> None:
        self.now_ns = round(ms * NS_PER_MS)
        self.turn()

    def say(self, end: socket.socket, *numbers: int) -> None:
        """Send messages of these numbers, now."""
        for number in numbers:
            end.send(batch(MESSAGE, number))
        self.turn()

    def push(self, end: socket.socket, data: bytes) -> bytes:
        """Send as much as is taken; return what is not."""
        taken = 1
        while data and taken:
            try:
                taken = end.send(data)
            except BlockingIOError:
                taken = 0
                self.turn()
                if end in select.select([], [end], [], 0)[1]:
                    taken = end.send(data)
            data = data[taken:]
        return data

    def rest_of(self, end: socket.socket, other: socket.socket, rest: bytes, size: int) -> bytes:
        """Send what was not taken, and return all that comes, of a size."""
        got = b""
        while len(got) < size:
            rest = self.push(end, rest)
            self.turn()
            got += heard(other) or b""
        return got

    def release(self) -> None:
        """Go on after a change, as the loop does."""
        self.relay.release_held(self.now_ns)

    def close(self) -> None:
        self.relay.close()
        self.watch.close()
        for end in self.ends:
            end.close()


def heard(end: socket.socket) -> bytes | None:
    """Return what there is; None if there is nothing, empty if it has ended."""
    try:
        return end.recv(1 << 20)
    except BlockingIOError:
        return None


def numbers(end: socket.socket) -> list[int]:
    return numbers_in(heard(end) or b"")
