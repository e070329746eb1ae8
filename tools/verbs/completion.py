"""`xrl completion`: what completes verbs, options and files in bash, zsh or tcsh; by shtab."""

from __future__ import annotations

import argparse
from pathlib import Path

import shtab

from tools.cli import whole_parser
from tools.verb_table import Subparsers, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "completion",
        """
        xrl completion bash > ~/.local/share/bash-completion/completions/xrl
        xrl completion zsh > "${fpath[1]}/_xrl"
        """,
    )
    parser.add_argument("shell", choices=shtab.SUPPORTED_SHELLS, help="print it for this shell")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    parser = whole_parser()
    _complete_paths(parser)
    print(shtab.complete(parser, shell=args.shell))
    return 0


def _complete_paths(parser: argparse.ArgumentParser) -> None:
    """Let every argument that is a path complete files, and its subparsers' too."""
    for action in parser._actions:  # noqa: SLF001 - argparse has no other list of them
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for below in dict.fromkeys(action.choices.values()):
                _complete_paths(below)
        elif action.metavar == "DIR":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]  # shtab looks for it
        elif action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
