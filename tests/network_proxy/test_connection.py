"""How connections end: seen as late as all else, with all that went before, and none is kept."""

from __future__ import annotations

import socket

import pytest

from services.network_proxy.relay import LINKS_MAX
from shared.config.impairment import Impairment
from tests.network_proxy.rig import LEASE_NS, MESSAGE, WAIT_S, Rig, batch, heard, numbers

CUT = Impairment(partition=True)
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


def test_a_process_that_dials_again_is_linked_again(rig: Rig) -> None:
    planner, knee = rig.link()
    planner.close()
    rig.turn()
    assert heard(knee) == b""
    planner, knee = rig.link()
    rig.say(planner, 7)
    assert heard(knee) == batch(MESSAGE, 7)
    assert rig.relay.links == 1


def test_the_last_messages_of_a_sender_that_left_reach_a_slow_receiver(rig: Rig) -> None:
    planner, knee = rig.link()
    sent = 75 * batch(MESSAGE + bytes(4000))  # more than the kernel keeps for one socket
    assert rig.push(planner, sent) == b""
    planner.close()
    rig.turn()
    got = b""
    while (more := heard(knee)) != b"":
        got += more or b""
        rig.turn()
    assert got == sent
    assert rig.relay.links == 0


def test_a_death_behind_a_partition_is_not_seen_by_a_connected_peer(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, CUT)
    planner.close()
    rig.turn()
    for ms in range(1, 20):
        rig.now_ns = ms * 1_000_000
        rig.say(knee, ms)
    assert heard(knee) is None, "neither a message nor the end"
    rig.there.end(1)
    rig.release()
    assert heard(knee) == b""


def test_dials_in_a_partition_leave_nothing_once_both_have_given_up(rig: Rig) -> None:
    rig.there.begin(1, CUT)
    rig.back.begin(1, CUT)
    for _ in range(50):
        planner, knee = rig.link()
        rig.say(planner, 1)
        planner.close()
        rig.turn()
        knee.close()
        rig.turn()
        assert rig.relay.links == 0
    assert rig.relay.refused == 0


def test_dials_in_a_partition_to_one_who_is_frozen_are_kept_up_to_a_bound(rig: Rig) -> None:
    rig.there.begin(1, CUT)
    rig.back.begin(1, CUT)
    lasting = rig.dial()
    for _ in range(50):
        rig.dial().close()
        rig.turn()
        assert rig.relay.links <= LINKS_MAX
    assert heard(lasting) is None, "the first that is given up is one that was left already"


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


def test_a_link_that_is_idle_or_cut_is_not_given_up(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, CUT_STREAM)
    rig.say(planner, 1)
    for step in range(1, 50):
        rig.at(500.0 * step)
    assert rig.relay.links == 1
    assert heard(planner) is None
    assert heard(knee) is None


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


def test_a_late_message_without_a_receiver_is_lost_once_though_it_was_doubled(rig: Rig) -> None:
    planner, knee = rig.link()
    rig.there.begin(1, Impairment(delay_ms=50.0, duplicate=1.0))
    rig.say(planner, 1, 2, 3)
    rig.at(50.0)
    assert heard(knee) == b"".join(2 * batch(MESSAGE, number) for number in (1, 2, 3))
    rig.say(planner, 4, 5)
    knee.close()
    rig.turn()
    assert rig.ended() == (3, 2)


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
