"""`python -m tools.dev.words`: finds phrases that a colleague would not say, with replacements.

It searches README, CONTRIBUTING, docs, and the Python files of services, shared and tools.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from shared.exceptions import FAULT_EXIT_CODE

ROOT: Final = Path(__file__).resolve().parents[2]
PATTERNS: Final = (
    (r"\bnobody's\b|\bof somebody's own\b", "name the owner, or say that there is none"),
    (r"\bnobody knows\b|\bwhich nobody\b|\bleads nobody\b", "is unknown; does not lead"),
    (r"\bwhoever\b", "name the person or the process"),
    (r"\bso (long|many|much|often)\b(?! (as|that)\b)", "a number, a maximum, a timeout"),
    (r"\bnever so\b|\bno longer than so\b", "at most N"),
    (r"\bfor ever\b", "forever, or say until when"),
    (r"\bat the (most|least)\b", "at most, at least"),
    (r"\b(is|are) no more\b|\bno more$", "has ended; no longer"),
    (r"\bof none\b|\bhas none\b", "None if ...; has no X"),
    (r"\bgoes on\b", "continues"),
    (r"\bstands in (the|a|its|this|that)\b", "is in"),
    (r"\b(is|are) to be\b", "must be, should be"),
    (r"\bin vain\b", "without success"),
    (r'"""(Of|What|How|Whether|Who|That|Which) ', "a noun phrase, or an imperative"),
    (r"\bwhat (it|there) is to\b|\bwhat may not\b", "name the thing"),
    (r"\bkeeps? (silence|still) about\b|\bis silent about\b", "does not report"),
)
"""Regular expression, which ignores case, and what to write instead."""
PLACES: Final = ("README.md", "CONTRIBUTING.md", "docs/*.md", "services", "shared", "tools")
_COMPILED: Final = tuple((re.compile(found, re.IGNORECASE), right) for found, right in PATTERNS)


def _findings(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield line number, phrase and replacement of each finding in a text."""
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, right in _COMPILED:
            found = pattern.search(line)
            if found:
                yield number, found[0], right


def _files() -> Iterator[Path]:
    for place in PLACES:
        path = ROOT / place
        yield from sorted(path.rglob("*.py") if path.is_dir() else ROOT.glob(place))


def main() -> int:
    """Print every finding; return the exit code, which is a fault if there is any finding."""
    count = 0
    for path in _files():
        if path == Path(__file__).resolve():
            continue
        for number, found, right in _findings(path.read_text(encoding="utf-8")):
            count += 1
            print(f"{path.relative_to(ROOT)}:{number}: {found.strip()!r}; write: {right}")
    print(f"words: {count} to replace" if count else "words: no findings")
    return FAULT_EXIT_CODE if count else 0


if __name__ == "__main__":
    sys.exit(main())
