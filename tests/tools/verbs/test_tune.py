"""`xrl drive tune`: in virtual time, and what it refuses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from services.simulator.physics.plant import IDEAL, PlantConfig
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tests.conftest import ROBOT_FILE
from tests.tools.exit_codes import exit_code
from tools.bringup.tune import excitation
from tools.bringup.tune.excitation import Excitation
from tools.bringup.tune.pose_probe import ProbeCourse
from tools.verbs.drive import tune


def test_a_direction_is_measured_beside_the_model_and_gains_are_proposed_that_do_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(excitation, "FREQUENCIES_HZ", (0.4, 0.6, 0.9, 1.2))
    monkeypatch.setattr(excitation, "CYCLES", 2)
    monkeypatch.setattr(excitation, "SHORTEST_S", 1.0)
    words = "drive tune x --sim --bandwidth 7 --damping 0.6 --out"
    assert exit_code([*words.split(), tmp_path]) == 0
    told = capsys.readouterr().out
    rows = {
        match[1].strip(): [float(one) for one in match[2].split()]
        for match in re.finditer(r"^(\w[\w ,]*?)  +((?:[\d.]+ +)+)", told, re.M)
    }
    measured, predicted, proposed = rows["natural frequency"]
    assert 3.0 < measured < 8.0
    assert 3.0 < predicted < 9.0
    assert abs(proposed - 7.0) < abs(measured - 7.0), "nearer to what was wanted"
    before, _, after = rows["overshoot"]
    assert after < before
    assert re.search(r"K_p = \[\d+\.\d, 2810\.0, 0\.0, 800\.0, 0\.0, 400\.0\]", told)
    assert (tmp_path / "tune.png").stat().st_size > 10_000


def test_a_robot_file_may_forbid_probes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = ROBOT_FILE.read_text(encoding="utf-8")
    probes = list(config_file.load_without_schedule(ROBOT_FILE).law.probe_max)
    path = tmp_path / "lab.toml"
    path.write_text(text.replace(f"probe_max = {probes}", "probe_max = [0, 0, 0, 0, 0, 0]"))
    schedule = ROBOT_FILE.with_suffix(".gains.json").read_bytes()
    path.with_suffix(".gains.json").write_bytes(schedule)
    assert exit_code(["drive", "tune", "x", "--dry-run", "--config", path]) == 2
    assert "forbids it" in capsys.readouterr().err


def test_a_dry_run_tells_the_motion_and_moves_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["drive", "tune", "roll", "--dry-run"]) == 0
    assert "0.016 rad" in capsys.readouterr().out


def test_a_simulation_that_fails_leaves_what_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def falls(
        _robot: RobotConfig, _row: int, plan: Excitation, plant: PlantConfig, *_rest: object
    ) -> ProbeCourse:
        if plant is IDEAL:
            raise RunError("the robot fell in lockstep")
        t = np.arange(0.0, plan.duration_s, 0.004)
        r = np.array([plan.offset(one) for one in t])
        _, y, _ = signal.lsim(([36.0], [1.0, 6.0, 36.0]), r, t)
        return ProbeCourse(t, r, np.asarray(y), "")

    monkeypatch.setattr(tune, "in_lockstep", falls)
    assert exit_code(["drive", "tune", "roll", "--sim", "--out", tmp_path]) == 0
    told = capsys.readouterr().out
    assert "predicted: the robot fell in lockstep" in told
    assert "natural frequency" in told
    assert (tmp_path / "tune.png").exists()


def test_a_reference_that_was_not_offset_is_said_so() -> None:
    """A planner that was started before law.probe_max was set echoes the request only."""
    plan = excitation.excitation(0.01)
    t = 0.004 * np.arange(10_000)
    with pytest.raises(RunError, match="did not offset"):
        tune._answer(ProbeCourse(t, 0.0 * t, 0.0 * t, ""), plan)
    with pytest.raises(RunError, match="did not offset"):
        tune._answer(ProbeCourse(t[:0], t[:0], t[:0], ""), plan)
