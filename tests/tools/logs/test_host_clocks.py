"""The record of several hosts: their clocks are found from the messages, and times compared."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Estop, JointEvent, JointState
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from tests.conftest import ROBOT_FILE
from tests.shared.mcap_log.runs import sample
from tests.tools.exit_codes import exit_code
from tests.tools.logs.three_hosts import (
    BODY,
    CLOCKS,
    LEFT,
    LEG,
    RIGHT,
    Sent,
    kept_up,
    on_three_hosts,
    sent_by_all,
    states,
    write_record,
)
from tools.logs.clock_offsets import ClockOffsets, OffsetBounds
from tools.logs.run_index import RunIndex
from tools.logs.run_log import clocks_of, read_run
from tools.sim.host_clock import HostClock

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
def sent(robot: RobotConfig) -> list[Sent]:
    return sent_by_all(robot, 2.0)


@pytest.fixture(scope="module")
def record(robot: RobotConfig, sent: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the fleet's record."""
    return write_record(tmp_path_factory.mktemp("fleet"), robot, sent, BODY)


def test_the_offset_of_each_host_is_found_and_how_well_it_is_known(record: Path) -> None:
    clocks = clocks_of(RunIndex(record))
    assert clocks is not None
    for host in (RIGHT, LEFT):
        truth = CLOCKS[BODY].read(5 * NS_PER_S) - CLOCKS[host].read(5 * NS_PER_S)
        ((point,),) = (life.points for life in clocks.lives[host])
        bounds = point.bounds
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
    assert (
        exit_code(["log", "resim", record, "--service", "planner", "--service", "knee_left"]) == 0
    )
    assert "all equal" in capsys.readouterr().out


def test_info_tells_the_clocks(record: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["log", "info", record]) == 0
    told = capsys.readouterr().out
    assert f"{BODY}: the recorder's (planner" in told
    for host, offset_s in ((RIGHT, 259_200.5), (LEFT, 252_000.0)):
        found = re.search(rf"{host}: ([+-][\d.]+) s to the recorder's, within ([\d.]+) ms", told)
        assert found is not None
        assert float(found[1]) == pytest.approx(offset_s, abs=0.01)
    assert exit_code(["log", "info", record, "--json"]) == 0
    left = json.loads(capsys.readouterr().out)["clocks"][LEFT]
    assert left["services"] == ["ankle_left", "knee_left", "hip_left"]
    assert left["clocks"][0]["offset_s"] == pytest.approx(252_000.0, abs=0.01)


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


# ---- clocks that start again, drift, or are heard late


