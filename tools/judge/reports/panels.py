"""Panels of the body, the operator's hand, the feet, the states, the harness, the certificate."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np

from shared.bus import topics
from shared.bus.messages import DriveStatus, Mode, PlannerMode, SplitSource
from shared.joints import MODULES
from tools.judge.reports.page_model import BarRow, LevelLine, Line, PageModel
from tools.judge.reports.run_data import RunData
from tools.judge.reports.signals import Array
from tools.judge.standing import LIMITS

NO_WORLD: Final = "no sim/truth in this log"
NO_PLANNER: Final = "no planner/status in this log"
NO_HARNESS: Final = "no harness/wrench in this log"
NO_STATES: Final = "no joint/*/state in this log"

ALLOWED: Final = {row.key: row.limit for row in LIMITS}
"""Limits of the verdict; the panels show those that hold while the planner leads."""

MODE_COLOURS: Final[dict[int, str]] = {
    Mode.DISARMED: "idle", Mode.HOLD: "warn", Mode.TRACK: "good",
    Mode.DAMP: "odd", Mode.FAULT: "bad",
}  # fmt: skip
DRIVE_COLOURS: Final[dict[int, str]] = {
    DriveStatus.LOST: "bad", DriveStatus.IDLE: "idle", DriveStatus.ARMED: "good",
    DriveStatus.ERROR: "odd", DriveStatus.UNZEROED: "warn", DriveStatus.HOLDING: "good",
}  # fmt: skip
PLANNER_COLOURS: Final[dict[int, str]] = {
    PlannerMode.WAITING: "idle", PlannerMode.ALIGNING: "warn", PlannerMode.LEADING: "good",
    PlannerMode.OVERLOADED: "odd", PlannerMode.UNCERTIFIED: "bad",
    PlannerMode.MISPLACED: "bad", PlannerMode.TRIPPED: "bad",
    PlannerMode.MISLOADED: "bad", PlannerMode.YIELDING: "odd",
}  # fmt: skip
SPLIT_COLOURS: Final[dict[int, str]] = {
    SplitSource.DIAGONAL: "idle", SplitSource.SCHEDULE: "good", SplitSource.STIFFENED: "warn",
    SplitSource.UNCERTIFIED: "bad", SplitSource.CONTROLLER: "good",
}  # fmt: skip


class WrenchQuality(IntEnum):
    """Quality of the harness sensor's wrench."""

    VALID = 0
    NOT_VALID = 1
    SATURATED = 2


WRENCH_COLOURS: Final[dict[int, str]] = {
    WrenchQuality.VALID: "good", WrenchQuality.NOT_VALID: "warn", WrenchQuality.SATURATED: "bad",
}  # fmt: skip


def add_body(run: RunData, model: PageModel) -> None:
    """Add COM, height and torso angles (the paper's Fig. 7), the operator's force and the feet."""
    com, torso, angles = _truth(run, "com", "torso", "angles")
    p, p_ref = _planner(run)
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    simulated = bool(len(t))

    def both(label: str, truth: Array, estimate: Array, colour: int) -> list[Line]:
        """Return the simulated value and, hidden, the planner's estimate; or only the latter."""
        lines = [Line(label, t, truth, colour)] if simulated else []
        name = f"{label}, planner's estimate" if simulated else label
        return [*lines, Line(name, t_p, estimate, colour, hidden=simulated, dashed=simulated)]

    neither = f"{NO_WORLD}, and {NO_PLANNER}"
    model.plot(
        "COM", "mm",
        [*both("x", com[:, 0] * 1e3, p[:, 0] * 1e3, 0),
         *both("y", com[:, 1] * 1e3, p[:, 1] * 1e3, 1)],
        limits=[*_leading_limits("alive_com_x_max_mm", "x, planner leading"),
                *_leading_limits("alive_com_y_max_mm", "y, planner leading")],
        note="World axes: x forward, y left; 0 is midway between the ankles.",
        if_empty=neither,
    )  # fmt: skip
    model.plot(
        "Height", "m",
        [Line("torso", t, torso[:, 2], 0), *both("COM", com[:, 2], p[:, 2], 1),
         Line("COM reference", t_p, p_ref[:, 2], 2, hidden=True, dashed=True)],
        note="Above the ankles.", if_empty=neither,
    )  # fmt: skip
    model.plot(
        "Torso angles", "rad",
        [*(line for number, name in enumerate(("roll", "pitch", "yaw"))
           for line in both(name, angles[:, number], p[:, 3 + number], number)),
         Line("pitch reference", t_p, p_ref[:, 4], 4, hidden=True, dashed=True)],
        limits=_leading_limits("alive_roll_max_rad", "roll and yaw, planner leading"),
        if_empty=neither,
    )  # fmt: skip
    _add_hand(run, model)
    _add_feet(run, model)


