"""The words that lint refuses, and what it says to write."""

from __future__ import annotations

import pytest

from tools.dev import words


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("A drive that is nobody's.", "nobody's"),
        ("The kernel has so long to answer", "so long"),
        ("so long as it holds", ""),
        ('    """What a mutant is."""', '"""What '),
        ("The planner does not lead.", ""),
    ],
)
def test_a_pattern_is_found_with_its_line_and_what_to_write(line: str, found: str) -> None:
    rows = list(words._findings(f"first\n{line}\n"))
    assert [(number, text) for number, text, _ in rows] == ([(2, found)] if found else [])
    assert all(right for _, _, right in rows)
