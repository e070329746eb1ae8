"""`xrl sweep`: studies over many random runs in virtual time. One module a study."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType
from typing import Final

from tools.verbs import Subparsers, add_verb

STUDIES: Final = {
    "certificate": ("tools.sweeps.certificate", "is the sign of K_fail right, in simulation?"),
    "dynamics": ("tools.sweeps.dynamics", "does anything grow that is said to fade?"),
    "kill": ("tools.sweeps.kill", "kill the planner in random postures, under random pushes"),
    "latency": ("tools.sweeps.latency", "three controls over bad networks: who falls, who leads"),
    "push": ("tools.sweeps.push", "the hardest push by direction, duration, pose and mode"),
    "trips": ("tools.sweeps.trips", "does each trip come where it is to, and none where not?"),
    "robust": (
        "tools.sweeps.robust",
        "every error of the plant at once: who falls, and why",
    ),
}
"""A study's module has EXAMPLES, `add_flags(parser)` and `run(args) -> int`."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb and its studies."""
    modules = {name: importlib.import_module(module) for name, (module, _) in STUDIES.items()}
    parser = add_verb(subparsers, "sweep", "\n".join(_lines(module) for module in modules.values()))
    studies = parser.add_subparsers(metavar="STUDY", required=True)
    for name, (_, words) in STUDIES.items():
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
    return int(args.study(args))


def _lines(study: ModuleType) -> str:
    return "\n".join(f"  {line.strip()}" for line in study.EXAMPLES.strip().splitlines())
