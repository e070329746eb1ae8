"""Timing panels: ages, rates, late cycles, refused commands, the planner's tick."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from shared.arrays import Array
from shared.bus import topics
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.judge.reports.page_model import LevelLine, Line, Panel, Plot
from tools.judge.reports.panels import NO_PLANNER, NO_STATES
from tools.judge.reports.run_data import RunData, module_of
from tools.judge.reports.signals import message_times

RATE_WINDOW_S: Final = 0.25
AGE_REACH: Final = 4.0
"""Upper end of an age axis, as a multiple of the largest usable age. In HOLD ages reach seconds,
which would flatten all others."""
NO_REAL_TIME: Final = "no real time in this log"
LATE_NOTE: Final = (
    "Cycles more than two periods after the previous one, since all six drives were armed."
)
REFUSED_NOTE: Final = (
    "Commands too old, of another session, out of order or out of limits, since all six drives "
    "were armed."
)


def ages(run: RunData) -> Iterator[Panel]:
    """Yield the ages of commands and states, to be compared with the network impairments."""
    lines = []
    for number, module in enumerate(MODULES):
        (age,) = run.columns(topics.JOINT_STATE, module, "age_ns")
        lines.append(_age(module, run.times(topics.JOINT_STATE, module), age, number))
    note = "Age of the command in use, by each joint service's own clock."
    most_ms = run.robot.joint_service.max_command_age_ms if run.robot is not None else None
    yield _age_plot("Command age", note, "no service ever used a command", lines, most_ms, "HOLD")

    (state,) = run.columns(topics.PLANNER_STATUS, "", "state_age_ns")
    (sample,) = run.columns(topics.WRENCH, "", "age_ns")
    real = state.any() or (sample > 0.0).any()
    lines = []
    if real:
        t = run.times(topics.PLANNER_STATUS)
        lines = [
            _age(f"state, {module}", t, state[:, number], number)
            for number, module in enumerate(MODULES)
            if len(state)
        ]
        sampled = _age("harness sensor sample", run.times(topics.WRENCH), sample, 6)
        lines.append(sampled._replace(hidden=True))
    note = (
        "Time since each module's newest state arrived, by the planner's clock. The delay before "
        "the arrival is not included."
    )
    most_ms = run.robot.planner.state_stale_ms if run.robot is not None else None
    why = NO_PLANNER if real else NO_REAL_TIME
    yield _age_plot("Age of the planner's inputs", note, why, lines, most_ms, "planner waits")


def _age(label: str, t: Array, age_ns: Array, colour: int) -> Line:
    """Return the line of an age; a negative one stands for none."""
    return Line(label, t, np.where(age_ns < 0.0, np.nan, age_ns) / NS_PER_MS, colour)


def _age_plot(
    title: str, note: str, if_empty: str, lines: list[Line], most_ms: float | None, then: str
) -> Panel:
    """Return a panel of ages; beyond `most_ms` something happens."""
    if most_ms is None:
        return Plot(title, "ms", note, if_empty, lines=lines)
    reach = AGE_REACH * most_ms
    note += f" The axis ends at {reach:g} ms."
    limits = [LevelLine(most_ms, then)]
    return Plot(title, "ms", note, if_empty, lines=lines, limits=limits, reach=reach)


def times(run: RunData) -> Iterator[Panel]:
    """Yield rates, late cycles, refused commands and the planner's tick."""
    lines = []
    for number, topic in enumerate(row for row in topics.TOPICS if row.rate_hz >= 10.0):
        name = topic.name.replace("/*/", "/") + ", slowest module" * topic.per_module
        hidden = topic is topics.JOINT_TRACE
        lines.append(Line(name, *_rate(run, topic), number, hidden=hidden))
    note = f"Mean over {RATE_WINDOW_S:g} s, by the recorder's clock."
    yield Plot("Messages recorded", "Hz", note, "no messages", lines=lines)
    yield from _cycles(run)
    (tick,) = run.columns(topics.PLANNER_STATUS, "", "tick_us")
    note = "Time from reading the inputs to publishing the last command."
    lines = [Line("tick", run.times(topics.PLANNER_STATUS), tick, 0)] if tick.any() else []
    yield Plot("Planner tick", "\u00b5s", note, NO_REAL_TIME, lines=lines)


def _cycles(run: RunData) -> Iterator[Panel]:
    """Yield the rates of the control loops, their late cycles and the commands they refused."""
    armed_s = run.armed_s()
    rates: list[Line] = []
    counted: dict[str, list[Line]] = {"late": [], "refused": []}
    for number, module in enumerate(MODULES):
        t = run.times(topics.JOINT_STATE, module)
        if len(t) < 2:
            continue
        cycles, *counts = run.columns(topics.JOINT_STATE, module, "cycle", *counted)
        rates.append(Line(module, *_cycle_rate(t, cycles), number))
        for lines, count in zip(counted.values(), counts, strict=True):
            after = t >= armed_s
            lines.append(Line(module, t[after], _increase(count[after]), number, counts_up=True))
    note = f"Mean over {RATE_WINDOW_S:g} s, by each service's clock."
    yield Plot("Control cycles of each service", "Hz", note, NO_STATES, lines=rates)
    for name, title, note, none in (
        ("late", "Late control cycles", LATE_NOTE, "no cycle was late"),
        ("refused", "Refused commands", REFUSED_NOTE, "no command was refused"),
    ):
        yield Plot(title, "count", note, none, lines=counted[name], needs_count=True)


def _cycle_rate(t: Array, cycles: Array) -> tuple[Array, Array]:
    """Return cycles per second over windows; a restarted service counts from 0."""
    edges = np.arange(t[0], t[-1], RATE_WINDOW_S)
    places = np.unique(np.minimum(np.searchsorted(t, edges), len(t) - 1))
    t, cycles = t[places], cycles[places]
    steps = np.diff(t)
    rate = np.where(np.diff(cycles) >= 0.0, np.diff(cycles) / np.maximum(steps, 1e-9), np.nan)
    return t[:-1] + steps / 2, rate


def _increase(count: Array) -> Array:
    """Return the growth of a counter since its first value; a restart resets the counter to 0."""
    steps = np.diff(count, prepend=count[:1])
    return np.asarray(np.cumsum(np.where(steps >= 0.0, steps, count)))


def _rate(run: RunData, topic: Topic) -> tuple[Array, Array]:
    """Return messages per second over windows, of the slowest recorded module."""
    begin, end = run.span
    edges = np.arange(begin, end, RATE_WINDOW_S)
    if len(edges) < 2:
        return np.zeros(0), np.zeros(0)
    counts = []
    for key in topics.keys(topic, run.log.robot):
        received = run.log.received_ns(topic, module_of(topic, key))
        if received:
            t = message_times(received, run.zero_ns)
            counts.append(np.histogram(t, edges)[0])
    if not counts:
        return np.zeros(0), np.zeros(0)
    rate = np.min(counts, axis=0) / RATE_WINDOW_S
    return edges[:-1] + RATE_WINDOW_S / 2, rate.astype(np.float64)
