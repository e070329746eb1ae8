"""The verbs of the command line, by noun; and what their parsers have in common."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Final, NamedTuple, TypeAlias, get_type_hints

from shared import places
from shared.run_directory import RUN_DIR_VARIABLE, default_run_dir, own_directory
from tools.flags import Flags, add_flags, read_flags

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 - its only name
"""What `add_parser` is given."""

FLEET: Final = "that of the fleet in --run-dir"
"""Whose robot file a verb takes that works on a fleet, if there is one: for `add_config`."""
RUN_HELP: Final = "a run's record, finished or not; or its directory: all files of a split run"


class Verb(NamedTuple):
    """One row.

    Its module has `EXAMPLES` and a function whose one parameter is the declaration of its flags
    (`tools.flags`); it returns the exit code.
    """

    name: str
    """What is typed: `demo`, or a noun and a verb, `log info`."""
    help: str
    at: str = ""
    """MODULE:FUNCTION below `tools.verbs`; none: `run` in the module of the verb's name."""

    @property
    def noun(self) -> str:
        """What it is about; "" at the top."""
        return self.name.partition(" ")[0] if " " in self.name else ""

    @property
    def word(self) -> str:
        """What comes after the noun."""
        return self.name.rpartition(" ")[2]

    @property
    def module(self) -> ModuleType:
        """Imported now."""
        path = self.at.partition(":")[0] or self.name.replace(" ", ".")
        return importlib.import_module(f"tools.verbs.{path}")

    @property
    def function(self) -> Callable[[Flags], int]:
        """What does it."""
        found: Callable[[Flags], int] = getattr(self.module, self.at.partition(":")[2] or "run")
        return found

    @property
    def examples(self) -> str:
        """Those of its module; of a module with several verbs, those that begin with this one."""
        lines = [line.strip() for line in self.module.EXAMPLES.strip().splitlines()]
        own = [line for line in lines if f"xrl {self.name}" in line]
        return "\n".join(f"  {line}" for line in (own if self.at else lines))


NOUNS: Final = {
    "topic": "what is on the bus",
}
"""What the verbs of a noun are about."""

VERBS: Final = (
    Verb("demo", "run the reference experiment, kill the planner, judge the outcome"),
    Verb("sim", "run the same experiment in virtual time, with a modelled network"),
    Verb("sweep", "run many random cases in virtual time and count the falls"),
    Verb("crashtest", "kill one service after the other, live, and judge each run"),
    Verb("up", "start the fleet"),
    Verb("status", "show every service and every module"),
    Verb("top", "show processes and topics on one screen: CPU, rates, ages, bytes"),
    Verb("echo", "print the messages of a topic as they come"),
    Verb("topic hz", "measure the rate, spacing, age and size of topics"),
    Verb("faults", "list the faults: what the robot does then, and the way out"),
    Verb("kill", "send a signal to one service"),
    Verb("inject", "delay, drop or cut a live fleet's messages for a while"),
    Verb("start", "start a service that is down, or continue one that is paused"),
    Verb("estop", "stop every module: a slow sink, never a drop"),
    Verb("pendant", "hold a dead man's handle: when it ends, every module stops"),
    Verb("assist", "ask the robot to carry some of the person, while it runs"),
    Verb("lead", "lead height, pitch and assist by a gamepad or by keys"),
    Verb("new", "make a robot's own directory: robot file, gains, scenarios, plants"),
    Verb("gains", "compute the certified gain schedule of a robot"),
    Verb("tare", "set the harness's zero from its unloaded reading"),
    Verb("doctor", "check drives, buses and computer against the robot file"),
    Verb("can", "bring the CAN buses up, listen to them, measure how long drives answer"),
    Verb("configure", "write the drives' settings, after a backup of the old ones"),
    Verb("zero", "write each joint's position to its drive"),
    Verb("jog", "move one joint of one module a little and judge the response"),
    Verb("identify", "measure what the robot file assumes: masses, zeros, friction, scale"),
    Verb("tune", "offset a reference by step and sines: rise, damping, margin; propose gains"),
    Verb("hosts", "run the services on several hosts: bring, check, start, look, stop"),
    Verb("keys", "make, pack, check, renew and revoke the keys of the fleet's processes"),
    Verb("info", "show what is in a log: topics, rates, gaps, losses"),
    Verb("recover", "finish a log that was cut off"),
    Verb("join", "join the records of several hosts into one run"),
    Verb("play", "put a log back onto the bus, beside the live robot"),
    Verb("explain", "break one planner tick down: gains, margins, torque by origin"),
    Verb("view", "show the robot in a browser: live, a record, or one to lead and push"),
    Verb("report", "write a run as one page: plots, timeline, torques, versions"),
    Verb("export", "write a run for others: 3-D scene, picture, CSV, Parquet, ROS 2 bag"),
    Verb("resim", "run a log's services again and compare, bit for bit or changed"),
    Verb("whatif", "kill a service at each moment of a run: would it have stood?"),
    Verb("ros2", "check what ROS 2 sees of the robot"),
    Verb("bench", "measure what each part of the fleet costs here, warm and cold"),
    Verb("stiffness", "print how stiff the body must be to balance"),
    Verb("down", "stop the fleet and leave nothing behind"),
    Verb("completion", "print what completes this command line in a shell"),
)
"""A verb's module is imported only when the verb is used."""

