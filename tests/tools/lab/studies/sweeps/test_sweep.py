"""`xrl study`: what the one runner does for every study, and the verb around it."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from tests.tools.lab.studies.sweeps.tables import finished, printed, rows_of, run_cases_here, sweep
from tests.waiting import comes_true
from tools import cli
from tools.lab.studies.sweeps import certificate, kill, latency, push_trial, study
from tools.lab.studies.sweeps.figures import Ending, worst
from tools.lab.studies.sweeps.kill_trial import KillCases
from tools.lab.studies.sweeps.report import wilson
from tools.lab.studies.sweeps.table import Row, code_of
from tools.verb_table import Verb

KILL = ("kill", "--split", "diagonal")
"""The paper's split needs no gain schedule."""
CERTIFICATE = ("certificate", "--rigid")
"""The study whose cases take the least time."""


def _certificate_was_right(row: Mapping[str, str]) -> bool:
    return (float(row["margin"]) > 0.0) == (row["stood"] == "True")


@pytest.mark.usefixtures("on_its_feet")
@pytest.mark.parametrize(
    ("flags", "numbers", "true", "words", "other"),
    [
        (
            (*CERTIFICATE, "--n", "1"), 1, _certificate_was_right,
            "said to fall", ("--seed", "2"),
        ),
        (("dynamics", "--n", "1"), 1, lambda _row: True, "said to fade", ("--seed", "2")),
        (
            ("push", "--pose", "squat", "--angle", "90", "--duration", "0.3"), 2,
            lambda row: row["mode"] == ("led", "dead")[int(row["number"])]
            and float(row["stood_n"]) > 20.0,
            "gives way", ("--plant", "ideal"),
        ),
        (
            ("trips", "--trouble", "drops", "--on", "rigid"), 1,
            lambda row: row["tripped"] == "SAGGING",
            "led down by 0.39 m in 0.3 s", ("--trouble", "sags"),
        ),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) and len(value) > 2 else "",
)  # fmt: skip
def test_a_study_is_tabled_drawn_gone_on_with_and_another_is_refused_in_its_folder(
    flags: tuple[str, ...],
    numbers: int,
    true: Callable[[Mapping[str, str]], bool],
    words: str,
    other: tuple[str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_cases_here(monkeypatch)
    monkeypatch.setattr(push_trial, "STEP_N", 80.0)
    assert sweep(*flags, "--out", tmp_path) == 0
    assert words in capsys.readouterr().out
    (path,) = tmp_path.glob("*.csv")
    table = path.read_bytes()
    assert [int(row["number"]) for row in rows_of(path)] == list(range(numbers))
    assert all(true(row) for row in rows_of(path))
    pictures = list(tmp_path.glob("*.png"))
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert pictures or flags[0] == "trips"
    assert sweep(*flags, "--out", tmp_path) == 0
    assert f"{numbers} of {numbers} cases are done already" in capsys.readouterr().out
    assert path.read_bytes() == table
    assert sweep(*flags, *other, "--out", tmp_path) == 2
    assert "holds a study of another" in capsys.readouterr().err


def test_the_same_seed_gives_the_same_table_gone_on_with_and_with_any_number_of_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = (("--out", tmp_path / name) for name in "ab")
    with monkeypatch.context() as patch:
        run_cases_here(patch)
        sweep(*CERTIFICATE, "--n", 1, *a)
    first = rows_of(tmp_path / "a" / "certificate.csv")
    capsys.readouterr()
    sweep(*CERTIFICATE, "--n", 2, "--workers", 1, *a)
    assert "1 of 2 cases are done already" in capsys.readouterr().out
    both = rows_of(tmp_path / "a" / "certificate.csv")
    assert both[0] == first[0]
    assert [row["number"] for row in both] == ["0", "1"]
    sweep(*CERTIFICATE, "--n", 2, "--workers", 2, *b)
    tables = [(tmp_path / name / "certificate.csv").read_bytes() for name in "ab"]
    assert tables[0] == tables[1]


@pytest.mark.usefixtures("on_its_feet")
def test_a_single_case_equals_the_case_of_the_study_and_so_does_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log is judged by the code that judges live runs: another way to the same figures."""
    run_cases_here(monkeypatch)
    short = (*KILL, "--seed", 42)
    sweep(*short, "--n", 1, "--out", tmp_path / "all")
    assert sweep(*short, "--only", 0, "--out", tmp_path / "one") == 0
    (row,) = rows_of(tmp_path / "all" / "cases.csv")
    assert (tmp_path / "all" / "cases.png").stat().st_size > 20_000
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["stood"] is (row["ending"] == "stood")
    com_x = max(abs(float(row["com_x_min_mm"])), abs(float(row["com_x_max_mm"])))
    com_y = max(abs(float(row["com_y_min_mm"])), abs(float(row["com_y_max_mm"])))
    for figure, key in (
        (com_x, "hold_com_x_max_mm"),
        (com_y, "hold_com_y_max_mm"),
        (row["roll_max_rad"], "hold_roll_max_rad"),
        (row["yaw_max_rad"], "hold_yaw_max_rad"),
        (row["hold_ms"], "handover_max_ms"),
        (row["torque_step_nm"], "handover_torque_step_nm"),
        (row["operator_peak_before_n"], "operator_peak_n"),
    ):
        assert float(figure) == pytest.approx(summary[key], rel=1e-4, abs=1e-9), key


def test_the_baseline_falls_and_alone_that_is_exit_code_1_whatever_the_study_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_cases_here(monkeypatch)
    soon_down = ("latency", "--control", "centralised", "--delay", "200", "--loss", "0")
    of_one = (*soon_down, "--n", "1", "--out", tmp_path)
    assert sweep(*of_one) == 0, "the shipped control did not fall"
    assert "centralised: 1 of 1 fell" in capsys.readouterr().out
    assert all(path.stat().st_size > 10_000 for path in tmp_path.glob("*.png"))
    (row,) = rows_of(tmp_path / "latency.csv")
    assert 0.5 < float(row["fell_at_s"]) < 7.0
    assert float(row["hold_share"]) == 0.0
    assert sweep(*of_one, "--delay", "100") == 2
    assert "holds a study of another" in capsys.readouterr().err
    assert sweep(*soon_down, "--only", 0) == 1
    lines = (line.split() for line in capsys.readouterr().out.splitlines())
    alone = {words[0]: words[1] for words in lines if len(words) == 2}
    assert alone["ending"] == row["ending"] == "fell"
    assert alone["control"] == row["control"]
    for name in ("fell_at_s", "operator_peak_n", "com_max_mm", "torque_step_nm"):
        assert float(alone[name]) == pytest.approx(float(row[name]), rel=1e-3)


def test_a_fall_is_exit_code_1_with_the_command_that_shows_it(
    robot: RobotConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plain average of the legs cannot carry the whole payload."""
    run_cases_here(monkeypatch)
    some = KillCases(robot)
    seed = next(s for s in range(100) if some.draw(s, 0).payload_kg == 20.4)
    average = ("--n", 1, "--seed", seed, "--jacobian", "average")
    assert sweep(*KILL, *average, "--out", tmp_path) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "1 falls of 1" in output
    (row,) = rows_of(tmp_path / "cases.csv")
    assert row["ending"] == "fell"
    command = f"xrl study kill --seed {seed} --split diagonal --jacobian average --only 0"
    assert command in output
    assert cli.main(command.split()[1:]) == 1


GOOD: Mapping[str, Row] = {
    "kill": {"ending": Ending.STOOD},
    "heat": {"ending": Ending.STOOD, "unseen": False, "winding_max": 90.0},
    "dynamics": {"said_stable": True, "grew": False, "ended": "tracked"},
    "trips": {
        "trouble": "sags", "led": True, "tripped": "SAGGING", "fell_at_s": None,
        "untripped_fell_at_s": None,
    },
    "certificate": {"margin": 0.5, "stood": True},
    "push": {"stood_n": 0.0},
}  # fmt: skip
"""A row that nothing is wrong with, by study; `latency` and `robust` judge as `kill` does."""


def module_of(name: str) -> Any:
    return importlib.import_module(f"tools.lab.studies.sweeps.{name}")


@pytest.mark.parametrize(
    ("name", "changes", "code"),
    [
        *((name, {}, 0) for name in GOOD),
        ("kill", {"ending": Ending.UNREADY}, FAULT_EXIT_CODE),
        ("kill", {"ending": Ending.TIPPING}, FELL_EXIT_CODE),
        ("kill", {"ending": Ending.FELL}, FELL_EXIT_CODE),
        ("heat", {"ending": Ending.FELL}, FELL_EXIT_CODE),
        ("heat", {"ending": Ending.UNREADY}, 0),
        ("heat", {"unseen": True}, FAULT_EXIT_CODE),
        ("heat", {"winding_max": 156.0}, FAULT_EXIT_CODE),
        ("dynamics", {"grew": True}, FAULT_EXIT_CODE),
        ("dynamics", {"grew": True, "ended": "left"}, FAULT_EXIT_CODE),
        ("dynamics", {"grew": True, "ended": "fell"}, FELL_EXIT_CODE),
        ("dynamics", {"grew": True, "ended": "fell", "said_stable": False}, 0),
        ("trips", {"tripped": ""}, FAULT_EXIT_CODE),
        ("trips", {"fell_at_s": 2.1}, FELL_EXIT_CODE),
        ("certificate", {"stood": False}, FELL_EXIT_CODE),
        ("certificate", {"stood": False, "margin": -0.5}, 0),
    ],
)
def test_a_row_has_the_exit_code_of_what_is_wrong_with_it(
    name: str, changes: Row, code: int
) -> None:
    assert module_of(name).STUDY.exit_code({**GOOD[name], **changes}) == code


@pytest.mark.parametrize(
    ("codes", "code"), [([], 0), ([0, 0], 0), ([0, 3], 3), ([3, 1, 0], 1), ([2, 3], 3), ([2, 1], 1)]
)
def test_of_many_a_fall_decides_before_all_else_then_a_fault(codes: list[int], code: int) -> None:
    assert worst(codes) == code


def test_predictions_are_counted_against_outcomes(robot: RobotConfig) -> None:
    rows = [
        {"number": 0, "margin": margin, "stood": margin > 0.15, "weakest": "roll", "com_mm": 1.0}
        for margin in (0.5, 0.2, 0.1, -0.3, -0.4, -0.5)
    ]
    said = printed(certificate.report, finished(rows, robot, certificate.CertificateStudyFlags()))
    assert "said to stand: 2 stood, 1 fell" in said
    assert "said to fall: 0 stood, 3 fell" in said
    assert "with the limit at margin 0.150" in said
    assert said.count("case 0") == 1, "the one mistake"


@pytest.mark.parametrize("name", ["kill", "robust", "heat", "dynamics"])
def test_a_case_follows_from_seed_and_number_whatever_was_drawn_before(
    name: str, robot: RobotConfig
) -> None:
    kind = Verb(f"study {name}", "", module_of(name).__name__).declaration

    def drawn(seed: int, *numbers: int) -> list[Any]:
        case_of = module_of(name).STUDY.cases(kind(seed=seed), robot)
        return [case_of(number) for number in numbers]

    (_, case), (again,), (other,) = drawn(3, 5, 17), drawn(3, 17), drawn(4, 17)
    assert again == case
    assert msgspec.structs.replace(other, seed=3) != case


def test_the_verbs_help_imports_no_study() -> None:
    code = (
        "import sys\nfrom tools import cli\ntry:\n    cli.main(['study', '--help'])\n"
        "except SystemExit:\n    pass\n"
        "assert not [name for name in sys.modules if name.startswith('tools.lab')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("error", [RunError("a worker was killed"), KeyboardInterrupt()])
def test_an_interrupted_study_prints_how_to_resume(
    tmp_path: Path,
    error: BaseException,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def one_and_stop(_work: object, tasks: list[object], *_: object) -> Iterator[object]:
        yield tasks[0], kill.KillResult(ending=kill.Ending.FELL)
        raise error

    monkeypatch.setattr(study.pool, "results", one_and_stop)
    out, address = tmp_path / "a b", "tcp://host:8786"
    flags = (*KILL, "--n", "2", "--push", "0.5", "--cluster", address, "--out", str(out))
    assert sweep(*flags) == (2 if isinstance(error, RunError) else 130)
    again = f"xrl study kill --seed 1 --split diagonal --push 0.5 --n 2 --cluster {address}"
    words = f"1 cases are in {out}; resume with: {again} --out '{out}'\n"
    assert words in capsys.readouterr().out
    assert [row["number"] for row in rows_of(out / "cases.csv")] == ["0"]


def session(sid: int) -> list[int]:
    """Return the living processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == sid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_study_that_is_stopped_keeps_its_rows_and_leaves_no_process(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    """Ctrl-C goes to every process of the terminal; SIGKILL here to the first only."""
    command = [sys.executable, "-m", "tools.cli", "study", *CERTIFICATE, "--n", "200"]
    process = subprocess.Popen(
        [*command, "--workers", "2", "--out", str(tmp_path)],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    table = tmp_path / "certificate.csv"
    try:
        assert comes_true(lambda: table.exists() and len(rows_of(table)) >= 2, 60.0)
        if number is signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.kill()
        _, said = process.communicate(timeout=60)
        assert process.returncode == code
        assert "Traceback" not in said
        assert comes_true(lambda: session(process.pid) == [], 60.0), "a worker stayed"
        assert len(rows_of(table)) >= 2
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(("hits", "of"), [(0, 500), (3, 200), (1, 1), (20, 20)])
def test_wilsons_bounds_solve_his_equation(hits: int, of: int) -> None:
    """A bound p is as far from what was seen as 1.96 deviations of a share p allow."""
    for p in wilson(hits, of):
        share = hits / of
        assert (share - p) ** 2 == pytest.approx(1.959964**2 * p * (1 - p) / of, abs=1e-12)
    low, high = wilson(hits, of)
    assert 0.0 <= low <= hits / of <= high <= 1.0
    assert low < high


def test_another_gain_schedule_is_another_robot(robot: RobotConfig) -> None:
    other = msgspec.structs.replace(robot, gain_schedule=None)
    assert study.digest_of(robot) == study.digest_of(msgspec.structs.replace(robot))
    assert study.digest_of(robot) != study.digest_of(other)


def test_the_digest_has_every_tool_that_decides_a_run_and_no_picture() -> None:
    """Whatever lockstep imports, and so on from there, with no list to be kept."""
    sweeps = "tools/lab/studies/sweeps"
    for one, own in (
        (kill.STUDY, {f"{sweeps}/kill_trial.py", "tools/lab/design/split_program.py"}),
        (latency.STUDY, {f"{sweeps}/latency_trial.py", "tools/sim/centralised.py"}),
    ):
        code = one.code
        runs = ("lockstep", "network", "virtual_drive", "virtual_services")
        assert {"services", "shared", *(f"tools/sim/{name}.py" for name in runs)} | own <= {*code}
        assert [part for part in code if "picture" in part or "report" in part] == []


def test_the_code_of_a_study_is_all_that_it_imports_in_either_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tools.lab.studies.sweeps.table.CHECKOUT", tmp_path)
    (tmp_path / "tools").mkdir()
    for name, text in (("a", "import tools.b"), ("b", "from tools import c"), ("c", ""), ("d", "")):
        (tmp_path / "tools" / f"{name}.py").write_text(text)
    assert code_of("tools.a") == ("services", "shared", "tools/a.py", "tools/b.py", "tools/c.py")