def _add_hand(run: RunData, model: PageModel) -> None:
    hand, load, carried, push = _truth(run, "operator_force", "load_n", "harness_force_z", "push")
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    requested, assist = run.columns(topics.PLANNER_STATUS, "", "assist_requested_n", "assist_n")
    lines = [Line("hand, z", t, hand[:, 2], 0)]
    if load.any():
        lines += [Line("weight on the harness", t, load, 1), Line("carried", t, carried, 2)]
    if requested.any() or assist.any():
        lines += [
            Line("assist requested", t_p, requested, 6, dashed=True),
            Line("assist applied", t_p, assist, 7, hidden=True),
        ]
    lines += [
        Line(f"push, {axis}", t, push[:, number], 3 + number, hidden=True)
        for number, axis in enumerate("xyz")
        if push[:, number].any()
    ]
    model.plot(
        "Operator's force", "N", lines if len(t) else [],
        limits=_leading_limits("operator_peak_n", "hand, planner leading"),
        note="World axes, on the torso.", if_empty=NO_WORLD,
    )  # fmt: skip


def _add_feet(run: RunData, model: PageModel) -> None:
    """Add tilt and slip of the feet, and how far the legs' estimates of the torso differ."""
    right, left, slip = _truth(run, "foot_right_tilt", "foot_left_tilt", "feet_slip")
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    model.plot(
        "Tilt of the soles", "rad", [Line("right", t, right, 0), Line("left", t, left, 1)],
        limits=_leading_limits("alive_sole_tilt_max_rad", "planner leading")[:1],
        note="Angle between sole and floor: a tilted foot stands on an edge.",
        if_empty=NO_WORLD,
    )  # fmt: skip
    model.plot(
        "Slip of the feet", "mm", [Line("larger of both ankles", t, slip * 1e3, 0)],
        note="Distance of the ankle from its position at the start.", if_empty=NO_WORLD,
    )  # fmt: skip
    mode, closure = run.columns(topics.PLANNER_STATUS, "", "mode", "closure")
    closure = _wide(closure, 6)
    closure[(mode == PlannerMode.WAITING) | (t_p < run.armed_s())] = np.nan
    note = (
        "Left leg's estimate of the torso pose minus the right leg's: grows when a foot slips or "
        "tips."
    )
    model.plot(
        "Difference between the legs, position", "mm",
        [Line(axis, t_p, closure[:, number] * 1e3, number) for number, axis in enumerate("xyz")],
        note=note, if_empty=NO_PLANNER,
    )  # fmt: skip
    model.plot(
        "Difference between the legs, angle", "rad",
        [Line(axis, t_p, closure[:, 3 + number], number)
         for number, axis in enumerate(("roll", "pitch", "yaw"))],
        if_empty=NO_PLANNER,
    )  # fmt: skip


def _leading_limits(key: str, label: str) -> list[LevelLine]:
    """Return a limit of the verdict for both signs; visible once a line comes close."""
    most = ALLOWED[key]
    return [LevelLine(most, label, shown=False), LevelLine(-most, label, shown=False)]


