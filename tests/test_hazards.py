"""docs/hazards.md: every test that it names is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "hazards.md").read_text(encoding="utf-8")
CITED = sorted(set(re.findall(r"`(tests/[^`]+)`", TEXT)))


def test_every_kind_of_hazard_is_reported() -> None:
    kinds = re.findall(r"^## (.+)$", TEXT, flags=re.MULTILINE)
    assert [kind.split(",")[0] for kind in kinds] == [
        "It falls",
        "It moves unasked",
        "It sinks unasked",
        "It pinches",
        "It cannot be stopped",
    ]


@pytest.mark.parametrize("cited", CITED)
def test_a_test_that_is_named_is_there(cited: str) -> None:
    file, _, name = cited.partition("::")
    assert (ROOT / file).is_file()
    assert not name or f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")


def test_what_is_open_names_no_test_as_if_it_were_shown() -> None:
    rows = [line.split("|") for line in TEXT.splitlines() if "**Open**" in line]
    assert rows
    assert all("tests/" not in row[3] for row in rows)
