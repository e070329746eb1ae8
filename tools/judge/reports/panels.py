"""Panels of the body, the hand, the feet, the states, the network, the harness, the certificate."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import DriveStatus, Mode, PlannerMode, SplitSource
from shared.bus.topics import Topic
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_S
from shared.joints import MODULES
from shared.links import GROUPS
from tools.judge.reports.page_model import BarRow, Bars, LevelLine, Line, Panel, Plot
from tools.judge.reports.run_data import RunData
from tools.judge.reports.signals import GAP_S
from tools.judge.standing import BY_KEY

NO_WORLD: Final = "no sim/truth in this log"
NO_PLANNER: Final = "no planner/status in this log"
NO_HARNESS: Final = "no harness/wrench in this log"
NO_STATES: Final = "no joint/*/state in this log"
NO_IMPAIRMENTS: Final = "no impairment in this log"
XYZ: Final = ("x", "y", "z")
ANGLES: Final = ("roll", "pitch", "yaw")


class ImpairedLink(IntEnum):
    """State of one direction of a link."""

    CLEAR = 0
    IMPAIRED = 1
    """Delayed, or lossy."""
    CUT = 2


class WrenchQuality(IntEnum):
    """Quality of the harness sensor's wrench."""

    VALID = 0
    NOT_VALID = 1
    SATURATED = 2


COLOURS: Final[Mapping[type[IntEnum], Mapping[int, str]]] = {
    Mode: {
        Mode.DISARMED: "idle", Mode.HOLD: "warn", Mode.TRACK: "good", Mode.DAMP: "odd",
        Mode.FAULT: "bad",
    },
    DriveStatus: {
        DriveStatus.LOST: "bad", DriveStatus.IDLE: "idle", DriveStatus.ARMED: "good",
        DriveStatus.ERROR: "odd", DriveStatus.UNZEROED: "warn", DriveStatus.HOLDING: "good",
        DriveStatus.UNACKNOWLEDGED: "bad",
    },
    PlannerMode: {
        PlannerMode.WAITING: "idle", PlannerMode.ALIGNING: "warn", PlannerMode.LEADING: "good",
        PlannerMode.OVERLOADED: "odd", PlannerMode.UNCERTIFIED: "bad",
        PlannerMode.MISPLACED: "bad", PlannerMode.TRIPPED: "bad", PlannerMode.MISLOADED: "bad",
        PlannerMode.YIELDING: "odd",
    },
    SplitSource: {
        SplitSource.DIAGONAL: "idle", SplitSource.SCHEDULE: "good", SplitSource.STIFFENED: "warn",
        SplitSource.UNCERTIFIED: "bad", SplitSource.CONTROLLER: "good",
    },
    WrenchQuality: {
        WrenchQuality.VALID: "good", WrenchQuality.NOT_VALID: "warn",
        WrenchQuality.SATURATED: "bad",
    },
    ImpairedLink: {
        ImpairedLink.CLEAR: "good", ImpairedLink.IMPAIRED: "warn", ImpairedLink.CUT: "bad",
    },
}  # fmt: skip


class StateBars(NamedTuple):
    """A panel of bars that shows one field of a topic."""

    title: str
    label: str
    """Its row's label; empty: a row for each module."""
    topic: Topic
    field: str
    names: type[IntEnum]
    if_empty: str


STATES: Final = (
    StateBars("Modes of the six services", "", topics.JOINT_STATE, "mode", Mode, NO_STATES),
    StateBars("Drives", "", topics.JOINT_STATE, "drive", DriveStatus, NO_STATES),
    StateBars("Planner", "planner", topics.PLANNER_STATUS, "mode", PlannerMode, NO_PLANNER),
    StateBars(
        "Source of the local gains", "gains", topics.PLANNER_STATUS, "split", SplitSource,
        NO_PLANNER,
    ),
)  # fmt: skip

History = tuple[tuple[float, ImpairedLink], ...]


