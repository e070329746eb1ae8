"""Text of a file that a person wrote, in whatever editor: UTF-8, with a byte order mark or without.

Windows' editors set the mark; it says nothing, and TOML and JSON have no place for it.
"""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Final

_OTHERS: Final = (
    ("UTF-32", codecs.BOM_UTF32_LE),  # before UTF-16, with whose mark it begins
    ("UTF-32", codecs.BOM_UTF32_BE),
    ("UTF-16", codecs.BOM_UTF16_LE),
    ("UTF-16", codecs.BOM_UTF16_BE),
)


def decoded(content: bytes) -> str:
    """Return the text of a file's content; UnicodeError says what it is instead of UTF-8."""
    for name, mark in _OTHERS:
        if content.startswith(mark):
            raise UnicodeError(f"is {name}; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UnicodeError(
            f"is no UTF-8 text: byte 0x{content[error.start]:02x} in line {line}; save it as UTF-8"
        ) from None


def read_text(path: Path) -> str:
    """Return the text of a file; OSError if it cannot be read, UnicodeError if it is no UTF-8."""
    return decoded(path.read_bytes())
