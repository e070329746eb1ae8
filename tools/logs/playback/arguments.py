"""The arguments of `xrl log play`, and its help."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Final

from shared.exceptions import RunError
from tools.logs.playback.schedule import RATE_MAX, RATE_MIN
from tools.logs.playback.selection import CLOCK
from tools.number_arguments import finite
from tools.verb_table import add_run_dir

PREFIX: Final = "replay"
LISTEN: Final = "unixsock-stream/{run}/play.zenoh"
NOWHERE: Final = "none"
CLOCK_HZ: Final = 100.0
CLOCK_HZ_MAX: Final = 1000.0
WAIT_S: Final = 1.0

EXAMPLES: Final = """
xrl log play out/a/run.mcap
xrl log play out/a --rate 0.5 --loop --clock
xrl log play run.mcap run_1.mcap --start-offset 10 --duration 2.5
xrl log play run.mcap --topics 'joint/*/state' harness/wrench --start-paused
xrl log play run.mcap --exclude 'joint/*/trace' --remap harness/wrench=harness/before
"""

ABOUT: Final = f"""
Messages go out in the order and at the times at which the recorder had them, byte for byte:
t_ns and every other stamp in them is that of the recording. Hold them against --clock, not
against your own. What is late goes at once.

Keys: xrl/<robot>/x becomes {PREFIX}/xrl/<robot>/x, which no service subscribes to. With
--prefix "" it is xrl/<robot>/x itself. What a robot acts on (joint states and commands,
harness wrench and tare, attitude, operator intent, estop, sim/control) is then refused while a
joint service is on the bus. --force puts tare, intent, estop and sim/control all the same;
states, commands, wrenches and attitudes would move the robot, and are never put beside a live
drive.

Subscribers dial the player at --listen:
  open_session(robot, "mine", run_dir, connect=["{LISTEN}"])
  .stream(["{PREFIX}/**"])
or any Zenoh 1.x peer or client that connects there. The services of a fleet that is up in
--run-dir are dialled by the player.

In a terminal: space pauses and goes on; right puts the next message of a paused play (or
goes on by 100 ms); up and down change the rate by a tenth; q ends.

Exit code: 0 played; 2 refused, messages could not be sent, or a subscriber that took nothing for
5 s was dropped; 130 Ctrl-C. A subscriber that links up later misses what went out before: the
summary says how many messages nobody heard.
"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add every argument, with the warnings for a person."""
    parser.description = f"{parser.description}\n{ABOUT.rstrip()}"
    parser.add_argument(
        "files",
        nargs="*",
        type=Path,
        metavar="FILE",
        help="files of a run in any order, finished or not, or its directory; write it first",
    )
    _add_what(parser)
    _add_when(parser)
    parser.add_argument(
        "--listen",
        default=LISTEN,
        metavar="ENDPOINT",
        help=f"where subscribers dial (default {LISTEN}); {NOWHERE}: nowhere",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="robot file with the bus's endpoints (default: that of the fleet in --run-dir, else "
        "as shipped: never a log's)",
    )
    add_run_dir(parser)


def _add_what(parser: argparse.ArgumentParser) -> None:
    for flag, words in (("--topics", "play these only"), ("--exclude", "leave these out")):
        parser.add_argument(
            flag,
            nargs="+",
            action="extend",
            default=[],
            metavar="NAME",
            help=f"{words}: names below xrl/<robot>/, or globs as joint/*/state",
        )
    parser.add_argument(
        "--remap",
        nargs="+",
        action="extend",
        default=[],
        metavar="OLD=NEW",
        help="play OLD under the name NEW, both below xrl/<robot>/; * stands for the same in both",
    )
    parser.add_argument(
        "--prefix",
        default=PREFIX,
        metavar="WORD",
        help="what stands before each key (default: %(default)s); empty: the live keys",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="on the live keys beside a live drive: also what it acts on, but for what moves it",
    )


def _add_when(parser: argparse.ArgumentParser) -> None:
    numbers = (
        ("--rate", "-r", 1.0, "R", "recorded seconds for each second (default: %(default)g)"),
        ("--start-offset", "-s", 0.0, "S", "start S seconds after the first message of the log"),
        ("--duration", "-d", None, "S", "length of the part to play, in recorded seconds"),
    )
    for flag, short, default, metavar, words in numbers:
        parser.add_argument(flag, short, type=finite, default=default, metavar=metavar, help=words)
    parser.add_argument("--loop", "-l", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument(
        "--start-paused", "-p", action="store_true", help="until space is pressed; on a terminal"
    )
    parser.add_argument(
        "--clock",
        action="store_true",
        help=f"publish the recorded time on PREFIX/{CLOCK}, as {{t_ns, seq}}",
    )
    parser.add_argument(
        "--clock-hz",
        type=finite,
        default=CLOCK_HZ,
        metavar="HZ",
        help="its rate, in real time (default: %(default)g)",
    )
    parser.add_argument(
        "--wait",
        type=finite,
        default=WAIT_S,
        metavar="S",
        help="longest wait for the first subscriber, seconds (default: %(default)g)",
    )


def check(args: argparse.Namespace) -> None:
    """Refuse numbers that cannot be meant."""
    for name, value, least, most in (
        ("--rate", args.rate, RATE_MIN, RATE_MAX),
        ("--start-offset", args.start_offset, 0.0, math.inf),
        ("--duration", args.duration, 1e-9, math.inf),
        ("--clock-hz", args.clock_hz, RATE_MIN, CLOCK_HZ_MAX),
        ("--wait", args.wait, 0.0, math.inf),
    ):
        if value is not None and not (least <= value <= most and math.isfinite(value)):
            limit = f"{least:g} .. {most:g}" if most < math.inf else f"a number from {least:g} on"
            raise RunError(f"{name} {value:g}: {limit} is right")
