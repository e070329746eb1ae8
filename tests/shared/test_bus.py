"""The bus between processes: what arrives, what is refused, who is linked, what a stop costs."""

import math
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from shared import run_directory
from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Estop, JointCommand, JointEvent, JointState, Wrench
from shared.bus.pubsub import Latest, Publisher
from shared.bus.session import Session, open_session
from shared.bus.traces import Batch, JointTrace
from shared.config import files as config_file
from shared.exceptions import BusError
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from shared.run_directory import live_dir, make_live_dir
from tests.messages import sample
from tests.waiting import comes_true

ROOT = Path(__file__).resolve().parents[2]
ROBOT = config_file.load(DEFAULT_CONFIG)
TOOL = "test"

PRELUDE = """
import os, sys, time
from pathlib import Path
from shared.config import files as config_file
from shared.bus import topics
from shared.bus.session import open_session
from shared.bus.messages import Estop, JointCommand, JointEvent
from shared.places import DEFAULT_CONFIG
robot, run_dir = config_file.load(DEFAULT_CONFIG), Path(sys.argv[1])
"""

ECHO = """
module = sys.argv[2]
with open_session(robot, module, run_dir) as session:
    commands = session.latest(topics.JOINT_COMMAND, JointCommand, module)
    events = session.publisher(topics.JOINT_EVENT, JointEvent, module)
    while True:
        command = commands.take()
        if command is not None:
            events.put(JointEvent(
                t_ns=command.t_ns, seq=command.seq, mode_before=0, mode_after=0, cause=0,
                age_ns=0, tau_before=command.q_ref, tau_after=command.k_p))
        time.sleep(0.001)
"""
"""A joint service that answers each command with an event of the same number."""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def run_dir(short_dir: Path) -> Path:
    return short_dir


