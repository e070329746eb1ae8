"""Names of the codes in messages: another version, or a stranger, may send one that is unknown."""

from __future__ import annotations

from enum import IntEnum


def name_of(kind: type[IntEnum], code: int) -> str:
    """Return the name of a code, for example TRACK, or "unknown (99)"."""
    try:
        return kind(code).name
    except ValueError:
        return f"unknown ({code})"