def body(run: RunData) -> Iterator[Panel]:
    """Yield COM, height and torso angles (the paper's Fig. 7)."""
    com, torso, angles = (run.wide(topics.SIM_TRUTH, n, 3) for n in ("com", "torso", "angles"))
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    p, p_ref = (run.wide(topics.PLANNER_STATUS, name, 6) for name in ("p", "p_ref"))
    p[_waits(run)] = p_ref[_waits(run)] = np.nan
    simulated = bool(len(t))

    def both(label: str, truth: Array, estimate: Array, colour: int) -> list[Line]:
        """Return the simulated value and, hidden, the planner's estimate; or only the latter."""
        lines = [Line(label, t, truth, colour)] if simulated else []
        name = f"{label}, planner's estimate" if simulated else label
        return [*lines, Line(name, t_p, estimate, colour, hidden=simulated, dashed=simulated)]

    neither = f"{NO_WORLD}, and {NO_PLANNER}"
    yield Plot(
        "COM", "mm", "World axes: x forward, y left; 0 is midway between the ankles.", neither,
        lines=[*both("x", com[:, 0] * 1e3, p[:, 0] * 1e3, 0),
               *both("y", com[:, 1] * 1e3, p[:, 1] * 1e3, 1)],
        limits=[*_leading_limits("alive_com_x_max_mm", "x, planner leading"),
                *_leading_limits("alive_com_y_max_mm", "y, planner leading")],
    )  # fmt: skip
    yield Plot(
        "Height", "m", "Above the ankles.", neither,
        lines=[Line("torso", t, torso[:, 2], 0), *both("COM", com[:, 2], p[:, 2], 1),
               Line("COM reference", t_p, p_ref[:, 2], 2, hidden=True, dashed=True)],
    )  # fmt: skip
    yield Plot(
        "Torso angles", "rad", "", neither,
        lines=[*(line for number, name in enumerate(ANGLES)
                 for line in both(name, angles[:, number], p[:, 3 + number], number)),
               Line("pitch reference", t_p, p_ref[:, 4], 4, hidden=True, dashed=True)],
        limits=_leading_limits("alive_roll_max_rad", "roll and yaw, planner leading"),
    )  # fmt: skip


def hand(run: RunData) -> Iterator[Panel]:
    """Yield the operator's force, with what is carried and pushed."""
    force, push = (run.wide(topics.SIM_TRUTH, name, 3) for name in ("operator_force", "push"))
    load, carried = run.columns(topics.SIM_TRUTH, "", "load_n", "harness_force_z")
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    requested, assist = run.columns(topics.PLANNER_STATUS, "", "assist_requested_n", "assist_n")
    lines = [Line("hand, z", t, force[:, 2], 0)]
    limits = _leading_limits("operator_peak_n", "hand z, planner leading")
    if force[:, 1].any():
        limits += _leading_limits("operator_side_peak_n", "hand y, planner leading")
        lines.append(Line("hand, y", t, force[:, 1], 7))
    if load.any():
        lines += [Line("weight on the harness", t, load, 1), Line("carried", t, carried, 2)]
    if requested.any() or assist.any():
        lines += [
            Line("assist requested", t_p, requested, 6, dashed=True),
            Line("assist applied", t_p, assist, 7, hidden=True),
        ]
    lines += [
        Line(f"push, {axis}", t, push[:, number], 3 + number, hidden=True)
        for number, axis in enumerate(XYZ)
        if push[:, number].any()
    ]
    yield Plot(
        "Operator's force", "N", "World axes, on the torso.", NO_WORLD,
        lines=lines if len(t) else [],
        limits=limits,
    )  # fmt: skip


