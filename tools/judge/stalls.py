"""Stalls: times in which the machine, all joint services or the simulated world stood still.

A module that gets no command in time holds, as it should: a run is judged apart from what a stall
made of it. Whoever leads a run finds stalls and puts them into its record; all others read them
there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared.bus import topics
from shared.bus.messages import Cause, JointEvent, Mode, PlannerStatus, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from shared.mcap_log.sequence_stats import KeyCount
from tools.fleet.stall_watch import GAP_NS
from tools.logs.run_log import RunLog

MACHINE: Final = "the machine"
SERVICES: Final = "all joint services"
SIMULATOR: Final = "the simulator"
ALL: Final = "all services"
"""Joint services and simulator."""
WORLD_STOPS: Final = (MACHINE, ALL, SIMULATOR)
"""While these stand still the simulated world does."""
PERIOD_NS: Final = round(NS_PER_S / topics.JOINT_STATE.rate_hz)
LASTED_MAX_MS: Final = 1e9
DROP_OUT_NS: Final = 150 * NS_PER_MS
"""A module that loses TRACK so soon after a stall does so for it: commands grow too old."""
EXCUSE_MIN_MS: Final = 30.0
"""A shorter stall makes no command 50 ms old: most are some 10 ms old when they are used."""
EXCUSED_MAX_NS: Final = 5 * NS_PER_S
"""Modules that do not track again so long after a stall hold for a reason of their own."""
CATCH_UP_NS: Final = NS_PER_S
"""So long after the modules track again the robot catches up with the hand."""
STALL_SHOWN_NS: Final = 2 * NS_PER_S
"""So long a display tells of a stall."""
TOGETHER_NS: Final = 100 * NS_PER_MS
"""Drop-outs of several modules within this time share a line."""
ARRIVE_NS: Final = 250 * NS_PER_MS
"""So long after a stall messages pile up, and may be lost."""


class Stall(NamedTuple):
    """Time in which something stood still, monotonic as of messages."""

    begin_ns: int
    end_ns: int
    who: str
    """`MACHINE`, some of its cores, `ALL`, `SERVICES` or `SIMULATOR`."""
    stolen_ms: float = 0.0
    """So much of it was taken by the host of a virtual machine."""

    @property
    def lasted_ms(self) -> float:
        """How long it was."""
        return (self.end_ns - self.begin_ns) / NS_PER_MS

    @property
    def words(self) -> str:
        """For example `the machine stood still for 63 ms`."""
        taken = f", {self.stolen_ms:.0f} ms taken by its host" if self.stolen_ms else ""
        return f"{self.who} stood still for {self.lasted_ms:.0f} ms{taken}"

    def event(self, seq: int, scenario_zero_ns: int) -> RunEvent:
        """Return the event that `stalls_of` reads."""
        return RunEvent(
            t_ns=self.end_ns,
            seq=seq,
            kind=int(RunEventKind.STALLED),
            subject=self.who,
            detail=f"{self.lasted_ms:.1f} ms, stolen {self.stolen_ms:.0f} ms",
            scenario_s=(self.begin_ns - scenario_zero_ns) / NS_PER_S,
        )


def stalls_of(events: Iterable[RunEvent]) -> list[Stall]:
    """Return the stalls among a run's events; those of another form are left out."""
    found = []
    for event in events:
        words = event.detail.split()
        if event.kind != RunEventKind.STALLED or len(words) < 5:
            continue
        try:
            lasted_ms, stolen_ms = float(words[0]), float(words[3])
        except ValueError:  # written by hand
            continue
        if 0.0 < lasted_ms < LASTED_MAX_MS and 0.0 <= stolen_ms < LASTED_MAX_MS:
            begin_ns = event.t_ns - round(lasted_ms * NS_PER_MS)
            found.append(Stall(begin_ns, event.t_ns, event.subject, stolen_ms))
    return sorted(found)


class Disturbance(NamedTuple):
    """What a stall made of a run, for as long as it is judged apart."""

    stall: Stall
    begin_ns: int
    end_ns: int
    held_until_ns: int | None
    """When all modules tracked again; None: none held, or they did not track again."""
    held: int
    """Number of modules that went to HOLD."""


