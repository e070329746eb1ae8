"""Filter for text to a terminal, pipe or file: it shows control characters instead of sending them.

A log, the bus, another host or a file name may contain escape sequences, which could rename a
window, clear it or fake a verdict. In JSON, the replacement denotes the same character.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import re
import sys
from collections.abc import Iterator
from typing import IO, Any, Final, cast

_CONTROL: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 except tab and newline, DEL, C1
    "\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"  # characters that reverse or break a line
    "\ud800-\udfff]"  # bytes of a file name that are not UTF-8
)

DRAWN: Final = "xrl-drawn"
"""Name of the error handler of `codecs` that replaces characters that a terminal cannot draw."""
_ALIKE: Final = {"█": "#", "±": "+-", "…": "...", "µ": "u", "°": "deg", "→": "->"}


def cleaned(text: str) -> str:
    r"""Return a text with each control character except tab and newline written as `\u001b`."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def is_clean(text: str) -> bool:
    """Return True if `cleaned` changes nothing."""
    return _CONTROL.search(text) is None


def printable(text: str) -> str:
    """Return a text on one line, with control characters escaped."""
    return cleaned(text).replace("\n", "\\n")


class _Guarded:
    """Stream that cleans printed text. Rich bypasses it, because Rich writes colour codes."""

    def __init__(self, stream: IO[str]) -> None:
        self.rich_proxied_file = stream
        """The stream that Rich's console writes to."""
        self._lost: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text with its control characters escaped."""
        try:
            self.rich_proxied_file.write(cleaned(text))
        except OSError as error:
            self._lost = error
            raise
        return len(text)

    def flush(self) -> None:
        """Flush, and raise a write error that the caller ignored, as argparse does."""
        if self._lost is not None:
            raise self._lost
        self.rich_proxied_file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextlib.contextmanager
def guarded_streams() -> Iterator[None]:
    """Guard `print` and the error stream, and replace characters that a terminal cannot draw."""
    codecs.register_error(DRAWN, _as_it_can)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=DRAWN)
    with (
        contextlib.redirect_stdout(cast("IO[str]", _Guarded(sys.stdout))),
        contextlib.redirect_stderr(cast("IO[str]", _Guarded(sys.stderr))),
    ):
        yield


def _as_it_can(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that an encoding lacks; an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_ALIKE.get(c, "?") for c in lacking), error.end
