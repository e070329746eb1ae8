"""`xrl study sweep certificate`: compares the sign of K_fail with falls in simulation."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Final, NamedTuple

from services.planner.law.certificate import DIRECTIONS
from services.simulator.physics.plant import IDEAL, PlantConfig
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FELL_EXIT_CODE
from tools.lab.studies.sweeps import certificate_study, study
from tools.lab.studies.sweeps.certificate_study import CertificateCases, CertificateResult
from tools.lab.studies.sweeps.table import code_of
from tools.number_arguments import count
from tools.terminal import Console
from tools.verb_table import add_config

N: Final = 200
BATCH: Final = 20
"""Cases a worker is given at once: what draws them is built once for a batch."""
TABLE: Final = "certificate.csv"
PICTURE: Final = "certificate.png"
CODE: Final = code_of("tools.lab.studies.sweeps.certificate_study")
LABELS: Final = {"stood": {"True", "False"}, "weakest": frozenset(DIRECTIONS)}

EXAMPLES: Final = """
    xrl study sweep certificate
    xrl study sweep certificate --n 1000 --seed 3 --rigid
    xrl study sweep certificate --friction
"""


class CaseBatch(NamedTuple):
    """Cases to run in one go."""

    robot: RobotConfig
    seed: int
    numbers: tuple[int, ...]
    rigid: bool
    plant: PlantConfig


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=count, default=N, help=f"cases ({N})")
    parser.add_argument(
        "--rigid", action="store_true", help="a floor as hard as the certificate takes it"
    )
    parser.add_argument(
        "--friction",
        action="store_true",
        help="with the joints' dry friction, which holds up what is a little too soft",
    )
    study.add_flags(parser, "certificate", f"{TABLE} and {PICTURE}")


def run(args: argparse.Namespace) -> int:
    """Run the study; 0 if no case fell that was said to stand."""
    executor = study.executor_of(args, CODE)
    robot = config_file.load(args.config)
    plant = IDEAL if args.friction else certificate_study.FRICTIONLESS
    console = Console()
    first = row_of(
        certificate_study.run(
            robot, CertificateCases(robot).draw(args.seed, 0), rigid=args.rigid, plant=plant
        )
    )

    def batches(done: set[int]) -> list[CaseBatch]:
        missing = [number for number in range(args.n) if number not in done]
        return [
            CaseBatch(robot, args.seed, tuple(missing[start : start + BATCH]), args.rigid, plant)
            for start in range(0, len(missing), BATCH)
        ]

    inputs = study.inputs(
        "certificate", robot, CODE, seed=str(args.seed), rigid=str(args.rigid),
        friction=str(args.friction),
    )  # fmt: skip
    switches = [f"--{name}" for name in ("rigid", "friction") if getattr(args, name)]
    command = study.command("certificate", args, f"--n {args.n}", f"--seed {args.seed}", *switches)
    finished = study.run(
        study.Study("certificate", TABLE, tuple(first), LABELS, inputs, (), args.n, JOB, command),
        batches, args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    predicted = [(float(row["margin"]), row["stood"] == "True") for row in rows]
    found = certificate_study.confusion(predicted)
    console.print(
        f"said to stand: {found.stand_stood} stood, {found.stand_fell} fell\n"
        f"said to fall: {found.fall_stood} stood, {found.fall_fell} fell\n"
        f"fewest mistakes with the limit at margin {certificate_study.threshold(predicted):.3f}"
    )
    for row, (margin, stood) in zip(rows, predicted, strict=True):
        if (margin > 0.0) != stood:
            console.print(
                f"  case {row['number']}: margin {row['margin']}, weakest {row['weakest']}, COM "
                f"{row['com_mm']} mm away",
                style="dim",
            )
    title = f"{len(rows)} random postures and gains, seed {args.seed}"
    certificate_study.draw_picture(rows, title, finished.out / PICTURE)
    finished.show_files(f"{TABLE}, {PICTURE}", "case", console)
    return FELL_EXIT_CODE if found.stand_fell else 0


def row_of(outcome: CertificateResult) -> dict[str, object]:
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


def _run_batch(batch: CaseBatch) -> list[CertificateResult]:
    cases = CertificateCases(batch.robot)
    return [
        certificate_study.run(
            batch.robot, cases.draw(batch.seed, number), rigid=batch.rigid, plant=batch.plant
        )
        for number in batch.numbers
    ]


def _name(batch: CaseBatch) -> str:
    return f"cases {batch.numbers[0]} to {batch.numbers[-1]} (seed {batch.seed})"


def _rows(_batch: CaseBatch, outcomes: list[CertificateResult]) -> list[dict[str, object]]:
    return [row_of(outcome) for outcome in outcomes]


def _fell(row: Mapping[str, object]) -> bool:
    return str(row["stood"]) == "False"


JOB: Final = study.Job(_run_batch, _name, _rows, _fell)
