"""What is asked of the injector, what it answers, and what it tells the log."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from services.injector.control import Control
from services.injector.loop import Orders
from shared.exceptions import FleetError
from shared.impairment import Direction
from shared.injection import SOCKET, Begin, Clear, List, Reply
from shared.injections import Injections
from shared.links import COMMANDS, DIRECTIONS
from shared.scenario import Inject
from shared.traces import LinkEvent
from tools.runs.injector_client import InjectorClient

DELAY = Inject(link="planner->joints", at=0.0, delay_ms=30.0)
LOSS = Inject(link="all", at=0.0, loss=0.5, duration=2.0)


class Rig:
    def __init__(self) -> None:
        self.directions = {name: Direction(name, 0) for name in DIRECTIONS}
        self.told: list[LinkEvent] = []
        self.injections = Injections(self.directions, self.told.append)
        self.orders = Orders(self.injections)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_what_begins_is_in_force_on_every_direction_of_the_link_and_told(rig: Rig) -> None:
    reply = rig.orders.obey(Begin(DELAY))
    assert [row.link for row in reply.asked] == ["planner->joints"]
    assert reply.asked[0].left_s is None
    impaired = {name for name, one in rig.directions.items() if one.in_force is not None}
    assert impaired == set(COMMANDS)
    assert [(e.link, e.in_force, e.delay_ms) for e in rig.told] == [
        (name, True, 30.0) for name in COMMANDS
    ]
    assert [e.seq for e in rig.told] == list(range(1, 7))


def test_what_has_its_time_ends_by_itself_and_tells_what_it_took(rig: Rig) -> None:
    rig.orders.obey(Begin(LOSS))
    for number in range(100):
        rig.directions["knee_left->planner"].passes(number, 10)
    end_ns = round(rig.injections.next_end)
    assert not rig.injections.end_due(end_ns - 1, end_ns - 1)
    assert rig.injections.end_due(end_ns, end_ns)
    assert all(one.in_force is None for one in rig.directions.values())
    (ended,) = [e for e in rig.told if not e.in_force and e.link == "knee_left->planner"]
    assert ended.passed + ended.lost == 100
    assert 30 < ended.lost < 70


def test_clearing_a_link_ends_what_touches_it_and_leaves_the_rest(rig: Rig) -> None:
    rig.orders.obey(Begin(DELAY))
    rig.orders.obey(Begin(Inject(link="harness->planner", at=0.0, loss=0.1)))
    reply = rig.orders.obey(Clear("planner->knee_left"))
    assert [row.link for row in reply.asked] == ["harness->planner"]
    assert rig.orders.obey(Clear()).asked == ()


def test_counts_are_told_while_it_lasts(rig: Rig) -> None:
    rig.orders.obey(Begin(LOSS))
    for number in range(50):
        rig.directions["planner->knee_left"].passes(number, 10)
    (row,) = rig.orders.obey(List()).asked
    assert row.passed + row.lost == 50
    assert row.detail == "loss=0.5"
    assert 0.0 < (row.left_s or 0.0) <= 2.0


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (Begin(Inject(link="planner->elbow", at=0.0, delay_ms=1.0)), "planner->MODULE"),
        (Begin(Inject(link="all", at=0.0, ordered=True, reorder=0.1)), "leave one out"),
        (Clear("nothing"), "planner->MODULE"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_changes(
    rig: Rig, request_: Begin | Clear, words: str
) -> None:
    assert words in rig.orders.obey(request_).error
    assert rig.told == []
    assert rig.injections.asked == {}


@pytest.fixture
def served(rig: Rig, tmp_path: Path) -> Iterator[tuple[Rig, Path]]:
    control = Control(tmp_path / SOCKET, rig.orders.obey)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            for end in select.select(control.sockets(), [], [], 0.01)[0]:
                control.readable(end)

    thread = threading.Thread(target=serve)
    thread.start()
    yield rig, tmp_path
    over.set()
    thread.join()
    control.close()


def test_the_client_asks_and_is_answered(served: tuple[Rig, Path]) -> None:
    client = InjectorClient(served[1])
    assert client.list() == ()
    assert [row.detail for row in client.begin(DELAY)] == ["delay=30"]
    assert client.clear("all") == ()
    with pytest.raises(FleetError, match="refused"):
        client.clear("elbow")


def test_rubbish_is_answered_with_an_error_and_the_next_is_heard(
    served: tuple[Rig, Path],
) -> None:
    with socket.socket(socket.AF_UNIX) as asking:
        asking.settimeout(5.0)
        asking.connect(str(served[1] / SOCKET))
        asking.sendall(b'nonsense\n{"type":"list"}\n')
        with asking.makefile("rb") as answers:
            first, second = (msgspec.json.decode(answers.readline(), type=Reply) for _ in range(2))
    assert "not understood" in first.error
    assert second == Reply()
    assert InjectorClient(served[1]).list() == ()


def test_without_an_injector_the_client_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match="xrl up --injectable"):
        InjectorClient(tmp_path).list()
