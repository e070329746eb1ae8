"""`xrl log play` without a bus: which messages it plays, and when."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.clock import NS_PER_MS, NS_PER_S
from tests.shared.mcap_log.runs import STATE_KEY, item, write, write_in_parts, writer
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunPart
from tools.verbs.log.play import Entry, Played, entries, pace

LENGTH = 40
"""Messages, a millisecond apart."""
OVERSLEEP_NS = 100_000


class World:
    """A clock that goes on while the player sleeps, and takes what it sends."""

    def __init__(self, *, heard_from: int = 0, sent_until: int = LENGTH) -> None:
        self.now_ns, self.sleeps = 0, 0
        self.sent: list[tuple[int, bytes]] = []
        self.shown: list[int] = []
        self.stalls_ns: dict[int, int] = {}
        self._heard_from, self._sent_until = heard_from, sent_until

    def sleep(self, seconds: float) -> None:
        self.sleeps += 1
        self.now_ns += round(seconds * NS_PER_S) + OVERSLEEP_NS
        self.now_ns += self.stalls_ns.pop(self.sleeps, 0)

    def put(self, payload: bytes) -> bool:
        self.sent.append((self.now_ns, payload))
        return len(self.sent) <= self._sent_until

    def play(self, rate: float, count: int = LENGTH) -> Played:
        rows = [Entry(10 * NS_PER_MS * n, "x", b"%d" % n) for n in range(count)]
        played = Played()
        pace(
            rows, {"x": self}, rate, played, now_ns=lambda: self.now_ns, sleep=self.sleep,
            heard=lambda: len(self.sent) >= self._heard_from, show=self.shown.append,
        )  # fmt: skip
        assert [payload for _, payload in self.sent] == [entry.payload for entry in rows]
        return played


@pytest.mark.parametrize("rate", [0.5, 1.0, 3.0])
def test_each_message_goes_out_at_its_moment_and_no_error_adds_up(rate: float) -> None:
    world = World()
    played = world.play(rate)
    for number, (at_ns, _) in enumerate(world.sent):
        due_ns = 10 * NS_PER_MS * number / rate
        assert due_ns <= at_ns <= due_ns + 2 * OVERSLEEP_NS
    assert played.late_max_ns <= 2 * OVERSLEEP_NS
    assert world.shown == sorted(world.shown)
    assert world.shown[-1] <= 10 * NS_PER_MS * LENGTH


def test_after_a_stall_late_messages_go_at_once_and_the_rest_at_their_moments() -> None:
    world = World()
    world.stalls_ns[5] = 100 * NS_PER_MS
    played = world.play(1.0)
    late = [at_ns - 10 * NS_PER_MS * n for n, (at_ns, _) in enumerate(world.sent)]
    assert sum(one > OVERSLEEP_NS for one in late) == 11
    assert max(late) == played.late_max_ns
    assert late[-1] <= 2 * OVERSLEEP_NS


def test_the_summary_counts_what_nobody_received_and_what_was_not_sent() -> None:
    played = World(heard_from=3, sent_until=30).play(1.0)
    assert (played.sent, played.failed, played.unheard) == (30, 10, 3)
    words = played.summary(1, 0.4)
    assert "30 messages on 1 keys in 0.40 s" in words
    assert "10 not sent" in words
    assert "no subscriber for the first 3" in words
    assert "there was no subscriber" in World(heard_from=99).play(1.0).summary(1, 0.4)


def test_parts_that_follow_each_other_hold_every_message_once(tmp_path: Path) -> None:
    index = RunIndex(write(tmp_path, [item(n) for n in range(LENGTH)]))
    found = list(entries(index, RunPart(0.01, 0.015), {STATE_KEY}))
    assert [entry.payload for entry in found] == [item(n)[1] for n in range(10, 15)]
    assert [entry.after_ns for entry in found] == [n * NS_PER_MS for n in range(5)]
    parts = [RunPart(0.01 * n, 0.01 * (n + 1)) for n in range(4)]
    assert sum(len(list(entries(index, part, {STATE_KEY}))) for part in parts) == LENGTH


def test_a_split_run_is_played_as_one_in_the_recorded_order(tmp_path: Path) -> None:
    rows = [item(n) for n in range(LENGTH)]
    write_in_parts(writer(tmp_path), rows)
    found = entries(RunIndex(tmp_path), RunPart(), {STATE_KEY})
    assert [entry.payload for entry in found] == [row[1] for row in rows]
