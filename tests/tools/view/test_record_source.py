"""Frames of a record: those of its messages, at any time, in any order."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import JointState
from shared.bus.traces import SimTruth
from shared.joints import MODULES
from tests.shared.mcap_log.runs import recorded_in_parts
from tests.tools.judge.reports.runs import changed
from tools.fleet.stalls import Stall
from tools.logs.run_log import RunLog, read_run, robot_of
from tools.view.frame import Newest
from tools.view.record import RecordFrames

LOG = Path(__file__).parents[1] / "logs" / "reexecution" / "golden" / "stand.mcap"


@pytest.fixture(scope="module")
def source(log: RunLog) -> RecordFrames:
    return RecordFrames(log, robot_of(log))


def test_a_frame_holds_the_newest_messages_at_its_time(log: RunLog, source: RecordFrames) -> None:
    truths: list[SimTruth] = log.messages(topics.SIM_TRUTH)
    states: dict[str, list[JointState]] = {
        module: log.messages(topics.JOINT_STATE, module) for module in MODULES
    }
    model = source.model
    moments = [row for row in truths if row.scenario_s >= 0.0][::7]
    assert len(moments) > 20
    for truth in reversed(moments):  # backwards: a frame depends on no other
        frame = source.at(truth.scenario_s + 1e-6)
        assert frame is not None
        assert frame.torso == pytest.approx(truth.torso, abs=1e-5)
        assert frame.is_true
        for index, module in enumerate(MODULES):
            newest = [row for row in states[module] if row.t_ns <= truth.t_ns + 1000][-1]
            shown = frame.q[2 * index : 2 * index + 2]
            assert shown == pytest.approx(newest.q, abs=1e-5)
            assert frame.modes[index] == newest.mode
    assert model.begin_s <= 0.0 < model.end_s
    assert {"kill", "push", "fault"} <= {mark.kind for mark in model.marks}


def test_a_stall_of_the_machine_is_shown_for_moments_after_it_and_marked(log: RunLog) -> None:
    zero_ns = next(row.t_ns for row in log.messages(topics.SIM_TRUTH) if row.scenario_s >= 0.0)
    event = Stall(zero_ns + 2_430_000_000, zero_ns + 2_493_000_000).event(99, zero_ns)
    more = [(event.t_ns, "run/event", msgspec.json.encode(event))]
    found = changed(log, more=more)
    source = RecordFrames(found, robot_of(found))
    shown = [source.at(t_s) for t_s in (2.4, 2.6, 3.1, 2.6)]
    words = "the machine stalled for 63 ms"
    assert [frame and frame.stall for frame in shown] == ["", words, words, words]
    assert [mark.text for mark in source.model.marks if mark.kind == "stall"] == [words]


def test_an_unfinished_record_is_shown_as_far_as_it_goes(
    log: RunLog, source: RecordFrames, tmp_path: Path
) -> None:
    content = log.path.read_bytes()
    cut = tmp_path / "run.mcap"
    cut.write_bytes(content[: round(0.7 * len(content))])
    found = read_run(cut)
    shown = RecordFrames(found, robot_of(found))
    assert 1.0 < shown.model.end_s < source.model.end_s - 0.5
    frame, same = shown.at(1.0), source.at(1.0)
    assert frame is not None
    assert frame == same


def test_the_files_of_a_split_run_are_shown_as_one(
    log: RunLog, source: RecordFrames, tmp_path: Path
) -> None:
    found = read_run(recorded_in_parts(log, tmp_path))
    shown = RecordFrames(found, robot_of(found))
    assert shown.model.end_s == source.model.end_s
    assert shown.model.marks == source.model.marks
    for t_s in (0.5, 2.0, 3.5):
        assert shown.at(t_s) == source.at(t_s)


def test_before_all_modules_were_heard_there_is_no_frame_and_behind_the_end_they_are_silent(
    source: RecordFrames,
) -> None:
    assert source.at(-1e6) is None
    frame = source.at(source.model.end_s + 10.0)
    assert frame is not None
    assert frame.modes == (-1,) * 6
    assert not any("xrl " in way for way in frame.ways_out), "there is no fleet"
    assert frame.planner is None


def test_without_a_simulated_world_pose_and_soles_are_what_the_legs_know(log: RunLog) -> None:
    """By the planner's own kinematics; the robot stands still before the scenario begins."""
    with_truth = RecordFrames(log, robot_of(log))
    without = RecordFrames(log, robot_of(log))
    without._keys = [row for row in without._keys if row[0] is not topics.SIM_TRUTH]
    known, true = without.at(-0.2), with_truth.at(-0.2)
    assert known is not None
    assert true is not None
    assert (known.is_true, known.soles_estimated) == (False, True)
    assert (true.is_true, true.soles_estimated) == (True, False)
    assert known.torso == pytest.approx(true.torso, abs=0.01)
    for estimated, measured in zip(known.soles, true.soles, strict=True):
        assert estimated.force[2] == pytest.approx(measured.force[2], rel=0.04)
        assert estimated.cop == pytest.approx(measured.cop, abs=0.005)


def test_straight_legs_say_nothing_of_the_soles(log: RunLog) -> None:
    assert Newest(robot_of(log)).estimated_soles([0.0] * 12, [1.0] * 12) == ()
