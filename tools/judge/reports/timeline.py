"""Timeline of a run: its events, mode changes, silences and limit violations, in order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from shared.bus import topics
from shared.bus.messages import (
    Cause,
    DriveStatus,
    HeatAction,
    JointEvent,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    Tare,
    Trip,
    Wrench,
    name_of,
)
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.fleet.stalls import stalls_of
from tools.judge.reports.limit_violations import LimitViolations, together
from tools.judge.reports.page_model import TimelineEvent
from tools.judge.reports.run_data import RunData, module_of
from tools.judge.reports.signals import GAP_S, Span, message_times
from tools.logs.impairment_intervals import impairments

TOGETHER_S: Final = 0.1
"""Equal changes of several modules within this time share one row."""
ROWS_MAX: Final = 500
BACKOFF_MIN_S: Final = 0.5
"""Shortest back-off of the planner after drop-outs that has a row."""
END_S: Final = 0.1
"""An impairment that ends this close to the end of the log has no mark for its end."""

_NORMAL_MODES: Final = (PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.LEADING)


class Timeline:
    """The events of a run, whose parts are taken one after the other."""

    def __init__(self) -> None:
        self._found: list[TimelineEvent] = []
        self._violations = LimitViolations()
        self._silences = Silences()
        self._successive = Successive()

    def add(self, run: RunData) -> None:
        """Add a run, or the next part of it."""
        found = (
            *_run_events(run),
            *_mode_changes(run),
            *_drives(run, self._successive),
            *_planner(run, self._successive),
            *_harness(run, self._successive),
            *_world(run),
            *_network(run),
        )
        self._found += [event for event in found if run.inside(event.t)]
        self._violations.add(run)
        self._silences.add(run)

    def events(self, span: Span) -> list[TimelineEvent]:
        """Return all events in the order of time."""
        found = [*self._found, *self._violations.events(), *self._silences.events()]
        found.sort(key=lambda row: row.t)
        if len(found) > ROWS_MAX:
            left = len(found) - ROWS_MAX
            kept = [row for row in found if row.mark] + _first_unmarked(found)
            found = sorted(kept, key=lambda row: row.t)
            found.append(TimelineEvent(span.end, "note", f"about {left} more rows are left out"))
        return found


def timeline_events(run: RunData) -> list[TimelineEvent]:
    """Return all events of a whole run in the order of time."""
    timeline = Timeline()
    timeline.add(run)
    return timeline.events(run.span)


def _first_unmarked(found: Sequence[TimelineEvent]) -> list[TimelineEvent]:
    """Return the first rows without a mark, as many as the page has room for."""
    unmarked = [row for row in found if not row.mark]
    return unmarked[: max(0, ROWS_MAX - (len(found) - len(unmarked)))]


def _run_events(run: RunData) -> Iterator[TimelineEvent]:
    for event in run.log.messages(topics.RUN_EVENT):
        yield TimelineEvent(run.at(event.t_ns), *_told(event))
    last = None
    for stop in run.log.messages(topics.ESTOP):
        t = run.at(stop.t_ns)
        if last is None or t - last > 1.0:  # a stop is published repeatedly
            yield TimelineEvent(t, "estop", f"emergency stop by {stop.source}", "e-stop")
        last = t
    for request in run.log.messages(topics.HARNESS_TARE):
        yield TimelineEvent(run.at(request.t_ns), "note", f"tare requested by {request.source}")


def _network(run: RunData) -> Iterator[TimelineEvent]:
    """Yield the begin and the end of each impairment, of all its directions together."""
    for row in impairments(run.log.messages(topics.LINK_EVENT)):
        begin_s, end_s = row.begin_s(run.zero_ns), row.end_s(run.zero_ns)
        yield TimelineEvent(begin_s, "network", f"network, {row.title}", row.title)
        if end_s is None:
            continue
        text = f"network, {row.title} ends; {row.counts()}"
        mark = f"{row.link} ends" if end_s < run.span.end - END_S else ""
        yield TimelineEvent(end_s, "network" if mark else "note", text, mark)


def _told(event: RunEvent) -> tuple[str, str, str]:
    """Return kind, text and mark of a run's event."""
    who, detail = event.subject, event.detail
    named = f"{who} {detail}".strip()
    match event.kind:
        case RunEventKind.STARTED:
            return "note", f"{who} starts", ""
        case RunEventKind.FINISHED:
            return "note", f"{who} ends {detail}".strip(), ""
        case RunEventKind.KILLED:
            return "kill", f"{who} gets SIG{detail}", named
        case RunEventKind.RESTARTED:
            return "restart", f"{who} restarts", f"{who} back"
        case RunEventKind.PUSHED:
            return "push", f"push {detail}", f"push {detail.partition(' for ')[0]}"
        case RunEventKind.FAULTED:
            return "fault", f"{who}: fault {detail} begins", named
        case RunEventKind.STALLED if stalls := stalls_of([event]):
            return "stall", stalls[0].words, "stall"
    kind = "stall" if event.kind == RunEventKind.STALLED else "note"
    text = f"{who} {name_of(RunEventKind, event.kind)} {detail}".strip()
    return kind, text, "stall" if kind == "stall" else ""


