"""Table of the command line's verbs and nouns, and the setup that their parsers share."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Final, NamedTuple, TypeAlias, get_type_hints

from shared.arguments import FlagParser
from tools.flags import Flags, add_flags, read_flags

Subparsers: TypeAlias = "argparse._SubParsersAction[FlagParser]"  # noqa: SLF001 - its only name
"""Object whose `add_parser` adds a verb or a noun."""


class Verb(NamedTuple):
    """One verb.

    Its module has `EXAMPLES` and a function that takes the verb's flags (`tools.flags`) and returns
    the exit code.
    """

    name: str
    """Words that a person types: `demo`, or a noun and a verb such as `log info`."""
    help: str
    at: str = ""
    """MODULE:FUNCTION, relative to `tools.verbs` unless it begins with `tools.`. By default, the
    module has the verb's name and the function is `run`."""

    @property
    def noun(self) -> str:
        """Noun of the verb; "" for a verb without a noun."""
        return self.name.rpartition(" ")[0]

    @property
    def word(self) -> str:
        """Verb without its noun."""
        return self.name.rpartition(" ")[2]

    @property
    def module(self) -> ModuleType:
        """Module of the verb, imported on access."""
        path = self.at.partition(":")[0] or self.name.replace(" ", ".")
        return importlib.import_module(path if path.startswith("tools.") else f"tools.verbs.{path}")

    @property
    def function(self) -> Callable[[Flags], int]:
        """Function that runs the verb."""
        found: Callable[[Flags], int] = getattr(self.module, self.at.partition(":")[2] or "run")
        return found

    @property
    def declaration(self) -> type[Flags]:
        """Declaration of the verb's flags."""
        hints = get_type_hints(self.function)
        (found,) = (kind for name, kind in hints.items() if name != "return")
        return found  # type: ignore[no-any-return]

    @property
    def examples(self) -> list[str]:
        """Examples in the verb's module; if several verbs share it, only those of this verb."""
        lines = [line.strip() for line in self.module.EXAMPLES.strip().splitlines()]
        if not self.at.partition(":")[2]:
            return lines
        return [line for line in lines if f"xrl {self.name} " in f"{line} "]


NOUNS: Final = {
    "drive": "set up, move and measure drives",
    "log": "inspect, export and replay logs",
    "topic": "show messages on the bus",
    "study": "run many cases and explain the falls",
    "hosts": "run the services on several hosts",
    "keys": "make, check and renew certificates",
    "ros2": "check the robot's topics in ROS 2",
}
"""Help of each noun. `bench` is missing because it is also a verb."""

PERSONS: Final = {
    "To run a robot": (
        "new doctor up down status start kill estop rearm pendant lead cue view faults drive log "
        "topic hosts keys ros2"
    ),
    "To study it": "demo sim inject study gains",
    "To develop it": "bench completion",
}
"""Verbs and nouns of `xrl --help`, by purpose."""

