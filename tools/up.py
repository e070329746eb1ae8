"""`xrl up`: start the fleet."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from shared import config_file, gain_schedule
from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.runs.experiment import make_out, scenario_file
from tools.supervision.supervise import Fleet
from tools.verbs import Subparsers, add_config, add_run_dir, add_verb

SETTLE_S = 3.0
"""A scenario starts so long after the hoist is down."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "up",
        """
        xrl up
        xrl up --scenario crawl --out out/crawl
        xrl up --injectable                            # then: xrl inject --link ... --delay 30
        xrl up --config lab.toml --no-sim
        xrl up --config lab.toml --no-sim --readonly   # move the joints by hand, and look
        """,
    )
    add_config(parser)
    add_run_dir(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where the recorder writes (default: out/ and the time)",
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME|FILE",
        help="what the simulated operator does once the robot stands: a file, or a name from "
        "deploy/scenarios (its kills are left to you)",
    )
    parser.add_argument(
        "--no-sim",
        action="store_true",
        help="start no simulator: the drives are real, or come later",
    )
    parser.add_argument(
        "--snapshot",
        type=float,
        metavar="SECONDS",
        help="record nothing until something goes wrong, then so much before and after it",
    )
    parser.add_argument(
        "--no-planner",
        action="store_true",
        help="six modules that HOLD by themselves; `xrl start planner` lets it lead",
    )
    parser.add_argument(
        "--injectable",
        action="store_true",
        help="with the injector on the links between planner, joints and harness, for `xrl inject`",
    )
    parser.add_argument(
        "--readonly",
        action="store_true",
        help="the joint services listen to their drives and publish, and send them nothing",
    )


def run(args: argparse.Namespace) -> int:
    """Start the fleet and say where it is."""
    gain_schedule.require(config_file.load(args.config), args.config)
    out = args.out or Path("out") / time.strftime("%Y%m%d-%H%M%S")
    make_out(out, "up")
    overrides = {"recorder": ["--out", str(out.absolute())]}
    if args.snapshot is not None:
        overrides["recorder"] += ["--snapshot", f"{args.snapshot:g}"]
    if args.readonly:
        overrides |= {module: ["--readonly"] for module in MODULES}
    if args.scenario is not None:
        if args.no_sim:
            raise FleetError("--scenario is for the simulator, and --no-sim starts none; leave one")
        path = str(scenario_file(args.scenario))
        overrides["simulator"] = ["--scenario", path, "--autostart", str(SETTLE_S)]
        overrides["recorder"] += ["--scenario", path, "--scenario-text", args.scenario]
    fleet = Fleet.start(
        args.config,
        args.run_dir,
        overrides=overrides,
        asleep=("planner",) if args.no_planner else (),
        simulation=not args.no_sim,
        injected=args.injectable,
    )
    up = len(fleet.manifest.services) - args.no_planner
    print(
        f"{up} services are up in {fleet.run.path} "
        f"(logs: {fleet.run.logs}, record: {out}); `xrl status` shows them, `xrl down` stops them"
    )
    return 0
