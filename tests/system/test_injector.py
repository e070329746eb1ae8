"""The injector as a process, between two real sessions of the bus."""

from __future__ import annotations

import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared import config_file, topics
from shared.bus import Publisher, Session, Stream, open_session
from shared.clock import NS_PER_MS, now_ns
from shared.codec import Decoder
from shared.injection import SOCKET
from shared.messages import JointState
from shared.process import DEFAULT_CONFIG
from shared.scenario import Inject
from shared.traces import LinkEvent
from tests.recorder.runs import sample
from tools import cli
from tools.runs.injector_client import InjectorClient

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

ROBOT = config_file.load(DEFAULT_CONFIG)
KNEE = "knee_left"
PERIOD_S = 0.004
PATIENCE_S = 20.0


class Rig:
    """A joint service's session, a planner's that dials it through the injector, and that."""

    def __init__(self, run_dir: Path, knee: Session, planner: Session, tool: Session) -> None:
        self.run_dir = run_dir
        self.client = InjectorClient(run_dir)
        self.events = tool.stream([topics.LINK_EVENT.key(ROBOT.name)])
        self._put: Publisher[JointState] = knee.publisher(topics.JOINT_STATE, JointState, KNEE)
        self._stream: Stream = planner.stream([topics.JOINT_STATE.key(ROBOT.name, KNEE)])
        self._decode = Decoder(JointState).decode
        self.sent = 0
        self.heard: list[tuple[int, float]] = []
        """Number and delay, ms, of each message."""

    def send(self, count: int) -> list[tuple[int, float]]:
        """Send states at 250 Hz, listening; return what is heard until nothing more comes."""
        self.heard = []
        for _ in range(count):
            self.sent += 1
            self._put.put(sample(JointState, seq=self.sent, t_ns=now_ns()))
            self._listen(PERIOD_S)
        self._listen(0.3)
        return self.heard

    def _listen(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            item = self._stream.take()
            if item is None:
                time.sleep(0.0002)
                continue
            state = self._decode(item[1])
            assert state is not None
            self.heard.append((state.seq, (now_ns() - state.t_ns) / NS_PER_MS))

    def linked(self) -> bool:
        return bool(self.send(1))

    def told(self) -> list[LinkEvent]:
        found, decode = [], Decoder(LinkEvent).decode
        while (item := self.events.take()) is not None:
            event = decode(item[1])
            assert event is not None
            found.append(event)
        return found


@pytest.fixture
def rig() -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-i-") as folder:
        run_dir = Path(folder) / "r"
        run_dir.mkdir()
        command = [sys.executable, "-m", "services.injector", "--run-dir", str(run_dir)]
        injector = subprocess.Popen([*command, "--seed", "3"], stderr=subprocess.PIPE, text=True)
        try:
            with (
                open_session(ROBOT, KNEE, run_dir) as knee,
                open_session(ROBOT, "recorder", run_dir) as tool,
                open_session(ROBOT, "planner", run_dir, injected=True) as planner,
            ):
                made = Rig(run_dir, knee, planner, tool)
                deadline = time.monotonic() + PATIENCE_S
                while not ((run_dir / SOCKET).exists() and made.linked()):
                    assert time.monotonic() < deadline
                yield made
                injector.send_signal(signal.SIGTERM)
                said = injector.communicate(timeout=PATIENCE_S)[1]
                assert injector.returncode == 0, said
                assert not list(run_dir.glob("through-*"))
                assert not (run_dir / SOCKET).exists()
        finally:
            injector.kill()
            injector.communicate()


def inject(rig: Rig, **what: float | bool | str) -> None:
    rig.client.begin(Inject(link="joints->planner", at=0.0, **what))  # type: ignore[arg-type]


def numbers(rows: list[tuple[int, float]]) -> list[int]:
    return [number for number, _ in rows]


def test_unimpaired_nothing_is_lost_and_with_a_delay_it_comes_so_much_later(rig: Rig) -> None:
    near = rig.send(200)
    assert len(near) == 200
    inject(rig, delay_ms=25.0)
    far = rig.send(200)
    assert len(far) == 200
    assert numbers(far) == sorted(numbers(far))
    assert min(delay for _, delay in far) >= 25.0
    added = statistics.median(d for _, d in far) - statistics.median(d for _, d in near)
    assert 20.0 < added < 35.0


def test_a_share_is_lost_a_share_comes_twice_and_neither_breaks_the_link(rig: Rig) -> None:
    """Zenoh's own sequence numbers: gaps are taken, doubles and what is overtaken are dropped."""
    inject(rig, loss=0.3)
    came = len(rig.send(500))
    assert 250 < came < 450
    rig.client.clear("all")
    inject(rig, duplicate=0.5)
    assert len(rig.send(200)) == len(set(numbers(rig.heard)))
    rig.client.clear("all")
    inject(rig, delay_ms=20.0, jitter_ms=20.0)
    jumbled = numbers(rig.send(400))
    assert jumbled == sorted(jumbled), "never an older one after a newer"
    assert 60 < len(jumbled) < 350
    rig.client.clear("all")
    assert len(rig.send(100)) == 100


def test_a_stream_keeps_the_order_and_loses_nothing(rig: Rig) -> None:
    inject(rig, delay_ms=20.0, jitter_ms=20.0, ordered=True)
    rows = rig.send(300)
    assert numbers(rows) == list(range(rows[0][0], rig.sent + 1))
    assert len(rows) == 300


def test_a_partition_is_total_and_after_its_time_the_link_is_whole_again(rig: Rig) -> None:
    """Longer than the lease: the link itself is given up, and made anew through the injector."""
    inject(rig, partition=True, duration=2.0)
    assert rig.send(300) == []
    deadline = time.monotonic() + PATIENCE_S
    while not rig.linked():
        assert time.monotonic() < deadline
    assert len(rig.send(100)) == 100


def test_what_is_done_is_told_on_the_bus_and_shown_by_the_verb(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--run-dir", str(rig.run_dir)]
    assert cli.main(["inject", "--link", "joints->planner", "--loss", "0.5", *words]) == 0
    rig.send(100)
    assert cli.main(["inject", "--list", *words]) == 0
    assert "loss=0.5" in capsys.readouterr().out
    assert cli.main(["inject", "--clear", *words]) == 0
    assert "nothing is done" in capsys.readouterr().out
    deadline = time.monotonic() + PATIENCE_S
    told = rig.told()
    while len(told) < 12:
        assert time.monotonic() < deadline
        time.sleep(0.05)
        told += rig.told()
    assert [event.in_force for event in told] == [True] * 6 + [False] * 6
    ended = next(e for e in told if not e.in_force and e.link == f"{KNEE}->planner")
    assert ended.passed + ended.lost > 90  # those that are sent at once travel as one
    assert ended.lost > 20
    assert cli.main(["inject", "--link", "elbow", "--loss", "0.5", *words]) == 2
    assert "planner->MODULE" in capsys.readouterr().err