HELP: Final = {verb.name: verb.help for verb in VERBS}

RENAMED: Final = {
    "hz": "topic hz",
}
"""Old names and what answers now."""


def sentence(text: str) -> str:
    """Return a line of the table as a description."""
    return f"{text[0].upper()}{text[1:]}" + ("" if text.endswith("?") else ".")


def add_declared(subparsers: Subparsers, verb: Verb) -> None:
    """Add the parser of a verb whose flags are declared."""
    parser = subparsers.add_parser(
        verb.word,
        help=verb.help,
        description=sentence(verb.help),
        epilog=f"examples:\n{verb.examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    function = verb.function
    (declaration,) = (kind for name, kind in get_type_hints(function).items() if name != "return")
    add_flags(parser, declaration)
    parser.set_defaults(run=lambda found: function(read_flags(declaration, found)))


def add_verb(subparsers: Subparsers, name: str, examples: str) -> argparse.ArgumentParser:
    """Add a verb's parser, with its line of the table as description and its examples.

    Args:
        subparsers: of `xrl`.
        name: of the verb, as in `VERBS`.
        examples: command lines, one per line.
    """
    lines = "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines())
    sentence = f"{HELP[name][0].upper()}{HELP[name][1:]}"
    sentence += "" if sentence.endswith("?") else "."
    return subparsers.add_parser(
        name,
        help=HELP[name],
        description=sentence,
        epilog=f"examples:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_run_dir(
    parser: argparse.ArgumentParser, check: Callable[[str], Path] = own_directory
) -> None:
    """Add `--run-dir`: which fleet is meant.

    Args:
        parser: of the verb.
        check: takes the directory's name; that of another user is refused, but where a robot is
            to be stopped.
    """
    parser.add_argument(
        "--run-dir",
        type=check,
        default=str(default_run_dir()),
        metavar="DIR",
        help="directory of the fleet's sockets and logs (default: "
        f"${RUN_DIR_VARIABLE}, else /tmp/xrl-UID of the user); keep it short",
    )


def add_config(parser: argparse.ArgumentParser, *, before: str = "") -> None:
    """Add `--config`: the robot file, found in the working directory if it is not given.

    Args:
        parser: of the verb.
        before: whose robot file a verb takes before it looks there, such as a running fleet's. Then
            the argument is None if it is not given, and the verb calls `places.robot_file` itself.
    """
    if before:
        text = places.HELP.replace("(default: ", f"(default: {before}, else ")
        parser.add_argument("--config", type=Path, metavar="FILE", help=text)
        return
    parser.add_argument(
        "--config",
        type=places.config_argument,
        default=places.NOT_NAMED,
        metavar="FILE",
        help=places.HELP,
    )
