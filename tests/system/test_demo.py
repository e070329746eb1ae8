"""The real fleet, live: ten processes, a kill and a verdict. Outcomes only, no milliseconds."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.messages import Cause, PlannerStatus, Wrench
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import CHECKOUT
from tests.system.fleets import command, leaving_nothing, xrl_led
from tests.system.stalls import stalled_before_it_began
from tools.fleet import procfs
from tools.judge.stalls import stalls_of
from tools.logs.run_log import read_run

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

NOT_HERE = (topics.ESTOP, topics.HARNESS_TARE, topics.LINK_EVENT, topics.OPERATOR_HAND)
SUMMARY_KEYS = {
    "stood", "duration_s", "real_time_factor", "com_x_max_mm", "com_y_max_mm", "roll_max_rad",
    "pitch_max_rad", "yaw_max_rad", "torso_height_min_m", "torso_height_max_m",
    "operator_peak_n", "assist_error_n", "handover_ms", "handover_torque_step_nm", "reengage_s",
    "pd_cycles_late_pct", "planner_tick_us", "messages_recorded", "sequence_gaps",
    *(
        f"{phase}_{key}"
        for phase in ("alive", "hold")
        for key in ("com_x_max_mm", "com_y_max_mm", "roll_max_rad", "pitch_max_rad", "yaw_max_rad")
    ),
}  # fmt: skip


def test_a_killed_and_restarted_planner_is_survived_and_recorded(
    tmp_path: Path, robot: RobotConfig
) -> None:
    flags = ("--duration", "8", "--kill", "planner@2.2", "--restart", "planner@4")
    uphill = ("--imu", "--plant", "floor.slope=[0.05,0.0]")
    with leaving_nothing():
        result = xrl_led("demo", tmp_path, *flags, *uphill, "--push", "3:0.3:30,0,0")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "STOOD" in result.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary.keys() >= SUMMARY_KEYS
    assert summary["stood"] is True
    assert set(summary["handover_ms"]) == set(MODULES)
    assert all(value is not None for value in summary["handover_ms"].values())
    assert summary["reengage_s"] is not None
    assert (tmp_path / "run.png").stat().st_size > 20_000
    log = read_run(tmp_path / "run.mcap")
    assert log.complete
    silent = [
        key
        for key, topic in topics.all_keys(robot.name).items()
        if topic.recorded and topic not in NOT_HERE and not log.count(key)
    ]
    assert not silent
    assert log.metadata["run"]["scenario"] == "squat"
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    assert statuses[-1].slope == pytest.approx((0.05, 0.0), abs=0.02), "the IMU was heard"
    wrenches: list[Wrench] = log.messages(topics.WRENCH)
    felt = max(abs(wrench.force[2]) for wrench in wrenches if wrench.valid)
    given = max(abs(row.operator_force[2]) for row in log.messages(topics.SIM_TRUTH))
    assert felt == pytest.approx(given, rel=0.25)
    first = [log.messages(topics.JOINT_EVENT, module) for module in MODULES]
    ages_ms = [
        e.age_ns / NS_PER_MS for each in first for e in each if e.cause == Cause.COMMAND_STALE
    ]
    assert min(ages_ms) < robot.joint_service.max_command_age_ms, "its process was seen to end"
    assert {"robot.toml", "robot.gains.json", "scenario.toml", "model.xml"} <= set(log.attachments)


def test_a_robot_that_cannot_stand_is_a_finding_and_not_an_error(tmp_path: Path) -> None:
    result = xrl_led("demo", tmp_path, "--push", "1:3:0,250,0", "--duration", "6")
    assert result.returncode == 1, result.stdout + result.stderr
    assert "FELL" in result.stdout
    assert json.loads((tmp_path / "summary.json").read_text())["stood"] is False


def test_an_interrupted_demo_leaves_nothing_behind(tmp_path: Path) -> None:
    with leaving_nothing():
        process = subprocess.Popen(
            command("demo", "--out", tmp_path), cwd=CHECKOUT, stdout=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            if "modes" in line:
                break
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 130
        process.stdout.close()


def test_a_stall_of_all_services_is_told_in_line_record_and_verdict(tmp_path: Path) -> None:
    words = command("demo", "--out", tmp_path, "--duration", "5", "--kill", "planner@4.5")
    said, stopped = list[str](), False
    with (
        leaving_nothing() as mine,
        subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if not stopped and re.match(r" +[1-9]\.\d+ s ", line):
                (run_dir,) = mine()
                stop_all(run_dir, 0.12)
                stopped = True
    text = "".join(said)
    if stalled_before_it_began(process.returncode, text, tmp_path):
        pytest.skip("this machine stalled so often that the scenario could not begin")
    assert process.returncode == 0, text
    live, _, verdict = text.partition("Verdict")
    assert re.search(r"stood still for \d+ ms: all six h[eo]ld", live), text
    assert re.search(r"\d s: .* stood still for \d+ ms: all six held", verdict), text
    log = read_run(tmp_path / "run.mcap")
    pace = json.loads((tmp_path / "summary.json").read_text())["pace"]
    longest_ms = max(row.lasted_ms for row in stalls_of(log.messages(topics.RUN_EVENT)))
    assert longest_ms > pace * 100.0, "of the 120 ms, on the fleet's clock"


def stop_all(run_dir: str, for_s: float) -> None:
    """Have every service of a fleet stand still."""
    pids = procfs.service_pids(Path(run_dir)).values()
    procfs.signal_all(pids, signal.SIGSTOP)
    time.sleep(for_s)
    procfs.signal_all(pids, signal.SIGCONT)
