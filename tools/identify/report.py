"""Tells what was identified: a table, the robot file's new lines, what to do about zeros."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.places import refuse_shipped
from tools.fleet import procfs
from tools.fleet.run_dir import RunDir
from tools.identify.estimates import (
    ParameterEstimate,
    Value,
    Verdict,
    changes,
    measured,
    remarks,
)
from tools.identify.robot_file_edit import apply
from tools.terminal import Console

_STYLES = {
    Verdict.CHANGE: "bold yellow", Verdict.AGREES: "green", Verdict.MEASURED: "",
    Verdict.UNKNOWN: "dim",
}  # fmt: skip


def estimates_table(estimates: Sequence[ParameterEstimate]) -> Table:
    """Return the estimates as a table for the terminal."""
    table = Table(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)  # in 80 columns
    table.add_column("")
    for heading in ("robot file", "measured", "95 %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("", no_wrap=True)
    for row in estimates:
        digits = row.digits
        table.add_row(
            row.what, "" if row.file is None else f"{row.file:.{digits}f}",
            f"{row.value:.{digits}f}",
            f"± {row.half_width:.{digits}f}", row.unit,
            Text(row.verdict.value, _STYLES[row.verdict]),
        )  # fmt: skip
    return table


def lines_of(values: Mapping[str, Value]) -> str:
    """Return the robot file's new lines, by section."""
    text, section_before = "", ""
    for key in sorted(values):
        section, name = key.split(".")
        if section != section_before:
            text += f"[{section}]\n"
        section_before = section
        value = values[key]
        text += f"{name} = {list(value) if isinstance(value, tuple) else value}\n"
    return text


def tell(
    estimates: list[ParameterEstimate], robot: RobotConfig, path: Path | None, console: Console
) -> None:
    """Print the estimates, what to write and what to know; write it if there is a path.

    Args:
        estimates: of one measurement.
        robot: that they were measured against.
        path: of the robot file to write; None: none.
        console: to speak on.

    Raises:
        RunError: the file is another robot's, or cannot be read or written.
        ConfigError: the new values make no robot file that can be used.
    """
    values, known = changes(estimates, robot), measured(estimates)
    console.print(estimates_table(estimates))
    if values:
        console.print("to write into the robot file (`--apply` does, after a backup):")
        console.print(lines_of(values), markup=False, highlight=False, end="")
    else:
        console.print("nothing to write: the robot file is right, within what was measured")
    if known:
        console.print(f"measured now, no longer assumed: {', '.join(sorted(known))}", style="dim")
    for remark in remarks(estimates, robot):
        console.print(remark, style="yellow")
    if path is not None:
        refuse_other_robot(path, robot, values)
        write(path, values, known, console)


def refuse_running(path: Path) -> None:
    """Refuse to write the robot file of a fleet that is up: a service that restarts would read it.

    Raises:
        RunError: naming the fleet, and what to do; or it is the shipped one of an installed wheel.
    """
    refuse_shipped(path)
    for place in sorted(procfs.fleets()):
        manifest = RunDir(Path(place)).read_manifest()
        if manifest is not None and Path(manifest.config).resolve() == path.resolve():
            raise RunError(
                f"{path}: the fleet in {place} runs with it; measure without --apply, `xrl down "
                f"--run-dir {place}`, then --apply (`xrl drive identify body RECORD --apply`)"
            )


def refuse_other_robot(path: Path, robot: RobotConfig, values: Mapping[str, Value]) -> None:
    """Refuse to write what was measured against another file than the one to be written.

    Args:
        path: of the robot file.
        robot: that the record was made with.
        values: new ones by dotted key.

    Raises:
        RunError: the file has another value where a new one would go, or another robot's name.
        ConfigError: the file cannot be read.
    """
    file = config_file.load_without_schedule(path)
    if file.name != robot.name:
        raise RunError(f"{path}: the robot {file.name}; the record is of {robot.name}")
    for key in values:
        section, name = key.split(".")
        here, there = (getattr(getattr(one, section), name) for one in (file, robot))
        if here != there:
            raise RunError(
                f"{path}: {key} is {here}, and was {there} when the record was made; give that "
                "robot's file as --config, or record again"
            )


def write(
    path: Path, values: Mapping[str, Value], known: Collection[str], console: Console
) -> None:
    """Write the new values, and say what has to follow.

    Raises:
        RunError: a file cannot be read or written.
        ConfigError: the new values make no robot file that can be used.
    """
    if not values and not known:
        console.print(f"{path}: nothing to write")
        return
    backup = apply(path, values, known, time.strftime("%Y%m%d-%H%M%S"))
    console.print(f"{path}: written; as it was: {backup}")
    if any(key in SCHEDULED or key.startswith(("mass.", "geometry.")) for key in values):
        console.print(f"now `xrl gains --config {path}`: its schedule is another robot's")


SCHEDULED = ("joint.armature",)
"""Keys beside masses and lengths that the gain schedule depends on."""
