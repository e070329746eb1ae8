"""Command line parser of every verb, service and script: flags must be written in full."""

from __future__ import annotations

import argparse
import difflib
from typing import Any


class FlagParser(argparse.ArgumentParser):
    """Parser that refuses abbreviated and unknown flags, and suggests the closest flag.

    With argparse's abbreviations, `xrl down --li` would mean `--limp`, which lets a standing robot
    fall.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; exit with the usage of this parser, not of its parent, if a word is unknown."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(self._refusal(unknown))
        return found, unknown

    def _refusal(self, unknown: list[str]) -> str:
        flags = [word.partition("=")[0] for word in unknown if word.startswith("-")]
        if not flags:
            return f"unexpected argument: {' '.join(unknown)[:80]}"
        known = {flag.lstrip("-"): flag for flag in self._option_string_actions}
        asked = flags[0].lstrip("-")
        near = [name for name in known if name.startswith(asked)]
        near = near or difflib.get_close_matches(asked, known, n=1)
        hint = f"did you mean {' or '.join(known[name] for name in near)}? " if near else ""
        return f"unknown flag {flags[0][:40]!r}; {hint}`--help` lists all flags"