VERBS: Final = (
    Verb("demo", "run the paper's experiment, live"),
    Verb("sim", "run an experiment in virtual time"),
    Verb("up", "start the fleet"),
    Verb("down", "lower the robot and stop the fleet"),
    Verb("status", "show services, modules and topics"),
    Verb("start", "start or resume one service", "services:start"),
    Verb("kill", "send a signal to one service", "services:kill"),
    Verb("inject", "impair the network of a live fleet"),
    Verb("estop", "stop every module: the robot sinks", "estop:estop"),
    Verb("rearm", "re-arm all modules after a stop", "services:rearm"),
    Verb("pendant", "act as a dead man's handle", "estop:pendant"),
    Verb("lead", "lead the robot by gamepad or keys"),
    Verb("cue", "alert the wearer if the robot holds"),
    Verb("view", "show the robot in a browser"),
    Verb("new", "create a directory for a robot"),
    Verb("doctor", "check drives, buses and computer"),
    Verb("faults", "list faults and how to recover"),
    Verb("drive configure", "back up and write drive settings; calibrate drives"),
    Verb("drive zero", "write each joint's position to its drive"),
    Verb("drive jog", "move one joint slightly and judge its response"),
    Verb("drive tare", "set the harness's zero from its unloaded reading"),
    Verb("drive identify", "measure a hanging joint's friction and reflected inertia"),
    Verb("log info", "show a log's topics, rates, gaps and lost messages"),
    Verb("log recover", "write a finished copy of an unfinished log"),
    Verb("log play", "replay a log on a separate bus, under replay/"),
    Verb("log report", "write a one-page report of a run"),
    Verb("log wearer", "measure a wearer's park thresholds"),
    Verb("log export", "export a run as an animation, CSV tables or a ROS 2 bag"),
    Verb("log explain", "explain one planner tick: gains, margins, torque by origin"),
    Verb("log resim", "rerun a log's services and compare their outputs with the log"),
    Verb("log whatif", "kill a service at each moment of a simulated run: does the robot stand?"),
    Verb("topic echo", "print a topic's messages as they arrive"),
    *(
        Verb(f"study {name}", about, f"tools.lab.studies.sweeps.{name}")
        for name, about in (
            ("kill", "kill the planner in random poses, under random pushes"),
            ("robust", "simulate robots with random plant errors: which fall, and why"),
            ("latency", "compare three controllers over bad networks"),
            ("push", "find the largest push that the robot withstands, with and without planner"),
            ("wearer", "simulate wearers who squat, rest, let go or go limp, with park off and on"),
        )
    ),
    Verb(
        "study crash",
        "fail services, links and drives of a live fleet, and judge each case",
        "tools.lab.studies.crash.matrix",
    ),
    Verb("hosts files", "write each host's files into a folder", "hosts:files"),
    Verb("hosts update", "send each host its files over ssh", "hosts:update"),
    Verb("hosts check", "check the hosts' files, versions, keys, clocks and units", "hosts:check"),
    Verb("hosts up", "start the services on all hosts, and arm the drives", "hosts:up"),
    Verb("hosts status", "show all hosts' services in one table", "hosts:status"),
    Verb("hosts estop", "stop every module through each host's shared memory", "hosts:estop"),
    Verb("hosts down", "lower the robot and stop the services on all hosts", "hosts:down"),
    Verb("keys make", "make a robot's certificate authority and its certificates", "keys:make"),
    Verb("keys pack", "pack the keys of one host, without the authority's key", "keys:pack"),
    Verb("keys check", "check this host's keys, or with --authority the authority's", "keys:check"),
    Verb("keys renew", "make new certificates; the old ones stay valid", "keys:renew"),
    Verb("keys revoke", "replace certificates; updated hosts refuse the old ones", "keys:revoke"),
    Verb("gains", "compute the certified gain schedule"),
    Verb("ros2 check", "join ROS 2 as a node and check the robot's topics"),
    Verb("bench", "measure the CPU time of each part"),
    Verb("bench bus", "compare transports under the fleet's message pattern", "bench:bus"),
    Verb("bench fleet", "measure the whole fleet live, during the experiment", "bench:fleet"),
    Verb("completion", "print a shell's completion script"),
)
"""All verbs; a verb's module is imported only when the verb is used."""


def sentence(text: str) -> str:
    """Return a help text as a sentence."""
    return f"{text[0].upper()}{text[1:]}" + ("" if text.endswith("?") else ".")


def add_declared(subparsers: Subparsers, verb: Verb) -> None:
    """Add the parser of a verb with its flags, help and examples."""
    lines = "\n".join(f"  {line}" for line in verb.examples)
    about = getattr(verb.module, "ABOUT", "")
    parser = subparsers.add_parser(
        verb.word,
        help=verb.help,
        description=f"{sentence(verb.help)}\n{about}".rstrip(),
        epilog=f"examples:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    function, declaration = verb.function, verb.declaration
    add_flags(parser, declaration)
    parser.set_defaults(run=lambda found: function(read_flags(declaration, found)))
