"""The relay between two ends: what comes out, when and in which order, and how links end."""

from __future__ import annotations

import socket
from itertools import groupby
from operator import itemgetter

import pytest

from services.network_proxy.connection import PENDING_MAX, WAITING_MAX
from shared.config.impairment import Direction, Impairment
from tests.network_proxy.rig import (
    DECLARE,
    LEASE_NS,
    MESSAGE,
    PAIR,
    WAIT_S,
    Rig,
    batch,
    heard,
    numbers,
)


def test_unimpaired_all_passes_at_once_and_a_delay_is_of_one_direction(rig: Rig) -> None:
    planner, knee = rig.link()
    planner.send(batch(MESSAGE, 1))
    knee.send(batch(DECLARE, 2))
    rig.turn()
    assert heard(knee) == batch(MESSAGE, 1)
    assert heard(planner) == batch(DECLARE, 2)
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


def test_only_messages_are_lost_and_datagrams_do_not_wait_for_declarations(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(loss=1.0))
    rig.say(planner, *range(20))
    planner.send(batch(DECLARE, 99))
    rig.turn()
    assert heard(knee) == batch(DECLARE, 99)
    assert rig.ended() == (0, 20)
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=20.0, reorder=1.0))
    planner.send(batch(DECLARE, 1))
    rig.say(planner, 2)
    assert numbers(knee) == [2]


JITTERS = {
    "uniform": Impairment(delay_ms=20.0, jitter_ms=10.0),
    "normal": Impairment(delay_ms=25.0, jitter_ms=8.0, distribution="normal"),
    "pareto": Impairment(delay_ms=25.0, jitter_ms=12.0, distribution="pareto", loss=0.1),
    "stream": Impairment(delay_ms=20.0, jitter_ms=15.0, ordered=True),
}


@pytest.mark.parametrize("name", JITTERS)
def test_messages_come_exactly_when_the_modelled_network_releases_them(rig: Rig, name: str) -> None:
    """`tools.sim.network` delays by the same `Direction`: live and lockstep have one network."""
    planner, knee = rig.link()
    model = Direction(PAIR.there, 0)
    for direction in (rig.there, model):
        direction.begin(1, JITTERS[name])
    rig.say(planner, *range(40))
    due = sorted((at, n) for n in range(40) for at in model.passes(0, len(batch(MESSAGE))))
    assert len({at for at, _ in due}) > 2
    for at, rows in groupby(due, key=itemgetter(0)):
        rig.now_ns = at - 1
        rig.turn()
        assert numbers(knee) == []
        rig.now_ns = at
        rig.turn()
        assert numbers(knee) == [number for _, number in rows]


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


CUT_STREAM = Impairment(partition=True, ordered=True)


def test_the_end_of_a_link_is_seen_as_late_as_the_messages_before_it(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=10.0))
    rig.say(planner, 1)
    planner.close()
    rig.at(9.0)
    assert heard(knee) is None
    rig.at(20.0)
    assert heard(knee) == batch(MESSAGE, 1)
    assert heard(knee) == b"", "ended"


def test_a_link_to_a_process_that_is_not_there_ends_at_once(rig: Rig) -> None:
    rig.beyond.close()
    dialling = rig.dial()
    dialling.settimeout(WAIT_S)
    assert dialling.recv(10) == b""
    assert rig.relay.refused == 1


def test_a_link_whose_other_end_is_gone_ends_and_a_new_dial_links_again(rig: Rig) -> None:
    planner, knee = rig.link()
    planner.close()
    rig.turn()
    assert heard(knee) == b""
    planner, knee = rig.link()
    rig.say(planner, 7)
    assert heard(knee) == batch(MESSAGE, 7)
    assert rig.relay.links == 1


def test_an_end_that_takes_nothing_for_a_lease_is_parted_and_the_other_sees_it(rig: Rig) -> None:
    """Given up by both ends and closed by neither: each stands in a full socket."""
    planner, knee = rig.link()
    body = batch(MESSAGE + bytes(4000))
    rig.there.begin(1, Impairment(delay_ms=1.0))
    for _ in range(2):
        rig.at(2.0)
        while not rig.push(planner, body):
            rig.at(rig.now_ns / 1e6 + 1.0)
            assert rig.now_ns < LEASE_NS / 2
    begun_ms = rig.now_ns / 1e6
    rig.at(begun_ms + 990.0)
    assert rig.relay.links == 1
    rig.at(begun_ms + 1300.0)
    assert rig.relay.links == 0
    assert rig.relay.stuck == 1
    with pytest.raises(BrokenPipeError):
        planner.send(body)
    passed, lost = rig.ended()
    whole = sum(map(len, iter(lambda: heard(knee) or b"", b"")))
    assert lost > 0
    assert passed == whole // len(body)


def test_an_end_that_is_slow_but_reads_is_not_given_up(rig: Rig) -> None:
    planner, knee = rig.link()
    body = batch(MESSAGE + bytes(4000))
    while not rig.push(planner, body):
        pass
    for step in range(1, 25):
        rig.at(500.0 * step)
        assert rig.relay.links == 1
        assert len(knee.recv(20_000)) == 20_000


def test_what_a_link_takes_with_it_is_lost_and_has_not_passed(rig: Rig) -> None:
    """A partition on a stream that is longer than the lease: nothing of it ever comes."""
    planner, knee = rig.link()
    rig.there.begin(1, CUT_STREAM)
    rig.back.begin(1, CUT_STREAM)
    rig.say(planner, *range(100))
    for end in (planner, knee):
        end.close()
        rig.turn()
    assert rig.ended() == (0, 100)


def test_clearing_with_all_queues_full_lets_everything_through(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=40.0, ordered=True))
    rig.say(planner, *range(100))
    rig.there.begin(2, CUT_STREAM)
    rig.say(planner, *range(100, 200))
    rig.there.end(2)
    rig.there.end(1)
    rig.release()
    rig.say(planner, *range(200, 300))
    came = []
    for ms in range(40, 50):
        rig.at(ms)
        came += numbers(knee)
    assert came == list(range(300))


def test_closing_the_relay_ends_every_link(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.relay.close()
    assert heard(planner) == b""
    assert heard(knee) == b""
    with socket.socket(socket.AF_UNIX) as dialling:
        assert dialling.connect_ex(str(rig.through)) != 0
