"""The record of several hosts: clocks are found from its messages; records become one run."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

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
from tests.conftest import ROBOT_FILE
from tests.shared.mcap_log.runs import Queue, sample
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
    writer_of,
)
from tools.hosts.records import fleets_run, join_fetched
from tools.logs.host_clocks import OffsetBounds, offset_bounds
from tools.logs.joined_records import in_order
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, clocks_of, parts_of, read_run
from tools.sim.virtual_services import HostClock

# ---- bounds


@given(
    st.lists(st.integers(-(10**15), 10**15), min_size=2, max_size=5),
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10**7)), max_size=40),
)
def test_a_true_offset_lies_within_its_bounds_whatever_the_delays_are(
    zeros: list[int], sent: list[tuple[int, int, int]]
) -> None:
    hosts = [f"h{n}" for n in range(len(zeros))]
    heard = [
        (hosts[a], t + zeros[a], hosts[b], t + delay + zeros[b])
        for t, (a, b, delay) in enumerate(sent)
        if a < len(hosts) and b < len(hosts)
    ]
    for host, bounds in offset_bounds("h0", hosts, heard).items():
        truth = zeros[0] - zeros[hosts.index(host)]
        assert bounds.low_ns - 1.0 <= truth <= bounds.high_ns + 1.0
        if bounds.known:
            assert abs(bounds.best_ns - truth) <= bounds.high_ns - bounds.low_ns + 1.0


def test_a_host_that_hears_nothing_is_bounded_from_one_side() -> None:
    heard = [("leg", 1_000, "body", 51_000), ("leg", 2_000, "body", 62_000)]
    leg = offset_bounds("body", ("body", "leg"), heard)["leg"]
    assert not leg.known
    assert (leg.low_ns, leg.high_ns, leg.best_ns) == (-math.inf, 50_000, 50_000)


def test_two_hosts_that_talk_to_a_third_only_are_compared_by_it() -> None:
    heard = [
        ("a", 100, "via", 1_150), ("via", 1_200, "a", 250), ("b", 50, "via", 2_060),
        ("via", 2_100, "b", 110),
    ]  # fmt: skip
    bounds = offset_bounds("a", ("a", "via", "b"), heard)["b"]
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


def late_ns(log: RunLog, module: str) -> list[int]:
    """Return reception less time of each state of a module."""
    rows = log.messages(topics.JOINT_STATE, module)
    received = log.received_ns(topics.JOINT_STATE, module)
    return [at_ns - row.t_ns for at_ns, row in zip(received, rows, strict=True)]


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
        late = late_ns(log, module)
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
    with writer_of(tmp_path, robot, ROBOT_FILE.read_bytes()):
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
    late = late_ns(log, "knee_left")
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
    late = late_ns(log, "knee_left")
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
    heard = [
        ("left", 0, "body", 10_000_000), ("body", 0, "left", 100_000_000),
        ("left", 900_000_000, "body", 400_000_000),  # its host restarted
        ("right", 0, "body", 51_000_000), ("body", 0, "right", -49_500_000),
    ]  # fmt: skip
    found = offset_bounds("body", ("body", "left", "right"), heard)
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
    with writer_of(tmp_path, robot, text.encode()) as writer:
        key = topics.JOINT_STATE.key(robot.name, "knee_left")
        writer.take_from(Queue([(key, encode(sample(JointState, t_ns=t_ns, seq=1)), 7)]), 1)
    assert exit_code(["log", "info", writer.path]) == 0
    assert read_run(writer.path).count(key) == 1


# ---- records of single hosts, joined with the fleet's


def in_the_cut(one: Sent) -> bool:
    """The left leg's network is cut for 0.8 s: nothing of it arrives at the fleet's recorder."""
    return one[1] in LEG and 4 * NS_PER_S <= one[0] < 4.8 * NS_PER_S


@pytest.fixture(scope="module")
def with_a_gap(
    robot: RobotConfig, sent: list[Sent], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("gap")
    return write_record(folder, robot, sent, BODY, lost=in_the_cut)


@pytest.fixture(scope="module")
def of_the_leg(
    robot: RobotConfig, sent: list[Sent], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return write_record(tmp_path_factory.mktemp("leg"), robot, sent, LEFT, of=LEG)


def test_joined_with_a_hosts_own_record_the_fleets_has_what_a_cut_network_kept_from_it(
    record: Path,
    with_a_gap: Path,
    of_the_leg: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    lost = [key for key in topics.all_keys("xrl") if "_left/" in key]
    assert exit_code(["log", "resim", with_a_gap, "--service", "knee_left"]) == 0
    assert not re.search(r"knee_left +2810 +0 ", capsys.readouterr().out)
    assert exit_code(["log", "join", with_a_gap, of_the_leg, "--out", tmp_path / "joined"]) == 0
    assert "xrl/xrl/joint/knee_left/state: 200" in capsys.readouterr().out
    whole, joined = (
        read_run(path, as_sent=True) for path in (record, tmp_path / "joined" / "run.mcap")
    )
    for key in whole.keys():  # noqa: SIM118 - no dict
        assert [row[1] for row in joined.raw(key)] == [row[1] for row in whole.raw(key)], key
    for key in lost:
        times = zip(joined.raw(key), whole.raw(key), strict=True)
        assert all(abs(mine[0] - its[0]) < 3 * NS_PER_MS for mine, its in times)
    assert exit_code(["log", "resim", tmp_path / "joined", "--service", "knee_left"]) == 0
    assert re.search(r"knee_left +2810 +0 .*all equal", capsys.readouterr().out)
    assert exit_code(["log", "info", tmp_path / "joined" / "run.mcap"]) == 0


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 300), st.integers(0, 300)), max_size=30))
def test_joined_messages_of_a_key_are_in_the_order_in_which_they_were_sent(
    rows: list[tuple[bool, int, int]],
) -> None:
    """However late the fleet's recorder had those that it had; those keep their times."""
    own: list[tuple[int, bytes]] = []
    gained: list[tuple[int, bytes]] = []
    newest = 0
    for n, (is_gained, late, off) in enumerate(rows):
        payload = b'{"t_ns":%d,"seq":%d}' % (100 * n, n)
        if is_gained:
            gained.append((100 * n + off, payload))
        else:
            newest = max(newest, 100 * n + late)
            own.append((newest, payload))
    found = in_order(own, gained)
    assert sorted(found, key=lambda row: row[0]) == found or not own
    if own:
        assert [payload for _, payload, _ in found] == [
            b'{"t_ns":%d,"seq":%d}' % (100 * n, n) for n in range(len(rows))
        ]
    assert [(t_ns, payload) for t_ns, payload, is_new in found if not is_new] == own