def _mode_changes(run: RunData) -> Iterator[TimelineEvent]:
    changes: list[tuple[float, str, JointEvent]] = sorted(
        (run.at(event.t_ns), module, event)
        for module in MODULES
        for event in run.log.messages(topics.JOINT_EVENT, module)
    )
    for group in together(
        changes, lambda row: (row[2].mode_before, row[2].mode_after, row[2].cause), TOGETHER_S
    ):
        t, _, first = group[0]
        bad = first.mode_after in (Mode.FAULT, Mode.DAMP)
        yield TimelineEvent(t, "bad" if bad else "note", _describe_mode_change(group))


def _modules(found: Iterable[str]) -> str:
    modules = sorted(set(found), key=MODULES.index)
    return "all six" if len(modules) == len(MODULES) else ", ".join(modules)


def _describe_mode_change(group: Sequence[tuple[float, str, JointEvent]]) -> str:
    first = group[0][2]
    modules = _modules(module for _, module, _ in group)
    step = max(
        abs(b - a)
        for _, _, event in group
        for a, b in zip(event.tau_before, event.tau_after, strict=True)
    )
    within_ms = (group[-1][0] - group[0][0]) * 1e3
    text = (
        f"{modules}: {name_of(Mode, first.mode_before)} to {name_of(Mode, first.mode_after)}, "
        f"{name_of(Cause, first.cause)}"
    )
    if len(group) > 1 and within_ms > 0.0:
        text += f", within {within_ms:.1f} ms"
    ages = [event.age_ns for _, _, event in group if event.age_ns >= 0]
    if ages:
        text += f"; command {max(ages) / NS_PER_MS:.1f} ms old"
    return f"{text}; torque step {step:.2f} N m"


