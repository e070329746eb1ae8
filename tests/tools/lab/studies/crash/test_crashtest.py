"""`xrl study crash`: how a case is run, and what is written of it."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from shared.bus.messages import Mode, RunEvent, RunEventKind
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.tools.exit_codes import exit_code
from tools.fleet.supervisor_client import ServiceInfo
from tools.lab.studies.crash import report, runner
from tools.lab.studies.crash.cases import CASES, CrashCase, CrashVerdict, scenario_of
from tools.lab.studies.crash.outcome import CrashResult
from tools.lab.studies.crash.report import Result
from tools.live.scenario_runner import ScenarioRunner, TriggeredKill
from tools.terminal import Console
from tools.verbs.study import crash

BY_NAME = {case.name: case for case in CASES}
PLANNER = BY_NAME["kill-planner"]
KNEE = BY_NAME["kill-knee_left"]
STOOD = CrashResult(verdict=CrashVerdict.STOOD, wall_s=13.0)
FELL = CrashResult(verdict=CrashVerdict.FELL, fell_after_s=0.7, wall_s=9.0)
SANK = CrashResult(verdict=CrashVerdict.SANK, sank_mm=60.0, wall_s=13.0)
LOST = CrashResult(verdict=CrashVerdict.UNJUDGED, remarks=("no fleet",))


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

    monkeypatch.setattr(runner, "_run_once", once)
    out = tmp_path / "case"
    return runner.run_case(case, robot, out, print), list(out.glob("*.mcap"))


def test_a_disturbed_run_is_made_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    late = msgspec.structs.replace(STOOD, in_real_time=False)
    for first in (late, LOST):
        outcome, _ = run_with([first, STOOD], tmp_path, monkeypatch, robot)
        assert (outcome.verdict, outcome.in_real_time, outcome.tries) == (
            CrashVerdict.STOOD,
            True,
            2,
        )
    outcome, _ = run_with([late, late, STOOD], tmp_path, monkeypatch, robot)
    assert (outcome.in_real_time, outcome.tries) == (False, 2)


def test_a_fall_is_not_tried_again_and_keeps_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    for fell in (FELL, msgspec.structs.replace(FELL, in_real_time=False)):
        outcome, logs = run_with([fell, STOOD], tmp_path, monkeypatch, robot)
        assert (outcome.verdict, outcome.tries) == (CrashVerdict.FELL, 1)
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
    assert runner.died_of([*as_told, service("harness", up=True)], events) == []
    services = [service("harness", up=True, restarts=1), service("hip_left", up=False)]
    assert runner.died_of(services, events) == ["harness", "hip_left"]


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


RESULTS = [
    Result(PLANNER, STOOD),
    Result(KNEE, FELL),
    Result(BY_NAME["disarmed-ankle_left"], FELL),
    Result(BY_NAME["kill-harness"], LOST),
]


def test_the_exit_code_distinguishes_a_forbidden_fall_from_a_run_that_failed() -> None:
    stood, bad_fall, allowed_fall, lost = RESULTS
    assert crash.exit_code([stood, allowed_fall]) == 0
    assert crash.exit_code([stood, lost]) == 2
    assert crash.exit_code([lost, bad_fall]) == 1
    sank = Result(PLANNER, SANK)
    assert crash.exit_code([lost, sank]) == 3, "it sank, and did not fall"
    assert crash.exit_code([sank, bad_fall]) == 1


def test_json_holds_what_was_done_and_what_came_of_it(tmp_path: Path) -> None:
    report.write(RESULTS, tmp_path, {"loop": "onboard"}, planned=5)
    document = json.loads((tmp_path / report.RESULTS).read_text())
    assert document["about"] == {"loop": "onboard"}
    assert document["complete"] is False
    assert document["counts"] == {"stood": 1, "sank": 0, "fell": 2, "unjudged": 1}
    rows = {row["name"]: row for row in document["cases"]}
    assert rows["kill-knee_left"]["as_expected"] is False
    assert rows["disarmed-ankle_left"]["as_expected"] is True
    assert rows["kill-knee_left"]["fell_after_s"] == 0.7
    assert rows["kill-knee_left"]["safe_ms"] is None
    assert "knee_left KILL at 2.4 s" in rows["kill-knee_left"]["what"]
    assert set(rows["kill-knee_left"]) >= set(CrashResult.__struct_fields__)


def test_junit_distinguishes_a_failure_from_an_error_and_allows_expected_ones(
    tmp_path: Path,
) -> None:
    report.write(RESULTS, tmp_path, {"loop": "onboard"}, planned=4)
    suite = ET.parse(tmp_path / report.JUNIT).getroot().find("testsuite")  # noqa: S314 - our own
    assert suite is not None
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("4", "1", "1")
    cases = {case.get("name"): case for case in suite.findall("testcase")}
    assert [name for name in cases if cases[name].find("failure") is not None] == ["kill-knee_left"]
    assert [name for name in cases if cases[name].find("error") is not None] == ["kill-harness"]
    output = cases["kill-planner"].find("system-out")
    assert output is not None
    assert "verdict: stood" in (output.text or "")
    assert suite.find("properties/property[@name='loop']") is not None


def test_the_table_fits_a_terminal_and_has_every_case() -> None:
    console = Console(width=80, record=True, file=None, quiet=False)
    full = CrashResult(
        verdict=CrashVerdict.STOOD,
        safe_ms=123.4,
        torque_step_nm=12.34,
        torque_step_back_nm=12.34,
        leads_again_s=1.23,
        com_x_mm=(-123.0, 4.0),
        com_y_mm=(-1.0, 123.0),
    )
    report.show([Result(case, full) for case in CASES], console)
    text = console.export_text()
    assert "…" not in text
    assert all(case.name in text for case in CASES)
    assert f"{len(CASES)} of {len(CASES)} as expected or better" in text


def test_cases_are_chosen_by_name_pattern_and_length() -> None:
    chosen = crash.select(CASES, quick=False, only=["kill-planner", "disarmed-*"])
    assert [case.name for case in chosen[:2]] == ["kill-planner", "disarmed-ankle_right"]
    assert len(chosen) == 1 + len(MODULES)
    assert len(crash.select(CASES, quick=True, only=["kill-*"])) < 6
    assert crash.select(CASES, quick=False, only=()) == list(CASES)


def test_list_runs_nothing_and_names_every_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["study", "crash", "--list", "--out", tmp_path / "out"]) == 0
    printed = capsys.readouterr().out
    assert all(case.name in printed for case in CASES)
    assert not (tmp_path / "out").exists()


def test_results_that_are_there_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / report.RESULTS).write_text("kept")
    assert exit_code(["study", "crash", "--quick", "--out", tmp_path]) == 2
    assert (tmp_path / report.RESULTS).read_text() == "kept"


def test_what_was_done_before_an_interrupt_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    outcomes = [STOOD, FELL]

    def run_case(*_: object, **__: object) -> CrashResult:
        if not outcomes:
            raise KeyboardInterrupt
        return outcomes.pop(0)

    monkeypatch.setattr(crash, "run_case", run_case)
    results: list[Result] = []
    with pytest.raises(KeyboardInterrupt):
        crash._run_all(CASES, robot, 0, tmp_path, results, Console(quiet=True))
    document = json.loads((tmp_path / report.RESULTS).read_text())
    assert [row["verdict"] for row in document["cases"]] == ["stood", "fell"]
    assert document["planned"] == len(CASES)
    assert len(results) == 2


def test_a_fleet_that_cannot_be_run_ends_the_matrix_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    monkeypatch.setattr(crash, "run_case", lambda *_, **__: LOST)
    results: list[Result] = []
    with pytest.raises(RunError, match=r"3 cases in a row.*no fleet"):
        crash._run_all(CASES, robot, 0, tmp_path, results, Console(quiet=True))
    assert len(results) == 3