@pytest.fixture
def start(run_dir: Path) -> Iterator[Start]:
    """Start a script in a process of its own; none outlives the test."""
    processes: list[subprocess.Popen[str]] = []

    def start_script(script: str, *arguments: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [sys.executable, "-c", PRELUDE + script, str(run_dir), *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield start_script
    for process in processes:
        process.kill()
        process.communicate()


def command(seq: int, q_phi: float = 0.1) -> JointCommand:
    pair, k_p = (q_phi, 1 / 3), (0.25, -1e-300)
    return sample(JointCommand, t_ns=time.monotonic_ns(), seq=seq, session=1, q_ref=pair, k_p=k_p)


class Link:
    """The planner's two ends of one module; `reaches` sends until an answer comes."""

    def __init__(self, session: Session, module: str) -> None:
        self.commands: Publisher[JointCommand] = session.publisher(
            topics.JOINT_COMMAND, JointCommand, module
        )
        self.events: Latest[JointEvent] = session.latest(topics.JOINT_EVENT, JointEvent, module)
        self.seq = 0
        self.newest: JointEvent | None = None

    @property
    def answered(self) -> int:
        return -1 if self.newest is None else self.newest.seq

    def send(self) -> bool:
        self.seq += 1
        return self.commands.put(command(self.seq))

    def listen(self) -> int:
        self.newest = self.events.take() or self.newest
        return self.answered

    def reaches(self) -> bool:
        """True once a command sent from now on is answered."""
        first = self.seq + 1
        return comes_true(lambda: self.send() and self.listen() >= first)


def test_only_the_newest_message_is_kept(run_dir: Path) -> None:
    with (
        open_session(ROBOT, "ankle_right", run_dir) as joint,
        open_session(ROBOT, "planner", run_dir) as planner,
    ):
        commands = joint.latest(topics.JOINT_COMMAND, JointCommand, "ankle_right")
        every = joint.stream([topics.JOINT_COMMAND.key(ROBOT.name, "ankle_right")])
        publisher = planner.publisher(topics.JOINT_COMMAND, JointCommand, "ankle_right")
        assert comes_true(lambda: publisher.put(command(0)) and commands.take())
        time.sleep(0.2)  # what was under way has come
        assert list(iter(every.take, None))
        commands.take()
        for seq in range(1, 11):
            publisher.put(command(seq))
            time.sleep(0.002)
        seen: list[tuple[str, bytes, int]] = []
        assert comes_true(lambda: seen.extend(iter(every.take, None)) or len(seen) == 10)  # type: ignore[func-returns-value]
        newest = commands.take()
        assert newest is not None
        assert newest.seq == 10
        assert commands.take() is None


def longest_put_s(deaf: Link, other: Link) -> float:
    """Send to both, 1 MB in all: several times what the deaf one's socket and queue can take."""
    heard_before, longest_s = other.listen(), 0.0
    for _ in range(2000):
        begin = time.monotonic()
        assert deaf.send()
        assert other.send()
        longest_s = max(longest_s, time.monotonic() - begin)
        other.listen()
        time.sleep(0.0002)
    assert other.answered > heard_before + 100
    return longest_s


def test_a_subscriber_that_is_stopped_or_killed_stalls_nobody_and_is_reached_again(
    run_dir: Path, start: Start
) -> None:
    process = start(ECHO, "ankle_right")
    start(ECHO, "knee_right")
    with open_session(ROBOT, "planner", run_dir) as session:
        deaf, other = Link(session, "ankle_right"), Link(session, "knee_right")
        assert deaf.reaches()
        assert other.reaches()
        process.send_signal(signal.SIGSTOP)
        assert longest_put_s(deaf, other) < 2.0  # a blocking put waits 5 s for the queue
        assert other.reaches()
        process.send_signal(signal.SIGCONT)
        assert deaf.reaches()
        process.kill()
        process.wait()
        assert (live_dir(run_dir) / "ankle_right.zenoh").exists()  # nobody cleaned up
        assert longest_put_s(deaf, other) < 2.0
        assert comes_true(lambda: session.alive() == {"planner", "knee_right"})
        again = start(ECHO, "ankle_right")
        assert deaf.reaches()
        assert again.poll() is None
        answer = deaf.newest
        assert answer is not None
        assert (answer.tau_before, answer.tau_after) == ((0.1, 1 / 3), (0.25, -1e-300))
        assert deaf.commands.failed == deaf.events.refused == 0


def test_session_closes_while_a_subscriber_is_stopped(run_dir: Path, start: Start) -> None:
    stopped = start(ECHO, "ankle_right")
    with open_session(ROBOT, "planner", run_dir) as session:
        link = Link(session, "ankle_right")
        assert link.reaches()
        stopped.send_signal(signal.SIGSTOP)
        for _ in range(2000):
            link.send()
    assert not (live_dir(run_dir) / "planner.zenoh").exists()
    assert not link.send()
    assert link.commands.failed == 1


def test_publisher_reaches_its_subscriber_again_after_it_was_killed(
    run_dir: Path, start: Start
) -> None:
    """The planner dials the joints: this is the restart of the side that dials."""
    planner = """
with open_session(robot, "planner", run_dir) as session:
    publisher = session.publisher(topics.ESTOP, Estop)
    while True:
        publisher.put(Estop(t_ns=0, seq=int(sys.argv[2]), source="planner"))
        time.sleep(0.002)
"""
    with open_session(ROBOT, "ankle_right", run_dir) as session:
        stops = session.latest(topics.ESTOP, Estop)

        def heard(life: int) -> bool:
            stop = stops.take()
            return stop is not None and stop.seq == life

        for life in (1, 2):
            process = start(planner, str(life))
            assert comes_true(lambda life=life: heard(life))  # type: ignore[misc]
            process.kill()
            process.wait()


Ankle = tuple[Session, Publisher[JointCommand], Latest[JointCommand]]


@pytest.fixture
def ankle(run_dir: Path) -> Iterator[Ankle]:
    """Return the planner's session, its publisher and the ankle's subscriber, linked."""
    with (
        open_session(ROBOT, "ankle_right", run_dir) as joint,
        open_session(ROBOT, "planner", run_dir) as planner,
    ):
        commands = joint.latest(topics.JOINT_COMMAND, JointCommand, "ankle_right")
        publisher = planner.publisher(topics.JOINT_COMMAND, JointCommand, "ankle_right")
        assert comes_true(lambda: publisher.put(command(0)) and commands.take())
        yield planner, publisher, commands


def test_number_that_is_not_finite_is_refused_counted_and_logged_once_by_the_sender(
    ankle: Ankle, caplog: pytest.LogCaptureFixture
) -> None:
    _, publisher, commands = ankle
    assert publisher.failed == 0
    for bad in (math.nan, math.inf, -math.inf):
        assert not publisher.put(command(1, q_phi=bad))
    assert publisher.failed == 3
    assert publisher.put(command(2))
    assert comes_true(lambda: (came := commands.take()) is not None and came.seq == 2)
    assert commands.refused == 0
    assert comes_true(lambda: len(caplog.records) == 1)
    assert "JointCommand 1" in caplog.text


@pytest.mark.parametrize("bad", [b'{"t_ns":0,"seq":1,"q_ref":[null,0.0]}', b"no json", b""])
def test_message_that_is_none_is_refused_and_counted_by_the_receiver(
    ankle: Ankle, bad: bytes
) -> None:
    planner, publisher, commands = ankle
    key = topics.JOINT_COMMAND.key(ROBOT.name, "ankle_right")
    planner._session.put(key, bad, attachment=key.encode())
    assert comes_true(lambda: commands.take() is None and commands.refused == 1)
    assert comes_true(lambda: publisher.put(command(2)) and commands.take())


@pytest.mark.parametrize("sent_to", ["ankle_left", None])
def test_a_command_that_zenoh_delivers_under_another_modules_key_is_refused_and_counted(
    ankle: Ankle, sent_to: str | None
) -> None:
    planner, publisher, commands = ankle
    sent = sent_to and topics.JOINT_COMMAND.key(ROBOT.name, sent_to).encode()
    came_as = topics.JOINT_COMMAND.key(ROBOT.name, "ankle_right")
    planner._session.put(came_as, encode(command(7)), attachment=sent)
    assert comes_true(lambda: commands.take() is None and commands.refused == 1)
    assert comes_true(lambda: publisher.put(command(8)) and commands.take())


def test_a_second_process_of_a_name_learns_that_the_endpoint_is_in_use(
    run_dir: Path, start: Start
) -> None:
    script = """
from shared.exceptions import BusError
try:
    open_session(robot, "planner", run_dir)
except BusError as error:
    print(error)
"""
    with open_session(ROBOT, "planner", run_dir) as session:
        out, err = start(script).communicate(timeout=30)
        assert out.count("\n") == 1
        assert f"unixsock-stream/{live_dir(run_dir)}/planner.zenoh: in use" in out
        assert "stop the planner" in out
        assert err == ""
        assert session.alive() == {"planner"}


SESSIONS_REFUSED = {
    **dict.fromkeys(("", "a/b", "*", "a b"), ("", "not a valid process name")),
    "planner": ("x" * 100, r"unixsock-stream/.*/planner\.zenoh.*shorter run directory"),
    "ankle_right": ("x" * 100, r"unixsock-stream/.*/ankle_right\.zenoh.*shorter run directory"),
    TOOL: ("x" * 100, r"unixsock-stream/.*shorter run directory"),
    "harness": ("a?b", r"harness\.zenoh: a socket path must not contain \? or #"),
    "simulator": ("file", r"file/simulator\.zenoh: simulator cannot listen: "),
}
"""Name: folder below the run directory, and what the error says."""


@pytest.mark.parametrize("name", SESSIONS_REFUSED)
def test_session_that_cannot_be_opened_is_one_clear_error(
    run_dir: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_directory, "_MEMORY_FOLDERS", ())
    folder, why = SESSIONS_REFUSED[name]
    (run_dir / "file").write_text("in the way")
    with pytest.raises(BusError, match=why) as caught:
        open_session(ROBOT, name, run_dir / folder)
    assert "\n" not in str(caught.value)


MODULE = "knee_left"


class Recorded:
    """A joint service, a recorder, and a tool that shows the newest state."""

    def __init__(self, joint: Session, recorder: Session, tool: Session) -> None:
        self.states = joint.publisher(topics.JOINT_STATE, JointState, MODULE)
        self.traces = joint.publisher(topics.JOINT_TRACE, JointTrace, MODULE)
        self.batches = joint.publisher(topics.JOINT_BATCH, Batch, MODULE)
        self.shown = tool.latest_in_batch(topics.JOINT_STATE, JointState, MODULE)
        self.joint, self.recording = joint, recorder.recording()
        self.taken: list[tuple[str, int]] = []
        assert comes_true(lambda: self.traces.put(sample(JointTrace, seq=0)) and self.take())
        time.sleep(0.2)  # what was under way has come
        self.take()
        self.taken.clear()

    def take(self) -> int:
        for key, payload, _ in iter(self.recording.take, None):
            number = msgspec.json.decode(payload)["seq"]
            self.taken.append((key.rpartition("/")[2], number))
        return len(self.taken)


@pytest.fixture
def recorded(run_dir: Path) -> Iterator[Recorded]:
    with (
        open_session(ROBOT, MODULE, run_dir) as joint,
        open_session(ROBOT, "recorder", run_dir) as recorder,
        open_session(ROBOT, TOOL, run_dir) as tool,
    ):
        yield Recorded(joint, recorder, tool)


def test_a_batch_brings_each_message_to_the_record_once_in_its_order(recorded: Recorded) -> None:
    for seq in (1, 2, 3):
        recorded.states.put(sample(JointState, seq=seq))
    recorded.traces.put(sample(JointTrace, seq=1))
    recorded.states.put(sample(JointState, seq=4))
    expected = [("state", 1), ("state", 2), ("state", 3), ("trace", 1)]
    assert comes_true(lambda: recorded.take() == len(expected))
    time.sleep(0.1)
    recorded.take()
    assert recorded.taken == expected, "the fourth state waits for its trace"
    newest = recorded.shown.take()
    assert newest is not None
    assert newest.seq == 3


def test_a_batch_brings_nothing_that_its_sender_may_not_put(recorded: Recorded) -> None:
    keys = (
        topics.JOINT_COMMAND.key(ROBOT.name, MODULE),
        topics.JOINT_STATE.key(ROBOT.name, "knee_right"),
        topics.JOINT_STATE.key(ROBOT.name, MODULE),
    )
    rows = tuple((key, msgspec.Raw(encode(sample(JointState, seq=7)))) for key in keys)
    recorded.batches.put(Batch(t_ns=1, seq=1, messages=rows))
    assert comes_true(lambda: recorded.take() > 0)
    time.sleep(0.1)
    recorded.take()
    assert recorded.taken == [("state", 7)]


def test_a_message_delivered_under_another_key_is_neither_recorded_nor_shown(
    recorded: Recorded,
) -> None:
    batch = Batch(t_ns=1, seq=1, messages=())
    sent, came_as = (topics.JOINT_BATCH.key(ROBOT.name, m) for m in ("knee_right", MODULE))
    recorded.joint._session.put(came_as, encode(batch), attachment=sent.encode())
    assert comes_true(lambda: recorded.take() == 0 and recorded.recording.misdelivered == 1)
    assert comes_true(lambda: recorded.shown.take() is None and recorded.shown.refused == 1)


def test_behind_a_slow_disk_a_bounded_number_of_batches_waits(recorded: Recorded) -> None:
    for seq in range(1500):
        recorded.traces.put(sample(JointTrace, seq=seq))
        if seq % 20 == 0:
            time.sleep(0.005)  # a full queue of the sender drops, too
    time.sleep(0.3)
    assert 500 < recorded.take() <= 1000
    assert recorded.taken[-1] == ("trace", 1499)


USES_REFUSED: dict[str, Callable[[Session], object]] = {
    "harness/wrench: Estop is not its message type; use W": lambda s: s.publisher(
        topics.WRENCH, Estop
    ),
    r"joint/\*/command: '' is not a valid module": lambda s: s.latest(
        topics.JOINT_COMMAND, JointCommand
    ),
    "omit the module": lambda s: s.latest(topics.WRENCH, Wrench, "ankle_right"),
    "not in a batch": lambda s: s.latest_in_batch(topics.WRENCH, Wrench),
    "xrl//estop": lambda s: s.stream(["xrl//estop"]),
}


def test_a_session_that_cannot_listen_is_refused_and_so_is_a_wrong_type_or_module(
    run_dir: Path,
) -> None:
    with open_session(ROBOT, "planner", run_dir) as session:
        for why, use in USES_REFUSED.items():
            with pytest.raises(BusError, match=why):
                use(session)
    with pytest.raises(BusError, match="a port from 1 to 65535"):
        open_session(ROBOT, TOOL, run_dir, listen=["tcp/127.0.0.1:0"])


def test_mute_and_absent_peers_delay_neither_opening_nor_closing(run_dir: Path) -> None:
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(
            str(make_live_dir(run_dir) / "ankle_right.zenoh")
        )  # as a stopped process: never answers
        mute.listen()
        begin = time.monotonic()
        with open_session(ROBOT, "planner", run_dir) as session:
            assert session.alive() == {"planner"}
            time.sleep(0.1)  # the handshake with the mute one is under way
        assert time.monotonic() - begin < 5.0  # Zenoh's own limit for a handshake is 10 s


def test_fleet_opened_dialling_side_first_is_linked_pair_by_pair(run_dir: Path) -> None:
    names = (TOOL, "simulator", "recorder", "harness", "planner", *MODULES)
    with ExitStack() as stack:
        sessions = {n: stack.enter_context(open_session(ROBOT, n, run_dir)) for n in names}
        for name, session in sessions.items():
            expected = set(names) - (set(MODULES) - {name} if name in MODULES else set())
            shown = expected - {TOOL}
            assert comes_true(lambda s=session, e=shown: s.alive() == e), name  # type: ignore[misc]
            assert len(session._session.info.peers_zid()) == len(expected) - 1
            assert len(session._session.info.links()) == len(expected) - 1


def test_tools_that_link_are_named_with_their_place_and_are_gone_when_they_end_or_are_killed(
    run_dir: Path, start: Start
) -> None:
    waits = "with open_session(robot, sys.argv[2], run_dir):\n    time.sleep(60)"
    with open_session(ROBOT, "recorder", run_dir) as session:
        tools = session.linked_tools()
        viewer, leader = start(waits, "view"), start(waits, "lead")
        expected = {("view", str(viewer.pid)), ("lead", str(leader.pid))}

        def found() -> set[tuple[str, str]]:
            return {(n.split(".")[0], n.rsplit(".")[-1]) for n in tools.names()}

        assert comes_true(lambda: found() == expected)
        viewer.kill()
        assert comes_true(lambda: found() == {("lead", str(leader.pid))})
        leader.terminate()
        assert comes_true(lambda: tools.names() == ())
