"""Timing panels: ages, rates, late cycles, refused commands, the planner's tick."""

from __future__ import annotations

from typing import Final

import numpy as np

from shared.bus import topics
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.judge.reports.page_model import LevelLine, Line, PageModel
from tools.judge.reports.run_data import RunData, module_of
from tools.judge.reports.signals import Array, message_times

RATE_WINDOW_S: Final = 0.25
AGE_REACH: Final = 4.0
"""Upper end of an age axis, as a multiple of the largest usable age. In HOLD ages reach seconds,
which would flatten all others."""
NO_REAL_TIME: Final = "no real time in this log"
NO_PLANNER: Final = "no planner/status in this log"
LATE_NOTE: Final = (
    "Cycles more than two periods after the previous one, since all six drives were armed."
)
REFUSED_NOTE: Final = (
    "Commands too old, of another session, out of order or out of limits, since all six drives "
    "were armed."
)


def add_ages(run: RunData, model: PageModel) -> None:
    """Add the ages of commands and states, to be compared with the network impairments."""
    _add_command_ages(run, model)
    _add_state_ages(run, model)


def add_times(run: RunData, model: PageModel) -> None:
    """Add rates, late cycles, refused commands and the planner's tick."""
    _add_rates(run, model)
    _add_cycles(run, model)
    _add_tick(run, model)


def _add_command_ages(run: RunData, model: PageModel) -> None:
    lines = []
    for number, module in enumerate(MODULES):
        (age,) = run.columns(topics.JOINT_STATE, module, "age_ns")
        age[age < 0.0] = np.nan
        lines.append(Line(module, run.times(topics.JOINT_STATE, module), age / NS_PER_MS, number))
    limits, reach = [], None
    note = "Age of the command in use, by each joint service's own clock."
    if run.robot is not None:
        most_ms = run.robot.joint_service.max_command_age_ms
        limits, reach = [LevelLine(most_ms, "HOLD")], AGE_REACH * most_ms
        note += f" The axis ends at {reach:g} ms."
    model.plot(
        "Command age", "ms", lines, limits=limits, reach=reach, note=note,
        if_empty="no service ever used a command",
    )  # fmt: skip


def _add_state_ages(run: RunData, model: PageModel) -> None:
    """Add the ages of the planner's inputs when it used them."""
    (ages,) = run.columns(topics.PLANNER_STATUS, "", "state_age_ns")
    (sample,) = run.columns(topics.WRENCH, "", "age_ns")
    if not ages.any() and not (sample > 0.0).any():
        model.leave_out("Age of the planner's inputs", NO_REAL_TIME)
        return
    t = run.times(topics.PLANNER_STATUS)
    ages[ages < 0.0] = np.nan
    sample[sample < 0.0] = np.nan
    lines = [
        Line(f"state, {module}", t, ages[:, number] / NS_PER_MS, number)
        for number, module in enumerate(MODULES)
        if len(ages)
    ]
    wrench_t = run.times(topics.WRENCH)
    lines.append(Line("harness sensor sample", wrench_t, sample / NS_PER_MS, 6, hidden=True))
    limits, reach = [], None
    note = (
        "Time since each module's newest state arrived, by the planner's clock. The delay before "
        "the arrival is not included."
    )
    if run.robot is not None:
        most_ms = run.robot.planner.state_stale_ms
        limits, reach = [LevelLine(most_ms, "planner waits")], AGE_REACH * most_ms
        note += f" The axis ends at {reach:g} ms."
    model.plot(
        "Age of the planner's inputs", "ms", lines, limits=limits, reach=reach, note=note,
        if_empty=NO_PLANNER,
    )  # fmt: skip


def _add_rates(run: RunData, model: PageModel) -> None:
    lines = []
    for number, topic in enumerate(row for row in topics.TOPICS if row.rate_hz >= 10.0):
        t, rate = _rate(run, topic)
        name = topic.name.replace("/*/", "/") if topic.per_module else topic.name
        label = f"{name}, slowest module" if topic.per_module else name
        lines.append(Line(label, t, rate, number, hidden=topic is topics.JOINT_TRACE))
    model.plot(
        "Messages recorded", "Hz", lines,
        note=f"Mean over {RATE_WINDOW_S:g} s, by the recorder's clock.",
        if_empty="no messages",
    )  # fmt: skip


def _add_cycles(run: RunData, model: PageModel) -> None:
    """Add the rates of the control loops, their late cycles and the commands they refused."""
    armed_s = run.armed_s()
    rates: list[Line] = []
    late: list[Line] = []
    refused: list[Line] = []
    for number, module in enumerate(MODULES):
        t = run.times(topics.JOINT_STATE, module)
        if len(t) < 2:
            continue
        cycles, *counts = run.columns(topics.JOINT_STATE, module, "cycle", "late", "refused")
        rates.append(Line(module, *_cycle_rate(t, cycles), number))
        for lines, count in zip((late, refused), counts, strict=True):
            after = t >= armed_s
            lines.append(Line(module, t[after], _increase(count[after]), number, counts_up=True))
    model.plot(
        "Control cycles of each service", "Hz", rates,
        note=f"Mean over {RATE_WINDOW_S:g} s, by each service's clock.",
        if_empty="no joint/*/state in this log",
    )  # fmt: skip
    for title, lines, note, none in (
        ("Late control cycles", late, LATE_NOTE, "no cycle was late"),
        ("Refused commands", refused, REFUSED_NOTE, "no command was refused"),
    ):
        model.plot(title, "count", lines, note=note, if_empty=none, needs_count=True)


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


def _add_tick(run: RunData, model: PageModel) -> None:
    t = run.times(topics.PLANNER_STATUS)
    (tick,) = run.columns(topics.PLANNER_STATUS, "", "tick_us")
    if not tick.any():
        model.leave_out("Planner tick", NO_REAL_TIME)
        return
    model.plot(
        "Planner tick", "\u00b5s", [Line("tick", t, tick, 0)],
        note="Time from reading the inputs to publishing the last command.",
    )  # fmt: skip


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
