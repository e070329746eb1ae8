"""What verbs have in common when they print or write."""

from __future__ import annotations

import contextlib
from pathlib import Path

from rich.markup import escape

from shared.exceptions import RunError


def printable(text: str) -> str:
    """Return a text of a file, which may be foreign or damaged, safe to print with Rich."""
    return escape("".join(c if c.isprintable() else "?" for c in text))


def write_atomically(out: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        RunError: the file cannot be written.
    """
    part = out.with_name(f".{out.name}.part")
    try:
        part.write_bytes(content)
        part.replace(out)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise RunError(f"{out}: cannot be written: {error.strerror}; give another -o") from None
