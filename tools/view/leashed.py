"""`python -m tools.view.leashed PID WORDS`: `xrl WORDS`, which ends when process PID does."""

from __future__ import annotations

import signal
import sys

from tools import cli
from tools.fleet.parent_death import die_with_parent


def main() -> int:
    """Run it."""
    parent, *words = sys.argv[1:]
    die_with_parent(int(parent), signal.SIGTERM)
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(main())
