"""`xrl`: the command line. The verbs are in `tools/verbs`; `tools.verb_table` lists them."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import itertools
import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import Any

from shared import revision
from shared.arguments import FlagParser
from shared.exceptions import (
    BUG_EXIT_CODE,
    HUNG_UP_EXIT_CODE,
    XrlError,
    os_error_in_words,
)
from tools.guarded_streams import guarded_streams
from tools.keyboard import is_hung_up
from tools.verb_table import NOUNS, PERSONS, VERBS, Subparsers, add_declared, sentence

INTERRUPTED = 128 + signal.SIGINT
_NEGATIVE_LIST = re.compile(r"-\.?\d[^,]*,")


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
            _tell(f"xrl: {error}")
            return error.exit_code
        except BrokenPipeError:
            _drop_output()
            return 128 + signal.SIGPIPE
        except OSError as error:
            if any(map(is_hung_up, range(3))):
                _drop_output()
                return HUNG_UP_EXIT_CODE
            _tell(f"xrl: {os_error_in_words(error)}")
            return XrlError.exit_code
        except KeyboardInterrupt:
            _tell("xrl: interrupted")
            return INTERRUPTED
        except Exception:  # noqa: BLE001 - Python would exit with 1, which means a fallen robot
            bug = "xrl: this is a bug in xrl; please report the lines above"
            _tell(f"{traceback.format_exc()}{bug}")
            return BUG_EXIT_CODE


def _run(arguments: Sequence[str]) -> int:
    try:
        args = _parser(arguments).parse_args(_with_values(arguments))
        code = int(args.run(args))
    except SystemExit:
        sys.stdout.flush()
        raise
    sys.stdout.flush()  # report a full disk here; at its exit Python would print a traceback
    return code


def _with_values(arguments: Sequence[str]) -> list[str]:
    """Join a flag and a list that begins with a minus sign, which argparse would read as a flag."""
    joined: list[str] = []
    for word in arguments:
        if joined and joined[-1].startswith("--") and _NEGATIVE_LIST.match(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _tell(words: str) -> None:
    """Print an error; a closed standard error does not change the exit code."""
    with contextlib.suppress(OSError):
        print(words, file=sys.stderr)
    _drop_output()


def _drop_output() -> None:
    """Discard output that cannot be written; otherwise Python retries at exit and fails."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(ValueError):
            try:
                stream.flush()
            except OSError:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)


class _TopParser(FlagParser):
    """Parser whose help fits on one screen: two verbs or nouns per line, by purpose."""

    def format_help(self) -> str:
        """Return the help."""
        about = {verb.name: verb.help for verb in VERBS} | NOUNS
        lines = [f"{self.format_usage()}{self.description}"]
        for purpose, words in PERSONS.items():
            entries = [f"  {name:<11}{about[name]:<36}" for name in words.split() if name in about]
            half = (len(entries) + 1) // 2
            columns = itertools.zip_longest(entries[:half], entries[half:], fillvalue="")
            lines += ["", f"{purpose}:", *("".join(row).rstrip() for row in columns)]
        return "\n".join([*lines, ""])


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser with every verb complete; takes a second or two."""
    return _parser([], whole=True)


def _parser(arguments: Sequence[str], *, whole: bool = False) -> argparse.ArgumentParser:
    """Return the parser, complete for the verb in use, with one line for every other verb."""
    parser = _TopParser(
        prog="xrl",
        usage="xrl [--version] VERB ...",
        description="Runtime for Extra Robotic Legs. `xrl VERB --help` shows flags and examples.",
    )
    parser.add_argument("--version", action=_Version, help="print version and commit, and exit")
    asked = _asked(parser, arguments)
    verbs = parser.add_subparsers(
        prog="xrl", metavar="VERB", required=True, parser_class=FlagParser
    )
    below: dict[str, Subparsers] = {"": verbs}
    for verb in VERBS:
        among = below.get(verb.noun) or _below(verb.noun, below)
        if whole or asked == verb.name or (asked == verb.noun != "" and asked not in NOUNS):
            add_declared(among, verb)
        else:
            among.add_parser(verb.word, help=verb.help)
    return parser


def _below(noun: str, below: dict[str, Subparsers]) -> Subparsers:
    """Return the subparsers of a noun; add the noun unless a verb has its name."""
    above, _, word = noun.rpartition(" ")
    among = below.get(above) or _below(above, below)
    parser = among.choices.get(word)
    if parser is None:
        parser = among.add_parser(word, help=NOUNS[noun], description=sentence(NOUNS[noun]))
    below[noun] = parser.add_subparsers(metavar="VERB", required=noun in NOUNS)
    return below[noun]


def _asked(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> str:
    """Return the verb or noun that a command line begins with, or "".

    An unknown word ends the program with a suggestion.
    """
    names = {verb.name for verb in VERBS} | set(NOUNS)
    found = ""
    for word in itertools.dropwhile(lambda word: word.startswith("-"), arguments):
        longer = f"{found} {word}".lstrip()
        if longer not in names:
            if not word.startswith("-") and (not found or found in NOUNS):
                _refuse(parser, found, word, arguments[0])
            break
        found = longer
    return found


def _refuse(parser: argparse.ArgumentParser, noun: str, word: str, begin: str) -> None:
    known = {verb.word: verb.name for verb in VERBS if verb.noun == noun}
    if not noun:
        known |= {name: name for name in NOUNS if " " not in name}
    near = dict.fromkeys(known[name] for name in difflib.get_close_matches(word, known, n=3))
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    if begin.startswith("-"):
        hint = f"{begin} comes after the verb; "
    asked, where = f"{noun} {word}".lstrip(), f"xrl {noun} --help".replace("  ", " ")
    parser.error(f"no verb {asked[:40]!r}; {hint}`{where}` lists all verbs")


class _Version(argparse.Action):
    """`--version`: prints version and commit."""

    def __init__(self, option_strings: Sequence[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        import importlib.metadata  # noqa: PLC0415 - costs every other verb 20 ms

        words = revision.in_words(revision.code())
        print(f"xrl {importlib.metadata.version('xrl')} ({words})")
        parser.exit()


def _leave(number: int, _frame: FrameType | None) -> None:
    """Exit by an exception, so that a verb stops what it has started."""
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
