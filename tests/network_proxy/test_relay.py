"""The relay between two ends: what comes out, when, how often and in which order."""

from __future__ import annotations

import pytest

from services.network_proxy.connection import PENDING_MAX, WAITING_MAX
from shared.config.impairment import Impairment
from tests.network_proxy.rig import DECLARE, MESSAGE, Rig, batch, heard, numbers


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
    rig.say(planner, *range(20))
    planner.send(batch(DECLARE, 99))
    rig.turn()
    assert heard(knee) == batch(DECLARE, 99)
    assert rig.ended() == (0, 20)


def test_a_slow_line_lets_out_so_many_bytes_a_second(rig: Rig) -> None:
    planner, knee = rig.link()
    size = len(batch(MESSAGE))
    rig.there.begin(1, Impairment(rate=100.0 * size))
    rig.say(planner, *range(10))
    for ms in range(0, 100, 10):
        rig.at(ms)
        assert numbers(knee) == ([ms // 10 - 1] if ms else [])
    rig.at(100.0)
    assert numbers(knee) == [9]


@pytest.mark.parametrize("ordered", [True, False])
def test_a_partition_holds_what_a_stream_would_and_loses_datagrams(rig: Rig, ordered: bool) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(partition=True, ordered=ordered))
    planner.send(batch(MESSAGE, 1))
    planner.send(batch(DECLARE, 2))
    rig.at(5000.0)
    assert heard(knee) is None
    rig.there.end(1)
    rig.release()
    assert heard(knee) == (batch(MESSAGE, 1) if ordered else b"") + batch(DECLARE, 2)


def test_a_stream_stays_in_order_when_its_delay_ends(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=100.0, ordered=True))
    rig.say(planner, 1)
    rig.at(50.0)
    rig.there.end(1)
    rig.release()
    rig.say(planner, 2)
    assert numbers(knee) == []
    rig.at(100.0)
    rig.say(planner, 3)
    assert numbers(knee) == [1, 2, 3]


def test_what_a_partition_held_comes_in_order_and_after_the_delay_in_force(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=200.0, ordered=True))
    rig.say(planner, 1)
    rig.at(10.0)
    rig.there.begin(2, Impairment(partition=True, ordered=True))
    rig.say(planner, 2)
    rig.at(60.0)
    rig.there.end(2)
    rig.release()
    rig.say(planner, 3)
    came = []
    for ms in (199.9, 200.0, 259.9, 260.0):
        rig.at(ms)
        came.append(numbers(knee))
    assert came == [[], [1], [], [2, 3]]


def test_what_a_partition_held_is_not_overtaken_within_the_turn_that_ends_it(rig: Rig) -> None:
    """A request ends it while the loop still goes round what can be read."""
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(partition=True, ordered=True))
    rig.say(planner, 1)
    rig.there.end(1)
    rig.say(planner, 2)
    rig.release()
    assert numbers(knee) == [1, 2]


def test_on_a_stream_a_message_stays_behind_a_declaration_and_one_behind_it(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=20.0, jitter_ms=20.0, ordered=True))
    sent = b"".join(batch(DECLARE if n % 3 else MESSAGE, n) for n in range(60))
    planner.send(sent)
    rig.turn()
    rig.there.end(1)
    rig.say(planner, 60)
    rig.at(50.0)
    assert heard(knee) == sent + batch(MESSAGE, 60)


def test_a_stream_that_begins_stays_behind_a_declaration_that_is_late_already(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=50.0))
    planner.send(batch(DECLARE, 1))
    rig.turn()
    rig.there.begin(2, Impairment(delay_ms=1.0, ordered=True))
    rig.say(planner, 2)
    rig.at(49.0)
    assert heard(knee) is None
    rig.at(50.0)
    assert numbers(knee) == [1, 2]


def test_what_a_partition_held_is_not_overtaken_by_datagrams_after_it(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=30.0, reorder=1.0))
    rig.there.begin(2, Impairment(partition=True, ordered=True))
    rig.say(planner, 1)
    rig.there.end(2)
    rig.release()
    rig.say(planner, 2)
    assert heard(knee) is None
    rig.at(30.0)
    assert numbers(knee) == [1, 2]


def test_datagrams_do_not_wait_for_declarations(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=20.0, reorder=1.0))
    planner.send(batch(DECLARE, 1))
    rig.say(planner, 2)
    assert numbers(knee) == [2]


def test_a_receiver_that_takes_nothing_stops_the_sender_and_loses_nothing(rig: Rig) -> None:
    planner, knee = rig.link()
    body, sent, rest = batch(MESSAGE + bytes(4000)), 0, b""
    while not rest:
        assert sent < 16 * PENDING_MAX, "the sender was never stopped"
        rest = rig.push(planner, body)
        sent += len(body)
    assert rig.rest_of(planner, knee, rest, sent) == sent // len(body) * body


def test_a_sender_is_stopped_when_too_much_is_on_its_way(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=60_000.0))
    body, sent, rest = batch(MESSAGE + bytes(60_000)), 0, b""
    while not rest:
        assert sent < 2 * WAITING_MAX, "the sender was never stopped"
        rest = rig.push(planner, body)
        sent += len(body)
    assert sent > WAITING_MAX
    rig.at(60_000.0)
    rig.there.end(1)
    rig.release()
    assert rig.rest_of(planner, knee, rest, sent) == sent // len(body) * body
