"""`xrl sweep certificate`: is the sign of K_fail right? Said against what the simulation does."""

from __future__ import annotations

import argparse
import hashlib
import time
from pathlib import Path
from typing import Final, NamedTuple

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from shared import config
from shared.config import RobotConfig
from shared.exceptions import RunError
from tools.sweeps import certificate_study as study
from tools.sweeps import pool
from tools.sweeps.certificate_study import Cases, Outcome
from tools.sweeps.table import Table, code_digest
from tools.verbs import add_config

N: Final = 200
BATCH: Final = 20
"""Cases a worker is given at once: what draws them is built once for a batch."""
TABLE: Final = "certificate.csv"
PICTURE: Final = "certificate.png"
CODE: Final = ("services", "shared", "tools/sweeps/certificate_study.py")

EXAMPLES: Final = """
    xrl sweep certificate
    xrl sweep certificate --n 1000 --seed 3 --rigid
    xrl sweep certificate --friction
"""


class Batch(NamedTuple):
    """Cases to run in one go."""

    robot: RobotConfig
    seed: int
    numbers: tuple[int, ...]
    rigid: bool


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=int, default=N, help=f"cases ({N})")
    parser.add_argument("--seed", type=int, default=1, help="of the cases (1)")
    parser.add_argument(
        "--workers", type=int, default=pool.cores(), help=f"processes (one a core: {pool.cores()})"
    )
    parser.add_argument(
        "--rigid", action="store_true", help="a floor as hard as the certificate takes it"
    )
    parser.add_argument(
        "--friction",
        action="store_true",
        help="with the joints' dry friction, which holds up what is a little too soft",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"where {TABLE} and {PICTURE} go (default: out/sweep-certificate-<time>); a study "
        "that was stopped is gone on with",
    )


def run(args: argparse.Namespace) -> int:
    """Run the study; 1 if a case fell that was said to stand."""
    for flag, value in (("--n", args.n), ("--workers", args.workers)):
        if value < 1:
            raise RunError(f"{flag} {value}: must be at least 1")
    robot = config.load(args.config)
    if not args.friction:
        robot = study.without_friction(robot)
    console = Console()
    out = args.out or Path("out") / time.strftime("sweep-certificate-%Y%m%d-%H%M%S")
    numbers = range(args.n)
    cases = Cases(robot)
    first = row_of(study.run(robot, cases.draw(args.seed, 0), rigid=args.rigid))
    with Table(out, TABLE, tuple(first), _inputs(args, robot)) as table:
        missing = [number for number in numbers if number not in table.numbers]
        batches = [
            Batch(robot, args.seed, tuple(missing[start : start + BATCH]), args.rigid)
            for start in range(0, len(missing), BATCH)
        ]
        with _bar(console) as bar:
            shown = bar.add_task("", total=args.n, completed=args.n - len(missing))
            for batch, outcomes in pool.results(_run_batch, batches, args.workers, _name):
                for outcome in outcomes:
                    table.add(row_of(outcome))
                bar.update(shown, advance=len(batch.numbers))
    rows = table.rows(args.n)
    said = [(float(row["margin"]), row["stood"] == "True") for row in rows]
    found = study.confusion(said)
    console.print(
        f"said to stand: {found.stand_stood} stood, {found.stand_fell} fell\n"
        f"said to fall: {found.fall_stood} stood, {found.fall_fell} fell\n"
        f"fewest mistakes with a margin of {study.threshold(said):.3f} as the limit"
    )
    for row, (margin, stood) in zip(rows, said, strict=True):
        if (margin > 0.0) != stood:
            console.print(
                f"  case {row['number']}: margin {row['margin']}, weakest {row['weakest']}, COM "
                f"{row['com_mm']} mm away",
                style="dim",
            )
    title = f"{len(rows)} random postures and gains, seed {args.seed}"
    study.draw_picture(rows, title, out / PICTURE)
    console.print(f"{out / TABLE}, {PICTURE}", style="dim", soft_wrap=True)
    return 1 if found.stand_fell else 0


def row_of(outcome: Outcome) -> dict[str, object]:
    """Return an outcome as a row of the table."""
    case, posture, weakest = outcome.case, outcome.case.posture, outcome.case.weakest
    row: dict[str, object] = {
        "number": case.number,
        "margin": outcome.margin,
        "stood": outcome.stood,
        "weakest": weakest.direction,
        "stiffness": weakest.stiffness,
        "com_mm": 1e3 * outcome.com_m,
        "angle_rad": outcome.angle_rad,
        "growth": outcome.growth,
        "ended_s": outcome.ended_s,
        "height_m": posture.height,
        "pitch_rad": posture.pitch,
        "payload_kg": posture.payload,
        "assist_n": posture.assist,
        "nudge_x_n": case.nudge[0],
        "nudge_y_n": case.nudge[1],
    }
    return row | {f"D{joint}": float(value) for joint, value in enumerate(case.D[:6])}


def _run_batch(batch: Batch) -> list[Outcome]:
    cases = Cases(batch.robot)
    return [
        study.run(batch.robot, cases.draw(batch.seed, number), rigid=batch.rigid)
        for number in batch.numbers
    ]


def _name(batch: Batch) -> str:
    return f"cases {batch.numbers[0]} to {batch.numbers[-1]} (seed {batch.seed})"


def _inputs(args: argparse.Namespace, robot: RobotConfig) -> dict[str, str]:
    digest = hashlib.sha256(config.to_toml(robot).encode()).hexdigest()
    return {
        "study": "certificate",
        "seed": str(args.seed),
        "rigid": str(args.rigid),
        "robot": digest,
        "code": code_digest(CODE),
    }


def _bar(console: Console) -> Progress:
    return Progress(
        BarColumn(), TextColumn("{task.completed} of {task.total} cases"), TimeRemainingColumn(),
        console=console, transient=True,
    )  # fmt: skip