def test_a_host_that_starts_again_has_two_clocks_and_all_its_times_are_right(
    robot: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = HostClock(-100 * NS_PER_S)
    sent = states("knee_left", CLOCKS[LEFT], 1.0, 80.0) + states("knee_left", again, 110.0, 200.0)
    path = write_record(tmp_path / "fleet", robot, [*sent, *kept_up(200.0)], BODY)
    log = read_run(path)
    received = log.received_ns(topics.JOINT_STATE, "knee_left")
    rows = log.messages(topics.JOINT_STATE, "knee_left")
    late = [at_ns - row.t_ns for at_ns, row in zip(received, rows, strict=True)]
    assert len(late) == 790 + 900
    assert max(map(abs, late)) < 3 * NS_PER_MS
    assert exit_code(["log", "info", path]) == 0
    assert "then it started again" in " ".join(capsys.readouterr().out.split())
    for number, those in enumerate((sent[:790], sent[790:])):
        clock = (CLOCKS[LEFT], again)[number]
        own = write_record(tmp_path / f"own{number}", robot, those, LEFT, of=LEG, clock=clock)
        assert exit_code(["log", "join", path, own, "--out", tmp_path / f"joined{number}"]) == 0
        assert ": 0 messages" in capsys.readouterr().out


def test_a_host_that_is_heard_late_is_known_from_then_on(
    robot: RobotConfig, tmp_path: Path
) -> None:
    sent = states("knee_left", CLOCKS[LEFT], 31.0, 60.0)
    log = read_run(write_record(tmp_path, robot, [*sent, *kept_up(60.0)], BODY))
    received = log.received_ns(topics.JOINT_STATE, "knee_left")
    rows = log.messages(topics.JOINT_STATE, "knee_left")
    late = [at_ns - row.t_ns for at_ns, row in zip(received, rows, strict=True)]
    assert max(map(abs, late)) < 3 * NS_PER_MS


def test_events_of_the_whole_run_do_not_bound_the_clock_at_its_begin(
    robot: RobotConfig, tmp_path: Path
) -> None:
    fast = HostClock(CLOCKS[LEFT].offset_ns, 50.0)
    sent = states("knee_left", fast, 0.0, 1800.0, hz=2.0)
    key = topics.JOINT_EVENT.key("xrl", "knee_left")
    for n, at_ns in enumerate((NS_PER_S, 1799 * NS_PER_S)):
        event = sample(JointEvent, t_ns=fast.read(at_ns), seq=n)
        sent.append((at_ns, "knee_left", key, encode(event)))
    clocks = clocks_of(RunIndex(write_record(tmp_path, robot, sent, BODY)))
    assert clocks is not None
    (life,) = clocks.lives[LEFT]
    for at_ns in (10 * NS_PER_S, 1790 * NS_PER_S):
        there_ns = CLOCKS[BODY].read(at_ns)
        truth = there_ns - fast.read(at_ns)
        assert abs(life.offset_ns(there_ns) - truth) < NS_PER_MS


def test_a_sender_whose_clock_is_not_known_has_the_times_at_which_it_was_heard(
    robot: RobotConfig, tmp_path: Path
) -> None:
    stop = sample(Estop, t_ns=5, seq=1, source="a laptop")
    sent = [(NS_PER_S, "", topics.ESTOP.key("xrl"), encode(stop)), *kept_up(3.0)]
    log = read_run(write_record(tmp_path, robot, sent, BODY))
    assert [row.t_ns for row in log.messages(topics.ESTOP)] == log.received_ns(topics.ESTOP)


def test_clocks_that_contradict_themselves_are_not_known_and_spoil_no_other() -> None:
    clocks = ClockOffsets(("body", "left", "right"))
    for sender, sent_ns, receiver, received_ns in (
        ("left", 0, "body", 10_000_000), ("body", 0, "left", 100_000_000),
        ("left", 900_000_000, "body", 400_000_000),  # its host restarted
        ("right", 0, "body", 51_000_000), ("body", 0, "right", -49_500_000),
    ):  # fmt: skip
        clocks.heard(sender, sent_ns, receiver, received_ns)
    found = clocks.against("body")
    assert not math.isfinite(found["left"].best_ns)
    assert (found["right"].low_ns, found["right"].high_ns) == (49_500_000, 51_000_000)


def test_bounds_that_are_wide_are_not_those_of_one_clock_because_they_hold_zero() -> None:
    wide = OffsetBounds(-1e6, 900e6)
    assert wide.best_ns == pytest.approx(449.5e6)
    assert wide.error_ns == pytest.approx(450.5e6)
    one = OffsetBounds(-3e6, 1e6)
    assert (one.best_ns, one.error_ns) == (0.0, 3e6)


@pytest.mark.parametrize(
    ("robot_file", "t_ns"),
    [("[" * 3000, 1), ("[bus]\nendpoints = 3", 1), ("", 2**62)],
    ids=["deeply nested", "no endpoints", "a time that no clock shows"],
)
def test_a_record_with_nonsense_in_it_is_told_of_in_words(
    robot_file: str, t_ns: int, robot: RobotConfig, tmp_path: Path
) -> None:
    text = robot_file or to_toml(on_three_hosts(robot))
    with RunWriter(
        tmp_path,
        topics.all_keys(robot.name),
        offset_ns=0,
        metadata={"run": {"schema_version": SCHEMA_VERSION, "robot": robot.name}},
        attachments={"robot.toml": text.encode()},
        chunk_kib=256,
    ) as writer:
        key = topics.JOINT_STATE.key(robot.name, "knee_left")
        rows = iter([(key, encode(sample(JointState, t_ns=t_ns, seq=1)), 7)])
        writer.take_from(SimpleNamespace(take=lambda: next(rows, None)), 1)
    assert exit_code(["log", "info", writer.path]) == 0
    assert read_run(writer.path).count(key) == 1
