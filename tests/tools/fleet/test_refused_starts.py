"""Words of `xrl up` and `xrl demo` that make no sense: a line, and no fleet."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import FleetError
from tests.tools.exit_codes import exit_code
from tools.fleet.supervise import SupervisedFleet

REFUSED = {
    "up": [
        (["--only", "knee"], "no service 'knee'; one of simulator, ankle_right"),
        (["--only", " , "], "--only names no service"),
        (["--only", "planner", "--scenario", "squat"], "--only starts none"),
        (["--only", "planner", "--snapshot", "5"], "--snapshot is for the recorder"),
        (["--only", "recorder", "--injectable"], "--injectable is for the planner"),
        (["--no-sim", "--scenario", "squat"], "--no-sim starts none"),
    ],
    "demo": [
        (["--scenario", "flight"], "no scenario 'flight'"),
        (["--kill", "plannner@3"], "services:"),
        (["--kill", "planner@3:BLINK"], "signals:"),
        (["--kill", "planner@30"], "not inside the run"),
        (["--restart", "planner@3"], "kill it first"),
        (["--push", "1:2:3"], "START:DURATION:FX,FY,FZ"),
        (["--duration", "0"], "a number of at least 0.001 s"),
        (["--config", "no_such.toml"], "not found"),
    ],
}


@pytest.mark.parametrize(
    ("verb", "words", "said"), [(verb, *row) for verb, rows in REFUSED.items() for row in rows]
)
def test_what_does_not_go_together_is_refused_and_nothing_is_started(
    verb: str, words: list[str], said: str, run_dir: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    place = ["--run-dir", run_dir] if verb == "up" else ["--out", run_dir]
    monkeypatch.setattr(SupervisedFleet, "start", None)
    assert exit_code([verb, *place, *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not run_dir.exists() or not list(run_dir.iterdir())


@pytest.mark.parametrize(("service", "recorded"), [("recorder", True), ("planner", False)])
def test_a_host_without_a_recorder_gets_no_folder_for_a_record(
    service: str, recorded: bool, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise FleetError("it is not to be started here")

    monkeypatch.setattr(SupervisedFleet, "start", fail)
    out = tmp_path / "out"
    assert exit_code(["up", "--run-dir", run_dir, "--out", out, "--only", service]) == 2
    assert out.exists() is recorded
