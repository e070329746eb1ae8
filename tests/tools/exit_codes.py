"""The exit code of a command line, whoever refuses it: its parser, or the verb."""

from __future__ import annotations

from collections.abc import Sequence

from tools import cli


def exit_code(words: Sequence[object]) -> int:
    """Run a verb in this process."""
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as left:
        return int(left.code or 0)
