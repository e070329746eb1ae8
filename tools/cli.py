"""`xrl`: the command line. One file per verb in `tools/verbs`; `tools.verb_table` lists them."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import importlib.metadata
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import Any

from shared import revision
from shared.exceptions import BUG_EXIT_CODE, XrlError, os_error_in_words
from tools.guarded_streams import guarded_streams
from tools.verb_table import VERBS

INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code (docs/reference/verbs.md)."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _leave)
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    with guarded_streams():
        try:
            return _run(arguments)
        except XrlError as error:
            print(f"xrl: {error}", file=sys.stderr)
            return error.exit_code
        except BrokenPipeError:
            _drop_output()
            return 128 + signal.SIGPIPE
        except OSError as error:
            _drop_output()
            print(f"xrl: {os_error_in_words(error)}", file=sys.stderr)
            return XrlError.exit_code
        except KeyboardInterrupt:
            print("xrl: interrupted", file=sys.stderr)
            return INTERRUPTED
        except Exception:  # noqa: BLE001 - Python's own exit code would be 1: a robot that fell
            traceback.print_exc()
            print("xrl: a fault of xrl itself: please report the lines above", file=sys.stderr)
            return BUG_EXIT_CODE


def _run(arguments: Sequence[str]) -> int:
    try:
        args = _parser(arguments).parse_args(arguments)
        code = int(args.run(args))
    except SystemExit:
        sys.stdout.flush()
        raise
    sys.stdout.flush()  # a full disk is told here; at the interpreter's end it would be a traceback
    return code


def _drop_output() -> None:
    """Take what nobody can be given from the standard output, or Python tries again at its end."""
    with contextlib.suppress(ValueError):
        try:
            sys.stdout.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser with every verb complete; takes a second or two."""
    parsers = [_parser([], whole=True)]
    for parser in parsers:
        parser.format_help()  # a study's parser has its flags once it is used
        for action in parser._actions:  # noqa: SLF001 - argparse has no other list of them
            if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
                parsers += dict.fromkeys(action.choices.values())
    return parsers[0]


def _parser(arguments: Sequence[str], *, whole: bool = False) -> argparse.ArgumentParser:
    """Return the parser, complete for the verb in use and with one line for each other."""
    parser = argparse.ArgumentParser(
        prog="xrl",
        description="Runtime for Extra Robotic Legs: start, watch and break a fleet of services.",
        epilog="`xrl help VERB` or `xrl VERB --help` shows a verb's arguments and examples.",
    )
    parser.add_argument("--version", action=_Version, help="print version and commit, and end")
    subparsers = parser.add_subparsers(metavar="VERB", required=True)
    wanted = next((word for word in arguments if not word.startswith("-")), "")
    names = [verb.name for verb in VERBS]
    if wanted and wanted not in names:
        near = difflib.get_close_matches(wanted, names, n=3)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        if arguments[0].startswith("-"):
            hint = f"{arguments[0]} comes after the verb; "
        parser.error(f"no verb {wanted[:40]!r}; {hint}`xrl --help` lists them")
    for verb in VERBS:
        if whole or verb.name == wanted:
            module = importlib.import_module(f"tools.verbs.{verb.name}")
            module.add_parser(subparsers)
            subparsers.choices[verb.name].set_defaults(run=module.run)
        else:
            subparsers.add_parser(verb.name, help=verb.help)
    return parser


class _Version(argparse.Action):
    """`--version`: and the commit that this code is of."""

    def __init__(self, option_strings: Sequence[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        words = revision.in_words(revision.code())
        print(f"xrl {importlib.metadata.version('xrl')} ({words})")
        parser.exit()


def _leave(number: int, _frame: FrameType | None) -> None:
    """Leave as if by an exception, so that what a verb has started is stopped again."""
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
