"""Verdicts of the doctor's rows, for its tests."""

from __future__ import annotations

from tools.bringup.findings import Finding, FindingKind

OK, WARNING, WRONG = FindingKind.OK, FindingKind.WARNING, FindingKind.WRONG


def bad(rows: list[Finding]) -> list[str]:
    """Return "subject: matter: verdict" of the rows that are not ok."""
    return [f"{row.subject}: {row.what}: {row.verdict}" for row in rows if row.verdict is not OK]
