"""`xrl completion`: prints a script (by shtab) that completes verbs, flags and files in a shell."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated, Final

import shtab

from tools.cli import whole_parser
from tools.flags import Flags, positional

EXAMPLES: Final = """
xrl completion bash > ~/.local/share/bash-completion/completions/xrl
xrl completion zsh > "${fpath[1]}/_xrl"
"""


class CompletionFlags(Flags):
    """Shell to print the script for."""

    shell: Annotated[str, positional("SHELL", choices=tuple(shtab.SUPPORTED_SHELLS))]
    """shell that the script is for"""


def run(flags: CompletionFlags) -> int:
    """Print the script."""
    parser = whole_parser()
    _complete_paths(parser)
    print(shtab.complete(parser, shell=flags.shell))
    return 0


def _complete_paths(parser: argparse.ArgumentParser) -> None:
    """Enable file completion for every path argument of a parser and its subparsers."""
    for action in parser._actions:  # noqa: SLF001 - argparse has no other list of them
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for below in dict.fromkeys(action.choices.values()):
                _complete_paths(below)
        elif action.metavar == "DIR":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]  # shtab looks for it
        elif action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
