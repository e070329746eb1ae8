"""`xrl study kill`: the planner killed at random, in random postures and under pushes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rich.table import Table

from shared.config.robot_config import RobotConfig
from shared.extras import late
from tools.flags import Count
from tools.lab.studies.sweeps import kill_trial, plants, push_range, study
from tools.lab.studies.sweeps.figures import Ending, with_payload
from tools.lab.studies.sweeps.kill_trial import (
    PUSHES_MAX,
    KillCase,
    KillCases,
    KillResult,
    payloads,
)
from tools.lab.studies.sweeps.push_range import PushFlags
from tools.lab.studies.sweeps.report import FALL_COLOUR, parted, show_falls, show_share
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Study, StudyRun, bar
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.live.experiment import LawFlags
from tools.output import Picture, new_figure
from tools.terminal import Console

if TYPE_CHECKING:
    import matplotlib as mpl
    from matplotlib import cm, colors, lines, patches
else:
    mpl = late("matplotlib")
    cm = late("matplotlib.cm")
    colors = late("matplotlib.colors")
    lines = late("matplotlib.lines")
    patches = late("matplotlib.patches")

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


def report(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console, command = finished.rows, finished.console, finished.command
    standing, fallen = parted(rows)
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


def draw(finished: StudyRun) -> Picture:
    """Draw the study."""
    flags, rows, robot = finished.flags, finished.rows, finished.robot
    figure = new_figure(13, 11)
    norm = _norm(payloads(robot))
    _draw_pushes(figure.add_subplot(2, 2, 1, projection="polar"), rows, norm)
    postures = figure.add_subplot(2, 2, 2)
    points = _points(rows, "kill_height_m", "kill_pitch_rad")
    _draw(postures, points, norm, "Postures")
    postures.set(xlabel="torso height at the kill in m", ylabel="torso pitch at the kill in rad")
    _draw_excursions(figure.add_subplot(2, 2, 3), rows, norm, robot)
    operator = figure.add_subplot(2, 2, 4)
    points = _points(rows, "delay_ms", "operator_peak_before_n")
    _draw(operator, points, norm, "Leading, before the kill")
    operator.set(xlabel="delay each way in ms", ylabel="operator's peak force in N")
    operator.set_ylim(bottom=0.0)
    bar = figure.colorbar(
        cm.ScalarMappable(norm, _colours()), ax=figure.axes, shrink=0.5, ticks=payloads(robot)
    )
    bar.set_label("payload in kg")
    title = f"Planner killed, {len(rows)} random cases, seed {flags.seed}, "
    title += f"{push_range.describe(flags)}: {len(parted(rows)[1])} fell"
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    return figure


Point = tuple[float, float, Row]


def _points(rows: Iterable[Row], x: str, y: str) -> list[Point]:
    """Return two columns of the cases that have both."""
    return [(row[x], row[y], row) for row in rows if None not in (row[x], row[y])]


def _colours() -> colors.Colormap:
    """Return the colours of the payload."""
    return mpl.colormaps["viridis"]


def _norm(levels: Sequence[float]) -> colors.BoundaryNorm:
    """Return a step of colour for each payload."""
    if len(set(levels)) < len(levels):
        return colors.BoundaryNorm([-0.5, 0.5], _colours().N)
    half = (levels[1] - levels[0]) / 2
    edges = [level - half for level in levels]
    return colors.BoundaryNorm([*edges, levels[-1] + half], _colours().N)


def _draw(axis: Any, points: Sequence[Point], norm: colors.BoundaryNorm, title: str) -> None:
    """Draw stands as dots coloured by payload (hollow: the hand was off), falls as crosses."""
    standing = [point for point in points if point[2]["ending"] is Ending.STOOD]
    for hand_on in (True, False):
        some = [point for point in standing if (point[2]["let_go_s"] is None) == hand_on]
        edges = _colours()(norm([row["payload_kg"] for _, _, row in some]))
        axis.scatter(
            [x for x, _, _ in some], [y for _, y, _ in some],
            s=22, facecolors=edges if hand_on else "none", edgecolors=edges, linewidths=1.0,
        )  # fmt: skip
    for x, y, row in points:
        if row["ending"] is not Ending.STOOD:
            axis.scatter(x, y, marker="x", s=70, color=FALL_COLOUR, linewidths=2.0, zorder=5)
            axis.annotate(
                row["number"], (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8,
                color=FALL_COLOUR,
            )  # fmt: skip
    axis.set_title(title)
    axis.grid(visible=True, lw=0.3)


def _draw_pushes(axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm) -> None:
    """COM excursion over the direction of the strongest push."""
    known = [row for row in rows if row["com_max_mm"] is not None]
    edge = 1.15 * max((row["com_max_mm"] for row in parted(known)[0]), default=100.0)
    points = [
        (_strongest_push(row), min(row["com_max_mm"], edge), row) for row in known
    ]  # a fall goes on the edge
    title = "COM, largest distance after the kill in mm,\nby direction of the strongest push"
    _draw(axis, points, norm, title)
    axis.set_rlim(0.0, 1.05 * edge)
    axis.set_theta_zero_location("N")  # forward is up, left is left
    axis.set_xticks(
        [0.0, math.pi / 2, math.pi, 3 * math.pi / 2], ["forward", "left", "back", "right"]
    )
    styles: Sequence[Any] = (
        ("stood, hand on", "o", "full", "#555555"),
        ("stood, hand off", "o", "none", "#555555"),
        ("fell (on the edge), with its number", "x", "full", FALL_COLOUR),
    )
    handles = [
        lines.Line2D([], [], ls="", marker=marker, fillstyle=fill, color=colour, label=words)
        for words, marker, fill, colour in styles
    ]
    axis.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.3, -0.12), fontsize=8)


def _strongest_push(row: Row) -> float:
    """Return the direction of the strongest push, rad from x to y."""
    pushes = [(row[f"push{i}_x_n"], row[f"push{i}_y_n"]) for i in range(1, PUSHES_MAX + 1)]
    x, y = max((push for push in pushes if None not in push), key=lambda push: math.hypot(*push))
    return math.atan2(y, x)


def _draw_excursions(
    axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm, robot: RobotConfig
) -> None:
    """Where the COM went furthest, over the soles."""
    points = [
        (
            max(row["com_y_min_mm"], row["com_y_max_mm"], key=abs),
            max(row["com_x_min_mm"], row["com_x_max_mm"], key=abs),
            row,
        )
        for row in rows
        if row["com_max_mm"] is not None
    ]
    _draw(axis, points, norm, "COM, largest way along x and y after the kill")
    geometry = robot.geometry
    length, width, base = (1e3 * v for v in (geometry.l_foot, geometry.w_foot, geometry.w_base))
    outer = (base + width) / 2
    axis.add_patch(
        patches.Rectangle(
            (-outer, -length / 2), 2 * outer, length, fill=False, ls="--", color="#777777"
        )
    )
    axis.annotate(
        "edge of the support", (0.02, length / 2), xycoords=("axes fraction", "data"),
        textcoords="offset points", xytext=(0, 3), fontsize=8, color="#777777",
    )  # fmt: skip
    stood = [abs(y) for y, _, row in points if row["ending"] is Ending.STOOD]
    limit_y = min(1.15 * max(stood, default=60.0), 1.1 * outer)
    axis.set_xlim(limit_y, -limit_y)
    axis.set_ylim(-length * 0.6, length * 0.6)
    axis.set(xlabel="COM y in mm, left is left", ylabel="COM x in mm")


STUDY: Final = Study[KillCase](
    name="kill",
    table="cases.csv",
    pictures={"cases.png": draw},
    load=experiment.make_robot,
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
