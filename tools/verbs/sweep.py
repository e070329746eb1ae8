"""`xrl study sweep`: studies over many random runs in virtual time. One module a study."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType
from typing import Final

from shared.extras import require
from tools.verb_table import Subparsers, add_verb

STUDIES: Final = {
    "certificate": "check the sign of K_fail against falls in simulation",
    "dynamics": "search for poses where a motion that should decay grows",
    "kill": "kill the planner in random poses, under random pushes",
    "latency": "compare three controls over bad networks: who falls, who leads",
    "push": "find the hardest push by direction, duration, pose and mode",
    "trips": "check that each trip comes where it should, and nowhere else",
    "robust": "draw every error of the plant at once: who falls, and why",
}
"""The module `_SWEEPS.NAME` has EXAMPLES, `add_flags(parser)`, `run(args) -> int`."""
_SWEEPS: Final = "tools.lab.studies.sweeps"


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb and its studies."""
    modules = {name: importlib.import_module(f"{_SWEEPS}.{name}") for name in STUDIES}
    parser = add_verb(subparsers, "sweep", "\n".join(_lines(module) for module in modules.values()))
    studies = parser.add_subparsers(metavar="STUDY", required=True)
    for name, words in STUDIES.items():
        study = studies.add_parser(
            name,
            help=words,
            description=f"{words[0].upper()}{words[1:]}.",
            epilog=f"examples:\n{_lines(modules[name])}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        modules[name].add_flags(study)
        study.set_defaults(study=modules[name].run)


def run(args: argparse.Namespace) -> int:
    """Run the study."""
    require("sim")
    return int(args.study(args))


def _lines(study: ModuleType) -> str:
    return "\n".join(f"  {line.strip()}" for line in study.EXAMPLES.strip().splitlines())
