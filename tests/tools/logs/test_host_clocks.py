"""The record of several hosts: all times are brought to the recorder's clock."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Estop, JointState, Message
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, side_of
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from tests.conftest import ROBOT_FILE
from tests.messages import sample
from tests.shared.mcap_log.runs import Queue
from tests.tools.exit_codes import exit_code
from tools.logs.run_log import RunLog, read_run
from tools.sim.lockstep import NOTHING_HAPPENS, Lockstep
from tools.sim.virtual_services import HostClock
from tools.topic_keys import sender_of

BODY, RIGHT, LEFT = "10.0.0.1", "10.0.0.2", "10.0.0.3"
CLOCKS = {
    BODY: HostClock(3 * 24 * 3600 * NS_PER_S),
    RIGHT: HostClock(-NS_PER_S // 2, 40.0),
    LEFT: HostClock(7_200 * NS_PER_S, -60.0),
}
"""Each against virtual time: started at another moment, and a little too fast or slow."""
HOST_OF = {"planner": BODY, "harness": BODY, "imu": BODY, "recorder": BODY} | {
    module: RIGHT if side_of(module) == "right" else LEFT for module in MODULES
}

Sent = tuple[int, str, bytes]
"""Virtual time, key, payload."""


def write_record(
    folder: Path, robot: RobotConfig, sent: Sequence[Sent], host: str = BODY, of: str = ""
) -> Path:
    """Write what a host's recorder receives, late at random and in order; `of`: a service."""
    dice, clock = random.Random(5), CLOCKS[host]
    newest: dict[str, int] = {}
    rows: list[tuple[str, bytes, int]] = []
    for at_ns, key, payload in sent:
        newest[key] = max(newest.get(key, 0), clock.read(at_ns) + dice.randrange(NS_PER_MS))
        rows.append((key, payload, newest[key]))
    rows.sort(key=lambda row: row[2])
    with writer_of(folder, robot, to_toml(on_three_hosts(robot)).encode(), of) as writer:
        writer.take_from(Queue(rows), len(rows))
    return writer.path


def writer_of(folder: Path, robot: RobotConfig, robot_file: bytes, of: str = "") -> RunWriter:
    gains = ROBOT_FILE.with_name("robot.gains.json").read_bytes()
    return RunWriter(
        folder,
        topics.recorded_keys(robot.name),
        offset_ns=1_600_000_000 * NS_PER_S,
        metadata={"run": {"schema_version": SCHEMA_VERSION, "robot": robot.name, "of": of}},
        attachments={"robot.toml": robot_file, "robot.gains.json": gains},
        chunk_kib=256,
    )


def on_three_hosts(robot: RobotConfig) -> RobotConfig:
    """Return the robot with its services' endpoints at their hosts."""
    ports = {name: f"tls/{host}:{7447 + n}" for n, (name, host) in enumerate(HOST_OF.items())}
    endpoints = {**robot.bus.endpoints, "simulator": "tls/127.0.0.1:7446", **ports}
    security = msgspec.structs.replace(robot.bus.security, mode="mtls")
    bus = msgspec.structs.replace(robot.bus, endpoints=endpoints, security=security)
    return msgspec.structs.replace(robot, bus=bus)


def states(clock: HostClock, begin_s: float, end_s: float, first: int = 0) -> list[Sent]:
    """Return ten states of the left knee in each second, stamped by a clock."""
    key = topics.JOINT_STATE.key("xrl", "knee_left")
    found: list[Sent] = []
    for n in range(round(10 * (end_s - begin_s))):
        at_ns = round((begin_s + n / 10) * NS_PER_S)
        state = sample(JointState, t_ns=clock.read(at_ns), seq=first + n)
        found.append((at_ns, key, encode(state)))
    return found


def late_ns(log: RunLog, module: str = "knee_left") -> list[int]:
    """Return reception less time of each state of a module."""
    rows = log.messages(topics.JOINT_STATE, module)
    received = log.received_ns(topics.JOINT_STATE, module)
    return [at_ns - row.t_ns for at_ns, row in zip(received, rows, strict=True)]


