"""The network proxy as a process, between two real sessions of the bus."""

from __future__ import annotations

import math
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.codec import Decoder
from shared.bus.messages import JointState
from shared.bus.session import Publisher, Session, Stream, open_session
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_MS, now_ns
from shared.config import files as config_file
from shared.config.scenarios import Inject
from shared.network.proxy_protocol import SOCKET
from shared.places import DEFAULT_CONFIG
from tests.shared.mcap_log.runs import sample
from tools import cli
from tools.fleet.proxy_client import ProxyClient

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

ROBOT = config_file.load(DEFAULT_CONFIG)
KNEE = "knee_left"
PERIOD_S = 0.004
PATIENCE_S = 20.0
QUIET_S = 0.3
SPARE = 12
"""Descriptors beyond those of the links that are up; each dial takes two."""


class Rig:
    """A joint service's session, a planner's that dials it through the network proxy, and that."""

    def __init__(self, run_dir: Path, knee: Session, planner: Session, tool: Session) -> None:
        self.run_dir = run_dir
        self.client = ProxyClient(run_dir)
        self._events = tool.stream([topics.LINK_EVENT.key(ROBOT.name)])
        self._put: Publisher[JointState] = knee.publisher(topics.JOINT_STATE, JointState, KNEE)
        self._stream: Stream = planner.stream([topics.JOINT_STATE.key(ROBOT.name, KNEE)])
        self._decode = Decoder(JointState).decode
        self.sent = 0
        self.heard: list[tuple[int, float]] = []
        """Number and delay, ms, of each message."""
        self.told: list[LinkEvent] = []
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "services.network_proxy", "--run-dir", str(self.run_dir)]
        self.proxy = subprocess.Popen([*command, "--seed", "3"], stderr=subprocess.PIPE, text=True)

    def stop(self) -> None:
        """End the network proxy as the supervisor does; what it leaves is what it should."""
        if self.proxy.returncode is not None:
            return
        self.proxy.send_signal(signal.SIGTERM)
        output = self.proxy.communicate(timeout=PATIENCE_S)[1]
        assert self.proxy.returncode == 0, output
        assert not list(self.run_dir.glob("through-*"))
        assert not (self.run_dir / SOCKET).exists()

    def kill(self) -> None:
        self.proxy.kill()
        self.proxy.communicate()

    def send(self, count: int) -> list[tuple[int, float]]:
        """Send states at 250 Hz, listening; return what is heard, and for a moment after."""
        self.heard = []
        for _ in range(count):
            self.sent += 1
            self._put.put(sample(JointState, seq=self.sent, t_ns=now_ns()))
            self._listen(PERIOD_S)
        self._listen(QUIET_S)
        return self.heard

    def send_to_the_last(self, count: int) -> list[tuple[int, float]]:
        """As `send`, where the last one is sure to come: however long this machine takes."""
        self.send(count)
        self.wait(lambda: bool(self.heard) and self.heard[-1][0] == self.sent)
        return self.heard

    def wait(self, done: Callable[[], bool]) -> None:
        """Listen until it is so."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline
            self._listen(0.02)

    def ended(self) -> LinkEvent:
        """Return what the newest impairment has done to the states, once it is told."""
        self.wait(lambda: any(not e.active and e.link == f"{KNEE}->planner" for e in self.told))
        found = [e for e in self.told if not e.active and e.link == f"{KNEE}->planner"]
        self.told.clear()
        return found[-1]

    def linked(self) -> bool:
        return bool(self.send(1))

    def _listen(self, seconds: float) -> None:
        end, decode = time.monotonic() + seconds, Decoder(LinkEvent).decode
        while time.monotonic() < end:
            while (item := self._events.take()) is not None:
                event = decode(item[1])
                assert event is not None
                self.told.append(event)
            item = self._stream.take()
            if item is None:
                time.sleep(0.0002)
                continue
            state = self._decode(item[1])
            assert state is not None
            self.heard.append((state.seq, (now_ns() - state.t_ns) / NS_PER_MS))


@pytest.fixture
def rig() -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-i-") as folder:
        run_dir = Path(folder) / "r"
        run_dir.mkdir()
        with (
            open_session(ROBOT, KNEE, run_dir) as knee,
            open_session(ROBOT, "recorder", run_dir) as tool,
            open_session(ROBOT, "planner", run_dir, injected=True) as planner,
        ):
            made = Rig(run_dir, knee, planner, tool)
            try:
                made.wait(lambda: (run_dir / SOCKET).exists() and made.linked())
                yield made
                made.stop()
            finally:
                made.kill()


def inject(rig: Rig, **what: float | bool | str) -> None:
    rig.client.begin(Inject(link="joints->planner", at=0.0, **what))  # type: ignore[arg-type]


def numbers(rows: list[tuple[int, float]]) -> list[int]:
    return [number for number, _ in rows]


def descriptors(rig: Rig) -> int:
    return len(list(Path(f"/proc/{rig.proxy.pid}/fd").iterdir()))


def test_unimpaired_nothing_is_lost_and_with_a_delay_it_comes_so_much_later(rig: Rig) -> None:
    near = list(rig.send_to_the_last(200))
    assert len(near) == 200
    inject(rig, delay_ms=25.0)
    far = rig.send_to_the_last(200)
    assert len(far) == 200
    assert numbers(far) == sorted(numbers(far))
    assert min(delay for _, delay in far) >= 25.0
    added = statistics.median(d for _, d in far) - statistics.median(d for _, d in near)
    assert 20.0 < added < 35.0


def test_the_requested_fraction_is_lost_and_reported(rig: Rig) -> None:
    """Those that are sent at once travel as one: counted is what travels."""
    inject(rig, loss=0.3)
    rig.send(500)
    rig.client.clear("all")
    ended = rig.ended()
    counted = ended.lost + ended.passed
    assert 100 < counted <= 500
    assert abs(ended.lost / counted - 0.3) < 4.5 * math.sqrt(0.3 * 0.7 / counted)
    rig.wait(lambda: len(rig.heard) >= ended.passed)
    assert len(rig.heard) <= 500 - ended.lost
    assert len(rig.send_to_the_last(100)) == 100


def test_a_duplicate_is_received_once_and_an_overtaken_message_not_at_all(rig: Rig) -> None:
    """Zenoh's own sequence numbers: doubles and what is overtaken are dropped."""
    inject(rig, duplicate=0.5)
    rig.send_to_the_last(200)
    assert numbers(rig.heard) == list(range(rig.sent - 199, rig.sent + 1))
    rig.client.clear("all")
    inject(rig, delay_ms=20.0, jitter_ms=20.0)
    jumbled = numbers(rig.send_to_the_last(400))
    assert jumbled == sorted(set(jumbled)), "never an older one after a newer"
    assert 40 < len(jumbled) < 400
    rig.client.clear("all")
    assert len(rig.send_to_the_last(100)) == 100


