"""The record of several hosts: their clocks are found from the messages, and times compared."""

from __future__ import annotations

import json
import math
import random
import re
from collections import deque
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from shared.robot.joints import MODULES, side_of
from tests.conftest import ROBOT_FILE
from tests.tools.exit_codes import exit_code
from tools.runs.clock_offsets import ClockOffsets
from tools.runs.host_clock import HostClock
from tools.runs.lockstep import Lockstep
from tools.runs.run_index import RunIndex
from tools.runs.run_log import clocks_of, read_run
from tools.runs.standing_start import NOTHING_HAPPENS

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


# ---- bounds


@given(
    st.lists(st.integers(-(10**15), 10**15), min_size=2, max_size=5),
    st.lists(
        st.tuples(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**7)),
        max_size=40,
    ),
)
def test_a_true_offset_lies_within_its_bounds_whatever_the_delays_are(
    zeros: list[int], sent: list[tuple[int, int, int]]
) -> None:
    hosts = tuple(f"h{n}" for n in range(len(zeros)))
    clocks = ClockOffsets(hosts)
    for t, (a, b, delay) in enumerate(sent):
        if a < len(hosts) and b < len(hosts):
            clocks.heard(hosts[a], t + zeros[a], hosts[b], t + delay + zeros[b])
    for host, bounds in clocks.against("h0").items():
        truth = zeros[0] - zeros[hosts.index(host)]
        assert bounds.low_ns - 1.0 <= truth <= bounds.high_ns + 1.0
        if bounds.known:
            assert abs(bounds.best_ns - truth) <= bounds.high_ns - bounds.low_ns + 1.0


def test_a_host_that_hears_nothing_is_bounded_from_one_side() -> None:
    clocks = ClockOffsets(("body", "leg"))
    clocks.heard("leg", 1_000, "body", 51_000)
    clocks.heard("leg", 2_000, "body", 62_000)
    leg = clocks.against("body")["leg"]
    assert not leg.known
    assert (leg.low_ns, leg.high_ns, leg.best_ns) == (-math.inf, 50_000, 50_000)


def test_two_hosts_that_talk_to_a_third_only_are_compared_by_it() -> None:
    clocks = ClockOffsets(("a", "via", "b"))
    for sender, sent_ns, receiver, received_ns in (
        ("a", 100, "via", 1_150), ("via", 1_200, "a", 250), ("b", 50, "via", 2_060),
        ("via", 2_100, "b", 110),
    ):  # fmt: skip
        clocks.heard(sender, sent_ns, receiver, received_ns)
    bounds = clocks.against("a")["b"]
    assert bounds.low_ns <= 2_010 - 1_000 <= bounds.high_ns
    assert bounds.known


# ---- a record of three hosts


@pytest.fixture(scope="module")
def record(robot: RobotConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the record of a robot on three hosts, in virtual time, in random network delays."""
    folder = tmp_path_factory.mktemp("hosts")
    ports = {name: f"tls/{host}:{7447 + n}" for n, (name, host) in enumerate(HOST_OF.items())}
    bus = msgspec.structs.replace(
        robot.bus,
        endpoints={**robot.bus.endpoints, "simulator": "tls/127.0.0.1:7446", **ports},
        security=msgspec.structs.replace(robot.bus.security, mode="mtls"),
    )
    queue: deque[tuple[str, bytes, int]] = deque()
    dice = random.Random(5)

    def put(topic: Topic, module: str, message: Message) -> None:
        late_ns = dice.randrange(NS_PER_MS)
        key = topic.key(robot.name, module)
        queue.append((key, encode(message), CLOCKS[BODY].read(fleet.now_ns) + late_ns))

    class Source:
        def take(self) -> tuple[str, bytes, int] | None:
            return queue.popleft() if queue else None

    scenario = msgspec.structs.replace(NOTHING_HAPPENS, duration=2.0)
    fleet = Lockstep(
        robot, scenario, record=put, clocks={name: CLOCKS[HOST_OF[name]] for name in HOST_OF}
    )
    for _ in fleet.run():
        pass
    ready = sorted(queue, key=lambda row: row[2])
    queue.clear()
    queue.extend(ready)
    with RunWriter(
        folder,
        topics.all_keys(robot.name),
        offset_ns=0,
        metadata={"run": {"schema_version": SCHEMA_VERSION, "robot": robot.name}},
        attachments={
            "robot.toml": to_toml(msgspec.structs.replace(robot, bus=bus)).encode(),
            "robot.gains.json": ROBOT_FILE.with_name("robot.gains.json").read_bytes(),
        },
        chunk_kib=256,
    ) as writer:
        writer.take_from(Source(), len(queue))
    return writer.path


def test_the_offset_of_each_host_is_found_and_how_well_it_is_known(record: Path) -> None:
    clocks = clocks_of(RunIndex(record))
    assert clocks is not None
    (found,) = clocks.looks
    for host in (RIGHT, LEFT):
        truth = CLOCKS[BODY].read(5 * NS_PER_S) - CLOCKS[host].read(5 * NS_PER_S)
        bounds = found.bounds[host]
        assert bounds.known
        assert bounds.error_ns < 3 * NS_PER_MS
        assert abs(bounds.best_ns - truth) < bounds.error_ns + 0.5 * NS_PER_MS


def test_times_of_all_hosts_are_the_recorders_and_as_sent_they_are_their_own(record: Path) -> None:
    log, sent = read_run(record), read_run(record, as_sent=True)
    for module in MODULES:
        received = log.received_ns(topics.JOINT_STATE, module)
        states = log.messages(topics.JOINT_STATE, module)
        late = [at_ns - row.t_ns for at_ns, row in zip(received, states, strict=True)]
        assert min(late[10:]) > -2 * NS_PER_MS
        assert max(late[10:]) < 6 * NS_PER_MS
        own = sent.messages(topics.JOINT_STATE, module)
        assert abs(own[-1].t_ns - received[-1]) > 3600 * NS_PER_S
        assert [row.q for row in own] == [row.q for row in states]


def test_its_services_are_executed_again_bit_for_bit(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["resim", record, "--service", "planner", "--service", "knee_left"]) == 0
    assert "all equal" in capsys.readouterr().out


def test_info_tells_the_clocks(
    record: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    assert exit_code(["info", record]) == 0
    told = capsys.readouterr().out
    assert f"{BODY}: the recorder's (planner" in told
    for host, offset_s in ((RIGHT, 259_200.5), (LEFT, 252_000.0)):
        found = re.search(rf"{host}: ([+-][\d.]+) s to the recorder's, within ([\d.]+) ms", told)
        assert found is not None
        assert float(found[1]) == pytest.approx(offset_s, abs=0.01)
    assert exit_code(["info", record, "--json"]) == 0
    left = json.loads(capsys.readouterr().out)["clocks"][LEFT]
    assert left["services"] == ["ankle_left", "knee_left", "hip_left"]
    assert left["offset_s"] == pytest.approx(252_000.0, abs=0.01)


def test_on_one_host_nothing_is_compared(tmp_path: Path, robot: RobotConfig) -> None:
    with RunWriter(
        tmp_path,
        topics.all_keys(robot.name),
        offset_ns=0,
        metadata={"run": {"schema_version": SCHEMA_VERSION, "robot": robot.name}},
        attachments={"robot.toml": ROBOT_FILE.read_bytes()},
        chunk_kib=256,
    ):
        pass
    assert clocks_of(RunIndex(tmp_path)) is None
