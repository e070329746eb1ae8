"""`xrl study sweep`: the pool, the words and the verb around them."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tests.tools.exit_codes import exit_code
from tools import cli
from tools.lab.studies.sweeps import cases, pool
from tools.lab.studies.sweeps.prepare import prepare
from tools.lab.studies.sweeps.wilson import wilson


def sweep(*flags: str) -> int:
    """Run the verb; the paper's split needs no gain schedule."""
    return cli.main(["study", "sweep", "kill", "--split", "diagonal", *flags])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def square(number: int) -> int:
    return number * number


def stumble(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


def die(_number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def test_every_task_comes_back_with_its_result() -> None:
    assert dict(pool.results(square, range(10), 2, str)) == {n: n * n for n in range(10)}


def test_an_error_names_its_task_and_leaves_no_worker() -> None:
    with pytest.raises(RunError, match="case 2: ValueError: two"):
        list(pool.results(stumble, range(4), 2, lambda n: f"case {n}"))
    assert multiprocessing.active_children() == []


def test_a_killed_worker_is_an_error_and_no_wait() -> None:
    with pytest.raises(RunError, match="fewer --workers"):
        list(pool.results(die, [1, 2], 2, str))


def test_a_loop_left_early_leaves_no_worker() -> None:
    done = pool.results(sleep, [0.0, 60.0], 2, str)
    next(done)
    begin = time.monotonic()
    done.close()  # type: ignore[attr-defined]  # a generator
    assert time.monotonic() - begin < 30.0
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("flags", "words"),
    [(("--workers", "2"), "--workers"), (("--only", "1"), "--only")],
)
def test_flags_that_a_cluster_would_not_heed_are_refused(
    flags: tuple[str, str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert sweep("--cluster", "tcp://127.0.0.1:1", *flags, "--out", str(out)) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(("hits", "of"), [(0, 500), (3, 200), (1, 1), (20, 20)])
def test_wilsons_bounds_solve_his_equation(hits: int, of: int) -> None:
    """A bound p is as far from what was seen as 1.96 deviations of a share p allow."""
    for p in wilson(hits, of):
        share = hits / of
        assert (share - p) ** 2 == pytest.approx(1.959964**2 * p * (1 - p) / of, abs=1e-12)
    low, high = wilson(hits, of)
    assert 0.0 <= low <= hits / of <= high <= 1.0
    assert low < high


def test_a_payload_gets_a_schedule_that_fits(robot: RobotConfig) -> None:
    other = cases.with_payload(robot, 10.2)
    reported: list[tuple[int, int]] = []
    ready = prepare([robot, other], 2, lambda done, of: reported.append((done, of)))
    assert ready[0] is robot, "its schedule was made for it"
    assert [gain_schedule.why_stale(one) for one in ready] == ["", ""]
    assert ready[1].mass.payload == 10.2
    assert reported == [(0, 1), (1, 1)]


def test_the_papers_split_needs_no_schedule(robot: RobotConfig) -> None:
    law = msgspec.structs.replace(robot.law, split="diagonal")
    other = cases.with_payload(msgspec.structs.replace(robot, law=law), 10.2)
    assert prepare([other], 2) == [other]


def test_the_same_seed_gives_the_same_table_gone_on_with_and_with_any_number_of_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = (("--out", str(tmp_path / name)) for name in "ab")
    sweep("--n", "1", "--workers", "1", *a)
    first = rows_of(tmp_path / "a" / "cases.csv")
    capsys.readouterr()
    sweep("--n", "2", "--workers", "1", *a)
    assert "1 of 2 cases are done already" in capsys.readouterr().out
    both = rows_of(tmp_path / "a" / "cases.csv")
    assert both[0] == first[0]
    assert [row["number"] for row in both] == ["0", "1"]
    assert sweep("--n", "2", "--seed", "2", *a) == 2
    assert "another seed" in capsys.readouterr().err
    sweep("--n", "2", "--workers", "2", *b)
    tables = [(tmp_path / name / "cases.csv").read_bytes() for name in "ab"]
    assert tables[0] == tables[1]
    assert all((tmp_path / name / "cases.png").stat().st_size > 20_000 for name in "ab")


def test_a_single_case_equals_the_case_of_the_study_and_so_does_its_log(tmp_path: Path) -> None:
    """The log is judged by the code that judges live runs: another way to the same figures."""
    sweep("--n", "1", "--out", str(tmp_path / "all"))
    assert sweep("--only", "0", "--out", str(tmp_path / "one")) == 0
    (row,) = rows_of(tmp_path / "all" / "cases.csv")
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    # such a push keeps motors at their limit: sound it is not, and the study asks for standing
    assert (summary["stood"] or summary["unsound"] != "") is (row["ending"] == "stood")
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


def test_a_fall_is_exit_code_1_with_the_command_that_shows_it(
    robot: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A plain average of the legs cannot carry the whole payload: it falls at the start."""
    some = cases.KillCases(robot)
    seed = next(s for s in range(100) if some.draw(s, 0).payload_kg == 20.4)
    average = ("--n", "1", "--seed", str(seed), "--jacobian", "average")
    assert sweep(*average, "--out", str(tmp_path)) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "1 falls of 1" in output
    command = f"xrl study sweep kill --seed {seed} --split diagonal --jacobian average --only 0"
    assert command in output
    assert cli.main(command.split()[1:]) == 1


@pytest.mark.parametrize("flags", [("--n", "0"), ("--workers", "0"), ("--only", "-1")])
def test_a_number_that_makes_no_sense_is_refused(
    flags: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["study", "sweep", "kill", "--split", "diagonal", *flags]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.search(rf"{flags[0]}: '{flags[1]}': must be a whole number of at least \d", error)


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


def wait_until(true: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_study_that_is_stopped_keeps_its_rows_and_leaves_no_process(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    """Ctrl-C goes to every process of the terminal; SIGKILL here to the first only."""
    command = [sys.executable, "-m", "tools.cli", "study", "sweep", "kill", "--split", "diagonal"]
    process = subprocess.Popen(
        [*command, "--n", "200", "--workers", "2", "--out", str(tmp_path)],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    table = tmp_path / "cases.csv"
    try:
        wait_until(lambda: table.exists() and len(rows_of(table)) >= 2, "no case came")
        if number is signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.kill()
        _, said = process.communicate(timeout=60)
        assert process.returncode == code
        assert "Traceback" not in said
        wait_until(lambda: session(process.pid) == [], "a worker stayed")
        assert len(rows_of(table)) >= 2
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    "words", [("sweep",), ("study", "sweep", "kill"), ("study", "sweep", "certificate")]
)
def test_the_verb_and_its_study_have_help_with_examples(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([*words, "--help"])
    assert left.value.code == 0
    shown = capsys.readouterr().out
    assert f"examples:\n  xrl study sweep {words[1] if len(words) > 1 else ''}" in shown
    assert f"xrl study sweep {words[-1] if len(words) > 1 else 'kill'}" in shown
