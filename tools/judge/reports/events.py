"""Events of a run in order: kills, faults, pushes, state changes, silences, exceeded limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeVar

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
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.fleet.stalls import stalls_of
from tools.judge.reports.panels import GAP_S, Beyond, Panel, panels_of
from tools.judge.reports.run_data import RunData, Span
from tools.logs.impairment_intervals import impairments

TOGETHER_S: Final = 0.1
"""Equal changes of several modules within this time share one row."""
ROWS_MAX: Final = 500
END_S: Final = 0.1
"""An impairment that ends this close to the end of the log has no mark for its end."""
_NORMAL_MODES: Final = (PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.LEADING)


class TimelineEvent(NamedTuple):
    """One event of a run."""

    t: float
    kind: str
    """`kill`, `restart`, `push`, `fault`, `stall`, `network`, `estop`, `fall`: also marked in the
    plots; `limit`, `bad`, `note`: only in the list."""
    text: str
    mark: str = ""
    """Label of the mark in the plots, or an empty string for no mark."""


class Events:
    """The events of a run; `add` receives the run in parts, in order."""

    def __init__(self) -> None:
        self._found: list[TimelineEvent] = []
        self._last: dict[tuple[_Watched, str], tuple[Any, str]] = {}
        """Newest message of each state, and its words."""
        self._last_heard: dict[str, float] = {}
        self._silences: list[tuple[float, str, float]] = []
        self._violations: dict[tuple[str, str, Beyond], tuple[float, float]] = {}
        """First time and duration, s, by title, label and limit."""

    def add(self, run: RunData, panels: Sequence[Panel]) -> None:
        """Add a run, or the next part of it, with its panels."""
        found = (
            *_run_events(run),
            *_network(run),
            *_mode_changes(run),
            *(event for watched in _WATCHED for event in self._changes(run, watched)),
        )
        self._found += [event for event in found if run.inside(event.t)]
        self._add_silences(run)
        for panel in panels:
            self._add_violations(run, panel)

    def all(self, span: Span) -> list[TimelineEvent]:
        """Return all events in order of time."""
        found = [*self._found, *self._told_silences(), *self._told_violations()]
        found.sort(key=lambda row: row.t)
        left = len(found) - ROWS_MAX
        if left > 0:
            marked = [row for row in found if row.mark]
            others = [row for row in found if not row.mark][: max(0, ROWS_MAX - len(marked))]
            found = sorted(marked + others, key=lambda row: row.t)
            found.append(TimelineEvent(span.end, "note", f"about {left} more events are left out"))
        return found

    def _changes(self, run: RunData, watched: _Watched) -> Iterator[TimelineEvent]:
        """Yield the changes of a state, including changes between two parts."""
        changes: list[tuple[float, str, Any, Any]] = []
        for module in MODULES if watched.topic.per_module else ("",):
            before, known = self._last.get((watched, module), (None, ""))
            times = run.times(watched.topic, module)
            messages = run.log.messages(watched.topic, module)
            for t, is_in, after in zip(times, run.inside(times), messages, strict=True):
                words = watched.words(after) if is_in else known
                if before is not None and words != known:
                    changes.append((float(t), module, before, after))
                before, known = (after, words) if is_in else (before, known)
            self._last[watched, module] = before, known
        changes.sort(key=lambda row: row[0])
        for group in _together(changes, lambda row: tuple(map(watched.words, row[2:]))):
            t, _, before, after = group[0]
            who = watched.who.format(_modules(module for _, module, _, _ in group))
            text = f"{who}: {watched.words(before)} to {watched.words(after)}"
            yield TimelineEvent(t, "bad" if watched.is_bad(before, after) else "note", text)

    def _add_silences(self, run: RunData) -> None:
        """Add the gaps of periodic topics, by the recorder's clock."""
        for key, topic in topics.all_keys(run.log.robot).items():
            if topic.rate_hz < 10.0 or topic is topics.JOINT_TRACE or not topic.recorded:
                continue
            module = key.split("/")[-2] if topic.per_module else ""
            t = run.on_axis(run.log.received_ns(topic, module))
            t = t[run.inside(t)]
            if not len(t):
                continue
            t = np.append(self._last_heard.get(key, t[0]), t)
            self._last_heard[key] = float(t[-1])
            steps = np.diff(t)
            name = key.removeprefix(f"xrl/{run.log.robot}/")
            self._silences += [
                (float(t[index]), name, float(steps[index]))
                for index in np.flatnonzero(steps > max(GAP_S, 5.0 / topic.rate_hz))
            ]

    def _told_silences(self) -> Iterator[TimelineEvent]:
        for group in _together(sorted(self._silences), lambda _: None):
            names = ", ".join(_merged([name for _, name, _ in group]))
            longest = max(length for *_, length in group)
            most = "up to " if len(group) > 1 else ""
            yield TimelineEvent(group[0][0], "note", f"{names} silent for {most}{longest:.2f} s")

    def _add_violations(self, run: RunData, panel: Panel) -> None:
        for line in panel.lines:
            steps = np.append(np.diff(line.t), 0.0)
            usual = float(np.median(steps[:-1])) if len(steps) > 1 else 0.0
            for limit, where in line.beyond:
                beyond = where & run.inside(line.t)
                if beyond.any():
                    key = panel.title, line.label, limit
                    first_s = float(line.t[int(np.argmax(beyond))])
                    first_s, before_s = self._violations.get(key, (first_s, 0.0))
                    duration_s = float(np.minimum(steps, 5.0 * usual)[beyond].sum())
                    self._violations[key] = first_s, before_s + duration_s

    def _told_violations(self) -> Iterator[TimelineEvent]:
        """Yield the first violation of each limit; modules that violate it together share a row.

        The earliest one is the place to start the search for the cause of a fall.
        """
        found = sorted(
            (first_s, title, limit.words, label, duration_s)
            for (title, label, limit), (first_s, duration_s) in self._violations.items()
            if duration_s >= limit.shortest_s
        )
        for group in _together(found, lambda row: row[1:3]):
            first_s, title, words, _, _ = group[0]
            labels = ", ".join(label for *_, label, _ in group)
            longest_s = max(duration_s for *_, duration_s in group)
            text = f"{title}, {labels}: {words} for the first time; {longest_s:.2f} s in total"
            yield TimelineEvent(first_s, "limit", text)