def test_a_stream_keeps_the_order_and_loses_nothing(rig: Rig) -> None:
    inject(rig, delay_ms=20.0, jitter_ms=20.0, ordered=True)
    rows = rig.send_to_the_last(300)
    assert numbers(rows) == list(range(rig.sent - 299, rig.sent + 1))


def test_a_partition_is_total_and_once_it_is_over_the_link_is_whole_again(rig: Rig) -> None:
    """Longer than the lease: Zenoh gives the link up and dials again through the proxy."""
    inject(rig, partition=True)
    assert rig.send(500) == []
    rig.client.clear("all")
    rig.wait(rig.linked)
    assert len(rig.send_to_the_last(100)) == 100


def test_what_a_partition_held_on_a_stream_that_is_given_up_counts_as_lost(rig: Rig) -> None:
    inject(rig, partition=True, ordered=True)
    assert rig.send(500) == []
    rig.client.clear("all")
    ended = rig.ended()
    assert ended.passed == 0
    assert ended.lost > 50


def test_a_partition_may_last_though_all_dial_again_and_again(rig: Rig) -> None:
    """Both ways, with few descriptors, for many dials: it neither ends early nor kills."""
    full = descriptors(rig) + SPARE
    resource.prlimit(rig.proxy.pid, resource.RLIMIT_NOFILE, (full, full))
    begun = time.monotonic()
    rig.client.begin(Inject(link="all", at=0.0, duration=12.0, partition=True))
    most = 0
    while time.monotonic() < begun + 10.0:
        arrived = list(rig.send(100))
        assert not arrived or time.monotonic() > begun + 12.0
        most = max(most, descriptors(rig))
    assert most < full, "none was turned away for want of one"
    assert rig.proxy.poll() is None
    rig.wait(rig.linked)
    assert time.monotonic() > begun + 12.0
    assert len(rig.send_to_the_last(100)) == 100


def test_an_injector_that_is_killed_and_started_again_links_anew_and_does_nothing(
    rig: Rig,
) -> None:
    inject(rig, loss=1.0)
    rig.kill()
    assert rig.send(20) == []
    rig.start()
    rig.wait(rig.linked)
    assert rig.client.list() == ()
    assert len(rig.send_to_the_last(100)) == 100


def test_an_impairment_that_lasts_is_reported_with_its_counts_when_the_injector_stops(
    rig: Rig,
) -> None:
    inject(rig, loss=0.5)
    rig.send(100)
    rig.stop()
    ended = rig.ended()
    assert ended.passed > 0
    assert ended.lost > 0


def test_an_action_is_published_on_the_bus_and_shown_by_the_verb(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--run-dir", str(rig.run_dir)]
    assert cli.main(["inject", "--link", "joints->planner", "--loss", "0.5", *words]) == 0
    rig.send(100)
    assert cli.main(["inject", "--list", *words]) == 0
    assert "loss=50%" in capsys.readouterr().out
    assert cli.main(["inject", "--clear", *words]) == 0
    assert "nothing is done" in capsys.readouterr().out
    rig.wait(lambda: len(rig.told) == 12)
    assert [event.active for event in rig.told] == [True] * 6 + [False] * 6
    assert cli.main(["inject", "--link", "elbow", "--loss", "0.5", *words]) == 2
    assert "planner->MODULE" in capsys.readouterr().err