class Successive:
    """Gives a topic's messages in parts of a run, each with the last message before the part."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], tuple[float, Any]] = {}

    def of(self, run: RunData, topic: Topic, module: str = "") -> list[tuple[float, Any]]:
        """Return (time, message) of what is inside the part, after the last one before it."""
        rows = [
            (t, message)
            for t, message in zip(
                run.times(topic, module).tolist(), run.log.messages(topic, module), strict=True
            )
            if run.inside(t)
        ]
        before = self._last.get((topic.name, module))
        if rows:
            self._last[topic.name, module] = rows[-1]
        return rows if before is None else [before, *rows]


def _drives(run: RunData, successive: Successive) -> Iterator[TimelineEvent]:
    changes: list[tuple[float, str, JointState, JointState]] = []
    for module in MODULES:
        rows = successive.of(run, topics.JOINT_STATE, module)
        changes += [
            (rows[index][0], module, rows[index - 1][1], rows[index][1])
            for index in _changes([(state.drive, state.drive_error) for _, state in rows])
        ]
    changes.sort(key=lambda row: row[0])
    for group in together(changes, _describe_drive_change, TOGETHER_S):
        t_s, _, before, after = group[0]
        worse = after.drive != DriveStatus.ARMED and before.drive == DriveStatus.ARMED
        bad = worse or after.drive == DriveStatus.ERROR or after.drive_error != 0
        modules = _modules(module for _, module, _, _ in group)
        text = f"{modules}: {_describe_drive_change(group[0])}"
        yield TimelineEvent(t_s, "bad" if bad else "note", text)


def _describe_drive_change(row: tuple[float, str, JointState, JointState]) -> str:
    _, _, before, after = row
    parts = []
    if before.drive != after.drive:
        parts.append(
            f"drive {name_of(DriveStatus, before.drive)} to {name_of(DriveStatus, after.drive)}"
        )
    if before.drive_error != after.drive_error:
        parts.append(f"error bits {after.drive_error:#x}")
    return ", ".join(parts)


def _planner(run: RunData, successive: Successive) -> Iterator[TimelineEvent]:
    rows: list[tuple[float, PlannerStatus]] = successive.of(run, topics.PLANNER_STATUS)
    for index in _changes([(row.mode, row.session) for _, row in rows]):
        (_, before), (t, after) = rows[index - 1], rows[index]
        fresh = " in a new session" if before.session != after.session else ""
        text = f"planner: {name_of(PlannerMode, before.mode)} to {name_of(PlannerMode, after.mode)}"
        trip = f", {name_of(Trip, after.trip)}" if after.mode == PlannerMode.TRIPPED else ""
        bad = after.mode not in _NORMAL_MODES
        yield TimelineEvent(t, "bad" if bad else "note", text + trip + fresh)
    for index in _changes([row.heat for _, row in rows]):
        t, row = rows[index]
        said = f", {row.heat_left_s:.0f} s left at this load" if row.heat else ""
        yield TimelineEvent(t, "note", f"heat: {name_of(HeatAction, row.heat)}{said}")
    for index in _changes([row.wait_s > 0.0 for _, row in rows]):
        t, row = rows[index]
        if row.wait_s >= BACKOFF_MIN_S:
            text = f"planner: backs off for {row.wait_s:.1f} s or more, after drop-outs or trips"
            yield TimelineEvent(t, "note", text)


def _harness(run: RunData, successive: Successive) -> Iterator[TimelineEvent]:
    rows: list[tuple[float, Wrench]] = successive.of(run, topics.WRENCH)
    for index in _changes([(row.valid, row.saturated, row.tare) for _, row in rows]):
        t, row = rows[index]
        state = "valid" if row.valid else "saturated" if row.saturated else "not valid"
        tare = "" if row.tare == Tare.DONE else f", tare {name_of(Tare, row.tare)}"
        kind = "note" if row.valid else "bad"
        yield TimelineEvent(t, kind, f"harness sensor {state}{tare}")


def _world(run: RunData) -> Iterator[TimelineEvent]:
    rows: list[SimTruth] = run.log.messages(topics.SIM_TRUTH)
    for row in rows:
        if row.fallen:
            yield TimelineEvent(run.at(row.t_ns), "fall", "the robot fell", "fell")
            return


class Silences:
    """The gaps in periodic topics, by the recorder's clock."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self._found: list[tuple[float, str, float]] = []

    def add(self, run: RunData) -> None:
        """Add a run, or the next part of it."""
        for key, topic in topics.all_keys(run.log.robot).items():
            if topic.rate_hz < 10.0 or topic is topics.JOINT_TRACE:
                continue
            t = message_times(run.log.received_ns(topic, module_of(topic, key)), run.zero_ns)
            t = t[run.inside(t)]
            if not len(t):
                continue
            t = np.append(self._last.get(key, t[0]), t)
            self._last[key] = float(t[-1])
            steps = np.diff(t)
            name = key.removeprefix(f"xrl/{run.log.robot}/")
            self._found += [
                (float(t[index]), name, float(steps[index]))
                for index in np.flatnonzero(steps > max(GAP_S, 5.0 / topic.rate_hz))
            ]

    def events(self) -> Iterator[TimelineEvent]:
        """Yield the gaps; those that begin together in one row."""
        for group in together(sorted(self._found), lambda _: None, TOGETHER_S):
            names = ", ".join(_merged([name for _, name, _ in group]))
            longest = max(length for *_, length in group)
            most = "up to " if len(group) > 1 else ""
            text = f"{names} silent for {most}{longest:.2f} s"
            yield TimelineEvent(group[0][0], "note", text)


def _merged(names: Sequence[str]) -> list[str]:
    """Return names of topics; the six of one topic as one name."""
    left = list(dict.fromkeys(names))
    for topic in topics.TOPICS:
        six = [topic.name.replace("*", module) for module in MODULES]
        if topic.per_module and set(six) <= set(left):
            left = [topic.name, *(name for name in left if name not in six)]
    return left


def _changes(values: Sequence[Any]) -> list[int]:
    return [index for index in range(1, len(values)) if values[index] != values[index - 1]]
