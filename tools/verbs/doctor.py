"""`xrl doctor`: is this robot as it should be? Looks, and moves and changes nothing."""

from __future__ import annotations

import argparse

import msgspec
from rich.text import Text

from shared.config import files as config_file
from shared.exceptions import FAULT_EXIT_CODE
from tools.bringup.drive_access import add_plant, check_plants, robot_file
from tools.bringup.findings import report_of, show
from tools.bringup.survey import survey
from tools.terminal import Console
from tools.verb_table import FLEET, Subparsers, add_config, add_run_dir, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "doctor",
        """
        xrl doctor
        xrl doctor --config lab.toml --verbose
        xrl doctor --json | jq '.groups[][] | select(.verdict == "wrong")'
        xrl doctor --plant knee_left.axis0.controller.config.vel_limit=2
        """,
    )
    add_config(parser, before=FLEET)
    add_run_dir(parser)
    parser.add_argument("--verbose", action="store_true", help="a line for each check that is ok")
    parser.add_argument("--json", action="store_true", help="print JSON: every row")
    add_plant(parser)


def run(args: argparse.Namespace) -> int:
    """Look at everything; 0 if nothing is wrong."""
    path = robot_file(args)
    robot = config_file.load(path)
    check_plants(robot, args.run_dir, args.plant)
    with Console(stderr=True).status("looking") as status:
        groups = survey(
            robot,
            path,
            args.run_dir,
            args.plant,
            lambda words: status.update(Text(f"looking at {words}")),
        )
    report = report_of(groups)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(report)).decode())
    else:
        show(Console(), groups, verbose=args.verbose)
    return 0 if report.ok else FAULT_EXIT_CODE
