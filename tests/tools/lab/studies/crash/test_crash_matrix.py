"""`xrl study crash`: how a case is run, and what is written of it."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from shared.bus.messages import Mode, RunEvent, RunEventKind
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill
from shared.joints import MODULES
from tests.tools.exit_codes import exit_code as exit_code_of
from tools.fleet.supervisor_client import ServiceInfo
from tools.lab.studies.crash import matrix
from tools.lab.studies.crash.cases import CASES, CrashCase, CrashVerdict, scenario_of
from tools.lab.studies.crash.matrix import CrashResult, exit_code, row_of, select, show
from tools.lab.studies.sweeps.table import Row
from tools.live.scenario_runner import ScenarioRunner, TriggeredKill
from tools.terminal import Console

BY_NAME = {case.name: case for case in CASES}
PLANNER = BY_NAME["kill-planner"]
KNEE = BY_NAME["kill-knee_left"]
STOOD = CrashResult(verdict=CrashVerdict.STOOD, wall_s=13.0)
FELL = CrashResult(verdict=CrashVerdict.FELL, fell_after_s=0.7, wall_s=9.0)
SANK = CrashResult(verdict=CrashVerdict.SANK, sank_mm=60.0, wall_s=13.0)
LOST = CrashResult(verdict=CrashVerdict.UNJUDGED, remarks="no fleet")


def run_with(
    outcomes: list[CrashResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    robot: RobotConfig,
    case: CrashCase = PLANNER,
) -> tuple[CrashResult, list[Path]]:
    def once(case: CrashCase, robot: RobotConfig, out: Path, *rest: object) -> CrashResult:
        (out / "run.mcap").write_bytes(b"log")
        return outcomes.pop(0)

    monkeypatch.setattr(matrix, "_run_once", once)
    out = tmp_path / "case"
    return matrix.run_case(case, robot, out, print), list(out.glob("*.mcap"))


def test_a_disturbed_run_is_made_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    late = msgspec.structs.replace(STOOD, in_real_time=False)
    for first in (late, LOST):
        done, _ = run_with([first, STOOD], tmp_path, monkeypatch, robot)
        assert (done.verdict, done.in_real_time, done.tries) == (
            CrashVerdict.STOOD,
            True,
            2,
        )
    done, _ = run_with([late, late, STOOD], tmp_path, monkeypatch, robot)
    assert (done.in_real_time, done.tries) == (False, 2)


def test_a_fall_is_not_tried_again_and_keeps_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    for fell in (FELL, msgspec.structs.replace(FELL, in_real_time=False)):
        done, logs = run_with([fell, STOOD], tmp_path, monkeypatch, robot)
        assert (done.verdict, done.tries) == (CrashVerdict.FELL, 1)
        assert len(logs) == 1
    limp_ankle = BY_NAME["disarmed-ankle_left"]
    _, logs = run_with([FELL], tmp_path, monkeypatch, robot, limp_ankle)
    assert len(logs) == 1, "also where it is allowed"
    _, logs = run_with([STOOD], tmp_path, monkeypatch, robot)
    assert logs == []


def test_a_service_that_ends_by_itself_is_distinguished_from_one_that_was_killed() -> None:
    def service(name: str, *, up: bool, restarts: int = 0) -> ServiceInfo:
        return ServiceInfo(
            name=name,
            pid=7 if up else None,
            state="",
            uptime_s=1.0,
            restarts=restarts,
            last_exit="",
        )

    def done(kind: RunEventKind, name: str) -> RunEvent:
        return RunEvent(t_ns=1, seq=1, kind=int(kind), subject=name, detail="", scenario_s=1.0)

    killed, back = RunEventKind.KILLED, RunEventKind.RESTARTED
    events = [done(killed, "planner"), done(killed, "hip_left"), done(back, "hip_left")]
    as_told = [service("planner", up=False), service("hip_left", up=True, restarts=1)]
    assert matrix.died_of([*as_told, service("harness", up=True)], events) == []
    services = [service("harness", up=True, restarts=1), service("hip_left", up=False)]
    assert matrix.died_of(services, events) == ["harness", "hip_left"]


def test_what_is_chased_is_killed_once_as_the_modules_track_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = SimpleNamespace(latest=lambda *_: None, publisher=lambda *_: None)
    scenario = scenario_of(BY_NAME["reengaging-first"])
    triggered_kill = TriggeredKill("planner", modules=2, after_s=0.0)
    conductor = ScenarioRunner(None, session, scenario, print, triggered_kill)  # type: ignore[arg-type]
    killed: list[object] = []
    monkeypatch.setattr(conductor, "_act", killed.append)
    for tracking, expected in ((6, 0), (3, 0), (0, 0), (1, 0), (2, 1), (6, 1)):
        conductor._modes = dict.fromkeys(MODULES[:tracking], int(Mode.TRACK))
        conductor._follow(2.0)
        assert len(killed) == expected, tracking
    assert killed == [Kill(service="planner", at=2.0)]


def result(case: CrashCase, done: CrashResult) -> Row:
    return {**row_of(case), **msgspec.structs.asdict(done)}


def test_the_exit_code_distinguishes_a_forbidden_fall_from_a_run_that_failed() -> None:
    stood, bad_fall = result(PLANNER, STOOD), result(KNEE, FELL)
    allowed_fall = result(BY_NAME["disarmed-ankle_left"], FELL)
    lost, sank = result(BY_NAME["kill-harness"], LOST), result(PLANNER, SANK)
    assert exit_code([stood, allowed_fall]) == 0
    assert exit_code([stood, lost]) == 2
    assert exit_code([lost, bad_fall]) == 1
    assert exit_code([lost, sank]) == 3, "it sank, and did not fall"
    assert exit_code([sank, bad_fall]) == 1


def test_the_table_fits_a_terminal_and_has_every_case() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    full = CrashResult(
        verdict=CrashVerdict.STOOD, safe_ms=123.4, torque_step_nm=12.34, torque_step_back_nm=12.34,
        leads_again_s=1.23, com_x_mm=-123.0, com_y_mm=123.0,
    )  # fmt: skip
    show([result(case, full) for case in CASES], console)
    text = console.export_text()
    assert "…" not in text
    assert all(case.name in text for case in CASES)
    assert f"{len(CASES)} of {len(CASES)} as expected or better" in text


def test_cases_are_chosen_by_name_pattern_and_length() -> None:
    chosen = select(CASES, quick=False, only=["kill-planner", "disarmed-*"])
    assert [case.name for case in chosen[:2]] == ["kill-planner", "disarmed-ankle_right"]
    assert len(chosen) == 1 + len(MODULES)
    assert len(select(CASES, quick=True, only=["kill-*"])) < 6
    assert select(CASES, quick=False, only=()) == list(CASES)


def test_list_runs_nothing_and_names_every_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code_of(["study", "crash", "--list", "--out", tmp_path / "out"]) == 0
    printed = capsys.readouterr().out
    assert all(case.name in printed for case in CASES)
    assert not (tmp_path / "out").exists()


def test_an_interrupted_matrix_keeps_its_cases_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = [STOOD, FELL]

    def run_case(*_: object, **__: object) -> CrashResult:
        if not outcomes:
            raise KeyboardInterrupt
        return outcomes.pop(0)

    monkeypatch.setattr(matrix, "run_case", run_case)
    words = ["study", "crash", "--only", "kill-*_right", "--out", tmp_path / "out"]
    assert exit_code_of(words) == 130
    assert "stopped; 2 of 3 cases are in" in " ".join(capsys.readouterr().out.split())
    outcomes += [STOOD]
    assert exit_code_of(words) == 1, "one of the first two fell"
    assert "2 of 3 as expected or better: 2 stood, 1 fell" in capsys.readouterr().out


def test_a_fleet_that_cannot_be_run_ends_the_matrix_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(matrix, "run_case", lambda *_, **__: LOST)
    assert exit_code_of(["study", "crash", "--quick", "--out", tmp_path / "out"]) == 2
    assert "3 cases in a row cannot be judged: no fleet" in capsys.readouterr().err
