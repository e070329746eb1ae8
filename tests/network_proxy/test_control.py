"""What is asked of the network proxy, what it answers, and what it tells the log."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from services.network_proxy.control import CommandHandler, ControlSocket
from services.network_proxy.sockets import SocketWatch
from shared.config.scenarios import Inject
from shared.exceptions import FleetError
from shared.links import COMMANDS
from shared.network.proxy_protocol import LINE_MAX, SOCKET, Begin, Clear, List, Reply
from shared.run_directory import live_dir, make_live_dir
from tests.shared.test_links import Rig as Schedule
from tools.fleet.proxy_client import ProxyClient

DELAY = Inject(link="planner->joints", at=0.0, delay_ms=30.0)
LOSS = Inject(link="all", at=0.0, loss=0.5, duration=2.0)


class Rig(Schedule):
    def __init__(self) -> None:
        super().__init__()
        self.commands = CommandHandler(self.impairments)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_what_begins_is_active_in_both_directions_of_the_link_and_reported(rig: Rig) -> None:
    reply = rig.commands.obey(Begin(DELAY))
    assert [row.link for row in reply.requested] == ["planner->joints"]
    assert reply.requested[0].left_s is None
    impaired = {name for name, one in rig.directions.items() if one.active is not None}
    assert impaired == set(COMMANDS)
    assert [(e.link, e.active, e.delay_ms) for e in rig.told] == [
        (name, True, 30.0) for name in COMMANDS
    ]
    assert [e.seq for e in rig.told] == list(range(1, 7))


def test_an_impairment_with_a_duration_ends_by_itself_and_reports_its_counts(rig: Rig) -> None:
    rig.commands.obey(Begin(LOSS))
    for number in range(100):
        rig.directions["knee_left->planner"].passes(number, 10)
    (row,) = rig.commands.obey(List()).requested
    assert (row.passed + row.lost, row.detail) == (100, "loss=50%")
    assert 0.0 < (row.left_s or 0.0) <= 2.0
    end_ns = round(rig.impairments.next_due)
    assert not rig.impairments.advance(end_ns - 1, end_ns - 1)
    assert rig.impairments.advance(end_ns, end_ns)
    assert all(one.active is None for one in rig.directions.values())
    (ended,) = [e for e in rig.told if not e.active and e.link == "knee_left->planner"]
    assert ended.passed + ended.lost == 100
    assert 30 < ended.lost < 70


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (Begin(Inject(link="planner->elbow", at=0.0, delay_ms=1.0)), "planner->MODULE"),
        (Begin(Inject(link="all", at=0.0, ordered=True, reorder=0.1)), "remove one of them"),
        (Begin(Inject(link="all", at=0.0, loss=7.0)), "loss: 7.0 is out of range; must be"),
        (Begin(Inject(link="all", at=0.0, loss=0.1), in_s=1e12), "must be between 0 and 86400 s"),
        (Begin(Inject(link="all", at=0.0, loss=0.1), in_s=-1.0), "must be between 0 and 86400 s"),
        (Clear("nothing"), "planner->MODULE"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_changes(
    rig: Rig, request_: Begin | Clear, words: str
) -> None:
    assert words in rig.commands.obey(request_).error
    assert rig.told == []
    assert rig.impairments.requested == {}


def dialled(folder: Path, timeout_s: float = 5.0) -> socket.socket:
    asking = socket.socket(socket.AF_UNIX)
    asking.settimeout(timeout_s)
    asking.connect(str(live_dir(folder) / SOCKET))
    return asking


@pytest.fixture
def served(rig: Rig, tmp_path: Path) -> Iterator[tuple[Rig, Path]]:
    watch = SocketWatch()
    control = ControlSocket(make_live_dir(tmp_path) / SOCKET, rig.commands.obey, watch)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            for call, events in watch.wait(0.01):
                call(events, 0)

    thread = threading.Thread(target=serve)
    thread.start()
    yield rig, tmp_path
    over.set()
    thread.join()
    control.close()
    watch.close()
    assert not (live_dir(tmp_path) / SOCKET).exists()


def test_the_client_asks_and_is_answered_or_names_how_to_get_a_proxy(
    served: tuple[Rig, Path],
) -> None:
    with pytest.raises(FleetError, match="xrl up --injectable"):
        ProxyClient(served[1] / "elsewhere").list()
    client = ProxyClient(served[1])
    assert client.list() == ()
    assert [row.detail for row in client.begin(DELAY)] == ["delay=30ms"]
    assert client.clear("all") == ()
    with pytest.raises(FleetError, match="refused"):
        client.clear("elbow")


def test_garbage_and_half_requests_are_answered_or_dropped_and_the_next_is_served(
    served: tuple[Rig, Path],
) -> None:
    with dialled(served[1]) as asking:
        asking.sendall(b'nonsense\n{"type":"list"}\n')
        with asking.makefile("rb") as answers:
            first, second = (msgspec.json.decode(answers.readline(), type=Reply) for _ in range(2))
    assert "invalid request" in first.error
    assert second == Reply()
    assert ProxyClient(served[1]).list() == ()
    for rubbish in (b"x" * (2 * LINE_MAX), b'{"type":'):
        with dialled(served[1]) as asking, contextlib.suppress(OSError):
            asking.sendall(rubbish)
            asking.shutdown(socket.SHUT_WR)
            assert asking.recv(1) == b""
    assert ProxyClient(served[1]).list() == ()
