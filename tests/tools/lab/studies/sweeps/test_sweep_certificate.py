"""`xrl study sweep certificate`: the table of a study, gone on with, and its exit code."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.tools.exit_codes import exit_code
from tools import cli

FEW = ("--n", "2", "--seed", "1", "--rigid", "--workers", "1")


def sweep(out: Path, *flags: str) -> int:
    return cli.main(["study", "sweep", "certificate", "--out", str(out), *flags])


def test_a_study_is_tabled_drawn_and_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(tmp_path, *FEW) == 0
    first = (tmp_path / "certificate.csv").read_text(encoding="utf-8")
    assert (tmp_path / "certificate.png").stat().st_size > 10_000
    assert sweep(tmp_path, *FEW[:1], "3", *FEW[2:]) == 0
    text = (tmp_path / "certificate.csv").read_text(encoding="utf-8")
    assert text.startswith(first)
    rows = list(csv.DictReader(text.splitlines()))
    assert [row["number"] for row in rows] == ["0", "1", "2"]
    for row in rows:
        assert (float(row["margin"]) > 0.0) == (row["stood"] == "True")
    assert "said to fall" in capsys.readouterr().out


def test_another_seed_is_refused_in_the_same_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(tmp_path, "--n", "1", "--workers", "1") in (0, 1)
    assert sweep(tmp_path, "--n", "1", "--workers", "1", "--seed", "2") == 2
    assert "another seed" in capsys.readouterr().err


def test_no_cases_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["study", "sweep", "certificate", "--n", "0", "--out", tmp_path]) == 2
    assert "at least 1" in capsys.readouterr().err
