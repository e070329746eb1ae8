"""The fleet's record and those of single hosts become one run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.tools.exit_codes import exit_code
from tests.tools.logs.three_hosts import (
    BODY,
    CLOCKS,
    LEFT,
    LEG,
    Sent,
    sent_by_all,
    states,
    write_record,
)
from tools.hosts.records import fleets_run, join_fetched
from tools.logs.joined_records import in_order
from tools.logs.run_index import RunIndex
from tools.logs.run_log import parts_of, read_run
from tools.sim.host_clock import HostClock


@pytest.fixture(scope="module")
def sent(robot: RobotConfig) -> list[Sent]:
    return sent_by_all(robot, 2.0)


@pytest.fixture(scope="module")
def record(robot: RobotConfig, sent: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the fleet's record."""
    return write_record(tmp_path_factory.mktemp("fleet"), robot, sent, BODY)


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


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 300), st.integers(0, 300)), max_size=30),
)
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
