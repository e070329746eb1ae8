"""The push envelope: a grid that is what was asked for, a bisection, a picture with its limits."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import msgspec
import pytest

from services.simulator.physics.plant import PlantConfig
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools import cli
from tools.lab.studies.sweeps import push, push_trial
from tools.lab.studies.sweeps.push_trial import (
    PushResult,
    PushTrial,
    limits_of,
    run_trial,
    scenario_of,
)


def asked(**changes: object) -> argparse.Namespace:
    given: dict[str, object] = {"pose": None, "angle": None, "duration": None}
    return argparse.Namespace(**(given | changes))


def point(**changes: object) -> PushTrial:
    given: dict[str, object] = {
        "number": 0, "pose": "squat", "angle_deg": 90, "duration_s": 3.0, "mode": "dead",
    }  # fmt: skip
    return PushTrial(**(given | changes))  # type: ignore[arg-type]  # as the fields are


def test_the_grid_has_every_pose_duration_angle_and_mode_once() -> None:
    trials = push.trials_of(asked())
    assert len(trials) == len({(t.pose, t.duration_s, t.angle_deg, t.mode) for t in trials})
    assert len(trials) == 3 * 2 * 5 * 2
    some = push.trials_of(asked(pose=["crawl"], angle=[0, 90], duration=[1.0]))
    assert {(t.pose, t.duration_s) for t in some} == {("crawl", 1.0)}
    assert [t.number for t in some] == list(range(4))


def test_a_duration_of_nothing_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["study", "sweep", "push", "--duration", "0"]) == 2
    assert "--duration 0" in capsys.readouterr().err


@pytest.mark.parametrize("falls_from", [3.0, 100.0, 1e9])
def test_the_bisection_finds_the_force_within_its_step(
    falls_from: float, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(push_trial, "_start_of", lambda *_: None)
    monkeypatch.setattr(push_trial, "_stands", lambda _t, _r, _p, _s, force: force < falls_from)
    outcome = run_trial(point(), robot, PlantConfig())
    if falls_from > push_trial.FORCE_MAX_N:
        assert outcome.fell_n is None
        assert outcome.stood_n >= push_trial.FORCE_MAX_N - push_trial.STEP_N
    else:
        assert outcome.fell_n is not None
        assert outcome.stood_n < falls_from <= outcome.fell_n
        assert outcome.fell_n - outcome.stood_n <= push_trial.STEP_N


@pytest.mark.parametrize("pose", push_trial.POSES)
@pytest.mark.parametrize("angle", push.ANGLES_DEG)
def test_no_mode_holds_more_than_the_body_bears(pose: str, angle: int, robot: RobotConfig) -> None:
    limits = limits_of(point(pose=pose, angle_deg=angle), robot)
    assert 0.0 < limits.held.force_n <= limits.body.force_n
    assert 0.0 < limits.drives.force_n <= limits.body.force_n


def test_a_robot_without_a_schedule_is_refused(robot: RobotConfig) -> None:
    with pytest.raises(RunError, match="xrl gains"):
        limits_of(point(), msgspec.structs.replace(robot, gain_schedule=None))


def test_with_the_planner_dead_a_lasting_push_from_the_side_is_stood(robot: RobotConfig) -> None:
    """30 N for 3 s made it fall; the certificate read 1.08."""
    trial, plant = point(pose="stand"), PlantConfig()
    start = push_trial._start_of(trial, robot, plant)
    assert start.planner is None
    assert push_trial._stands(trial, robot, plant, start, 50.0)
    assert not push_trial._stands(trial, robot, plant, start, 150.0), "it can fall here"


def test_the_push_is_in_the_direction_that_was_asked_for() -> None:
    x, y, _ = scenario_of(point(angle_deg=180), 40.0).push[0].force
    assert (x, y) == pytest.approx((-40.0, 0.0), abs=1e-9)
    assert scenario_of(point(mode="led"), 40.0).kill == ()


def test_a_table_is_drawn_with_both_modes_and_the_limits(tmp_path: Path) -> None:
    trials = push.trials_of(asked(pose=["stand", "crawl"]))
    outcome = PushResult(
        stood_n=50.0, fell_n=55.0, held_limit_n=40.0, held_part="left sole's toe", body_limit_n=90.0
    )
    rows = [
        {key: str(value) for key, value in push._rows((trial, None, None), outcome)[0].items()}  # type: ignore[arg-type]
        for trial in trials
    ]
    push.draw(rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 30_000


def test_a_study_of_one_point_is_tabled_and_goes_on(tmp_path: Path) -> None:
    words = ["study", "sweep", "push", "--pose", "squat", "--angle", "90", "--duration", "0.3"]
    out = tmp_path / "push"
    assert cli.main([*words, "--workers", "2", "--out", str(out)]) == 0
    with (out / push.TABLE).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["mode"] for row in rows] == ["led", "dead"]
    assert all(float(row["stood_n"]) > 20.0 for row in rows)
    stamp = (out / push.TABLE).read_bytes()
    assert cli.main([*words, "--workers", "2", "--out", str(out)]) == 0
    assert (out / push.TABLE).read_bytes() == stamp
