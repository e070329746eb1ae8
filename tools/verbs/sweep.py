"""`xrl study sweep`: studies over many random runs in virtual time. One module a study."""

from __future__ import annotations

import argparse
import importlib
from typing import Any, Final

from shared.extras import require
from tools.verb_table import Subparsers, add_verb

STUDIES: Final = {
    "certificate": (
        "check the sign of K_fail against falls in simulation",
        "",
        "--n 1000 --seed 3 --rigid",
        "--friction",
    ),
    "dynamics": (
        "search for poses where a motion that should decay grows",
        "",
        "--n 400 --out out/dynamics",
        "--only 7",
    ),
    "kill": (
        "kill the planner in random poses, under random pushes",
        "",
        "--n 500 --seed 1 --out out/kill",
        "--only 137 --seed 1",
        "--only 137 --seed 1 --out out/case137",
    ),
    "latency": (
        "compare three controls over bad networks: who falls, who leads",
        "",
        "--delay 0:200:10 --jitter 5 --loss 0,0.2 --trials 10 --out out/latency",
        "--control distributed --delay 0:60:5 --loss 0 --lead-easing 0",
        "--only 137 --out out/trial137",
        "--cluster tcp://HOST:8786",
    ),
    "push": (
        "find the hardest push by direction, duration, pose and mode",
        "",
        "--pose stand --duration 3 --angle 90",
        "--plant drivetrain.stiffness=2000 --out out/soft",
    ),
    "trips": (
        "check that each trip comes where it should, and nowhere else",
        "",
        "--trouble sags --trouble drops",
        '--on "k 2000" --out out/trips',
    ),
    "robust": (
        "draw every error of the plant at once: who falls, and why",
        "",
        "--n 500 --out out/robust",
        "--beyond 2",
        "--slope 5 --imu",
        "--only 17 --out out/trial17",
    ),
}
"""In words, and the flags of its examples. The module `_SWEEPS.NAME` has `STUDY`."""
_SWEEPS: Final = "tools.lab.studies.sweeps"


class StudyParser(argparse.ArgumentParser):
    """Has the flags of its study once it is used: to import all studies takes a second."""

    study = ""

    def complete(self) -> None:
        """Add the flags, if they are not there yet."""
        if self.study and self.get_default("study") is None:
            study = importlib.import_module(f"{_SWEEPS}.{self.study}").STUDY
            importlib.import_module(f"{_SWEEPS}.study").add_flags(self, study)
            self.set_defaults(study=study)

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Parse with all flags."""
        self.complete()
        return super().parse_known_args(*args, **options)

    def format_help(self) -> str:
        """Return the help on all flags."""
        self.complete()
        return super().format_help()


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb and its studies."""
    parser = add_verb(subparsers, "sweep", "\n".join(map(_examples, STUDIES)))
    studies = parser.add_subparsers(metavar="STUDY", required=True, parser_class=StudyParser)
    for name, (words, *_) in STUDIES.items():
        study = studies.add_parser(
            name,
            help=words,
            description=f"{words[0].upper()}{words[1:]}.",
            epilog=f"examples:\n{_examples(name)}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        study.study = name


def run(args: argparse.Namespace) -> int:
    """Run the study."""
    require("sim")
    return int(importlib.import_module(f"{_SWEEPS}.study").run(args.study, args))


def _examples(name: str) -> str:
    return "\n".join(f"  xrl study sweep {name} {flags}".rstrip() for flags in STUDIES[name][1:])
