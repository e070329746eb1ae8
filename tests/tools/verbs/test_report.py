from __future__ import annotations

from pathlib import Path

import pytest

from shared.mcap_log.writer import SCHEMA_VERSION
from tests.shared.mcap_log import runs
from tools import cli


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return runs.write(tmp_path, [runs.item(seq) for seq in range(200)])


def report(*arguments: object) -> int:
    return cli.main(["log", "report", *map(str, arguments)])


def test_the_page_is_written_beside_the_log(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report(record) == 0
    page = record.with_suffix(".html")
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert "one file" in capsys.readouterr().out
    assert SCHEMA_VERSION in page.read_text(encoding="utf-8")


def test_an_old_page_is_replaced_and_no_other_file_remains(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    out.write_text("old", encoding="utf-8")
    assert report(record, "-o", out, "--open", "no") == 0
    assert out.stat().st_size > 10_000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "run.mcap"]


def test_a_browser_opens_on_request(record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert report(record, "--open", "no") == 0
    assert report(record) == 0
    assert opened == [], "no terminal here"
    assert report(record, "--open", "yes") == 0
    assert opened == [record.with_suffix(".html").as_uri()]
