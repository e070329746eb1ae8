"""The eight panels of a run: lines over one time axis, limits, and bars of states. Pure functions.

The report's page and `run.png` draw the same panels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.joint.trips import AT_LIMIT
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import Mode, PlannerMode, name_of
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.fleet import stalls
from tools.judge.reports.run_data import RunData
from tools.judge.standing import BY_KEY
from tools.judge.verdict import leading
from tools.logs.impairment_intervals import impairments

GAP_S: Final = 0.1
"""A plot interrupts its line where a signal has no sample for longer than this, s."""
AGE_REACH: Final = 1.2
"""Top of the panel of ages, as a multiple of the maximum usable age."""
AGE_MAX_MS: Final = 50.0
"""Maximum usable age if the log does not contain its robot."""
TORQUE_DURATION_MIN_S: Final = 0.02
"""Shorter total times at the torque limit are not reported, s."""
COLOURS: Final[Mapping[str, str]] = {
    "DISARMED": "idle", "HOLD": "warn", "TRACK": "good", "DAMP": "odd", "FAULT": "bad",
    "WAITING": "idle", "ALIGNING": "warn", "LEADING": "good", "OVERLOADED": "odd",
    "UNCERTIFIED": "bad", "MISPLACED": "bad", "TRIPPED": "bad", "MISLOADED": "bad",
    "YIELDING": "odd", "FALLEN": "bad", "IMPAIRED": "net", "CUT": "bad",
}  # fmt: skip
"""Name of the colour of each state in the bars."""

Bar = tuple[float, float, str]
"""Start and end, s, and the name of the state."""


class Beyond(NamedTuple):
    """A limit of a line."""

    words: str
    """Description, such as `over 20 mm while led`."""
    shortest_s: float = 0.0
    """A shorter total time beyond it is not reported, s."""


Beyonds = Sequence[tuple[Beyond, NDArray[np.bool_]]]
"""Limits of a line, each with a mask of the samples beyond it."""


class Line(NamedTuple):
    """One line of a panel."""

    label: str
    t: Array
    values: Array
    """NaN where the value is unknown."""
    colour: int
    hidden: bool = False
    """True if the line is hidden until the user clicks its name in the legend."""
    dashed: bool = False
    beyond: Beyonds = ()


class Level(NamedTuple):
    """A limit or other level to compare the lines with."""

    value: float
    label: str
    shown: bool = False
    """True if the value axis extends to it."""


class Panel(msgspec.Struct, frozen=True):
    """The data of a run, or of a part of it, for a panel: lines or rows of bars."""

    title: str
    unit: str = ""
    note: str = ""
    """An explanation for readers who do not know the panel."""
    lines: Sequence[Line] = ()
    levels: Sequence[Level] = ()
    rows: Mapping[str, Sequence[Bar]] = {}
    reach: float | None = None
    """Upper end of the value axis; lines may go beyond it."""


def panels_of(run: RunData) -> list[Panel]:
    """Return all panels in the order of the page; a panel may have no data."""
    return [*_body(run), _hand(run), _states(run), _ages(run), _torques(run), _certificate(run)]


def _body(run: RunData) -> Iterator[Panel]:
    """Yield COM, height and torso angles (the paper's Fig. 7)."""
    com, torso, angles = (run.wide(topics.SIM_TRUTH, n, 3) for n in ("com", "torso", "angles"))
    over = np.array([row.over for row in run.log.messages(topics.SIM_TRUTH)]).reshape(-1, 2) * 1e3
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    p, p_ref = (run.wide(topics.PLANNER_STATUS, name, 6) for name in ("p", "p_ref"))
    p[_waits(run)] = p_ref[_waits(run)] = np.nan
    simulated = bool(len(t))

    def both(
        label: str, truth: Array, estimate: Array, colour: int, beyond: Beyonds = ()
    ) -> list[Line]:
        """Return the simulated value and, hidden, the planner's estimate; or the estimate alone."""
        lines = [Line(label, t, truth, colour, beyond=beyond)] if simulated else []
        name = f"{label}, planner's estimate" if simulated else label
        return [*lines, Line(name, t_p, estimate, colour, hidden=simulated, dashed=simulated)]

    judged = _Judged(run)
    yield Panel(
        "COM", "mm", "Over the soles: x forward, y left; 0 is midway between the ankles.",
        lines=[
            line for number, axis in enumerate("xy")
            for line in both(
                axis, over[:, number], p[:, number] * 1e3, number,
                judged.beyond(over[:, number], f"alive_com_{axis}_max_mm",
                              f"hold_com_{axis}_max_mm"),
            )
        ],
        levels=[*_both_signs("alive_com_x_max_mm", "x, led"),
                *_both_signs("alive_com_y_max_mm", "y, led")],
    )  # fmt: skip
    yield Panel(
        "Height", "m", "Above the ankles.",
        lines=[Line("torso", t, torso[:, 2], 0), *both("COM", com[:, 2], p[:, 2], 1),
               Line("COM reference", t_p, p_ref[:, 2], 2, hidden=True, dashed=True)],
    )  # fmt: skip
    keys = ("alive_roll_max_rad", "", "alive_yaw_max_rad")
    yield Panel(
        "Torso angles", "rad",
        lines=[*(line for number, name in enumerate(("roll", "pitch", "yaw"))
                 for line in both(name, angles[:, number], p[:, 3 + number], number,
                                  judged.beyond(angles[:, number], keys[number]))),
               Line("pitch reference", t_p, p_ref[:, 4], 4, hidden=True, dashed=True)],
        levels=_both_signs("alive_roll_max_rad", "roll and yaw, led"),
    )  # fmt: skip


def _hand(run: RunData) -> Panel:
    """Return the operator's force and the carried load."""
    title, unit = "Operator's force", "N"
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    if not len(t):
        t, force = run.times(topics.WRENCH), run.wide(topics.WRENCH, "force", 3)
        lines = [Line(f"hand, {axis}", t, force[:, n], n) for n, axis in enumerate("xyz")]
        return Panel(title, unit, "By the harness sensor, in torso axes.", lines=lines)
    force = run.wide(topics.SIM_TRUTH, "operator_force", 3)
    load, carried = run.columns(topics.SIM_TRUTH, "", "load_n", "harness_force_z")
    requested, assist = run.columns(topics.PLANNER_STATUS, "", "assist_requested_n", "assist_n")
    judged = _Judged(run)
    lines = [
        Line("hand, z", t, force[:, 2], 0, beyond=judged.beyond(force[:, 2], "operator_peak_n"))
    ]
    levels = _both_signs("operator_peak_n", "hand z, led")
    if force[:, 1].any():
        beyond = judged.beyond(force[:, 1], "operator_side_peak_n")
        lines.append(Line("hand, y", t, force[:, 1], 7, beyond=beyond))
        levels += _both_signs("operator_side_peak_n", "hand y, led")
    if load.any():
        lines += [Line("weight on the harness", t, load, 1), Line("carried", t, carried, 2)]
    if requested.any() or assist.any():
        lines += [
            Line("assist requested", t_p, requested, 6, dashed=True),
            Line("assist applied", t_p, assist, 7, hidden=True),
        ]
    return Panel(title, unit, "On the torso, in world axes.", lines=lines, levels=levels)


def _states(run: RunData) -> Panel:
    """Return the modes of planner and services, and the impairments of the network."""
    (modes,) = run.columns(topics.PLANNER_STATUS, "", "mode")
    rows = {"planner": _bars(run.times(topics.PLANNER_STATUS), modes, PlannerMode)}
    for module in MODULES:
        (modes,) = run.columns(topics.JOINT_STATE, module, "mode")
        rows[module] = _bars(run.times(topics.JOINT_STATE, module), modes, Mode)
    rows["network"] = []
    for row in impairments(run.log.messages(topics.LINK_EVENT)):
        end_s = row.end_s(run.zero_ns)
        name = "CUT" if "partition" in row.words else "IMPAIRED"
        end_s = run.span.end if end_s is None else end_s
        rows["network"].append((row.begin_s(run.zero_ns), end_s, name))
    return Panel("Modes", rows={label: bars for label, bars in rows.items() if bars})


def _bars(t: Array, codes: Array, names: type[Mode | PlannerMode]) -> list[Bar]:
    """Return an interval for each time in one state; a gap ends an interval."""
    if not len(t):
        return []
    ends = (np.diff(codes) != 0) | (np.diff(t) > GAP_S)
    starts = np.flatnonzero(np.concatenate(([True], ends)))
    found: list[Bar] = []
    for start, following in zip(starts, np.append(starts[1:], len(t)), strict=True):
        end = t[following - 1]
        if following < len(t) and t[following] - end <= GAP_S:
            end = t[following]
        found.append((float(t[start]), float(end), name_of(names, int(codes[start]))))
    return found


def _ages(run: RunData) -> Panel:
    lines = []
    for number, module in enumerate(MODULES):
        (age_ns,) = run.columns(topics.JOINT_STATE, module, "age_ns")
        age_ms = np.where(age_ns < 0.0, np.nan, age_ns) / NS_PER_MS
        lines.append(Line(module, run.times(topics.JOINT_STATE, module), age_ms, number))
    most_ms = run.robot.joint_service.max_command_age_ms if run.robot is not None else AGE_MAX_MS
    return Panel(
        "Command age", "ms", "Age of the command in use, by each joint service's own clock.",
        lines=lines,
        levels=[Level(most_ms, "HOLD", shown=True)],
        reach=AGE_REACH * most_ms,
    )  # fmt: skip


def _torques(run: RunData) -> Panel:
    lines = []
    most = run.robot.joint.tau_module_max if run.robot is not None else np.inf
    for number, module in enumerate(MODULES):
        tau = np.abs(run.wide(topics.JOINT_STATE, "tau", 2, module)).sum(axis=1)
        limit = Beyond(f"at the limit of {most:g} N m", TORQUE_DURATION_MIN_S)
        beyond = [(limit, tau >= AT_LIMIT * most)]
        t = run.times(topics.JOINT_STATE, module)
        lines.append(Line(module, t, tau, number, beyond=beyond))
    return Panel(
        "Torque of each module", "N m",
        "|tau_phi| + |tau_theta|: proportional to the torque of the more loaded motor.",
        lines=lines,
        levels=[Level(most, "limit")] if np.isfinite(most) else [],
    )  # fmt: skip


def _certificate(run: RunData) -> Panel:
    """Return the stability margins of the active gains, and the minimum margins."""
    t, levels, lines = run.times(topics.PLANNER_STATUS), [Level(0.0, "unstable", shown=True)], []
    least = (math.nan, math.nan)
    if run.robot is not None:
        least = run.robot.certificate.margin_min, run.robot.certificate.onboard_margin_min
    for number, (field, name) in enumerate(
        (("margin", "joint services alone"), ("margin_onboard", "drives alone"))
    ):
        mode, margin = run.columns(topics.PLANNER_STATUS, "", "mode", field)
        margin[_waits(run)] = math.nan
        is_under = (margin < least[number]) & (mode != PlannerMode.MISPLACED)
        beyond = [(Beyond(f"under {least[number]:g}"), is_under)]
        lines.append(Line(name, t, margin, number, beyond=beyond))
        if math.isfinite(least[number]):
            levels.append(Level(least[number], f"minimum, {name}", shown=True))
    return Panel(
        "Certificate margin",
        note="Stability without the planner: 1 is the required stiffness, at 0 the robot falls.",
        lines=lines,
        levels=levels,
    )


class _Judged:
    """Times of `sim/truth` that the verdict judges, and the limits that apply."""

    def __init__(self, run: RunData) -> None:
        rows = run.log.messages(topics.SIM_TRUTH)
        times_ns = np.array([row.t_ns for row in rows], dtype=np.int64)
        self._led = self._held = np.zeros(len(rows), dtype=bool)
        if run.course is not None:
            begin_ns, end_ns = run.course.rows[0].t_ns, run.course.rows[-1].t_ns
            judged = (times_ns >= begin_ns) & (times_ns <= end_ns)
            changes = [row for m in MODULES for row in run.log.messages(topics.JOINT_EVENT, m)]
            events = run.log.messages(topics.RUN_EVENT)
            judged &= ~stalls.inside(stalls.disturbances(events, changes, end_ns), times_ns)
            led = leading(run.log, times_ns)
            self._led, self._held = led & judged, ~led & judged

    def beyond(self, values: Array, led_key: str, held_key: str = "") -> Beyonds:
        """Return where values exceed their limits of the verdict; an empty key means no limit."""
        found = []
        for key, mask, when in ((led_key, self._led, "led"), (held_key, self._held, "held")):
            if key:
                row = BY_KEY[key]
                limit = Beyond(f"over {row.limit:g} {row.unit} while {when}")
                found.append((limit, mask & (np.abs(values) > row.limit)))
        return found


def _both_signs(key: str, label: str) -> list[Level]:
    """Return a limit of the verdict for both signs; it shows when a line comes close."""
    most = BY_KEY[key].limit
    return [Level(most, label), Level(-most, label)]


def _waits(run: RunData) -> NDArray[np.bool_]:
    """Return where the planner waits, so that its estimates and margins are unknown."""
    (mode,) = run.columns(topics.PLANNER_STATUS, "", "mode")
    return np.asarray(mode == PlannerMode.WAITING)