def disturbances(log: RunLog, begin_ns: int, end_ns: int) -> list[Disturbance]:
    """Return what each stall made of a part of a run, also of one that came before the part.

    A drop-out is a stall's doing only if commands grew too old right after it, it was long enough,
    and not the joint services alone stood still: what makes all six wait may be our own fault.
    After a kill or a fault none is: it may be that one's. What a stall made ends at `end_ns`.
    """
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    stalls = [row for row in stalls_of(events) if row.begin_ns <= end_ns]
    if not stalls:
        return []
    own = (RunEventKind.KILLED, RunEventKind.FAULTED)
    limit_ns = min([row.t_ns for row in events if row.kind in own] + [end_ns])
    transitions = [log.messages(topics.JOINT_EVENT, name) for name in MODULES]
    found = []
    for stall in stalls:
        backs_ns = [] if stall.who == SERVICES else _backs_ns(transitions, stall, limit_ns)
        last_ns, held_until_ns = stall.end_ns + PERIOD_NS, None
        if backs_ns:
            most_ns = min(stall.end_ns + EXCUSED_MAX_NS, limit_ns)
            held_until_ns = int(max(backs_ns)) if max(backs_ns) <= most_ns else None
            last_ns = min(most_ns, (held_until_ns or most_ns) + CATCH_UP_NS)
        if last_ns >= begin_ns:
            last_ns = min(last_ns, end_ns)
            found.append(Disturbance(stall, stall.begin_ns, last_ns, held_until_ns, len(backs_ns)))
    return found


def _backs_ns(
    transitions: Sequence[Sequence[JointEvent]], stall: Stall, limit_ns: int
) -> list[float]:
    """Return when each module that a stall made hold tracked again; infinite if it never did."""
    found: dict[int, float] = {}
    stale = False
    for module, rows in enumerate(transitions):
        for row in rows:
            if module in found and found[module] == math.inf and row.mode_after == Mode.TRACK:
                found[module] = row.t_ns
            if _is_excused(row, stall) and row.t_ns < limit_ns:
                found.setdefault(module, math.inf)
                stale |= row.cause == Cause.COMMAND_STALE
    enough = stale and stall.lasted_ms >= EXCUSE_MIN_MS
    return list(found.values()) if enough else []


def goes_to_hold(row: JointEvent) -> bool:
    """Return True for a module that drops out: it tracked, and holds."""
    return row.mode_before == Mode.TRACK and row.mode_after == Mode.HOLD


def _is_excused(row: JointEvent, stall: Stall) -> bool:
    in_time = stall.begin_ns <= row.t_ns <= stall.end_ns + DROP_OUT_NS
    return in_time and goes_to_hold(row) and row.cause in (Cause.COMMAND_STALE, Cause.HOLD_ALL)


