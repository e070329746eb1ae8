from __future__ import annotations

import pytest

from services.recorder.snapshot import OVERHEAD, SnapshotRing
from shared.bus import codec, topics
from shared.bus.messages import Estop, JointEvent, Mode
from shared.clock import NS_PER_S
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ROBOT, STATE_KEY, Queue

Item = tuple[str, bytes, int]
EVENT_KEY = topics.JOINT_EVENT.key(ROBOT, "knee_right")
ESTOP_KEY = topics.ESTOP.key(ROBOT)
TRUTH_KEY = topics.SIM_TRUTH.key(ROBOT)


def ring(seconds: float = 10.0, most_bytes: int = 1 << 24) -> SnapshotRing:
    return SnapshotRing(seconds, most_bytes, topics.recorded_keys(ROBOT))


def at(second: float, key: str = TRUTH_KEY, payload: bytes = b"{}") -> Item:
    return key, payload, round(second * NS_PER_S)


def event(second: float, mode: int) -> Item:
    return at(second, EVENT_KEY, codec.encode(runs.sample(JointEvent, mode_after=mode)))


def feed(snapshot: SnapshotRing, *items: Item) -> None:
    for item in items:
        snapshot.take_from(Queue([item]), 1)
        snapshot.pass_time(item[2])


def taken(snapshot: SnapshotRing) -> list[float]:
    found = []
    while (item := snapshot.take()) is not None:
        found.append(item[2] / NS_PER_S)
    return found


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DAMP])
def test_a_module_in_fault_or_damp_gives_the_seconds_before_and_after(mode: Mode) -> None:
    snapshot = ring(3.0)
    feed(snapshot, *(at(s) for s in range(10)), event(10.0, mode), *(at(s) for s in (11, 13, 14)))
    assert taken(snapshot) == [7.0, 8.0, 9.0, 10.0, 11.0, 13.0]
    snapshot.pass_time(15 * NS_PER_S)
    assert not snapshot.writing
    assert snapshot.reason == f"{EVENT_KEY}: {mode.name}"


def test_an_emergency_stop_is_a_fault() -> None:
    snapshot = ring()
    feed(snapshot, at(1, ESTOP_KEY, codec.encode(runs.sample(Estop))))
    assert snapshot.writing


def test_a_steady_sender_that_falls_silent_is_a_fault_once() -> None:
    snapshot = ring(2.0)
    feed(snapshot, at(0, STATE_KEY), *(at(s / 2) for s in range(8)))
    assert snapshot.reason == f"{STATE_KEY} is silent"
    assert taken(snapshot)
    snapshot.pass_time(60 * NS_PER_S)
    assert not snapshot.writing
    feed(snapshot, at(61), at(62))
    assert not snapshot.writing


def test_a_sender_that_never_sent_or_has_no_steady_rate_is_not_missed() -> None:
    snapshot = ring()
    feed(snapshot, at(0), at(0, topics.SIM_CONTROL.key(ROBOT)), at(9))
    assert not snapshot.writing


def test_asked_for_it_is_written_without_a_fault() -> None:
    snapshot = ring()
    feed(snapshot, at(1))
    snapshot.trigger("asked", NS_PER_S)
    assert taken(snapshot) == [1.0]


def test_a_second_fault_meanwhile_makes_it_longer() -> None:
    snapshot = ring(3.0)
    feed(snapshot, event(0, Mode.FAULT), event(2, Mode.FAULT), at(4.5), at(5.5))
    assert taken(snapshot) == [0.0, 2.0, 4.5]


def test_what_is_old_is_forgotten_and_what_follows_a_snapshot_is_kept_for_the_next() -> None:
    snapshot = ring(2.0)
    feed(snapshot, *(at(s) for s in range(100)))
    assert len(snapshot) == 3
    feed(snapshot, event(100, Mode.FAULT), at(101), at(103))
    assert taken(snapshot) == [98.0, 99.0, 100.0, 101.0]
    feed(snapshot, at(104))
    assert not snapshot.writing
    assert len(snapshot) == 2


def test_memory_is_bounded_and_the_oldest_go_first() -> None:
    most = 100 * (OVERHEAD + 1000)
    snapshot = ring(3600.0, most)
    for index in range(1000):
        feed(snapshot, at(index * 1e-3, payload=bytes(1000)))
        assert snapshot.memory <= most
    assert (len(snapshot), snapshot.dropped) == (100, 900)
    snapshot.trigger("asked", NS_PER_S)
    assert taken(snapshot)[0] == pytest.approx(0.9)
    assert snapshot.memory == 0