def feet(run: RunData) -> Iterator[Panel]:
    """Yield tilt and slip of the feet, and how far the legs' estimates of the torso differ."""
    right, left, slip = run.columns(
        topics.SIM_TRUTH, "", "foot_right_tilt", "foot_left_tilt", "feet_slip"
    )
    t, t_p = run.times(topics.SIM_TRUTH), run.times(topics.PLANNER_STATUS)
    yield Plot(
        "Tilt of the soles", "rad",
        "Angle between sole and floor: a tilted foot stands on an edge.", NO_WORLD,
        lines=[Line("right", t, right, 0), Line("left", t, left, 1)],
        limits=_leading_limits("alive_sole_tilt_max_rad", "planner leading")[:1],
    )  # fmt: skip
    yield Plot(
        "Slip of the feet", "mm", "Distance of the ankle from its position at the start.", NO_WORLD,
        lines=[Line("larger of both ankles", t, slip * 1e3, 0)],
    )  # fmt: skip
    closure = run.wide(topics.PLANNER_STATUS, "closure", 6)
    closure[_waits(run) | (t_p < run.armed_s())] = np.nan
    closure[:, :3] *= 1e3
    note = (
        "Left leg's estimate of the torso pose minus the right leg's: grows when a foot slips or "
        "tips."
    )
    for what, unit, names, values, words in (
        ("position", "mm", XYZ, closure[:, :3], note),
        ("angle", "rad", ANGLES, closure[:, 3:], ""),
    ):
        title = f"Difference between the legs, {what}"
        yield Plot(title, unit, words, NO_PLANNER, lines=_components(names, t_p, values))


def states(run: RunData) -> Iterator[Panel]:
    """Yield the state bars: services, drives, planner, gains, harness."""
    for title, label, topic, field, names, if_empty in STATES:
        rows = [
            BarRow(label or module, run.times(topic, module), *run.columns(topic, module, field))
            for module in (("",) if label else MODULES)
        ]
        yield Bars(title, if_empty=if_empty, rows=rows, names=names, colours=COLOURS[names])
    valid, saturated = run.columns(topics.WRENCH, "", "valid", "saturated")
    quality = np.where(saturated > 0.0, WrenchQuality.SATURATED, np.where(valid > 0.0, 0.0, 1.0))
    yield Bars(
        "Harness sensor",
        if_empty=NO_HARNESS,
        rows=[BarRow("harness", run.times(topics.WRENCH), quality)],
        names=WrenchQuality,
        colours=COLOURS[WrenchQuality],
    )


def network(run: RunData) -> Iterator[Panel]:
    """Yield the impaired directions; directions with equal histories share a row."""
    names_by_history: dict[History, list[str]] = defaultdict(list)
    events: list[LinkEvent] = run.log.messages(topics.LINK_EVENT)
    for name, history in histories(events, run.zero_ns).items():
        names_by_history[history].append(name)
    rows = []
    for history, names in names_by_history.items():
        # samples that are close enough to form one bar
        changes = np.array([t for t, _ in history])
        codes = np.array([ImpairedLink.CLEAR, *(code for _, code in history)])
        t = np.union1d(np.arange(*run.span, GAP_S / 2), changes)
        codes = codes[np.searchsorted(changes, t, side="right")]
        rows += [BarRow(label, t, codes) for label in _labels(names)]
    yield Bars(
        "Injected network impairments",
        if_empty=NO_IMPAIRMENTS,
        rows=rows,
        names=ImpairedLink,
        colours=COLOURS[ImpairedLink],
    )


def histories(events: Iterable[LinkEvent], zero_ns: int) -> dict[str, History]:
    """Return (time in s, state from then on) of each direction that was ever impaired.

    A partition outweighs all other impairments (`shared.config.impairment.Direction`).
    """
    found: dict[str, list[tuple[float, ImpairedLink]]] = defaultdict(list)
    active: dict[str, dict[int, bool]] = defaultdict(dict)
    for event in events:
        cuts = active[event.link]
        if event.active:
            cuts[event.number] = event.partition
        else:
            cuts.pop(event.number, None)
        state = ImpairedLink.IMPAIRED if cuts else ImpairedLink.CLEAR
        state = ImpairedLink.CUT if any(cuts.values()) else state
        found[event.link].append(((event.t_ns - zero_ns) / NS_PER_S, state))
    return {name: tuple(history) for name, history in found.items()}


