"""`xrl study kill`: the planner killed at random, in random postures and under pushes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from rich.table import Table

from shared.config.robot_config import RobotConfig
from tools.flags import Count
from tools.lab.studies.sweeps import kill_picture, kill_trial, plants, push_range, study
from tools.lab.studies.sweeps.figures import Ending, with_payload
from tools.lab.studies.sweeps.kill_trial import PUSHES_MAX, KillCase, KillCases, KillResult
from tools.lab.studies.sweeps.push_range import PushFlags
from tools.lab.studies.sweeps.report import parted, show_falls, show_share
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Finished, Study, bar
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.live.experiment import LawFlags
from tools.terminal import Console

PICTURE: Final = "cases.png"
WORST: Final = (
    ("com_x_max_mm", "COM forward", 1.0, "mm"),
    ("com_x_min_mm", "COM backward", -1.0, "mm"),
    ("com_y_max_mm", "COM to the left", 1.0, "mm"),
    ("com_y_min_mm", "COM to the right", -1.0, "mm"),
    ("sole_tilt_max_rad", "tilt of a sole", 1.0, "rad"),
    ("foot_load_min_n", "load on the lighter foot", -1.0, "N"),
    ("slip_max_mm", "slip of a foot", 1.0, "mm"),
    ("torque_step_nm", "torque step at the hand-over", 1.0, "N m"),
    ("hold_ms", "kill to HOLD", 1.0, "ms"),
    ("operator_peak_before_n", "operator's force before the kill", 1.0, "N"),
)
"""Column, in words, which sign is worse, unit."""


EXAMPLES: Final = """
xrl study kill
xrl study kill --n 500 --seed 1 --out out/kill
xrl study kill --only 137 --seed 1
xrl study kill --only 137 --seed 1 --out out/case137
"""


class KillStudyFlags(AloneFlags, LawFlags, PushFlags):
    """How many, and which law."""

    n: Count = 500
    """cases"""


def load(flags: KillStudyFlags) -> RobotConfig:
    """Check the flags and return the robot."""
    return experiment.make_robot(flags)


def _robots(
    cases: Sequence[KillCase], robot: RobotConfig, workers: int, console: Console
) -> list[RobotConfig]:
    """Return the robot with the payload of each case, and a gain schedule that fits."""
    payloads = sorted({case.payload_kg for case in cases})
    loaded = [with_payload(robot, payload) for payload in payloads]
    if any(kill_trial.needs_schedule(one) for one in loaded):
        with bar("{task.completed} of {task.total} gain schedules", console) as shown:
            line = shown.add_task("", total=None)
            loaded = kill_trial.prepare(
                loaded, workers, lambda done, of: shown.update(line, completed=done, total=of)
            )
    by_payload = dict(zip(payloads, loaded, strict=True))
    return [by_payload[case.payload_kg] for case in cases]


def _metadata(case: KillCase, command: str) -> dict[str, str]:
    hand = "hand on" if case.let_go_s is None else f"hand off at {case.let_go_s:g} s"
    return {"lockstep": f"{command}; delay {case.delay_ms:g} ms, {hand}"}


def report(finished: Finished) -> None:
    """Draw and print what came of the study."""
    rows, console, command = finished.rows, finished.console, finished.command
    standing, fallen = parted(rows)
    title = f"Planner killed, {len(rows)} random cases, seed {finished.flags.seed}, "
    title += f"{push_range.describe(finished.flags)}: {len(fallen)} fell"
    kill_picture.draw(rows, finished.robot, title, finished.out / PICTURE)
    show_falls(fallen, command, describe, console)
    if standing:
        table = Table(title="Worst of those that stood", title_justify="left")
        for name in ("what", "figure", "case"):
            table.add_column(name, justify="left" if name == "what" else "right")
        for column, what, sign, unit in WORST:
            known = [row for row in standing if row[column] is not None]
            if known:
                worst = max(known, key=lambda row: sign * float(row[column]))
                table.add_row(what, f"{worst[column]:.3g} {unit}", str(worst["number"]))
        console.print(table)
        console.print(f"one case alone: {command} --only CASE", style="dim", soft_wrap=True)
    show_share(len(fallen), len(rows), console)


def describe(row: Row) -> str:
    """Return a case in a line."""
    words = [f"case {row['number']}: payload {row['payload_kg']:g} kg"]
    if row["kill_height_m"] is not None:
        words.append(
            f"killed at {row['kill_s']:g} s, {row['kill_height_m']:.2f} m, "
            f"pitch {row['kill_pitch_rad']:.2f} rad"
        )
    if row["fell_at_s"] is not None:
        words.append(f"fell at {row['fell_at_s']:.2f} s")
    elif row["ending"] is Ending.FELL:
        words.append("fell before the scenario began")
    words.append(f"delay {row['delay_ms']:g} ms")
    hand_off = row["let_go_s"]
    words.append("hand on" if hand_off is None else f"hand off at {hand_off:g} s")
    assist = row["pose1_assist_n"] if row["pose2_assist_n"] is None else row["pose2_assist_n"]
    words.append(f"assist to {assist:g} N")
    pushes = [
        f"{row[f'push{i}_x_n']:g},{row[f'push{i}_y_n']:g} N at {row[f'push{i}_at_s']:g} s"
        for i in range(1, PUSHES_MAX + 1)
        if row[f"push{i}_at_s"] is not None
    ]
    words.append("push " + " and ".join(pushes))
    return ", ".join(words)


STUDY: Final = Study[KillCase](
    name="kill",
    table="cases.csv",
    pictures=(PICTURE,),
    code=("tools.lab.studies.sweeps.kill_trial",),
    load=load,
    cases=lambda flags, robot: partial(KillCases(robot, flags.push).draw, flags.seed),
    decided_by=("seed", "push"),
    inputs=lambda _flags: {"ranges": plants.digest()},
    row=kill_trial.row_of,
    figures=KillResult,
    trial=kill_trial.run_case,
    robots=_robots,
    log=CaseLog(kill_trial.scenario_of, kill_trial.plant_of, _metadata),
    report=report,
)


def run(flags: KillStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