def inside(rows: Iterable[Disturbance], times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each time whether it is judged apart."""
    mask = np.zeros(len(times_ns), dtype=bool)
    for row in rows:
        mask |= (times_ns >= row.begin_ns) & (times_ns <= row.end_ns)
    return mask


def as_dicts(
    log: RunLog, rows: Sequence[Disturbance], truth: Sequence[SimTruth], zero_ns: int
) -> list[dict[str, Any]]:
    """Return disturbances as plain values, with what the robot did meanwhile."""
    times_ns = np.array([row.t_ns for row in truth])
    rows = [row for row in rows if row.begin_ns >= times_ns[0]]
    lost = _lost(log, rows)
    found = []
    for row, missing in zip(rows, lost, strict=True):
        first, last = np.searchsorted(times_ns, (row.begin_ns, row.end_ns + 1))
        meanwhile = truth[first:last]
        values: dict[str, Any] = {
            "at_s": (row.begin_ns - zero_ns) / NS_PER_S,
            "who": row.stall.who,
            "lasted_ms": row.stall.lasted_ms,
            "stolen_ms": row.stall.stolen_ms,
            "modules_held": row.held,
            "held_until_s": row.held_until_ns and (row.held_until_ns - zero_ns) / NS_PER_S,
            "apart_until_s": (row.end_ns - zero_ns) / NS_PER_S,
            "operator_peak_n": max((abs(one.operator_force[2]) for one in meanwhile), default=None),
            "com_x_max_mm": max((1e3 * abs(one.over[0]) for one in meanwhile), default=None),
            "messages_lost": missing,
        }
        found.append(values | {"said": _said(row.stall.words, values)})
    return found


def _said(words: str, values: dict[str, Any]) -> str:
    """Return for example `6.58 s: the machine stood still for 63 ms: all six held until 7.12 s`."""
    parts = [f"{values['at_s']:.2f} s: {words}"]
    if values["modules_held"]:
        who = "all six" if values["modules_held"] == len(MODULES) else values["modules_held"]
        until = values["held_until_s"]
        parts[0] += f": {who} held" + (f" until {until:.2f} s" if until is not None else "")
        if until is None:
            parts.append("and did not track again soon")
        if values["operator_peak_n"] is not None:
            parts.append(f"hand force up to {values['operator_peak_n']:.1f} N meanwhile")
            parts.append(f"COM x up to {values['com_x_max_mm']:.1f} mm")
    if values["messages_lost"]:
        parts.append(f"messages lost: {values['messages_lost']}")
    return ", ".join(parts)


def _lost(log: RunLog, rows: Sequence[Disturbance]) -> list[int]:
    """Return how many messages were lost on the way to the log in each disturbance."""
    found = [0] * len(rows)
    for key in log.keys() if rows else ():
        count = KeyCount(several=topics.several_may_write(key))
        before_ns = missing = 0
        for at_ns, _, seq in log.raw(key):
            count.feed(seq)
            if count.missing > missing:
                for place, row in enumerate(rows):
                    if before_ns <= row.stall.end_ns + ARRIVE_NS and at_ns >= row.begin_ns:
                        found[place] += count.missing - missing
                        break
            before_ns, missing = at_ns, count.missing
    return found


def drop_outs(
    log: RunLog, rows: Sequence[Disturbance], zero_ns: int, begin_ns: int, end_ns: int
) -> list[str]:
    """Return a line for each time that modules held for old commands without a stall."""
    excused = [row.stall for row in rows if row.held]
    found = sorted(
        (event.t_ns, module)
        for module in MODULES
        for event in log.messages(topics.JOINT_EVENT, module)
        if goes_to_hold(event)
        and event.cause in (Cause.COMMAND_STALE, Cause.PLANNER_ENDED, Cause.HOLD_ALL)
        and begin_ns <= event.t_ns < end_ns
        and not any(_is_excused(event, stall) for stall in excused)
    )
    groups = together(found, lambda _: None, TOGETHER_NS)
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS) if groups else []
    sent_ns = np.array([row.t_ns for row in statuses], np.int64)
    lines = []
    for group in groups:
        modules = [module for _, module in group]
        who = "all six" if len(set(modules)) == len(MODULES) else ", ".join(modules)
        known = _planners_silence(sent_ns, group[0][0]) or "no stall was measured then"
        at_s = (group[0][0] - zero_ns) / NS_PER_S
        lines.append(f"{at_s:.2f} s: {who} held without a stall; {known}")
    return lines


Row = TypeVar("Row", bound=tuple[Any, ...])


def together(rows: Iterable[Row], key: Callable[[Row], Any], within: float) -> list[list[Row]]:
    """Group rows with equal keys at about the same time, which is the first field of a row."""
    groups: list[list[Row]] = []
    open_: dict[Any, list[Row]] = {}
    for row in rows:
        group = open_.get(key(row))
        if group is None or row[0] - group[0][0] > within:
            group = open_[key(row)] = []
            groups.append(group)
        group.append(row)
    return groups


def _planners_silence(sent_ns: NDArray[np.int64], at_ns: int) -> str:
    """Return how long the planner sent nothing around a time; empty if it sent as it should."""
    place = int(np.searchsorted(sent_ns, at_ns))
    if place == len(sent_ns):
        return "the planner sent nothing any more"
    near = sent_ns[(sent_ns >= at_ns - DROP_OUT_NS) & (sent_ns <= at_ns)]
    before = sent_ns[max(place - 1 - len(near), 0) : place + 1]
    longest_ns = int(np.diff(before).max(initial=0))
    if longest_ns <= PERIOD_NS + GAP_NS:
        return ""
    return f"the planner sent nothing for {longest_ns / NS_PER_MS:.0f} ms"
