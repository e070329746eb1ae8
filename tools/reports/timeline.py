"""What happened in a run, from all that its log says, in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

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
from tools.reports.sheet import Happening
from tools.reports.signals import GAP_S, seconds
from tools.reports.source import Source

TOGETHER_S: Final = 0.1
"""The same change of several modules within this time is told in one line."""
LINES_MAX: Final = 500

KINDS: Final = {
    RunEventKind.KILLED: "kill",
    RunEventKind.RESTARTED: "restart",
    RunEventKind.PUSHED: "push",
    RunEventKind.FAULTED: "fault",
    RunEventKind.STARTED: "note",
    RunEventKind.FINISHED: "note",
}


def happenings(source: Source) -> list[Happening]:
    """Return what happened, in the order of time."""
    found = [
        *_from_outside(source),
        *_changes_of_mode(source),
        *_drives(source),
        *_planner(source),
        *_harness(source),
        *_world(source),
        *_silences(source),
    ]
    found.sort(key=lambda row: row.t)
    if len(found) > LINES_MAX:
        left = len(found) - LINES_MAX
        found = sorted([row for row in found if row.mark] + _spread(found), key=lambda row: row.t)
        found.append(Happening(source.span.end, "note", f"about {left} more lines are left out"))
    return found


def _spread(found: Sequence[Happening]) -> list[Happening]:
    """Return what marks nothing, but not more of it than a page can hold."""
    quiet = [row for row in found if not row.mark]
    return quiet[: max(0, LINES_MAX - (len(found) - len(quiet)))]


def _at(source: Source, t_ns: int) -> float:
    return (t_ns - source.zero_ns) / NS_PER_S


def _from_outside(source: Source) -> Iterator[Happening]:
    events: list[RunEvent] = source.log.messages(topics.RUN_EVENT)
    for event in events:
        kind = KINDS.get(_known(RunEventKind, event.kind), "note")
        text = " ".join((event.subject, _word(RunEventKind, event.kind), event.detail)).strip()
        mark = ""
        if kind != "note":
            mark = f"{event.subject} {event.detail}".strip() if kind != "restart" else ""
            mark = mark or f"{event.subject} back"
        if kind == "push":
            text, mark = f"push {event.detail}", f"push {event.detail.partition(' for ')[0]}"
        yield Happening(_at(source, event.t_ns), kind, text, mark)
    last = None
    for stop in source.log.messages(topics.ESTOP):
        t = _at(source, stop.t_ns)
        if last is None or t - last > 1.0:  # it is said again and again
            yield Happening(t, "estop", f"emergency stop by {stop.source}", "e-stop")
        last = t
    for request in source.log.messages(topics.HARNESS_TARE):
        yield Happening(_at(source, request.t_ns), "note", f"tare asked for by {request.source}")


def _changes_of_mode(source: Source) -> Iterator[Happening]:
    changes: list[tuple[int, str, JointEvent]] = sorted(
        (event.t_ns, module, event)
        for module in MODULES
        for event in source.log.messages(topics.JOINT_EVENT, module)
    )
    while changes:
        t_ns, _, first = changes[0]
        alike = [
            row
            for row in changes
            if row[0] - t_ns <= TOGETHER_S * NS_PER_S
            and (row[2].mode_before, row[2].mode_after, row[2].cause)
            == (first.mode_before, first.mode_after, first.cause)
        ]
        changes = [row for row in changes if row not in alike]
        yield Happening(_at(source, t_ns), _severity(first), _change_in_words(alike))


def _severity(event: JointEvent) -> str:
    return "bad" if event.mode_after in (Mode.FAULT, Mode.DAMP) else "note"


def _change_in_words(alike: Sequence[tuple[int, str, JointEvent]]) -> str:
    first = alike[0][2]
    modules = sorted({module for _, module, _ in alike}, key=MODULES.index)
    who = "all six" if len(modules) == len(MODULES) else ", ".join(modules)
    step = max(
        abs(b - a)
        for _, _, event in alike
        for a, b in zip(event.tau_before, event.tau_after, strict=True)
    )
    within_ms = (alike[-1][0] - alike[0][0]) / NS_PER_MS
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


def _drives(source: Source) -> Iterator[Happening]:
    for module in MODULES:
        states: list[JointState] = source.log.messages(topics.JOINT_STATE, module)
        t = source.times(topics.JOINT_STATE, module)
        for index in _changes([(state.drive, state.drive_error) for state in states]):
            before, after = states[index - 1], states[index]
            parts = []
            if before.drive != after.drive:
                parts.append(
                    f"drive {_word(DriveStatus, before.drive)} to {_word(DriveStatus, after.drive)}"
                )
            if before.drive_error != after.drive_error:
                parts.append(f"error bits {after.drive_error:#x}")
            kind = "note" if after.drive == DriveStatus.ARMED else "bad"
            yield Happening(float(t[index]), kind, f"{module}: {', '.join(parts)}")


def _planner(source: Source) -> Iterator[Happening]:
    rows: list[PlannerStatus] = source.log.messages(topics.PLANNER_STATUS)
    t = source.times(topics.PLANNER_STATUS)
    for index in _changes([(row.mode, row.session) for row in rows]):
        before, after = rows[index - 1], rows[index]
        fresh = " in a new session" if before.session != after.session else ""
        text = f"planner: {_word(PlannerMode, before.mode)} to {_word(PlannerMode, after.mode)}"
        bad = after.mode in (PlannerMode.OVERLOADED, PlannerMode.UNCERTIFIED)
        yield Happening(float(t[index]), "bad" if bad else "note", text + fresh)


def _harness(source: Source) -> Iterator[Happening]:
    rows: list[Wrench] = source.log.messages(topics.WRENCH)
    t = source.times(topics.WRENCH)
    for index in _changes([(row.valid, row.saturated, row.tare) for row in rows]):
        row = rows[index]
        word = "valid" if row.valid else "saturated" if row.saturated else "not valid"
        tare = "" if row.tare == Tare.DONE else f", tare {_word(Tare, row.tare)}"
        kind = "note" if row.valid else "bad"
        yield Happening(float(t[index]), kind, f"harness sensor {word}{tare}")


def _world(source: Source) -> Iterator[Happening]:
    rows: list[SimTruth] = source.log.messages(topics.SIM_TRUTH)
    for row in rows:
        if row.fallen:
            yield Happening(_at(source, row.t_ns), "kill", "the robot fell", "fell")
            return


def _silences(source: Source) -> Iterator[Happening]:
    """Tell where a topic with a rate said nothing for long, as the recorder heard it."""
    for key, topic in topics.all_keys(source.log.robot).items():
        if topic.rate_hz < 10.0 or topic is topics.JOINT_TRACE:
            continue
        name = key.removeprefix(f"xrl/{source.log.robot}/")
        if topic is topics.JOINT_COMMAND and not name.startswith(f"joint/{MODULES[0]}/"):
            continue  # the planner's six fall silent together
        t = seconds([row[0] for row in source.log.raw(key)], source.zero_ns)
        steps = np.diff(t)
        for index in np.flatnonzero(steps > max(GAP_S, 5.0 / topic.rate_hz)):
            yield Happening(float(t[index]), "note", f"{name} silent for {steps[index]:.2f} s")


def _changes(values: Sequence[Any]) -> list[int]:
    return [index for index in range(1, len(values)) if values[index] != values[index - 1]]


def _word(enumeration: Any, code: int) -> str:
    found = _known(enumeration, code)
    return str(found.name) if found is not None else f"unknown ({code})"


def _known(enumeration: Any, code: int) -> Any:
    return next((member for member in enumeration if member == code), None)
