"""The kill study in words: falls, with their bound, and the cases that came closest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rich.table import Table

from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.table import Row
from tools.lab.studies.sweeps.wilson import wilson
from tools.terminal import Console, marked

FALLS_SHOWN: Final = 10


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


def falls(rows: Sequence[Row]) -> list[Row]:
    """Return the cases that did not stand to the end."""
    return [row for row in rows if row["ending"] != Ending.STOOD]


def show(rows: Sequence[Row], command: str, console: Console) -> None:
    """Print what came of the study.

    Args:
        rows: of the table.
        command: that runs one case alone, but for the case's number.
        console: to print on.
    """
    fallen = falls(rows)
    for row in fallen[:FALLS_SHOWN]:
        console.print(marked("[red]{}[/] {}", row["ending"], describe(row)), highlight=False)
        console.print(f"    {command} --only {row['number']}", style="dim", soft_wrap=True)
    if len(fallen) > FALLS_SHOWN:
        console.print(f"... and {len(fallen) - FALLS_SHOWN} more in the table")
    standing = [row for row in rows if row["ending"] == Ending.STOOD]
    if standing:
        console.print(_worst(standing))
        console.print(f"one case alone: {command} --only CASE", style="dim", soft_wrap=True)
    low, high = wilson(len(fallen), len(rows))
    colour = "red" if fallen else "green"
    console.print(
        marked(
            f"[bold {colour}]{{}} falls of {{}}[/]; share of falls {{:.2f}} to {{:.2f}} % "
            "(95 %, Wilson)",
            len(fallen),
            len(rows),
            100 * low,
            100 * high,
        ),
        highlight=False,
    )


def describe(row: Row) -> str:
    """Return a case in a line."""
    words = [f"case {row['number']}: payload {row['payload_kg']} kg"]
    if row["kill_height_m"]:
        words.append(
            f"killed at {row['kill_s']} s, {float(row['kill_height_m']):.2f} m, "
            f"pitch {float(row['kill_pitch_rad']):.2f} rad"
        )
    if row["fell_at_s"]:
        words.append(f"fell at {float(row['fell_at_s']):.2f} s")
    elif row["ending"] == Ending.FELL:
        words.append("fell before the scenario began")
    words.append(f"delay {row['delay_ms']} ms")
    words.append(f"hand off at {row['let_go_s']} s" if row["let_go_s"] else "hand on")
    assist = row["pose2_assist_n"] or row["pose1_assist_n"]
    words.append(f"assist to {assist} N")
    pushes = [
        f"{row[f'push{i}_x_n']},{row[f'push{i}_y_n']} N at {row[f'push{i}_at_s']} s"
        for i in (1, 2, 3)
        if row[f"push{i}_at_s"]
    ]
    words.append("push " + " and ".join(pushes))
    return ", ".join(words)


def _worst(rows: Sequence[Row]) -> Table:
    table = Table(title="Worst of those that stood", title_justify="left")
    for name in ("what", "figure", "case"):
        table.add_column(name, justify="left" if name == "what" else "right")
    for column, what, sign, unit in WORST:
        known = [row for row in rows if row[column]]
        if known:
            worst = max(known, key=lambda row: sign * float(row[column]))
            table.add_row(what, f"{float(worst[column]):.3g} {unit}", worst["number"])
    return table
