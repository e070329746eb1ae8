"""`xrl sim`: the experiment in virtual time: no processes, bit-identical, as fast as it can."""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from services.recorder import provenance
from services.recorder.mcap_log import SCHEMA_VERSION, RunWriter
from services.simulator.plant import PlantConfig, plant_from
from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import RunError
from shared.network.impairment import Impairment
from shared.robot.robot_model import mjcf
from tools.centralised.fleet import CONTROLS, SHIPPED
from tools.runs import experiment, figure, verdict, verdict_table
from tools.runs.run_log import read_run
from tools.verbs import Subparsers, add_verb

AFTER_FALL_S = 1.0
DRAIN_EVERY = 512
NOT_HERE = ("pd_cycles_late_pct", "planner_tick_us", "real_time_factor", "world_time_lost_s")
"""Figures of real time: none in virtual time."""


class Outbox:
    """Messages on their way into the log."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._queue: deque[tuple[str, bytes, int]] = deque()
        self._newest_ns = 0

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._queue)

    def put(self, topic: Topic, module: str, message: Message) -> None:
        """Take a message as the bus would.

        It arrives no earlier than those before it: a joint service that hears nothing of its
        drive stamps its states with the last sample that it had.
        """
        self._newest_ns = max(self._newest_ns, message.t_ns)
        self._queue.append((topic.key(self._robot, module), encode(message), self._newest_ns))

    def take(self) -> tuple[str, bytes, int] | None:
        """Return the oldest, or None."""
        return self._queue.popleft() if self._queue else None


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "sim",
        """
        xrl sim
        xrl sim --delay 10 --out out/slow
        xrl sim --delay 5 --jitter 5 --loss 0.1 --seed 3
        xrl sim --scenario crawl --kill planner@8
        xrl sim --delay 50 --control centralised
        xrl sim --plant drivetrain.stiffness=3000 --plant drivetrain.play=0.01
        xrl sim --plant ideal
        xrl sim --inject 'planner->joints delay=30 jitter=10 at=3 for=4'
        xrl sim --inject 'all partition at=3 for=2' --inject 'planner->left loss=0.5 at=6'
        """,
    )
    experiment.add_flags(parser)
    parser.add_argument(
        "--delay", type=float, default=1.0, metavar="MS", help="of every link, each way (1)"
    )
    parser.add_argument(
        "--jitter", type=float, default=0.0, metavar="MS", help="uniform, +- so much (0)"
    )
    parser.add_argument(
        "--loss", type=float, default=0.0, metavar="P", help="share of messages lost, 0 to 1 (0)"
    )
    parser.add_argument(
        "--control",
        choices=CONTROLS,
        default=SHIPPED,
        help="who computes the torques; centralised: the planner all of them, a baseline to "
        "compare with (default: distributed)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where results go (default: out/sim-<time>)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the experiment; 0 only if the robot stood to the end."""
    if args.delay < 0.0 or args.jitter < 0.0 or not 0.0 <= args.loss <= 1.0:
        raise RunError("--delay and --jitter must be at least 0 ms, --loss from 0 to 1")
    console = Console()
    robot, scenario = experiment.make_robot(args), experiment.make_scenario(args)
    true_plant = plant_from(args.plant)
    network = Impairment(delay_ms=args.delay, jitter_ms=args.jitter, loss=args.loss)
    out = experiment.make_out(args.out, "sim")
    console.print(f"[bold]{scenario.name}[/]: {scenario.about}{experiment.describe(scenario)}")
    begin = time.monotonic()
    simulated_s = simulate(
        robot, scenario, network, args.seed, out, console, args.control, true_plant
    )
    factor = simulated_s / (time.monotonic() - begin)
    log = read_run(out / "run.mcap")
    summary = verdict.summarise(log, scenario.duration)
    summary |= dict.fromkeys(NOT_HERE) | {"in_real_time": True, "speed": factor}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    figure.draw(log, f"{scenario.name} in lockstep", summary, out / "run.png")
    verdict_table.show(summary, console)
    console.print(f"{factor:.1f} x real time; {out}/run.mcap, run.png, summary.json", style="dim")
    return 0 if summary["stood"] else 1


def simulate(
    robot: RobotConfig,
    scenario: Scenario,
    network: Impairment,
    seed: int,
    out: Path,
    console: Console,
    control: str = SHIPPED,
    true_plant: PlantConfig | None = None,
) -> float:
    """Run lockstep into a log with a progress bar; return the time simulated, s."""
    true_plant = true_plant or PlantConfig()
    inputs = experiment.write_inputs(out, robot, scenario, true_plant)
    outbox = Outbox(robot.name)
    fleet = CONTROLS[control](
        robot, scenario, network, seed=seed, record=outbox.put, plant=true_plant
    )
    bar = Progress(
        BarColumn(), TextColumn("{task.completed:5.1f} of {task.total:g} s"),
        TimeRemainingColumn(), console=console, transient=True,
    )  # fmt: skip
    recorded = {key: topic for key, topic in topics.all_keys(robot.name).items() if topic.recorded}
    with (
        RunWriter(
            out,
            recorded,
            offset_ns=0,
            metadata=_metadata(robot.name, scenario.name, network, seed, control),
            attachments={file.name: file.read_bytes() for file in inputs}
            | {"model.xml": mjcf(robot).encode()},
            chunk_kib=robot.recorder.chunk_kib,
        ) as writer,
        bar as progress,
    ):
        task = progress.add_task("", total=scenario.duration)
        fallen_at_s = None
        for truth in fleet.run():
            if len(outbox) >= DRAIN_EVERY:
                writer.take_from(outbox, len(outbox))
                progress.update(task, completed=max(0.0, truth.scenario_s))
            if truth.fallen and fallen_at_s is None:
                fallen_at_s = truth.scenario_s
            if fallen_at_s is not None and truth.scenario_s > fallen_at_s + AFTER_FALL_S:
                break
        fleet.network.end(fleet.now_ns)
        writer.take_from(outbox, len(outbox))
    return fleet.now_ns / 1e9


def _metadata(
    robot: str, scenario: str, network: Impairment, seed: int, control: str
) -> dict[str, dict[str, str]]:
    run_facts = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": scenario,
        "lockstep": f"delay {network.delay_ms:g} ms, jitter {network.jitter_ms:g} ms, "
        f"loss {network.loss:g}, seed {seed}",
        "control": control,
    }
    root = Path(__file__).resolve().parents[1]
    return {
        "run": run_facts | provenance.code(root) | provenance.machine(),
        "packages": provenance.packages(),
    }