def events_of(run: RunData) -> list[TimelineEvent]:
    """Return all events of a whole run in order of time."""
    events = Events()
    events.add(run, panels_of(run))
    return events.all(run.span)


def _run_events(run: RunData) -> Iterator[TimelineEvent]:
    for event in run.log.messages(topics.RUN_EVENT):
        yield TimelineEvent(run.at(event.t_ns), *_told(event))
    last_s = -math.inf
    for stop in run.log.messages(topics.ESTOP):
        t = run.at(stop.t_ns)
        if t - last_s > 1.0:  # a stop is published repeatedly
            yield TimelineEvent(t, "estop", f"emergency stop by {stop.source}", "e-stop")
        last_s = t
    for request in run.log.messages(topics.HARNESS_TARE):
        yield TimelineEvent(run.at(request.t_ns), "note", f"tare requested by {request.source}")
    fallen = next((row for row in run.log.messages(topics.SIM_TRUTH) if row.fallen), None)
    if fallen is not None:
        yield TimelineEvent(run.at(fallen.t_ns), "fall", "the robot fell", "fell")


_RUN_EVENTS: Final[Mapping[int, tuple[str, str, str]]] = {
    RunEventKind.STARTED: ("note", "{0} starts", ""),
    RunEventKind.FINISHED: ("note", "{0} ends {1}", ""),
    RunEventKind.KILLED: ("kill", "{0} receives SIG{1}", "{0} {1}"),
    RunEventKind.RESTARTED: ("restart", "{0} restarts", "{0} back"),
    RunEventKind.PUSHED: ("push", "push {1}", "push {2}"),
    RunEventKind.FAULTED: ("fault", "{0}: fault {1} begins", "{0} {1}"),
    RunEventKind.STALLED: ("stall", "{0} stalled for {1}", "stall"),
}
"""Kind, text and mark of a run's event: {0} subject, {1} detail, {2} the force of a push."""


def _told(event: RunEvent) -> tuple[str, str, str]:
    for stall in stalls_of([event]):
        return "stall", stall.words, "stall"
    unknown = ("note", f"{{0}} {name_of(RunEventKind, event.kind)} {{1}}", "")
    kind, *texts = _RUN_EVENTS.get(event.kind, unknown)
    words = event.subject, event.detail, event.detail.partition(" for ")[0]
    text, mark = (one.format(*words).strip() for one in texts)
    return kind, text, mark


def _network(run: RunData) -> Iterator[TimelineEvent]:
    """Yield the start and the end of each impairment, with all its directions together."""
    for row in impairments(run.log.messages(topics.LINK_EVENT)):
        begin_s, end_s = row.begin_s(run.zero_ns), row.end_s(run.zero_ns)
        yield TimelineEvent(begin_s, "network", f"network, {row.title}", row.title)
        if end_s is None:
            continue
        text = f"network, {row.title} ends; {row.counts()}"
        mark = f"{row.link} ends" if end_s < run.span.end - END_S else ""
        yield TimelineEvent(end_s, "network" if mark else "note", text, mark)


