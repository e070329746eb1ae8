"""`python -m tools.dev.reference`: writes the generated pages of docs, or checks them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from shared.arguments import FlagParser
from shared.exceptions import FAULT_EXIT_CODE
from tools.dev.reference import faults, modes, robot_file, topics, verbs

FOLDER: Final = Path(__file__).resolve().parents[3] / "docs" / "reference"
PAGES: Final[dict[str, Callable[[], Iterable[str]]]] = {
    "topics.md": topics.page,
    "robot-file.md": robot_file.page,
    "verbs.md": verbs.page,
    "faults.md": faults.page,
    "modes.md": modes.page,
}
"""Lines of the generated files, by name."""


def text_of(name: str) -> str:
    """Return a generated file."""
    return "\n".join(PAGES[name]()).rstrip() + "\n"


def main() -> int:
    """Write the pages; with `--check` say which differ: a fault."""
    parser = FlagParser(
        prog="python -m tools.dev.reference",
        description="Write docs/reference from the code. A test holds that it is up to date.",
    )
    parser.add_argument(
        "--check", action="store_true", help=f"write nothing; exit code {FAULT_EXIT_CODE} if old"
    )
    args = parser.parse_args()
    old = []
    for name in PAGES:
        path, text = FOLDER / name, text_of(name)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            old.append(name)
            if not args.check:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    for name in old:
        print(f"{'out of date' if args.check else 'written'}: docs/reference/{name}")
    return FAULT_EXIT_CODE if args.check and old else 0


if __name__ == "__main__":
    sys.exit(main())