def test_where_times_go_back_joined_messages_are_in_the_order_of_their_arrival() -> None:
    """The sender's host started again: its times say nothing of the order."""
    own = [(10, b'{"t_ns":900,"seq":1}'), (30, b'{"t_ns":5,"seq":1}')]
    new = [(20, b'{"t_ns":910,"seq":2}'), (40, b'{"t_ns":9,"seq":2}')]
    assert [t_ns for t_ns, _, _ in in_order(own, new)] == [10, 20, 30, 40]
    assert [t_ns for t_ns, _, _ in in_order(own, [(20, b"no message")])] == [10, 20, 30]


def test_what_is_no_hosts_record_is_not_joined(
    record: Path, of_the_leg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for first, second, why in (
        (record, record, "is no host's own record"),
        (of_the_leg, of_the_leg, "the fleet's comes first"),
        (record, tmp_path, "holds no .mcap file"),
    ):
        assert exit_code(["log", "join", first, second, "--out", tmp_path / "out"]) == 2
        assert why in capsys.readouterr().err
    assert not (tmp_path / "out" / "run.mcap").exists()


def test_a_record_of_another_time_is_not_joined(
    robot: RobotConfig,
    sent: list[Sent],
    of_the_leg: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    late = [(at_ns + 100 * NS_PER_S, *rest) for at_ns, *rest in sent]
    fleets = write_record(tmp_path, robot, late, BODY)  # type: ignore[arg-type]  # the same tuple
    assert exit_code(["log", "join", fleets, of_the_leg, "--out", tmp_path / "out"]) == 2
    assert "of another time" in capsys.readouterr().err


def test_over_hours_of_drift_no_message_is_lost_or_doubled(
    robot: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of a while in the middle were held up by a cut, and came eight seconds late."""
    drifts = HostClock(7 * NS_PER_S, 400.0)
    sent = states("knee_left", drifts, 0.0, 4_000.0, hz=1.0)
    missed = [one for n, one in enumerate(sent) if n % 7]
    begin_ns, end_ns = 1_000 * NS_PER_S, 2_000 * NS_PER_S
    late = [
        (min(at_ns + 8 * NS_PER_S, end_ns) if begin_ns < at_ns < end_ns else at_ns, *rest)
        for at_ns, *rest in missed
    ]
    fleets = write_record(tmp_path / "fleet", robot, late, BODY)  # type: ignore[arg-type]  # same
    own = write_record(tmp_path / "own", robot, sent, LEFT, of=LEG, clock=drifts)
    assert exit_code(["log", "join", fleets, own, "--out", tmp_path / "joined"]) == 0
    assert f": {len(sent) - len(missed)} messages" in capsys.readouterr().out
    key = topics.JOINT_STATE.key("xrl", "knee_left")
    seqs = [
        seq
        for log in parts_of(RunIndex(tmp_path / "joined"), part_s=500.0, margin_s=0.0)
        for t_ns, _, seq in log.raw(key)
        if log.holds(t_ns)
    ]
    assert seqs == list(range(len(sent)))


def test_a_hosts_record_of_hours_before_adds_a_second_at_most(
    robot: RobotConfig, tmp_path: Path
) -> None:
    sent = states("knee_left", CLOCKS[LEFT], 0.0, 1020.0)
    fleets = write_record(
        tmp_path / "fleet", robot, [one for one in sent if one[0] > 1000 * NS_PER_S], BODY
    )
    own = write_record(tmp_path / "own", robot, sent, LEFT, of=LEG)
    assert exit_code(["log", "join", fleets, own, "--out", tmp_path / "joined"]) == 0
    assert 20.0 < RunIndex(tmp_path / "joined").length_s < 21.2


def test_after_a_recorders_crash_the_fleets_newest_run_is_joined(
    robot: RobotConfig, sent: list[Sent], of_the_leg: Path, tmp_path: Path
) -> None:
    for folder, host, of in ((tmp_path / "body", BODY, ()), (tmp_path / "left", LEFT, LEG)):
        half = 3 * NS_PER_S
        for part in ([s for s in sent if s[0] < half], [s for s in sent if s[0] >= half]):
            write_record(folder, robot, part, host, of=of)
        assert {file.name for file in folder.iterdir()} == {"run.mcap", "run-1.mcap"}
    run = fleets_run(tmp_path / "body")
    assert [file.name for file in run.files] == ["run-1.mcap"]
    _, left_out = join_fetched(run, [tmp_path / "left"], tmp_path / "joined")
    assert len(left_out) <= 1, "the leg's first run may end before the fleet's second begins"
    joined, second = read_run(tmp_path / "joined"), read_run(run.files[0])
    key = topics.JOINT_STATE.key(robot.name, "hip_left")
    assert joined.count(key) >= second.count(key) > 0