def add_states(run: RunData, model: PageModel) -> None:
    """Add the state bars: services, drives, planner, gains, harness."""
    modes, drives = [], []
    for module in MODULES:
        t = run.times(topics.JOINT_STATE, module)
        mode, drive = run.columns(topics.JOINT_STATE, module, "mode", "drive")
        modes.append(BarRow(module, t, mode))
        drives.append(BarRow(module, t, drive))
    model.bars("Modes of the six services", modes, Mode, MODE_COLOURS, if_empty=NO_STATES)
    model.bars("Drives", drives, DriveStatus, DRIVE_COLOURS, if_empty=NO_STATES)
    t = run.times(topics.PLANNER_STATUS)
    mode, split = run.columns(topics.PLANNER_STATUS, "", "mode", "split")
    model.bars(
        "Planner", [BarRow("planner", t, mode)], PlannerMode, PLANNER_COLOURS, if_empty=NO_PLANNER
    )
    model.bars(
        "Source of the local gains", [BarRow("gains", t, split)], SplitSource, SPLIT_COLOURS,
        if_empty=NO_PLANNER,
    )  # fmt: skip
    valid, saturated = run.columns(topics.WRENCH, "", "valid", "saturated")
    quality = np.where(saturated > 0.0, WrenchQuality.SATURATED, np.where(valid > 0.0, 0.0, 1.0))
    row = BarRow("harness", run.times(topics.WRENCH), quality)
    model.bars("Harness sensor", [row], WrenchQuality, WRENCH_COLOURS, if_empty=NO_HARNESS)


def add_harness(run: RunData, model: PageModel) -> None:
    """Add the measured wrench of the operator on the torso."""
    t = run.times(topics.WRENCH)
    force, moment = run.columns(topics.WRENCH, "", "force", "moment")
    force, moment = _wide(force, 3), _wide(moment, 3)
    for title, unit, values in (("force", "N", force), ("moment", "N m", moment)):
        lines = [Line(axis, t, values[:, number], number) for number, axis in enumerate("xyz")]
        note = "Wrench of the operator on the torso, at the harness point, torso axes."
        model.plot(f"Harness {title}", unit, lines, note=note, if_empty=NO_HARNESS)


def add_certificate(run: RunData, model: PageModel) -> None:
    """Add the stability margins of the active gains and the least allowed margins."""
    t = run.times(topics.PLANNER_STATUS)
    mode, service, onboard = run.columns(
        topics.PLANNER_STATUS, "", "mode", "margin", "margin_onboard"
    )
    for values in (service, onboard):
        values[mode == PlannerMode.WAITING] = np.nan
    limits = [LevelLine(0.0, "unstable")]
    if run.robot is not None:
        certificate = run.robot.certificate
        limits += [
            LevelLine(certificate.margin_min, "least, services"),
            LevelLine(certificate.onboard_margin_min, "least, drives"),
        ]
    model.plot(
        "Certificate margin", "",
        [Line("joint services alone", t, service, 0), Line("drives alone", t, onboard, 1)],
        limits=limits,
        note="Stability without the planner: 1 is the required stiffness, at 0 the robot falls.",
        if_empty=NO_PLANNER,
    )  # fmt: skip


def _truth(run: RunData, *names: str) -> list[Array]:
    widths = {"com": 3, "torso": 3, "angles": 3, "operator_force": 3, "push": 3}
    found = run.columns(topics.SIM_TRUTH, "", *names)
    return [
        _wide(values, widths[name]) if name in widths else values
        for name, values in zip(names, found, strict=True)
    ]


def _planner(run: RunData) -> tuple[Array, Array]:
    """Return the planner's p and p_ref; NaN while it waits."""
    mode, p, p_ref = run.columns(topics.PLANNER_STATUS, "", "mode", "p", "p_ref")
    p, p_ref = _wide(p, 6), _wide(p_ref, 6)
    for values in (p, p_ref):
        values[mode == PlannerMode.WAITING] = np.nan
    return p, p_ref


def _wide(values: Array, columns: int) -> Array:
    """Return an array of `columns` columns, even without messages."""
    return values if values.ndim == 2 else np.zeros((0, columns))
