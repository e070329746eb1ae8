"""Links between processes: who has one, and what is done to their messages, when."""

from __future__ import annotations

import math
import statistics
from itertools import pairwise, product
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.session import peers_of
from shared.bus.topics import Topic
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.impairment import HELD, QUEUE_MAX, Direction, Distribution, Impairer, Impairment
from shared.config.robot_config import SERVICES
from shared.exceptions import ConfigError
from shared.joints import MODULES
from shared.links import COMMANDS, DIRECTIONS, GROUPS, PAIRS, WRENCHES, directions_of
from shared.network.impairment_schedule import ImpairmentSchedule

TOOL = topics.OPERATOR

TALK: dict[Topic, tuple[tuple[str, ...], tuple[str, ...]]] = {
    topics.JOINT_STATE: (MODULES, ("planner", "recorder", TOOL)),
    topics.JOINT_COMMAND: (("planner",), (*MODULES, "recorder", TOOL)),
    topics.JOINT_EVENT: (MODULES, ("recorder", TOOL)),
    topics.JOINT_TRACE: (MODULES, ("recorder",)),
    topics.JOINT_BATCH: (MODULES, ("recorder", TOOL)),
    topics.PLANNER_CHECKPOINT: (("planner",), ("recorder",)),
    topics.SIM_STATE: (("simulator",), ("recorder",)),
    topics.WRENCH: (("harness",), ("planner", "recorder", TOOL)),
    topics.ATTITUDE: (("imu",), ("planner", "recorder", TOOL)),
    topics.HARNESS_TARE: ((TOOL,), ("harness", "recorder")),
    topics.PLANNER_STATUS: (("planner",), ("recorder", TOOL)),
    topics.OPERATOR_INTENT: (("simulator", TOOL), ("planner", "simulator", "recorder", TOOL)),
    topics.OPERATOR_HAND: ((TOOL,), ("simulator", "recorder")),
    topics.ESTOP: ((TOOL,), (*MODULES, "recorder")),
    topics.SIM_TRUTH: (("simulator",), ("recorder", TOOL)),
    topics.SIM_CONTROL: ((TOOL,), ("simulator", "recorder")),
    topics.RUN_EVENT: ((TOOL,), ("recorder",)),
    topics.LINK_EVENT: (("network_proxy",), ("recorder",)),
    topics.TOOLS: (("recorder",), (TOOL,)),
}
"""Who puts each topic on the bus, and who takes it, by hand: not from the topic table."""


def linked(one: str, other: str) -> bool:
    return one in peers_of(other) or other in peers_of(one)


def test_every_publisher_has_one_link_to_every_subscriber() -> None:
    assert set(TALK) == set(topics.TOPICS), "each topic has a row in TALK, above"
    for topic, (publishers, subscribers) in TALK.items():
        for publisher in publishers:
            for subscriber in subscribers:
                if publisher != subscriber:
                    assert linked(publisher, subscriber), (topic.name, publisher, subscriber)
    for one in SERVICES:
        assert one not in peers_of(one)
        assert len(set(peers_of(one))) == len(peers_of(one))
        for other in SERVICES:
            both = (one in peers_of(other)) + (other in peers_of(one))
            expected = 0 if one == other or {one, other} <= set(MODULES) else 1
            assert both == expected, (one, other)
    assert set(peers_of(TOOL)) == set(SERVICES)
    assert not any(TOOL in peers_of(service) for service in SERVICES)


EVERY_NS = 4 * NS_PER_MS
SIZE = 200


def delays_ms(what: Impairment, count: int = 4000, seed: str = "a") -> list[float]:
    """Return the delay of each message that comes out, in the order in which they went in."""
    impairer = Impairer(what, seed)
    found = []
    for number in range(count):
        now_ns = number * EVERY_NS
        found += [(t - now_ns) / NS_PER_MS for t in impairer.passes(now_ns, SIZE)]
    return found


def test_nothing_is_done_unless_asked_and_nothing_comes_before_it_was_sent() -> None:
    assert delays_ms(Impairment()) == [0.0] * 4000
    assert Impairment().describe() == "nothing"
    assert min(delays_ms(Impairment(delay_ms=1.0, jitter_ms=30.0, distribution="normal"))) == 0.0


def test_uniform_jitter_fills_its_bounds_and_another_seed_decides_otherwise() -> None:
    found = delays_ms(Impairment(delay_ms=20.0, jitter_ms=10.0))
    assert len(found) == 4000, "none is lost"
    assert 10.0 <= min(found) < 10.1
    assert 29.9 < max(found) <= 30.0
    assert statistics.mean(found) == pytest.approx(20.0, abs=0.3)
    what = Impairment(loss=0.5)
    assert len({len(delays_ms(what, 1000, seed)) for seed in "abcdef"}) > 1


