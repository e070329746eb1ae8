"""The table of a study: rows on the disk, gone on with, damaged, or of other inputs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path

import msgspec
import pytest

from shared.exceptions import RunError
from tests.tools.lab.studies.sweeps.tables import rows_of
from tools.lab.studies.sweeps.table import CaseTable

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


@pytest.mark.parametrize("torn", ["2,1,0.", "2", "2\n", ""])
def test_a_row_cut_off_in_the_middle_is_done_again(tmp_path: Path, torn: str) -> None:
    with filled(tmp_path, 1).open("a") as file:
        file.write(torn)
    with table_in(tmp_path) as table:
        assert table.numbers == {1}
        table.add(DRAWN[1], Figures(1.5))
    assert [row["value"] for row in rows_of(tmp_path / "t.csv")] == ["0.25", "1.5"]


def test_a_folder_of_other_inputs_is_refused(tmp_path: Path) -> None:
    filled(tmp_path)
    with pytest.raises(RunError, match=r"another seed \(1, now 2\); choose another --out"):
        table_in(tmp_path, inputs=INPUTS | {"seed": "2"})
    with pytest.raises(RunError, match="other columns"):
        table_in(tmp_path, [{"number": 1, "drawn": 0.5, "more": 1}])


@pytest.mark.parametrize(
    "damaged",
    [
        b"x,1,0.5,stood,\r\n",
        b"2,1,0.5,stoood,\r\n",
        b"2,1,0.5,stood,,1\r\n",
        b'"2,1,0.5,stood,\r\n',
        b"2,1,\xff\xfe,stood,\r\n",
    ],
)
def test_a_row_that_is_damaged_or_of_another_case_is_done_again_and_the_others_are_kept(
    tmp_path: Path, damaged: bytes
) -> None:
    path = filled(tmp_path, 1, 3)
    head, first, third = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(head + first + damaged + third)
    with table_in(tmp_path) as table:
        assert table.numbers == {1, 3}
    assert path.read_bytes() == head + first + third


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
        with pytest.raises(RunError, match="another study is writing there"):
            table_in(tmp_path)
        first.add(DRAWN[0], Figures(0.5))
    with table_in(tmp_path) as second:
        assert second.numbers == {1}


def test_a_folder_of_something_else_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"a run")
    with pytest.raises(RunError, match="holds other files than a study's"):
        table_in(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
