"""`xrl study`: what the one runner does for every study, here and on a cluster; its table."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FELL_EXIT_CODE, RunError
from tests.tools.lab.studies.sweeps.tables import TOY, ToyFlags, rows_of, sleep, square, sweep
from tests.waiting import comes_true
from tools.lab.studies.sweeps import pool, push, study
from tools.lab.studies.sweeps.figures import worst
from tools.lab.studies.sweeps.table import CaseTable
from tools.verb_table import Verb

KILL = ("kill", "--split", "diagonal")
"""The paper's split needs no gain schedule."""


def toy(**flags: Any) -> int:
    return study.run(TOY, ToyFlags(**flags))


def test_the_same_seed_gives_the_same_table_resumed_and_with_any_number_of_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    assert toy(seed=7, n=2, workers=1, out=a) == 0
    assert toy(seed=7, n=5, workers=1, out=a) == FELL_EXIT_CODE
    assert "2 of 5 cases are already done" in capsys.readouterr().out
    assert toy(seed=7, n=5, workers=2, out=b) == FELL_EXIT_CODE
    assert (a / "toy.csv").read_bytes() == (b / "toy.csv").read_bytes()
    assert [row["ending"] for row in rows_of(b / "toy.csv")].count("fell") == 1
    assert (b / "toy.png").exists()
    with pytest.raises(RunError, match=r"contains a study with different parameters \(seed"):
        toy(seed=6, out=a)


def test_an_error_is_one_line_names_its_case_and_keeps_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RunError) as caught:
        toy(seed=8, n=3, workers=1, out=tmp_path)
    assert str(caught.value) == "case 2 (xrl study toy --seed 8 --only 2): ValueError: two lines"
    again = f"2 of 3 cases are in {tmp_path}; "
    again += f"resume with: xrl study toy --seed 8 --n 3 --out {tmp_path}"
    assert again in capsys.readouterr().out.replace("\n", "")
    assert [row["number"] for row in rows_of(tmp_path / "toy.csv")] == ["0", "1"]


def test_a_killed_worker_is_an_error_and_no_wait(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="fewer --workers"):
        toy(seed=9, n=3, workers=2, out=tmp_path)


def children() -> set[str]:
    done = subprocess.run(
        ["ps", "-o", "args=", "--ppid", str(os.getpid())],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return {line for line in done.stdout.splitlines() if "popen_loky" in line}


def test_a_loop_left_early_leaves_no_worker() -> None:
    assert dict(pool.results(square, range(9), 2, str)) == {n: n * n for n in range(9)}
    done = pool.results(sleep, [0.0, 60.0], 2, str)
    assert next(done) == (0.0, 0.0)
    done.close()  # type: ignore[attr-defined]  # a generator
    assert children() == set()


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "http://127.0.0.1:1", "tcp://nowhere"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(RunError, match="tcp://HOST:PORT"):
        list(pool.results(abs, [1], 1, str, address))


def test_without_dask_the_extra_that_brings_it_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    flags = ("--n", 1, "--cluster", "tcp://127.0.0.1:1", "--out", tmp_path)
    assert sweep("latency", *flags) == 2
    output = capsys.readouterr().err
    assert "extra `cluster`" in output
    assert output.count("\n") == 1


def test_a_study_on_a_real_cluster_is_that_of_this_machine_and_other_code_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        host="127.0.0.1", protocol="tcp://",
    ) as local:  # fmt: skip
        address = local.scheduler_address
        toy(seed=7, n=3, cluster=address, out=tmp_path / "a")
        monkeypatch.setattr(pool, "code_digest", lambda: "another")
        with pytest.raises(RunError, match="different code"):
            list(pool.results(square, [1, 2], 1, str, address))
    monkeypatch.undo()
    toy(seed=7, n=3, workers=1, out=tmp_path / "b")
    tables = [(tmp_path / name / "toy.csv").read_bytes() for name in "ab"]
    assert tables[0] == tables[1]
    monkeypatch.setattr(pool, "CONNECT_S", 0.5)
    with pytest.raises(RunError, match="no Dask scheduler answers"):
        list(pool.results(square, [1, 2], 1, str, address))


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


