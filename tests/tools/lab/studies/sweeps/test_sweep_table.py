"""The table of a study: rows on the disk, gone on with, damaged, or of other inputs."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.table import CaseTable, code_of
from tools.terminal import Console

INPUTS = {"study": "test", "seed": "1"}
COLUMNS = ("number", "value")


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_is_sorted_whatever_came_first(tmp_path: Path) -> None:
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as table:
        for number in (3, 1, 2):
            table.add({"number": number, "value": number / 2})
    assert [row["number"] for row in rows_of(tmp_path / "t.csv")] == ["1", "2", "3"]


def test_a_row_is_on_the_disk_when_it_is_done(tmp_path: Path) -> None:
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as table:
        table.add({"number": 7, "value": None})
        assert rows_of(tmp_path / "t.csv") == [{"number": "7", "value": ""}]


@pytest.mark.parametrize("torn", ["2,0.", "2", "2\n", ""])
def test_a_row_cut_off_in_the_middle_is_done_again(tmp_path: Path, torn: str) -> None:
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as table:
        table.add({"number": 1, "value": 0.5})
    with (tmp_path / "t.csv").open("a") as file:
        file.write(torn)
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as table:
        assert table.numbers == {1}
        table.add({"number": 2, "value": 1.5})
    assert [row["value"] for row in rows_of(tmp_path / "t.csv")] == ["0.5", "1.5"]


def test_a_folder_of_other_inputs_is_refused(tmp_path: Path) -> None:
    CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS)
    with pytest.raises(RunError, match=r"another seed \(1, now 2\); choose another --out"):
        CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS | {"seed": "2"})
    with pytest.raises(RunError, match="other columns"):
        CaseTable(tmp_path, "t.csv", (*COLUMNS, "more"), INPUTS)


WORDS = {"ending": {"stood", "fell"}}


@pytest.mark.parametrize(
    "damaged",
    [
        b"x,0.5,stood\r\n",
        b"-2,0.5,stood\r\n",
        b"2,0.x,stood\r\n",
        b"2,0.5,stoood\r\n",
        b"2,0.5,\r\n",
        b"2,0.5,stood,1\r\n",
        b'"2,0.5,stood\r\n',
        b"2,\xff\xfe,stood\r\n",
        b"\x00\x00\r\n",
        b"\r\n",
    ],
)
def test_a_damaged_row_is_done_again_and_the_others_are_kept(
    tmp_path: Path, damaged: bytes
) -> None:
    columns = (*COLUMNS, "ending")
    with CaseTable(tmp_path, "t.csv", columns, INPUTS, WORDS) as table:
        for number in (1, 3):
            table.add({"number": number, "value": None, "ending": "fell"})
    path = tmp_path / "t.csv"
    head, first, third = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(head + first + damaged + third)
    with CaseTable(tmp_path, "t.csv", columns, INPUTS, WORDS) as table:
        assert table.numbers == {1, 3}
    assert path.read_bytes() == head + first + third


@pytest.mark.parametrize("value", ["0.7", ""])
def test_a_row_that_is_of_another_case_is_done_again(tmp_path: Path, value: str) -> None:
    drawn = [{"number": number, "value": number / 2} for number in (1, 2)]
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS, drawn=drawn) as table:
        for case in (*drawn, {"number": 3, "value": 9.0}):
            table.add(case)
    path = tmp_path / "t.csv"
    path.write_text(path.read_text().replace("1,0.5", f"1,{value}"))
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS, drawn=drawn) as table:
        assert table.numbers == {2, 3}


@pytest.mark.parametrize("inputs", [None, b"", b"[]", b"{", b"null", b"\xff\xfe"])
def test_a_table_of_unknown_inputs_is_refused_and_left_alone(
    tmp_path: Path, inputs: bytes | None
) -> None:
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as table:
        table.add({"number": 1, "value": 0.5})
    before = (tmp_path / "t.csv").read_bytes()
    if inputs is None:
        (tmp_path / "inputs.json").unlink()
    else:
        (tmp_path / "inputs.json").write_bytes(inputs)
    for _ in range(2):
        with pytest.raises(RunError, match=r"does not say what t\.csv was made from"):
            CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS)
    assert (tmp_path / "t.csv").read_bytes() == before


def test_a_study_cut_off_before_it_wrote_anything_is_begun_anew(tmp_path: Path) -> None:
    (tmp_path / "inputs.json").write_bytes(b"")
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS):
        pass
    assert json.loads((tmp_path / "inputs.json").read_text()) == INPUTS


def test_two_studies_do_not_write_into_one_table(tmp_path: Path) -> None:
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as first:
        with pytest.raises(RunError, match="another study is writing there"):
            CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS)
        first.add({"number": 1, "value": 0.5})
    with CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS) as second:
        assert second.numbers == {1}


@pytest.mark.parametrize("error", [RunError("a worker was killed"), KeyboardInterrupt()])
def test_an_interrupted_study_prints_how_to_resume(
    tmp_path: Path,
    error: BaseException,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def one_and_stop(*_args: object) -> Iterator[tuple[int, float]]:
        yield 1, 0.5
        raise error

    monkeypatch.setattr(study.cluster, "results", one_and_stop)
    job = study.Job(
        float, str, lambda n, value: [{"number": n, "value": value}], lambda _row: False
    )
    plan = study.Study("kill", "t.csv", COLUMNS, {}, INPUTS, (), 2, job, "xrl study sweep kill")
    executor = study.Executor(2, "tcp://host:8786", ())
    out = tmp_path / "a b"
    with pytest.raises(type(error)):
        study.run(plan, lambda _done: [1, 2], out, executor, Console())
    words = f"xrl study sweep kill --cluster tcp://host:8786 --out '{out}'"
    assert f"1 cases are in {out}; resume with: {words}\n" in capsys.readouterr().out
    with CaseTable(out, "t.csv", COLUMNS, INPUTS) as table:
        assert table.numbers == {1}


def test_another_gain_schedule_is_another_robot(robot: RobotConfig) -> None:
    other = msgspec.structs.replace(robot, gain_schedule=None)
    assert study.digest_of(robot) == study.digest_of(msgspec.structs.replace(robot))
    assert study.digest_of(robot) != study.digest_of(other)


def test_the_code_of_a_study_is_all_that_it_imports_in_either_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tools.lab.studies.sweeps.table.CHECKOUT", tmp_path)
    (tmp_path / "tools").mkdir()
    for name, text in (
        ("a", "import tools.b"),
        ("b", "from tools import c"),
        ("c", ""),
        ("d", ""),
    ):
        (tmp_path / "tools" / f"{name}.py").write_text(text)
    assert code_of("tools.a") == ("services", "shared", "tools/a.py", "tools/b.py", "tools/c.py")


def test_a_folder_of_something_else_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"a run")
    with pytest.raises(RunError, match="holds other files than a study's; choose another --out"):
        CaseTable(tmp_path, "t.csv", COLUMNS, INPUTS)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