def _mode_changes(run: RunData) -> Iterator[TimelineEvent]:
    changes: list[tuple[float, str, JointEvent]] = sorted(
        (run.at(event.t_ns), module, event)
        for module in MODULES
        for event in run.log.messages(topics.JOINT_EVENT, module)
    )
    for group in _together(
        changes, lambda row: (row[2].mode_before, row[2].mode_after, row[2].cause)
    ):
        t, _, first = group[0]
        steps = [
            abs(b - a)
            for _, _, event in group
            for a, b in zip(event.tau_before, event.tau_after, strict=True)
        ]
        text = (
            f"{_modules(module for _, module, _ in group)}: {name_of(Mode, first.mode_before)} to "
            f"{name_of(Mode, first.mode_after)}, {name_of(Cause, first.cause)}"
        )
        within_ms = (group[-1][0] - t) * 1e3
        if len(group) > 1 and within_ms > 0.0:
            text += f", within {within_ms:.1f} ms"
        ages = [event.age_ns for _, _, event in group if event.age_ns >= 0]
        if ages:
            text += f"; command {max(ages) / NS_PER_MS:.1f} ms old"
        bad = first.mode_after in (Mode.FAULT, Mode.DAMP)
        yield TimelineEvent(
            t, "bad" if bad else "note", f"{text}; torque step {max(steps):.2f} N m"
        )


def _modules(found: Iterable[str]) -> str:
    names = set(found)
    modules = [module for module in MODULES if module in names]
    return "all six" if len(modules) == len(MODULES) else ", ".join(modules)


class _Watched(NamedTuple):
    """A state in a topic whose changes are events."""

    topic: Topic
    who: str
    """Subject of the sentence, with {} for the modules."""
    words: Callable[[Any], str]
    """The state of a message in words."""
    is_bad: Callable[[Any, Any], bool]
    """True if a change is an alarm, from the messages before and after it."""


def _drive(row: JointState) -> str:
    error = f", error bits {row.drive_error:#x}" if row.drive_error else ""
    return name_of(DriveStatus, row.drive) + error


def _drive_is_worse(before: JointState, after: JointState) -> bool:
    is_lost = before.drive == DriveStatus.ARMED != after.drive
    return is_lost or after.drive == DriveStatus.ERROR or after.drive_error != 0


def _planner(row: PlannerStatus) -> str:
    trip = f", {name_of(Trip, row.trip)}" if row.mode == PlannerMode.TRIPPED else ""
    waits = " (waits after dropouts or trips)" if row.wait_s > 0.0 else ""
    return name_of(PlannerMode, row.mode) + trip + waits


def _harness(row: Wrench) -> str:
    state = "valid" if row.valid else "saturated" if row.saturated else "not valid"
    return state + ("" if row.tare == Tare.DONE else f", tare {name_of(Tare, row.tare)}")


_WATCHED: Final = (
    _Watched(topics.JOINT_STATE, "drive of {}", _drive, _drive_is_worse),
    _Watched(topics.PLANNER_STATUS, "planner", _planner,
             lambda before, after: before.mode != after.mode not in _NORMAL_MODES),
    _Watched(topics.PLANNER_STATUS, "heat", lambda row: name_of(HeatAction, row.heat),
             lambda _, after: after.heat != HeatAction.NONE),
    _Watched(topics.WRENCH, "harness sensor", _harness, lambda _, after: not after.valid),
)  # fmt: skip


def _merged(names: Sequence[str]) -> list[str]:
    """Merge the six names of one topic into one name."""
    left = list(dict.fromkeys(names))
    for topic in topics.TOPICS:
        six = [topic.name.replace("*", module) for module in MODULES]
        if topic.per_module and set(six) <= set(left):
            left = [topic.name, *(name for name in left if name not in six)]
    return left


Row = TypeVar("Row", bound=tuple[Any, ...])


def _together(rows: Iterable[Row], key: Callable[[Row], Any]) -> list[list[Row]]:
    """Group rows that have equal keys and nearly the same time, which is a row's first field."""
    groups: list[list[Row]] = []
    open_: dict[Any, list[Row]] = {}
    for row in rows:
        group = open_.get(key(row))
        if group is None or row[0] - group[0][0] > TOGETHER_S:
            group = open_[key(row)] = []
            groups.append(group)
        group.append(row)
    return groups
