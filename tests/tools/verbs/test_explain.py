"""`xrl log explain`: one tick of a run laid open."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.messages import JointState, PlannerStatus
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import JOINTS, MODULES, N_JOINTS
from tests.tools.logs.reexecution.executions import edited
from tools import cli
from tools.judge.run_parts import zero_ns
from tools.lab.design.torque_breakdown import torque_breakdown
from tools.logs.run_log import RunLog, robot_of
from tools.terminal import Console
from tools.verbs.log import explain


@pytest.mark.parametrize("at_s", [0.3, 0.9, 2.4, 3.0])
def test_a_tick_recomputed_from_the_log_is_the_tick_that_was_sent(log: RunLog, at_s: float) -> None:
    tick = explain.tick_at(log, at_s, zero_ns(log.index))
    robot = robot_of(log)
    q, v = (np.array([getattr(s, n) for s in tick.states]).ravel() for n in ("q", "v"))
    commands = {
        name: np.array([getattr(command, name) for command in tick.commands]).ravel()
        for name in ("q_ref", "v_ref", "tau_ff", "k_p", "k_d")
    }
    status = tick.status
    q_ref, v_ref = commands["q_ref"], commands["v_ref"]
    found = torque_breakdown(
        robot, q, v, q_ref, v_ref, status.assist_n, status.slope, status.stance
    )
    np.testing.assert_allclose(found.p, tick.status.p, rtol=0.0, atol=2e-5)  # rounded
    np.testing.assert_allclose(found.gravity + found.assist, commands["tau_ff"], atol=0.05)
    np.testing.assert_allclose(found.local.D, commands["k_p"], rtol=0.01)
    np.testing.assert_allclose(found.local.D_B, commands["k_d"], rtol=0.01)
    assert found.local.margins.service == pytest.approx(tick.status.margin, rel=0.01)
    assert found.local.margins.onboard == pytest.approx(tick.status.margin_onboard, rel=0.01)


def test_the_tick_is_the_last_at_or_before_the_time(log: RunLog) -> None:
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    zero = zero_ns(log.index)
    early, late = (explain.tick_at(log, at_s, zero).status for at_s in (0.8, 0.804))
    assert late.seq == early.seq + 1
    assert explain.tick_at(log, None, zero).status == statuses[-1]


@pytest.mark.parametrize(
    ("at", "words"),
    [
        ("0.3", "network: not impaired at this time"),
        ("0.6", "network: planner->joints delay=25ms, 0.40 to 1.00 s"),
        ("1.8", "network: all partition, 1.50 to 1.90 s"),
    ],
)
def test_the_impairments_at_the_tick_are_reported(
    impaired: RunLog, at: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["log", "explain", str(impaired.path), "--at", at]) == 0
    assert words in capsys.readouterr().out


def test_the_age_of_each_command_is_reported(
    impaired: RunLog, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["log", "explain", str(impaired.path), "--at", "0.6"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for module in MODULES:
        found = re.search(rf"{module} TRACK (\d+\.\d) ms", shown)
        assert found is not None
        assert 25.0 <= float(found[1]) < 37.0


def test_where_the_planner_did_not_tick_the_modules_are_described_as_they_were_then(
    impaired: RunLog, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["log", "explain", str(impaired.path), "--at", "1.8"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "the planner did not tick at 1.8 s" in shown
    assert re.search(r"The modules at 1.8 s: ankle_right HOLD 30\d\.\d ms", shown)


def test_the_torques_by_origin_of_every_joint_are_printed(
    log: RunLog, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["log", "explain", str(log.path), "--at", "0.9"]) == 0
    shown = capsys.readouterr().out
    for joint in JOINTS:
        rows = re.findall(rf"^ ?{joint} +(.*)$", shown, re.MULTILINE)
        assert [len(row.split()) for row in rows] == [4, 6]
        *parts, total = map(float, rows[1].split())
        assert sum(parts) == pytest.approx(total, abs=0.04)
    assert "planner LEADING" in shown
    assert re.search(r"margin, joint services alone: \d\.\d\d; weakest: \w+", shown)
    assert re.search(r"push sideways: led \d+ N \(.+\), planner dead \d+ N", shown)


def test_a_time_without_ticks_names_the_times_with_some(
    log: RunLog, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["log", "explain", str(log.path), "--at", "60"]) == 2
    assert re.search(r"within the planner's ticks, -?\d", capsys.readouterr().err)


def test_a_tick_with_a_missing_state_names_the_nearest_complete_one(log: RunLog) -> None:
    zero = zero_ns(log.index)
    lost = explain.tick_at(log, 0.9, zero)
    lacking = edited(
        log, topics.JOINT_STATE, MODULES[2], lambda row: None if row == lost.states[2] else row
    )
    with pytest.raises(RunError, match=r"the nearest complete tick is at 0\.(89|90)\d s") as error:
        explain.tick_at(lacking, 0.9, zero)
    (nearest,) = re.findall(r"nearest complete tick is at (\S+) s", str(error.value))
    assert explain.tick_at(lacking, float(nearest), zero).status.seq in (
        lost.status.seq - 1, lost.status.seq + 1
    )  # fmt: skip


def test_a_state_of_a_restarted_module_with_the_same_number_is_not_taken(log: RunLog) -> None:
    zero = zero_ns(log.index)
    tick = explain.tick_at(log, 0.9, zero)
    last: JointState = log.messages(topics.JOINT_STATE, MODULES[2])[-1]
    again = msgspec.structs.replace(last, seq=tick.states[2].seq)
    restarted = edited(
        log, topics.JOINT_STATE, MODULES[2], lambda row: again if row is last else row
    )
    assert explain.tick_at(restarted, 0.9, zero).states == tick.states


@settings(max_examples=20)
@given(q=st.lists(st.floats(-2 * math.pi, 2 * math.pi), min_size=N_JOINTS, max_size=N_JOINTS))
@example(q=[2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0, 0.0])
def test_every_pose_within_a_turn_is_explained_or_called_singular(
    robot: RobotConfig, q: list[float]
) -> None:
    angles, still, said = np.array(q), np.zeros(N_JOINTS), "singular pose"
    try:
        found = torque_breakdown(robot, angles, still, angles, still, 0.0)
        explain.show(robot, found, Console(quiet=True))
    except RunError as error:
        said = str(error)
    assert "singular pose" in said
