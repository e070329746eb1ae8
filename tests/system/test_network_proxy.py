"""The network proxy as a process, between joint services' sessions of the bus and a planner's."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import pytest

from shared.bus import topics
from shared.bus.codec import Decoder
from shared.bus.messages import JointState
from shared.bus.session import Session, open_session
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_MS, now_ns
from shared.config import files as config_file
from shared.config.scenarios import Inject
from shared.links import ATTITUDES
from shared.network.proxy_protocol import SOCKET
from shared.places import CHECKOUT, DEFAULT_CONFIG
from shared.run_directory import live_dir
from tests.shared.mcap_log.runs import sample
from tools import cli
from tools.fleet.proxy_client import ProxyClient

ROBOT: Final = config_file.load(DEFAULT_CONFIG)
PERIOD_S: Final = 0.004
PATIENCE_S: Final = 20.0

Heard = list[tuple[int, float]]
"""Number and delay, ms, of each message."""


class Proxied:
    """Sends modules' states to a planner that dials them through the proxy."""

    def __init__(
        self, run_dir: Path, modules: dict[str, Session], planner: Session, tool: Session
    ) -> None:
        self.run_dir = run_dir
        self.client = ProxyClient(run_dir)
        self._events = tool.stream([topics.LINK_EVENT.key(ROBOT.name)])
        self._put = {
            module: session.publisher(topics.JOINT_STATE, JointState, module)
            for module, session in modules.items()
        }
        self._streams = {
            module: planner.stream([topics.JOINT_STATE.key(ROBOT.name, module)])
            for module in modules
        }
        self.first = next(iter(modules))
        self.sent = 0
        self.sent_ns: list[int] = []
        self.heard: dict[str, Heard] = {}
        self.told: list[LinkEvent] = []
        self.start()

    def start(self) -> None:
        words = [sys.executable, "-m", "services.network_proxy", "--run-dir", str(self.run_dir)]
        self.proxy = subprocess.Popen(
            [*words, "--seed", "3"], cwd=CHECKOUT, stderr=subprocess.PIPE, text=True
        )

    def stop(self) -> None:
        """End the network proxy as the supervisor does; what it leaves is what it should."""
        if self.proxy.returncode is not None:
            return
        self.proxy.send_signal(signal.SIGTERM)
        output = self.proxy.communicate(timeout=PATIENCE_S)[1]
        assert self.proxy.returncode == 0, output
        assert not list(live_dir(self.run_dir).glob("through-*"))
        assert not (live_dir(self.run_dir) / SOCKET).exists()

    def kill(self) -> None:
        self.proxy.kill()
        self.proxy.communicate()

    def send(self, count: int, quiet_s: float = 0.3) -> Heard:
        """Send states of each module at 250 Hz, listening, and for a moment after.

        Returns what is heard of the first module.
        """
        begin = self.sent + 1
        self.sent_ns, self.heard = [], {module: [] for module in self._put}
        for _ in range(count):
            self.sent += 1
            self.sent_ns.append(now_ns())
            for publisher in self._put.values():
                publisher.put(sample(JointState, seq=self.sent, t_ns=self.sent_ns[-1]))
            self._listen(PERIOD_S, begin)
        self._listen(quiet_s, begin)
        return self.heard[self.first]

    def send_to_the_last(self, count: int) -> Heard:
        """As `send`, where the last one is sure to come: however long this machine takes."""
        heard = self.send(count)
        self.wait(lambda: bool(heard) and heard[-1][0] == self.sent)
        return heard

    def wait(self, done: Callable[[], bool]) -> None:
        """Listen until it is so."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline
            self._listen(0.02)

    def linked(self) -> bool:
        self.send(1)
        return all(self.heard.values())

    def ended(self) -> LinkEvent:
        """Return what the newest impairment has done to the first module's states."""

        def found() -> list[LinkEvent]:
            link = f"{self.first}->planner"
            return [event for event in self.told if not event.active and event.link == link]

        self.wait(lambda: bool(found()))
        newest = found()[-1]
        self.told.clear()
        return newest

    def _listen(self, seconds: float, begin: int = 0) -> None:
        """Receive for a while; messages that were sent before number `begin` do not count."""
        end = time.monotonic() + seconds
        events, states = Decoder(LinkEvent).decode, Decoder(JointState).decode
        while time.monotonic() < end:
            while (item := self._events.take()) is not None:
                event = events(item[1])
                assert event is not None
                self.told.append(event)
            items = {module: stream.take() for module, stream in self._streams.items()}
            for module, one in items.items():
                state = states(one[1]) if one is not None else None
                if state is not None and state.seq >= begin:
                    late_ms = (now_ns() - state.t_ns) / NS_PER_MS
                    self.heard[module].append((state.seq, late_ms))
            if not any(items.values()):
                time.sleep(0.0002)


