"""`xrl`: the command line. One file per verb in `tools/verbs`; `tools.verb_table` lists them."""

from __future__ import annotations

import argparse
import difflib
import importlib
import signal
import sys
from collections.abc import Sequence
from types import FrameType

from shared.exceptions import XrlError
from tools.verb_table import VERBS

INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code: 0, the verb's own, or that of an `XrlError`."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _leave)
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        args = _parser(arguments).parse_args(arguments)
        return int(args.run(args))
    except XrlError as error:
        print(f"xrl: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()  # else the interpreter complains about stdout once more
        return 128 + signal.SIGPIPE
    except OSError as error:  # a path that cannot be, a full disk
        if error.filename is None:
            raise
        print(f"xrl: {str(error.filename)[:200]}: {error.strerror}", file=sys.stderr)
        return XrlError.exit_code
    except KeyboardInterrupt:
        print("xrl: interrupted", file=sys.stderr)
        return INTERRUPTED


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser with every verb complete; takes a second or two."""
    return _parser([], whole=True)


def _parser(arguments: Sequence[str], *, whole: bool = False) -> argparse.ArgumentParser:
    """Return the parser, complete for the verb in use and with one line for each other."""
    parser = argparse.ArgumentParser(
        prog="xrl",
        description="Runtime for Extra Robotic Legs: start, watch and break a fleet of services.",
        epilog="`xrl VERB --help` shows a verb's arguments and examples.",
    )
    subparsers = parser.add_subparsers(metavar="VERB", required=True)
    wanted = next((word for word in arguments if not word.startswith("-")), "")
    names = [verb.name for verb in VERBS]
    if wanted and wanted not in names:
        near = difflib.get_close_matches(wanted, names, n=3)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        parser.error(f"no verb {wanted[:40]!r}; {hint}`xrl --help` lists them")
    for verb in VERBS:
        if whole or verb.name == wanted:
            module = importlib.import_module(f"tools.verbs.{verb.name}")
            module.add_parser(subparsers)
            subparsers.choices[verb.name].set_defaults(run=module.run)
        else:
            subparsers.add_parser(verb.name, help=verb.help)
    return parser


def _leave(number: int, _frame: FrameType | None) -> None:
    """Leave as if by an exception, so that what a verb has started is stopped again."""
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