def test_other_jitter_has_its_mean_and_deviation_and_the_tail_of_pareto_is_the_heavier() -> None:
    far: dict[Distribution, int] = {}
    for kind in get_args(Distribution)[1:]:
        found = delays_ms(Impairment(delay_ms=100.0, jitter_ms=10.0, distribution=kind), 40_000)
        assert statistics.mean(found) == pytest.approx(100.0, abs=0.5)
        assert statistics.stdev(found) == pytest.approx(10.0, rel=0.15)
        far[kind] = sum(delay > 140.0 for delay in found)
    assert far["normal"] < 10 < far["pareto"]


@pytest.mark.parametrize(
    ("loss", "burst"), [(0.0, 1.0), (1.0, 1.0), *product((0.1, 0.5), (1.0, 3.0, 20.0))]
)
def test_as_many_are_lost_as_asked_with_bursts_or_without(loss: float, burst: float) -> None:
    came = len(delays_ms(Impairment(loss=loss, burst=burst), 60_000))
    assert came / 60_000 == pytest.approx(1.0 - loss, abs=0.03)


def test_as_many_come_twice_or_overtake_as_asked() -> None:
    assert len(delays_ms(Impairment(duplicate=0.3), 10_000)) == pytest.approx(13_000, abs=200)
    found = delays_ms(Impairment(delay_ms=30.0, reorder=0.25), 10_000)
    assert set(found) == {0.0, 30.0}
    assert found.count(0.0) / 10_000 == pytest.approx(0.25, abs=0.02)


