"""The verbs of the command line: one table, and what their parsers have in common."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from shared.process import DEFAULT_CONFIG, RUN_DIR_VARIABLE, default_run_dir

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 - its only name
"""What `add_parser` is given."""

RUN_HELP: Final = "a run's record, finished or not; or its directory: all files of a split run"


class Verb(NamedTuple):
    """One row: `module` has `add_parser(subparsers)` and `run(args) -> int`."""

    name: str
    module: str
    help: str


VERBS: Final = (
    Verb("demo", "tools.demo", "run the reference experiment, kill the planner, judge the outcome"),
    Verb("sim", "tools.sim", "run the same experiment in virtual time, with a modelled network"),
    Verb("sweep", "tools.sweep", "run many random cases in virtual time, and count the falls"),
    Verb("crashtest", "tools.crashtest", "kill one thing after the other, live, and judge each"),
    Verb("up", "tools.up", "start the fleet"),
    Verb("status", "tools.status", "show every service and every module"),
    Verb("faults", "tools.faults", "list what goes wrong, what then happens, and the way out"),
    Verb("kill", "tools.kill", "send a signal to one service"),
    Verb("inject", "tools.inject", "make a live fleet's network late, lossy or cut, for a while"),
    Verb("start", "tools.start", "start a service that is down, or continue one that is stopped"),
    Verb("estop", "tools.estop", "stop every module: a slow sink, never a drop"),
    Verb("pendant", "tools.pendant", "a dead man's handle: once it ends, every module stops"),
    Verb("assist", "tools.assist", "ask the robot to carry some of the person, while it runs"),
    Verb("gains", "tools.gains", "compute the certified gain schedule of a robot"),
    Verb("tare", "tools.tare", "take what the harness reads now, unloaded, for its zero"),
    Verb("doctor", "tools.doctor", "look whether drives, buses and computer are as they should be"),
    Verb("configure", "tools.configure", "write the drives' settings, with a backup of them"),
    Verb("zero", "tools.zero", "tell drives where their joints are"),
    Verb("jog", "tools.jog", "move one joint of one module a little, and judge it"),
    Verb("info", "tools.info", "show what is in a log: topics, rates, gaps, losses"),
    Verb("recover", "tools.recover", "give a log that was never finished its end"),
    Verb("play", "tools.play", "put a log back onto the bus, beside the live robot"),
    Verb("explain", "tools.explain", "lay one tick of the law open: gains, margins, torques"),
    Verb("report", "tools.report", "write a run as one page: plots, timeline, torques, versions"),
    Verb("export", "tools.export", "copy a log with a 3-D scene in it, or write a viewer's layout"),
    Verb("resim", "tools.resim", "execute a run's services again, bit for bit, or changed"),
    Verb("whatif", "tools.whatif", "kill something at each moment of a run: had it stood?"),
    Verb("bench", "tools.bench", "measure how fast the law and lockstep are here"),
    Verb("stiffness", "tools.stiffness", "print how stiff the body must be to balance"),
    Verb("down", "tools.down", "stop the fleet and leave nothing behind"),
)
"""A verb's module is imported only when the verb is used."""

HELP: Final = {verb.name: verb.help for verb in VERBS}


def add_verb(subparsers: Subparsers, name: str, examples: str) -> argparse.ArgumentParser:
    """Add a verb's parser, with its line of the table as description and its examples.

    Args:
        subparsers: of `xrl`.
        name: of the verb, as in `VERBS`.
        examples: command lines, one per line.
    """
    lines = "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines())
    sentence = f"{HELP[name][0].upper()}{HELP[name][1:]}."
    return subparsers.add_parser(
        name,
        help=HELP[name],
        description=sentence,
        epilog=f"examples:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_run_dir(parser: argparse.ArgumentParser) -> None:
    """Add `--run-dir`: which fleet is meant."""
    parser.add_argument(
        "--run-dir",
        type=Path,
        default=default_run_dir(),
        metavar="DIR",
        help="directory of the fleet's sockets and logs (default: "
        f"${RUN_DIR_VARIABLE}, else /tmp/xrl-UID of the user); keep it short",
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add `--config`: the robot file."""
    parser.add_argument(
        "--config",
        type=Path,
        default=DEFAULT_CONFIG,
        metavar="FILE",
        help="robot file (default: deploy/robot.toml of this checkout)",
    )
