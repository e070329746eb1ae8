"""`xrl drive identify`: on a record with planted errors, and what it refuses."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.joints import MODULES
from tests.conftest import ROBOT_FILE
from tests.tools.exit_codes import exit_code

ZEROS = dict(zip(MODULES, (0.004, -0.01, 0.012, -0.004, 0.009, -0.008), strict=True))
"""rad of theta."""
PLANTED = (
    "drive.torque_scale=1.05", "body.payload_scale=0.88", "body.com_offset=[0.012,-0.01,0.02]",
    f"encoder.zero_errors=[{','.join(f'0,{error}' for error in ZEROS.values())}]",
)  # fmt: skip
PAYLOAD = 0.88 * 20.4
TORSO = PAYLOAD + 39.66 - 20.4
STAND = Path(__file__).parents[1] / "logs" / "reexecution" / "golden" / "stand.mcap"
"""A second of a stand."""


def test_what_was_planted_is_found_within_its_interval_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By a record of the motions, in lockstep, on the realistic plant."""
    lab, run, fit = tmp_path / "lab.toml", tmp_path / "run", tmp_path / "fit"
    lab.write_bytes(ROBOT_FILE.read_bytes())
    before = config_file.load_without_schedule(lab)
    plants = [word for key in PLANTED for word in ("--plant", key)]
    assert exit_code(["sim", "--scenario", "identify", *plants, "--out", run]) == 0, "it stood"
    words = ["drive", "identify", "body", run, "--config", lab, "--apply", "--out", fit]
    assert exit_code(words) == 0
    told = capsys.readouterr().out
    rows = {
        match[1].strip(): (float(match[2]), float(match[3]))
        for match in re.finditer(r"^ *(\S.*?)  +[\d.-]* +(-?[\d.]+) +± ([\d.]+)", told, re.M)
    }
    at = [TORSO / PAYLOAD * by for by in (0.012, -0.01, 0.02)]
    truth = {"payload": PAYLOAD, "torque constant": 1.05 * before.drive.torque_constant}
    truth |= {f"payload's centre {axis}": place for axis, place in zip("xyz", at, strict=True)}
    truth |= {f"harness point {axis}": r for axis, r in zip("xyz", (0.08, 0.0, 0.0), strict=True)}
    truth |= {f"zero {joint}_theta": error for joint, error in ZEROS.items()}
    for name, value in truth.items():
        found, half_width = rows[name]
        assert abs(found - value) <= half_width, (name, found, half_width, value)
    after = config_file.load_without_schedule(lab)
    assert after.mass.payload == pytest.approx(PAYLOAD, abs=1.0)
    assert after.mass.payload_com[0] == pytest.approx(at[0], abs=0.01)
    assert after.drive.torque_constant == pytest.approx(1.05 * 0.0827, rel=0.03)
    assert "drive.torque_constant" not in after.assumed
    assert len(list(tmp_path.glob("lab.toml.*.bak"))) == 1
    assert (fit / "identify.png").stat().st_size > 10_000
    assert "xrl gains --config" in told
    assert re.search(r"xrl drive zero knee_right --by -?0\.0\d+,0\.0(0[89]|1[012])", told)


def test_a_dry_run_shows_the_motions_and_needs_no_robot(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert exit_code(["drive", "identify", "body", "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert "law.shift_max" in told
    assert "1.188" in told


def test_a_record_without_slow_motion_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert exit_code(["drive", "identify", "body", STAND]) == 2
    assert "quasi-static moments" in capsys.readouterr().err