def test_ordered_messages_never_overtake_and_a_slow_line_drops_what_it_cannot_queue() -> None:
    impairer = Impairer(Impairment(delay_ms=20.0, jitter_ms=20.0, ordered=True), "a")
    releases = [impairer.passes(n * NS_PER_MS, SIZE)[0] for n in range(1000)]
    assert all(a <= b for a, b in pairwise(releases))
    assert all(t >= n * NS_PER_MS for n, t in enumerate(releases))
    impairer = Impairer(Impairment(rate=1000.0), "a")
    taken = [impairer.passes(0, 100) for _ in range(QUEUE_MAX + 10)]
    assert [t[0] for t in taken[:3]] == [NS_PER_S // 10, NS_PER_S // 5, 3 * NS_PER_S // 10]
    assert taken[-1] == ()
    assert QUEUE_MAX <= impairer.passed <= QUEUE_MAX + 1
    assert impairer.passed + impairer.lost == QUEUE_MAX + 10


@given(
    st.builds(
        Impairment,
        delay_ms=st.floats(0, 500),
        jitter_ms=st.floats(0, 500),
        distribution=st.sampled_from(["uniform", "normal", "pareto"]),
        loss=st.floats(0, 1),
        duplicate=st.floats(0, 1),
        rate=st.floats(1e3, 1e9),
        ordered=st.booleans(),
    ),
    st.text(max_size=5),
)
def test_the_same_seed_decides_the_same_and_every_message_is_counted(
    what: Impairment, seed: str
) -> None:
    a, b = Impairer(what, seed), Impairer(what, seed)
    for number in range(50):
        now_ns = number * EVERY_NS
        out = a.passes(now_ns, SIZE)
        assert out == b.passes(now_ns, SIZE)
        assert all(t >= now_ns for t in out)
    assert a.passed + a.lost == 50


CHANGES = st.lists(
    st.tuples(st.sampled_from(["begin", "end"]), st.integers(0, 5), st.booleans()), max_size=20
)


@given(CHANGES)
def test_a_partition_in_force_wins_over_whatever_begins_later(
    changes: list[tuple[str, int, bool]],
) -> None:
    """By what passes: of the others the one that began last, and its delay is its number."""
    direction = Direction("planner->knee_left", 0)
    asked: dict[int, bool] = {}
    for what, number, cut in changes:
        if what == "end":
            assert (direction.end(number) is not None) is (number in asked)
            asked.pop(number, None)
        elif number not in asked:
            direction.begin(number, Impairment(delay_ms=0.0 if cut else number, partition=cut))
            asked[number] = cut
        expected: tuple[int, ...] = (next(reversed(asked), 0) * NS_PER_MS,)
        assert direction.passes(0, SIZE) == (() if any(asked.values()) else expected)


def test_what_passes_and_does_not_come_out_is_lost() -> None:
    impairer = Impairer(Impairment(partition=True, ordered=True), "a")
    impairer.passes(0, SIZE)
    impairer.drop()
    assert (impairer.passed, impairer.lost) == (0, 1)
    assert Impairer(Impairment(partition=True), "a").passes(5, SIZE) == ()
    assert Impairer(Impairment(partition=True, ordered=True), "a").passes(5, SIZE) == (HELD,)


@pytest.mark.parametrize(
    ("changes", "right"),
    [
        ({"ordered": True, "reorder": 0.1}, "remove one of them"),
        ({"burst": 3.0}, "loss between 0 and 1"),
        ({"burst": 2.0, "loss": 0.91}, "a burst of 11 or more"),
        ({"partition": True, "delay_ms": 5.0}, "remove all but ordered"),
        ({"partition": True, "ordered": True, "loss": 0.5}, "remove all but ordered"),
    ],
)
def test_impairments_that_do_not_go_together_are_refused(
    changes: dict[str, float], right: str
) -> None:
    assert right in msgspec.structs.replace(Impairment(), **changes).fault()


def test_links_have_their_directions_but_a_sensor_receives_nothing_and_others_are_refused() -> None:
    named = {name for pair in PAIRS for name in (pair.there, pair.back)}
    assert named - set(DIRECTIONS) == {"planner->harness", "planner->imu"}
    assert all(set(names) <= set(DIRECTIONS) for names in GROUPS.values())
    assert len(GROUPS["planner->left"]) == len(GROUPS["right->planner"]) == 3
    assert set(directions_of("all")) == set(DIRECTIONS)
    assert directions_of("planner->knee_left") == ("planner->knee_left",)
    with pytest.raises(ConfigError, match="planner->joints"):
        directions_of("planner->elbow")


CUT = Impairment(partition=True)
LATE = Impairment(delay_ms=5.0)


class Rig:
    def __init__(self) -> None:
        self.directions = {name: Direction(name, 0) for name in DIRECTIONS}
        self.told: list[LinkEvent] = []
        self.impairments = ImpairmentSchedule(self.directions, self.told.append)

    def begun(self) -> list[tuple[int, bool]]:
        return [(event.number, event.active) for event in self.told]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_what_is_planned_begins_when_it_is_due_and_ends_at_its_time(rig: Rig) -> None:
    number = rig.impairments.plan(WRENCHES, LATE, 2.0, 3.0)
    assert rig.impairments.next_due == 2.0
    assert not rig.impairments.advance(1.9, 19)
    assert rig.told == []
    assert rig.impairments.advance(2.0, 20)
    assert rig.directions[WRENCHES].active is not None
    assert rig.impairments.next_due == 3.0
    assert rig.impairments.advance(3.1, 31)
    assert rig.begun() == [(number, True), (number, False)]
    assert [event.t_ns for event in rig.told] == [20, 31]
    assert rig.impairments.next_due == math.inf


def test_what_is_planned_begins_in_order_and_only_if_it_is_seen(rig: Rig) -> None:
    late = rig.impairments.plan(WRENCHES, LATE, 2.0, 9.0)
    early = rig.impairments.plan(WRENCHES, LATE, 1.0, 9.0)
    rig.impairments.advance(5.0, 5)
    assert rig.begun() == [(early, True), (late, True)]
    rig = Rig()
    rig.impairments.plan(WRENCHES, LATE, 1.0, 1.5)
    assert rig.impairments.advance(2.0, 2)
    assert rig.told == []
    assert rig.impairments.requested == {}


def test_clearing_ends_what_touches_a_link_and_an_unknown_link_is_refused(rig: Rig) -> None:
    rig.impairments.begin("planner->joints", LATE, math.inf, 0)
    rig.impairments.plan("planner->joints", LATE, 1.0, math.inf)
    kept = rig.impairments.plan(WRENCHES, LATE, 1.0, math.inf)
    assert rig.impairments.clear("planner->knee_left", 0) == 2
    assert list(rig.impairments.requested) == [kept]
    rig.told.clear()
    rig.impairments.advance(1.0, 1)
    assert rig.begun() == [(kept, True)]
    rig = Rig()
    with pytest.raises(ConfigError):
        rig.impairments.plan("elbow", LATE, 1.0, 2.0)
    assert rig.impairments.requested == {}
    assert rig.impairments.next_due == math.inf


def test_a_hidden_impairment_is_reported_with_its_directions(rig: Rig) -> None:
    everywhere = rig.impairments.begin("all", LATE, math.inf, 0)
    cut = rig.impairments.begin("planner->joints", CUT, math.inf, 0)
    later = rig.impairments.begin("planner->knee_left", LATE, math.inf, 0)
    waits = rig.impairments.plan("all", CUT, 5.0, math.inf)
    assert set(rig.impairments.hidden(everywhere)) == set(COMMANDS)
    assert rig.impairments.hidden(cut) == ()
    assert rig.impairments.hidden(later) == ("planner->knee_left",)
    assert rig.impairments.hidden(waits) == ()
    rig.impairments.end(cut, 0)
    assert rig.impairments.hidden(everywhere) == ("planner->knee_left",)
