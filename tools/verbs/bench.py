"""`xrl bench`: how fast the law and lockstep are on this machine.

Absolute times of a busy machine say little: each figure stands beside a yardstick that is
measured in turn with it, and its ratio to that is what two versions are compared by.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from services.planner.planner import Planner
from shared.bus import topics
from shared.bus.messages import JointState, Message, Tare, Wrench
from shared.bus.topics import Topic
from shared.config import files as config_file
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import RunError
from shared.robot import gain_schedule
from shared.robot.joints import MODULES
from tools.runs.experiment import scenario_file
from tools.runs.lockstep import Lockstep
from tools.verb_table import Subparsers, add_config, add_verb

TICK_US: Final = 500.0
SPEED: Final = 3.0
"""Targets of docs/results.md#targets: planner tick, median; lockstep, in times of real time."""
TICKS: Final = 750
"""Ticks of a recorded squat: 3 s at 250 Hz, on the way down and up."""
YARDSTICK_CALLS: Final = 20


class Figure(NamedTuple):
    """One line of the table."""

    what: str
    value: float
    unit: str
    spread: str
    ratio: float
    """To the yardstick measured in turn with it."""
    target: str
    ok: bool


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "bench",
        """
        xrl bench
        xrl bench --rounds 9 --json bench.json
        """,
    )
    add_config(parser)
    parser.add_argument(
        "--rounds", type=int, default=5, metavar="N", help="of every measurement, in turn (5)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument("--strict", action="store_true", help="exit 1 if a target is missed")


def run(args: argparse.Namespace) -> int:
    """Measure and print; with --strict 1 if a target is missed."""
    if args.rounds < 1:
        raise RunError(f"--rounds {args.rounds}: at least 1")
    robot = config_file.load(args.config)
    gain_schedule.require(robot, args.config)
    console = Console()
    figures = measure(robot, args.rounds, console)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("", "median", "10 .. 90 %", "/ yardstick", "target"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in figures:
        mark = "[green]ok[/]" if row.ok else "[yellow]missed[/]"
        table.add_row(
            row.what, f"{row.value:.3g} {row.unit}", row.spread, f"{row.ratio:.3g}",
            f"{row.target} {mark}" if row.target else "",
        )  # fmt: skip
    console.print(table)
    console.print(
        f"yardstick: the time of {YARDSTICK_CALLS} solutions of a 12 x 12 system in NumPy, "
        "measured in turn with each figure",
        style="dim",
    )
    if args.json is not None:
        text = json.dumps([row._asdict() for row in figures], indent=2) + "\n"
        args.json.write_text(text, encoding="utf-8")
    return 1 if args.strict and not all(row.ok for row in figures) else 0


def measure(robot: RobotConfig, rounds: int, console: Console) -> list[Figure]:
    """Return the figures; every round measures each thing once."""
    scenario = scenarios.load(scenario_file("squat"))
    record = recorded_inputs(robot, scenario)
    law = msgspec.structs.replace(robot.law, split="diagonal")
    paper = msgspec.structs.replace(robot, law=law)
    ticks: dict[str, list[float]] = {"certified": [], "diagonal": []}
    speeds: list[float] = []
    yards: list[float] = []
    for _ in track(range(rounds), "measuring", console=console, transient=True):
        for name, variant in (("certified", robot), ("diagonal", paper)):
            yards.append(yardstick_s())
            ticks[name] += tick_times(variant, record)
        yards.append(yardstick_s())
        speeds.append(lockstep_speed(robot, scenario))
    yard = float(np.median(yards))
    return [
        _timing("planner tick, certified", ticks["certified"], yard, TICK_US),
        _timing("planner tick, diagonal", ticks["diagonal"], yard, None),
        _speed("lockstep to real time", speeds, yard),
    ]


def recorded_inputs(robot: RobotConfig, scenario: Scenario) -> list[tuple[int, list[JointState]]]:
    """Return the six states of every tick of a squat, with the time of the tick, ns."""
    latest: dict[str, JointState] = {}
    inputs: list[tuple[int, list[JointState]]] = []

    def take(topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_STATE and isinstance(message, JointState):
            latest[module] = message
        elif topic is topics.PLANNER_STATUS and len(latest) == len(MODULES):
            inputs.append((message.t_ns, [latest[name] for name in MODULES]))

    fleet = Lockstep(robot, scenario, record=take)
    for truth in fleet.run():
        if truth.scenario_s < 0.0:
            inputs.clear()
        if len(inputs) >= TICKS:
            break
    return inputs[:TICKS]


def tick_times(robot: RobotConfig, inputs: Sequence[tuple[int, list[JointState]]]) -> list[float]:
    """Return the time of each tick over recorded states, s: states in, messages out."""
    planner = Planner(robot, session=1)
    wrench = _leading()
    times = []
    for now_ns, states in inputs:
        begin = time.perf_counter()
        planner.receive_wrench(wrench, now_ns)
        for module, state in enumerate(states):
            planner.receive_state(module, state, now_ns)
        planner.tick(now_ns)
        planner.status(now_ns, 0.0)
        times.append(time.perf_counter() - begin)
    return times


def lockstep_speed(robot: RobotConfig, scenario: Scenario) -> float:
    """Return how many times faster than real time a squat runs on one core, without a log."""
    fleet = Lockstep(robot, scenario)
    begin, started_ns = time.process_time(), fleet.now_ns
    for truth in fleet.run():
        if truth.scenario_s >= scenario.keyframe[-1].at:
            break
    return (fleet.now_ns - started_ns) / 1e9 / (time.process_time() - begin)


def yardstick_s() -> float:
    """Return the time of the yardstick, s: the least of a few, so that a stall does not count."""
    A = np.eye(12) + 0.01 * np.arange(144.0).reshape(12, 12) / 144.0
    b = np.ones(12)

    def once() -> float:
        begin = time.perf_counter()
        for _ in range(YARDSTICK_CALLS):
            np.linalg.solve(A, b)
        return time.perf_counter() - begin

    return _least(once)


def _least(measurement: Callable[[], float]) -> float:
    return min(measurement() for _ in range(15))


def _leading() -> Wrench:
    """Return the wrench of a hand that leads: the harness is in the loop."""
    zero = (0.0, 0.0, 0.0)
    return Wrench(
        t_ns=0, seq=0, force=(0.0, 0.0, -20.0), moment=zero, valid=True, saturated=False,
        tare=int(Tare.DONE), age_ns=0,
    )  # fmt: skip


def _timing(what: str, times: list[float], yard: float, target_us: float | None) -> Figure:
    low, median, high = np.percentile(np.array(times) * 1e6, [10, 50, 90])
    return Figure(
        what,
        float(median),
        "us",
        f"{low:.0f} .. {high:.0f}",
        float(median) * 1e-6 / yard,
        "" if target_us is None else f"<= {target_us:g} us",
        target_us is None or bool(median <= target_us),
    )


def _speed(what: str, speeds: list[float], yard: float) -> Figure:
    low, median, high = np.percentile(speeds, [10, 50, 90])
    return Figure(
        what,
        float(median),
        "x",
        f"{low:.1f} .. {high:.1f}",
        1e-3 / float(median) / yard,
        f">= {SPEED:g} x",
        bool(median >= SPEED),
    )