NAPPING = """
from pathlib import Path; import sys
from tests.tools.lab.studies.sweeps.tables import TOY, ToyFlags
from tools.lab.studies.sweeps import study
study.run(TOY, ToyFlags(n=300, nap=0.2, workers=2, out=Path(sys.argv[1])))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_study_that_is_stopped_keeps_its_rows_and_leaves_no_process(
    tmp_path: Path, number: signal.Signals
) -> None:
    """Ctrl-C goes to every process of the terminal; SIGKILL here to the first only."""
    process = subprocess.Popen(
        [sys.executable, "-c", NAPPING, str(tmp_path)],
        start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    table = tmp_path / "toy.csv"
    try:
        assert comes_true(lambda: table.exists() and len(rows_of(table)) >= 2, 60.0)
        if number is signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.kill()
        said, _ = process.communicate(timeout=60)
        assert ("resume with" in said) is (number is signal.SIGINT)
        assert comes_true(lambda: session(process.pid) == [], 60.0), "a worker stayed"
        assert len(rows_of(table)) >= 2
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.usefixtures("on_its_feet")
def test_a_single_case_equals_the_case_of_the_study_and_so_does_its_log(tmp_path: Path) -> None:
    """The log is judged by the code that judges live runs: another way to the same figures."""
    short = (*KILL, "--seed", 42)
    sweep(*short, "--n", 1, "--workers", 1, "--out", tmp_path / "all")
    assert sweep(*short, "--only", 0, "--out", tmp_path / "one") == 0
    (row,) = rows_of(tmp_path / "all" / "cases.csv")
    assert (tmp_path / "all" / "cases.png").stat().st_size > 20_000
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["stood"] is (row["ending"] == "stood")
    com_x = max(abs(float(row["com_x_min_mm"])), abs(float(row["com_x_max_mm"])))
    for figure, key in (
        (com_x, "hold_com_x_max_mm"),
        (row["roll_max_rad"], "hold_roll_max_rad"),
        (row["hold_ms"], "handover_max_ms"),
        (row["torque_step_nm"], "handover_torque_step_nm"),
        (row["operator_peak_before_n"], "operator_peak_n"),
    ):
        assert float(figure) == pytest.approx(summary[key], rel=1e-4, abs=1e-9), key


def test_the_baseline_falls_and_alone_that_is_exit_code_1_whatever_the_study_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soon_down = ("latency", "--control", "centralised", "--delay", "200", "--loss", "0")
    assert sweep(*soon_down, "--n", "1", "--workers", "1", "--out", tmp_path) == 0
    assert "centralised: 1 of 1 fell" in capsys.readouterr().out
    assert (tmp_path / "latency.png").stat().st_size > 10_000
    (row,) = rows_of(tmp_path / "latency.csv")
    assert 0.5 < float(row["fell_at_s"]) < 7.0
    assert float(row["hold_share"]) == 0.0
    assert sweep(*soon_down, "--only", 0) == 1
    lines = (line.split() for line in capsys.readouterr().out.splitlines())
    alone = {words[0]: words[1] for words in lines if len(words) == 2}
    assert alone["ending"] == row["ending"] == "fell"
    for name in ("fell_at_s", "operator_peak_n", "com_max_mm", "torque_step_nm"):
        assert float(alone[name]) == pytest.approx(float(row[name]), rel=1e-3)


def test_the_push_study_is_tabled_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(push, "STEP_N", 80.0)
    flags = ("push", "--pose", "squat", "--angle", "90", "--duration", "0.3", "--workers", "1")
    assert sweep(*flags, "--out", tmp_path) == 0
    assert "gives way" in capsys.readouterr().out
    rows = rows_of(tmp_path / "pushes.csv")
    assert [row["mode"] for row in rows] == ["led", "dead"]
    assert all(float(row["stood_n"]) > 20.0 for row in rows)
    assert (tmp_path / "pushes.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("codes", "code"), [([], 0), ([0, 0], 0), ([0, 3], 3), ([3, 1, 0], 1), ([2, 3], 3), ([2, 1], 1)]
)
def test_of_many_a_fall_decides_before_all_else_then_a_fault(codes: list[int], code: int) -> None:
    assert worst(codes) == code


@pytest.mark.parametrize("name", ["kill", "robust"])
def test_a_case_follows_from_seed_and_number_whatever_was_drawn_before(
    name: str, robot: RobotConfig
) -> None:
    module = importlib.import_module(f"tools.lab.studies.sweeps.{name}")
    kind: Any = Verb(f"study {name}", "", module.__name__).declaration

    def drawn(seed: int, *numbers: int) -> list[Any]:
        case_of = module.STUDY.cases(kind(seed=seed), robot)
        return [case_of(number) for number in numbers]

    (_, case), (again,), (other,) = drawn(3, 5, 17), drawn(3, 17), drawn(4, 17)
    assert again == case
    assert msgspec.structs.replace(other, seed=3) != case


def test_another_gain_schedule_is_another_robot(robot: RobotConfig) -> None:
    other = msgspec.structs.replace(robot, gain_schedule=None)
    assert study.digest_of(robot) == study.digest_of(msgspec.structs.replace(robot))
    assert study.digest_of(robot) != study.digest_of(other)


INPUTS = {"study": "test", "seed": "1"}


class End(StrEnum):
    STOOD = "stood"
    FELL = "fell"


class Figures(msgspec.Struct):
    value: float | None
    end: End = End.FELL
    words: str | None = None


DRAWN: Sequence[Mapping[str, object]] = [{"number": n, "drawn": n / 2} for n in (1, 2, 3)]


def table_in(
    folder: Path, drawn: Sequence[Mapping[str, object]] = DRAWN, inputs: Mapping[str, str] = INPUTS
) -> CaseTable:
    return CaseTable(folder / "t.csv", drawn, Figures, inputs)


def filled(folder: Path, *numbers: int) -> Path:
    with table_in(folder) as table:
        for number in numbers:
            table.add(DRAWN[number - 1], Figures(number / 4))
    return folder / "t.csv"


def test_a_table_is_sorted_whatever_came_first(tmp_path: Path) -> None:
    assert [row["number"] for row in rows_of(filled(tmp_path, 3, 1, 2))] == ["1", "2", "3"]


def test_a_row_is_on_the_disk_when_it_is_done(tmp_path: Path) -> None:
    with table_in(tmp_path) as table:
        table.add(DRAWN[0], Figures(None))
        row = {"number": "1", "drawn": "0.5", "value": "", "end": "fell", "words": ""}
        assert rows_of(tmp_path / "t.csv") == [row]


def test_a_row_comes_back_with_its_values_as_drawn_and_as_measured(tmp_path: Path) -> None:
    drawn = [{"number": 1, "drawn": 1 / 3}]
    for figures in (Figures(2 / 3, End.STOOD, "a b"), Figures(None)):
        with table_in(tmp_path, drawn) as table:
            added = table.add(drawn[0], figures)
        with table_in(tmp_path, drawn) as table:
            (read,) = table.rows
        assert read == added
        assert read["drawn"] == 1 / 3
        assert read["value"] == (None if figures.value is None else 0.666667)
        assert (read["end"], read["words"]) == (figures.end, figures.words)


def test_a_folder_of_other_inputs_is_refused(tmp_path: Path) -> None:
    filled(tmp_path, 1)
    with pytest.raises(RunError, match=r"\(seed 1, now 2\); choose another --out"):
        table_in(tmp_path, inputs=INPUTS | {"seed": "2"})
    with pytest.raises(RunError, match="its columns are not this"):
        table_in(tmp_path, [{"number": 1, "drawn": 0.5, "more": 1}])


@pytest.mark.parametrize("row", [b"x,1,0.5,stood,", b"2,1,0.5,stoood,", b"2", b"\xff,1,0.5,,"])
def test_a_damaged_table_is_refused_and_left_alone(tmp_path: Path, row: bytes) -> None:
    path = filled(tmp_path, 1)
    path.write_bytes(path.read_bytes() + row + b"\r\n")
    before = path.read_bytes()
    with pytest.raises(RunError, match="is damaged"):
        table_in(tmp_path)
    assert path.read_bytes() == before


def test_rows_of_cases_that_are_not_asked_for_now_are_kept(tmp_path: Path) -> None:
    filled(tmp_path, 1, 2, 3)
    with table_in(tmp_path, DRAWN[:1]) as table:
        assert [row["number"] for row in table.rows] == [1]
    assert len(rows_of(tmp_path / "t.csv")) == 3


@pytest.mark.parametrize("inputs", [None, b"", b"[]", b"{"])
def test_a_table_of_unknown_inputs_is_refused_and_left_alone(
    tmp_path: Path, inputs: bytes | None
) -> None:
    before = filled(tmp_path, 1).read_bytes()
    if inputs is None:
        (tmp_path / "inputs.json").unlink()
    else:
        (tmp_path / "inputs.json").write_bytes(inputs)
    for _ in range(2):
        with pytest.raises(RunError, match=r"damaged inputs\.json"):
            table_in(tmp_path)
    assert (tmp_path / "t.csv").read_bytes() == before


def test_a_study_cut_off_before_it_wrote_anything_is_begun_again(tmp_path: Path) -> None:
    (tmp_path / "inputs.json").write_bytes(b"")
    filled(tmp_path)
    assert json.loads((tmp_path / "inputs.json").read_text()) == INPUTS


def test_two_studies_do_not_write_into_one_table(tmp_path: Path) -> None:
    with table_in(tmp_path) as first:
        with pytest.raises(RunError, match="another study is writing to it"):
            table_in(tmp_path)
        first.add(DRAWN[0], Figures(0.5))
    with table_in(tmp_path) as second:
        assert second.numbers == {1}


def test_a_folder_of_something_else_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"a run")
    with pytest.raises(RunError, match="contains files that are not a study's"):
        table_in(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
