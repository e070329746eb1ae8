"""What happened in a run, from all that its log says, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, TypeVar

import numpy as np

from shared import topics
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from shared.messages import (
    Cause,
    DriveStatus,
    JointEvent,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    SimTruth,
    Tare,
    Wrench,
)
from tools.reports.limit_violations import limit_violations
from tools.reports.page_model import TimelineEvent
from tools.reports.run_data import RunData
from tools.reports.signals import GAP_S, seconds
from tools.runs.impairment_intervals import impairments

TOGETHER_S: Final = 0.1
"""The same change of several modules within this time is told in one line."""
LINES_MAX: Final = 500
WAIT_S: Final = 0.5
"""A planner that waits for so long after drop-outs says it in the timeline."""
END_S: Final = 0.1
"""What ends so close to the end of the log has no mark: the run ends with it."""

Row = TypeVar("Row", bound=tuple[Any, ...])

KINDS: Final = {
    RunEventKind.KILLED: "kill",
    RunEventKind.RESTARTED: "restart",
    RunEventKind.PUSHED: "push",
    RunEventKind.FAULTED: "fault",
    RunEventKind.STARTED: "note",
    RunEventKind.FINISHED: "note",
}
_USUAL: Final = (PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.LEADING)


def timeline_events(run: RunData) -> list[TimelineEvent]:
    """Return what happened, in the order of time."""
    found = [
        *_from_outside(run),
        *_changes_of_mode(run),
        *_drives(run),
        *_planner(run),
        *_harness(run),
        *_world(run),
        *_silences(run),
        *limit_violations(run),
        *_network(run),
    ]
    found.sort(key=lambda row: row.t)
    if len(found) > LINES_MAX:
        left = len(found) - LINES_MAX
        found = sorted([row for row in found if row.mark] + _spread(found), key=lambda row: row.t)
        found.append(TimelineEvent(run.span.end, "note", f"about {left} more lines are left out"))
    return found


def _spread(found: Sequence[TimelineEvent]) -> list[TimelineEvent]:
    """Return what marks nothing, but not more of it than a page can hold."""
    quiet = [row for row in found if not row.mark]
    return quiet[: max(0, LINES_MAX - (len(found) - len(quiet)))]


def _at(run: RunData, t_ns: int) -> float:
    return (t_ns - run.zero_ns) / NS_PER_S


def _from_outside(run: RunData) -> Iterator[TimelineEvent]:
    events: list[RunEvent] = run.log.messages(topics.RUN_EVENT)
    for event in events:
        kind = KINDS.get(_known(RunEventKind, event.kind), "note")
        text = _said(event)
        mark = ""
        if kind != "note":
            mark = f"{event.subject} {event.detail}".strip() if kind != "restart" else ""
            mark = mark or f"{event.subject} back"
        if kind == "push":
            mark = f"push {event.detail.partition(' for ')[0]}"
        yield TimelineEvent(_at(run, event.t_ns), kind, text, mark)
    last = None
    for stop in run.log.messages(topics.ESTOP):
        t = _at(run, stop.t_ns)
        if last is None or t - last > 1.0:  # it is said again and again
            yield TimelineEvent(t, "estop", f"emergency stop by {stop.source}", "e-stop")
        last = t
    for request in run.log.messages(topics.HARNESS_TARE):
        yield TimelineEvent(_at(run, request.t_ns), "note", f"tare asked for by {request.source}")


def _network(run: RunData) -> Iterator[TimelineEvent]:
    """Tell when each impairment begins and ends; all its directions at once."""
    for row in impairments(run.log.messages(topics.LINK_EVENT)):
        begin_s, end_s = row.begin_s(run.zero_ns), row.end_s(run.zero_ns)
        yield TimelineEvent(begin_s, "network", f"network, {row.title}", row.title)
        if end_s is None:
            continue
        text = f"network, {row.title} ends; {row.counts()}"
        mark = f"{row.link} ends" if end_s < run.span.end - END_S else ""
        yield TimelineEvent(end_s, "network" if mark else "note", text, mark)


def _said(event: RunEvent) -> str:
    words = {
        RunEventKind.STARTED: f"{event.subject} starts",
        RunEventKind.KILLED: f"{event.subject} gets SIG{event.detail}",
        RunEventKind.RESTARTED: f"{event.subject} is started again",
        RunEventKind.PUSHED: f"push {event.detail}",
        RunEventKind.FINISHED: f"{event.subject} ends {event.detail}".strip(),
        RunEventKind.FAULTED: f"{event.subject}: fault {event.detail} begins",
    }
    other = f"{event.subject} {_word(RunEventKind, event.kind)} {event.detail}"
    return words.get(_known(RunEventKind, event.kind), other.strip())


def _changes_of_mode(run: RunData) -> Iterator[TimelineEvent]:
    changes: list[tuple[float, str, JointEvent]] = sorted(
        (_at(run, event.t_ns), module, event)
        for module in MODULES
        for event in run.log.messages(topics.JOINT_EVENT, module)
    )
    for alike in _together(
        changes, lambda row: (row[2].mode_before, row[2].mode_after, row[2].cause)
    ):
        t, _, first = alike[0]
        yield TimelineEvent(t, _severity(first), _describe_change(alike))


def _together(changes: Sequence[Row], what: Callable[[Row], Any]) -> list[list[Row]]:
    """Return rows, which begin with their time, in groups: the same, at about the same time."""
    groups: list[list[Row]] = []
    open_: dict[Any, list[Row]] = {}
    for row in changes:
        group = open_.get(what(row))
        if group is None or row[0] - group[0][0] > TOGETHER_S:
            group = open_[what(row)] = []
            groups.append(group)
        group.append(row)
    return groups


def _who(found: Iterable[str]) -> str:
    modules = sorted(set(found), key=MODULES.index)
    return "all six" if len(modules) == len(MODULES) else ", ".join(modules)


def _severity(event: JointEvent) -> str:
    return "bad" if event.mode_after in (Mode.FAULT, Mode.DAMP) else "note"


def _describe_change(alike: Sequence[tuple[float, str, JointEvent]]) -> str:
    first = alike[0][2]
    who = _who(module for _, module, _ in alike)
    step = max(
        abs(b - a)
        for _, _, event in alike
        for a, b in zip(event.tau_before, event.tau_after, strict=True)
    )
    within_ms = (alike[-1][0] - alike[0][0]) * 1e3
    text = (
        f"{who}: {_word(Mode, first.mode_before)} to {_word(Mode, first.mode_after)}, "
        f"{_word(Cause, first.cause)}"
    )
    if len(alike) > 1 and within_ms > 0.0:
        text += f", within {within_ms:.1f} ms"
    ages = [event.age_ns for _, _, event in alike if event.age_ns >= 0]
    if ages:
        text += f"; command {max(ages) / NS_PER_MS:.1f} ms old"
    return f"{text}; torque step {step:.2f} N m"


def _drives(run: RunData) -> Iterator[TimelineEvent]:
    changes: list[tuple[float, str, JointState, JointState]] = []
    for module in MODULES:
        states: list[JointState] = run.log.messages(topics.JOINT_STATE, module)
        t = run.times(topics.JOINT_STATE, module)
        changes += [
            (float(t[index]), module, states[index - 1], states[index])
            for index in _changes([(state.drive, state.drive_error) for state in states])
        ]
    changes.sort(key=lambda row: row[0])
    for alike in _together(changes, _what_of_drive):
        t_s, _, before, after = alike[0]
        worse = after.drive != DriveStatus.ARMED and before.drive == DriveStatus.ARMED
        bad = worse or after.drive == DriveStatus.ERROR or after.drive_error != 0
        who = _who(module for _, module, _, _ in alike)
        yield TimelineEvent(t_s, "bad" if bad else "note", f"{who}: {_what_of_drive(alike[0])}")


def _what_of_drive(row: tuple[float, str, JointState, JointState]) -> str:
    _, _, before, after = row
    parts = []
    if before.drive != after.drive:
        parts.append(
            f"drive {_word(DriveStatus, before.drive)} to {_word(DriveStatus, after.drive)}"
        )
    if before.drive_error != after.drive_error:
        parts.append(f"error bits {after.drive_error:#x}")
    return ", ".join(parts)


def _planner(run: RunData) -> Iterator[TimelineEvent]:
    rows: list[PlannerStatus] = run.log.messages(topics.PLANNER_STATUS)
    t = run.times(topics.PLANNER_STATUS)
    for index in _changes([(row.mode, row.session) for row in rows]):
        before, after = rows[index - 1], rows[index]
        fresh = " in a new session" if before.session != after.session else ""
        text = f"planner: {_word(PlannerMode, before.mode)} to {_word(PlannerMode, after.mode)}"
        bad = after.mode not in _USUAL
        yield TimelineEvent(float(t[index]), "bad" if bad else "note", text + fresh)
    for index in _changes([row.wait_s > 0.0 for row in rows]):
        if rows[index].wait_s >= WAIT_S:
            text = f"planner: leads again in {rows[index].wait_s:.1f} s at the earliest, for links"
            yield TimelineEvent(float(t[index]), "note", f"{text} have dropped out")


def _harness(run: RunData) -> Iterator[TimelineEvent]:
    rows: list[Wrench] = run.log.messages(topics.WRENCH)
    t = run.times(topics.WRENCH)
    for index in _changes([(row.valid, row.saturated, row.tare) for row in rows]):
        row = rows[index]
        word = "valid" if row.valid else "saturated" if row.saturated else "not valid"
        tare = "" if row.tare == Tare.DONE else f", tare {_word(Tare, row.tare)}"
        kind = "note" if row.valid else "bad"
        yield TimelineEvent(float(t[index]), kind, f"harness sensor {word}{tare}")


def _world(run: RunData) -> Iterator[TimelineEvent]:
    rows: list[SimTruth] = run.log.messages(topics.SIM_TRUTH)
    for row in rows:
        if row.fallen:
            yield TimelineEvent(_at(run, row.t_ns), "fall", "the robot fell", "fell")
            return


def _silences(run: RunData) -> Iterator[TimelineEvent]:
    """Tell where topics with a rate said nothing for long, as the recorder heard them."""
    found: list[tuple[float, str, float]] = []
    for key, topic in topics.all_keys(run.log.robot).items():
        if topic.rate_hz < 10.0 or topic is topics.JOINT_TRACE:
            continue
        t = seconds([row[0] for row in run.log.raw(key)], run.zero_ns)
        steps = np.diff(t)
        name = key.removeprefix(f"xrl/{run.log.robot}/")
        found += [
            (float(t[index]), name, float(steps[index]))
            for index in np.flatnonzero(steps > max(GAP_S, 5.0 / topic.rate_hz))
        ]
    for alike in _together(sorted(found), lambda _: None):
        names = _folded([name for _, name, _ in alike])
        longest = max(length for *_, length in alike)
        word = "silent for up to" if len(alike) > 1 else "silent for"
        yield TimelineEvent(alike[0][0], "note", f"{', '.join(names)} {word} {longest:.2f} s")


def _folded(names: Sequence[str]) -> list[str]:
    """Return names; those of all six modules as one."""
    left = list(dict.fromkeys(names))
    for topic in topics.TOPICS:
        six = [topic.name.replace("*", module) for module in MODULES]
        if topic.per_module and set(six) <= set(left):
            left = [topic.name, *(name for name in left if name not in six)]
    return left


def _changes(values: Sequence[Any]) -> list[int]:
    return [index for index in range(1, len(values)) if values[index] != values[index - 1]]


def _word(enumeration: Any, code: int) -> str:
    found = _known(enumeration, code)
    return str(found.name) if found is not None else f"unknown ({code})"


def _known(enumeration: Any, code: int) -> Any:
    return next((member for member in enumeration if member == code), None)
