"""The verbs of the command line, by noun; and what their parsers have in common."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Final, NamedTuple, TypeAlias, get_type_hints

from shared.arguments import FlagParser
from tools.flags import Flags, add_flags, read_flags

Subparsers: TypeAlias = "argparse._SubParsersAction[FlagParser]"  # noqa: SLF001 - its only name
"""What `add_parser` is given."""


class Verb(NamedTuple):
    """One row.

    Its module has `EXAMPLES` and a function whose one parameter is the declaration of its flags
    (`tools.flags`); it returns the exit code.
    """

    name: str
    """What is typed: `demo`; or a noun and a verb, `log info`."""
    help: str
    at: str = ""
    """MODULE:FUNCTION, below `tools.verbs` if it does not begin with `tools.`; none: `run` in the
    module of the verb's name."""

    @property
    def noun(self) -> str:
        """What it is about; "" at the top."""
        return self.name.rpartition(" ")[0]

    @property
    def word(self) -> str:
        """What comes after the noun."""
        return self.name.rpartition(" ")[2]

    @property
    def module(self) -> ModuleType:
        """Imported now."""
        path = self.at.partition(":")[0] or self.name.replace(" ", ".")
        return importlib.import_module(path if path.startswith("tools.") else f"tools.verbs.{path}")

    @property
    def function(self) -> Callable[[Flags], int]:
        """What does it."""
        found: Callable[[Flags], int] = getattr(self.module, self.at.partition(":")[2] or "run")
        return found

    @property
    def declaration(self) -> type[Flags]:
        """Its flags."""
        hints = get_type_hints(self.function)
        (found,) = (kind for name, kind in hints.items() if name != "return")
        return found  # type: ignore[no-any-return]

    @property
    def examples(self) -> list[str]:
        """Those of its module; of a module with several verbs, those of this one."""
        lines = [line.strip() for line in self.module.EXAMPLES.strip().splitlines()]
        if not self.at.partition(":")[2]:
            return lines
        return [line for line in lines if f"xrl {self.name} " in f"{line} "]


NOUNS: Final = {
    "drive": "set up, move and measure drives",
    "log": "inspect, export, replay records",
    "topic": "show what is on the bus",
    "study": "run many cases: who falls, and why",
    "hosts": "run the services on several hosts",
    "keys": "make, check and renew certificates",
    "ros2": "check what ROS 2 sees of the robot",
}
"""Subject of a noun's verbs; `bench` is also a verb itself."""

PERSONS: Final = {
    "To run a robot": (
        "new doctor up down status start kill estop rearm pendant lead cue view faults drive log "
        "topic hosts keys ros2"
    ),
    "To study it": "demo sim inject study gains",
    "To develop it": "bench completion",
}
"""Verbs and nouns of `xrl --help`, by who needs them."""

VERBS: Final = (
    Verb("demo", "run the reference experiment, live"),
    Verb("sim", "run an experiment in virtual time"),
    Verb("up", "start the fleet"),
    Verb("down", "stop the fleet and lower the robot"),
    Verb("status", "show services, modules and topics"),
    Verb("start", "start or continue one service", "services:start"),
    Verb("kill", "send a signal to one service", "services:kill"),
    Verb("inject", "delay, drop or cut live messages"),
    Verb("estop", "stop every module: the robot sinks", "estop:estop"),
    Verb("rearm", "arm all modules again after a stop", "services:rearm"),
    Verb("pendant", "hold a dead man's handle", "estop:pendant"),
    Verb("lead", "lead by a gamepad or by keys"),
    Verb("cue", "tell the wearer at once when the robot stops following, by sound"),
    Verb("view", "show the robot in a browser"),
    Verb("new", "make a robot's own directory"),
    Verb("doctor", "check drives, buses and computer"),
    Verb("faults", "list faults and how to recover"),
    Verb("drive configure", "write the drives' settings, after a backup; calibrate them"),
    Verb("drive zero", "write each joint's position to its drive"),
    Verb("drive jog", "move one joint of one module a little and judge the response"),
    Verb("drive tare", "set the harness's zero from its unloaded reading"),
    Verb("drive identify", "measure a hanging joint's friction and reflected inertia"),
    Verb("log info", "show what is in a log: topics, rates, gaps, losses"),
    Verb("log recover", "make a complete log from one that was cut off"),
    Verb("log play", "put a log back onto a bus of its own, under replay/"),
    Verb("log report", "write a run as one page: plots, timeline, torques, versions"),
    Verb("log wearer", "measure a person's thresholds of park, for the robot's wearer file"),
    Verb("log export", "write a run in other formats: picture, CSV, ROS 2 bag"),
    Verb("log explain", "break one planner tick down: gains, margins, torque by origin"),
    Verb("log resim", "run a log's services again and compare, bit for bit or changed"),
    Verb("log whatif", "kill a service at each moment of a run: would it have stood?"),
    Verb("topic echo", "print the messages of a topic as they come"),
    *(
        Verb(f"study {name}", about, f"tools.lab.studies.sweeps.{name}")
        for name, about in (
            ("kill", "kill the planner in random poses, under random pushes"),
            ("robust", "draw every error of the plant at once: who falls, and why"),
            ("latency", "compare three controls over bad networks: who falls, who leads"),
            ("push", "find the hardest push by direction, duration, pose and mode"),
            ("wearer", "draw persons who rest, let go, go limp, bump: park off and on"),
        )
    ),
    Verb(
        "study crash",
        "bring down services, links and drives one after the other, live, and judge",
        "tools.lab.studies.crash.matrix",
    ),
    Verb("hosts files", "write each host's files into a folder, and send nothing", "hosts:files"),
    Verb("hosts update", "send each host its files: robot file, keys, unit", "hosts:update"),
    Verb("hosts check", "check the hosts' files, versions, keys, clocks and units", "hosts:check"),
    Verb("hosts up", "start the services on all hosts, and arm the drives", "hosts:up"),
    Verb("hosts status", "show the services of all hosts in one table", "hosts:status"),
    Verb("hosts estop", "stop every module, by each host's own shared memory", "hosts:estop"),
    Verb("hosts down", "stop the services on all hosts", "hosts:down"),
    Verb("keys make", "make a robot's authority, and a certificate for each process", "keys:make"),
    Verb("keys pack", "pack what one host needs: never the authority's key", "keys:pack"),
    Verb("keys check", "check this host's keys", "keys:check"),
    Verb("keys renew", "make new certificates; the old ones stay valid", "keys:renew"),
    Verb("keys revoke", "make certificates of the next generation, for lost ones", "keys:revoke"),
    Verb("gains", "compute the certified gains"),
    Verb("ros2 check", "join the network as a node, and look for the robot and its topics"),
    Verb("bench", "measure what each part costs here"),
    Verb("bench bus", "measure the fleet's message pattern over each transport", "bench:bus"),
    Verb("bench fleet", "measure the whole fleet, live, in the experiment", "bench:fleet"),
    Verb("completion", "print a shell's completion script"),
)
"""A verb's module is imported only when the verb is used."""


def sentence(text: str) -> str:
    """Return a line of the table as a description."""
    return f"{text[0].upper()}{text[1:]}" + ("" if text.endswith("?") else ".")


def add_declared(subparsers: Subparsers, verb: Verb) -> None:
    """Add the parser of a verb: its flags as declared, its line of the table, its examples."""
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