@contextmanager
def proxied(*modules: str) -> Iterator[Proxied]:
    """Link these modules through a proxy that ends as it should."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-i-") as folder, ExitStack() as stack:
        run_dir = Path(folder) / "r"
        run_dir.mkdir()
        opened = {m: stack.enter_context(open_session(ROBOT, m, run_dir)) for m in modules}
        tool = stack.enter_context(open_session(ROBOT, "recorder", run_dir))
        planner = stack.enter_context(open_session(ROBOT, "planner", run_dir, injected=True))
        links = Proxied(run_dir, opened, planner, tool)
        try:
            links.wait(lambda: (live_dir(run_dir) / SOCKET).exists() and links.linked())
            yield links
            links.stop()
        finally:
            links.kill()


pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

BESIDE = ATTITUDES
"""A link that no test impairs: what is told of it comes after all that was told before."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Proxied]:
    with proxied("knee_left") as links:
        yield links


@pytest.fixture
def rig(shared: Proxied) -> Iterator[Proxied]:
    """Return links to which nothing is done, neither before nor after."""
    shared.wait(shared.linked)
    yield shared
    shared.client.clear("all")
    shared.client.begin(Inject(link=BESIDE, at=0.0, delay_ms=1.0))
    shared.client.clear("all")
    shared.wait(lambda: any(not event.active and event.link == BESIDE for event in shared.told))
    shared.told.clear()


@pytest.fixture
def own() -> Iterator[Proxied]:
    """Return links that a test may harm."""
    with proxied("knee_left") as links:
        yield links


def inject(rig: Proxied, **what: float | bool | str) -> None:
    rig.client.begin(Inject(link="joints->planner", at=0.0, **what))  # type: ignore[arg-type]


def test_a_partition_is_total_and_once_it_is_over_the_link_is_whole_again(rig: Proxied) -> None:
    """Longer than the lease: Zenoh gives the link up and dials again through the proxy."""
    inject(rig, partition=True)
    assert rig.send(500) == []
    rig.client.clear("all")
    ended = rig.ended()
    assert ended.passed == 0
    assert ended.lost > 50
    rig.wait(rig.linked)
    assert len(rig.send_to_the_last(100)) == 100


def test_a_killed_injector_links_anew_and_a_stopped_one_reports_its_counts(own: Proxied) -> None:
    inject(own, loss=1.0)
    own.kill()
    assert own.send(20) == []
    own.start()
    own.wait(own.linked)
    assert own.client.list() == ()
    assert len(own.send_to_the_last(100)) == 100
    inject(own, loss=0.5)
    own.send(100)
    own.stop()
    ended = own.ended()
    assert ended.passed > 0
    assert ended.lost > 0


def test_an_action_is_published_on_the_bus_and_shown_by_the_verb(
    rig: Proxied, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--run-dir", str(rig.run_dir)]
    assert cli.main(["inject", "joints->planner loss=0.5", *words]) == 0
    rig.send(100)
    assert cli.main(["inject", "--list", *words]) == 0
    assert "loss=50%" in capsys.readouterr().out
    assert cli.main(["inject", "--clear", "all", *words]) == 0
    assert "no link is impaired" in capsys.readouterr().out
    rig.wait(lambda: len(rig.told) == 12)
    assert [event.active for event in rig.told] == [True] * 6 + [False] * 6