@pytest.fixture(scope="module")
def record(robot: RobotConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the record of a standing robot whose services read the clocks of their hosts."""
    sent: list[Sent] = []

    def put(topic: Topic, module: str, message: Message) -> None:
        sent.append((fleet.now_ns, topic.key(robot.name, module), encode(message)))

    scenario = msgspec.structs.replace(NOTHING_HAPPENS, duration=2.0)
    clocks = {name: CLOCKS[host] for name, host in HOST_OF.items()}
    fleet = Lockstep(robot, scenario, record=put, clocks=clocks, traced=True)
    for _ in fleet.run():
        pass
    return write_record(tmp_path_factory.mktemp("fleet"), robot, sent)


def test_times_of_all_hosts_are_the_recorders_and_as_sent_they_are_their_own(record: Path) -> None:
    log, sent = read_run(record), read_run(record, as_sent=True)
    for module in MODULES:
        late = late_ns(log, module)
        assert min(late[10:]) > -2 * NS_PER_MS
        assert max(late[10:]) < 6 * NS_PER_MS
        assert abs(late_ns(sent, module)[-1]) > 3600 * NS_PER_S
        own, states = (one.messages(topics.JOINT_STATE, module) for one in (sent, log))
        assert [row.q for row in own] == [row.q for row in states]
    ticks = [one.messages(topics.PLANNER_STATUS) for one in (sent, log)]
    assert ticks[0] == ticks[1], "the recorder's own host"
    assert sender_of(topics.PLANNER_STATUS) == "planner"


def test_its_services_are_executed_again_bit_for_bit(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["log", "resim", record, "--service", "planner", "--service", "knee_left"]
    assert exit_code(words) == 0
    assert "all equal" in capsys.readouterr().out


def test_a_host_that_restarts_has_another_clock_from_then_on(
    robot: RobotConfig, tmp_path: Path
) -> None:
    again = HostClock(-100 * NS_PER_S)
    sent = states(CLOCKS[LEFT], 1.0, 80.0) + states(again, 110.0, 200.0)
    late = late_ns(read_run(write_record(tmp_path, robot, sent)))
    assert len(late) == 790 + 900
    assert max(map(abs, late)) < 7 * NS_PER_MS, "clocks drift by 60 ppm"


def test_messages_that_a_cut_link_held_up_keep_their_times(
    robot: RobotConfig, tmp_path: Path
) -> None:
    rows = states(CLOCKS[LEFT], 1.0, 5.0)
    held_up = [(max(at_ns, 4 * NS_PER_S) if n >= 20 else at_ns, key, payload)
               for n, (at_ns, key, payload) in enumerate(rows)]  # fmt: skip
    late = late_ns(read_run(write_record(tmp_path, robot, held_up)))
    assert max(map(abs, late[:20])) < 3 * NS_PER_MS
    assert late[20] == pytest.approx(NS_PER_S, abs=3 * NS_PER_MS)
    assert max(map(abs, late[-8:])) < 3 * NS_PER_MS


def test_a_sender_whose_clock_is_unknown_has_the_time_of_its_reception(
    robot: RobotConfig, tmp_path: Path
) -> None:
    stop = sample(Estop, t_ns=5, seq=1, source="a laptop")
    sent = [(NS_PER_S, topics.ESTOP.key("xrl"), encode(stop))]
    log = read_run(write_record(tmp_path, robot, sent))
    assert [row.t_ns for row in log.messages(topics.ESTOP)] == log.received_ns(topics.ESTOP)


def test_a_hosts_own_record_and_one_of_one_host_have_the_times_as_sent(
    robot: RobotConfig, tmp_path: Path
) -> None:
    sent = states(CLOCKS[LEFT], 1.0, 3.0)
    own = write_record(tmp_path / "own", robot, sent, LEFT, of="knee_left")
    single = tmp_path / "single"
    with writer_of(single, robot, ROBOT_FILE.read_bytes()) as writer:
        rows = [(key, payload, 7 + n) for n, (_, key, payload) in enumerate(sent)]
        writer.take_from(Queue(rows), len(rows))
    for path in (own, single):
        logs = read_run(path), read_run(path, as_sent=True)
        assert late_ns(logs[0]) == late_ns(logs[1])


@pytest.mark.parametrize(
    ("robot_file", "t_ns"),
    [("[" * 3000, 1), ("[bus]\nendpoints = 3", 1), ("", 2**62)],
    ids=["deeply nested", "no endpoints", "a time that no clock shows"],
)
def test_a_record_with_nonsense_in_it_is_read(
    robot_file: str, t_ns: int, robot: RobotConfig, tmp_path: Path
) -> None:
    text = robot_file or to_toml(on_three_hosts(robot))
    with writer_of(tmp_path, robot, text.encode()) as writer:
        key = topics.JOINT_STATE.key(robot.name, "knee_left")
        writer.take_from(Queue([(key, encode(sample(JointState, t_ns=t_ns, seq=1)), 7)]), 1)
    assert exit_code(["log", "info", writer.path]) == 0
    assert late_ns(read_run(writer.path)) in ([7 - t_ns], [0])