def _labels(names: Iterable[str]) -> list[str]:
    """Return short labels: the largest groups that the directions cover, then the rest."""
    left, found = set(names), []
    for group, members in sorted(GROUPS.items(), key=lambda item: -len(item[1])):
        if set(members) <= left:
            found.append(group)
            left -= set(members)
    return [_short(name) for name in (*found, *sorted(left))]


def _short(name: str) -> str:
    sender, arrow, receiver = name.partition("->")
    if not arrow:
        return name
    return f"to {receiver}" if sender == "planner" else f"from {sender}"


def harness(run: RunData) -> Iterator[Panel]:
    """Yield the measured wrench of the operator on the torso."""
    t = run.times(topics.WRENCH)
    note = "Wrench of the operator on the torso, at the harness point, torso axes."
    for name, unit in (("force", "N"), ("moment", "N m")):
        lines = _components(XYZ, t, run.wide(topics.WRENCH, name, 3))
        yield Plot(f"Harness {name}", unit, note, NO_HARNESS, lines=lines)


def heat(run: RunData) -> Iterator[Panel]:
    """Yield the estimated temperature of each module's warmer winding, and the seconds left."""
    lines = []
    for number, module in enumerate(MODULES):
        celsius = run.wide(topics.JOINT_STATE, "celsius", 2, module)
        if celsius.any():
            t = run.times(topics.JOINT_STATE, module)
            lines.append(Line(module, t, celsius.max(axis=1), number))
    limits = []
    if run.robot is not None and run.robot.heat.estimate:
        limits = [LevelLine(run.robot.heat.winding_max, "limit", shown=False)]
    yield Plot(
        "Warmest winding", "C", "Estimated from torque and time; the warmer of a module's motors.",
        "no estimate in this log", lines=lines, limits=limits,
    )  # fmt: skip
    t = run.times(topics.PLANNER_STATUS)
    (left,) = run.columns(topics.PLANNER_STATUS, "", "heat_left_s")
    left[left < 0.0] = np.nan
    known = bool(np.isfinite(left).any())
    yield Plot(
        "Left at this load", "s", "Until a winding or an output stage is too warm; 3600: or more.",
        "no estimate in this log", lines=[Line("least of all", t, left, 0)] if known else [],
    )  # fmt: skip


def certificate(run: RunData) -> Iterator[Panel]:
    """Yield the stability margins of the active gains and the least allowed margins."""
    t = run.times(topics.PLANNER_STATUS)
    service, onboard = run.columns(topics.PLANNER_STATUS, "", "margin", "margin_onboard")
    service[_waits(run)] = onboard[_waits(run)] = np.nan
    limits = [LevelLine(0.0, "unstable")]
    if run.robot is not None:
        least = run.robot.certificate
        limits += [
            LevelLine(least.margin_min, "least, services"),
            LevelLine(least.onboard_margin_min, "least, drives"),
        ]
    yield Plot(
        "Certificate margin",
        note="Stability without the planner: 1 is the required stiffness, at 0 the robot falls.",
        if_empty=NO_PLANNER,
        lines=[Line("joint services alone", t, service, 0), Line("drives alone", t, onboard, 1)],
        limits=limits,
    )


def _components(names: Iterable[str], t: Array, values: Array) -> list[Line]:
    return [Line(name, t, values[:, number], number) for number, name in enumerate(names)]


def _leading_limits(key: str, label: str) -> list[LevelLine]:
    """Return a limit of the verdict for both signs; visible once a line comes close."""
    most = BY_KEY[key].limit
    return [LevelLine(most, label, shown=False), LevelLine(-most, label, shown=False)]


def _waits(run: RunData) -> NDArray[np.bool_]:
    """Return where the planner waits: its estimates and margins are not known then."""
    (mode,) = run.columns(topics.PLANNER_STATUS, "", "mode")
    return np.asarray(mode == PlannerMode.WAITING)
