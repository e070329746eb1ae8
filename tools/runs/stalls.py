"""Stalls: times in which the machine, all joint services or the simulated world stood still.

A module that gets no command in time holds, as it should: a run is judged apart from what a stall
made of it. Whoever leads a run finds stalls and puts them into its record; all others read them
there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.joint.loop import READ_TIMEOUT_S
from shared.bus import topics
from shared.bus.messages import (
    Cause,
    JointEvent,
    JointState,
    Mode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    SimTruth,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.mcap_log.sequence_stats import KeyCount
from shared.robot.joints import MODULES
from tools.fleet.stall_watch import ANY_CORE, GAP_NS, UNSURE, Gap
from tools.runs.run_log import RunLog

MACHINE: Final = "the machine"
SERVICES: Final = "all joint services"
SIMULATOR: Final = "the simulator"
ALL: Final = "all services"
"""Joint services and simulator."""
A_THREAD: Final = "a thread"
WORLD_STOPS: Final = (MACHINE, ALL, SIMULATOR)
"""While these stand still the simulated world does."""
CYCLE_MAX_NS: Final = round(READ_TIMEOUT_S * NS_PER_S)
"""Longest cycle of a joint service that runs: its drive is silent."""
TRUTH_NS: Final = round(NS_PER_S / topics.SIM_TRUTH.rate_hz)
PERIOD_NS: Final = round(NS_PER_S / topics.JOINT_STATE.rate_hz)
ALIVE_NS: Final = NS_PER_S
"""A module that was silent for longer before a stall has no part in it."""
MERGE_NS: Final = 50 * NS_PER_MS
"""Two ways of finding one stall report it within this time of each other."""
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


class Silence:
    """Finds when one sender stood still, from those of its messages that are seen.

    Each message has a count that grows while the sender runs; how much it grew between two messages
    tells for how long the sender ran in between.
    """

    def __init__(self, step_ns: int) -> None:
        """Take the longest time in which the count of a sender that runs grows by one."""
        self._step_ns = step_ns
        self.last_ns, self._count = -1, -1
        self._silent_in_a_row = 0

    @property
    def is_slow(self) -> bool:
        """True if one silence follows the other: it is its pace, and no stall."""
        return self._silent_in_a_row > 1

    def feed(self, t_ns: int, count: int) -> tuple[int, int] | None:
        """Return begin and end of the silence before a message, if it is a stall."""
        if t_ns == self.last_ns:  # a stamp that is repeated
            return None
        last_ns, steps = self.last_ns, count - self._count
        self.last_ns, self._count = t_ns, count
        silent_ns = t_ns - last_ns - (steps - 1) * self._step_ns
        if last_ns < 0 or steps < 0 or silent_ns <= self._step_ns + GAP_NS:
            self._silent_in_a_row = 0
            return None
        self._silent_in_a_row += 1
        return last_ns, last_ns + silent_ns


class CommonSilence:
    """Finds when every joint service that was alive stood still.

    By its cycles: its states repeat the stamp of the last sample while a drive is silent.
    """

    def __init__(self) -> None:
        self._of: dict[str, Silence] = {}
        self._silent: dict[str, tuple[int, int]] = {}

    def feed(self, module: str, state: JointState) -> Stall | None:
        """Take a state; return the stall that it is the last to tell of."""
        own = self._of.setdefault(module, Silence(CYCLE_MAX_NS))
        silent = own.feed(state.t_ns, state.cycle)
        if silent is None:
            return None
        self._silent[module] = silent
        alive = [one for one, row in self._of.items() if row.last_ns > silent[0] - ALIVE_NS]
        if len(alive) < 2 or not self._silent.keys() >= set(alive):
            return None
        begin_ns = max(self._silent[one][0] for one in alive)
        end_ns = min(self._silent[one][1] for one in alive)
        if end_ns - begin_ns <= GAP_NS:
            return None
        self._silent.clear()
        return Stall(begin_ns, end_ns, SERVICES)


class StallFinder:
    """Finds the stalls of a live run, each once, whatever told of it."""

    def __init__(self, cores: int, gaps: Callable[[], Sequence[Gap]]) -> None:
        """Take what watches.

        Args:
            cores: how many threads watch a core of their own; fewer gaps are not the machine's.
            gaps: returns the new ones, CLOCK_MONOTONIC.
        """
        self._cores, self._gaps = cores, gaps
        self._services, self._world = CommonSilence(), Silence(TRUTH_NS)
        self._pending: list[Stall] = []

    def hear(self, module: str, state: JointState) -> None:
        """Take a state of a module."""
        stall = self._services.feed(module, state)
        if stall is not None:
            self._pending.append(stall)

    def see(self, truth: SimTruth) -> None:
        """Take a state of the simulated world."""
        silent = self._world.feed(truth.t_ns, truth.seq)
        if silent is not None and not self._world.is_slow:
            self._pending.append(Stall(*silent, SIMULATOR))

    def take(self, now_ns: int, pace: float) -> list[Stall]:
        """Return what has ended some moments ago and was not returned before, in order.

        Args:
            now_ns: fleet's clock.
            pace: its rate beside CLOCK_MONOTONIC.
        """
        for gap in self._gaps():
            end_ns, lasted_ns = int(pace * gap.end_ns), int(pace * gap.lasted_ns)
            who = {ANY_CORE: MACHINE, UNSURE: A_THREAD}.get(gap.core, f"core {gap.core}")
            stolen_ms = pace * gap.stolen_ns / NS_PER_MS
            self._pending.append(Stall(end_ns - lasted_ns, end_ns, who, stolen_ms))
        groups = _overlapping(self._pending)
        done = [group for group in groups if now_ns >= MERGE_NS + max(row.end_ns for row in group)]
        self._pending = [row for group in groups if group not in done for row in group]
        return merged([row for group in done for row in group], self._cores)

    def rest(self) -> list[Stall]:
        """Return what no other way of finding it can add to any more: the run is over."""
        found, self._pending = merged(self._pending, self._cores), []
        return found


def merged(stalls: Iterable[Stall], cores: int) -> list[Stall]:
    """Return stalls that overlap as one, of all that stood still.

    What a thread without real time saw alone is left out.

    Args:
        stalls: in any order.
        cores: that are watched, each by itself.
    """
    found = (_joined(group, cores) for group in _overlapping(stalls))
    return [stall for stall in found if stall.who != A_THREAD]


def _overlapping(stalls: Iterable[Stall]) -> list[list[Stall]]:
    groups: list[list[Stall]] = []
    end_ns = -1
    for stall in sorted(stalls):
        if stall.begin_ns > end_ns:
            groups.append([])
            end_ns = stall.end_ns
        groups[-1].append(stall)
        end_ns = max(end_ns, stall.end_ns)
    return groups


def _joined(group: Sequence[Stall], cores: int) -> Stall:
    names = {row.who for row in group}
    numbers = sorted(int(name.removeprefix("core ")) for name in names if name.startswith("core "))
    on_cores = [row for row in group if row.who.startswith("core ")]
    together = on_cores and max(r.begin_ns for r in on_cores) < min(r.end_ns for r in on_cores)
    if MACHINE in names or (len(numbers) >= cores and together):
        who = MACHINE
    elif numbers:
        who = f"core{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"
    elif {SERVICES, SIMULATOR} <= names:
        who = ALL
    else:
        who = next(name for name in (SERVICES, SIMULATOR, A_THREAD) if name in names)
    return Stall(
        min(row.begin_ns for row in group),
        max(row.end_ns for row in group),
        who,
        max(row.stolen_ms for row in group),
    )


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
    After a kill or a fault none is: it may be that one's.

    Args:
        log: the run.
        begin_ns: of the part, monotonic.
        end_ns: of the part; what a stall made ends there at the latest.
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


def _is_excused(row: JointEvent, stall: Stall) -> bool:
    in_time = stall.begin_ns <= row.t_ns <= stall.end_ns + DROP_OUT_NS
    into_hold = row.mode_before == Mode.TRACK and row.mode_after == Mode.HOLD
    return in_time and into_hold and row.cause in (Cause.COMMAND_STALE, Cause.HOLD_ALL)


def inside(rows: Iterable[Disturbance], times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each time whether it is judged apart."""
    mask = np.zeros(len(times_ns), dtype=bool)
    for row in rows:
        mask |= (times_ns >= row.begin_ns) & (times_ns <= row.end_ns)
    return mask


def as_dicts(
    log: RunLog, rows: Sequence[Disturbance], truth: Sequence[SimTruth], zero_ns: int
) -> list[dict[str, Any]]:
    """Return disturbances as plain values, with what the robot did meanwhile.

    Args:
        log: the run.
        rows: in order.
        truth: of the part that is judged.
        zero_ns: of the times, which are s.
    """
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
    """Return a line for each time that modules held for old commands, and no stall was the reason.

    Args:
        log: the run.
        rows: what the stalls made of it.
        zero_ns: of the times, which are s.
        begin_ns: from here on.
        end_ns: up to here.
    """
    excused = [row.stall for row in rows if row.held]
    found = sorted(
        (event.t_ns, module)
        for module in MODULES
        for event in log.messages(topics.JOINT_EVENT, module)
        if event.mode_before == Mode.TRACK
        and event.mode_after == Mode.HOLD
        and event.cause in (Cause.COMMAND_STALE, Cause.HOLD_ALL)
        and begin_ns <= event.t_ns < end_ns
        and not any(_is_excused(event, stall) for stall in excused)
    )
    groups: list[list[tuple[int, str]]] = []
    for row in found:
        if not groups or row[0] - groups[-1][0][0] > TOGETHER_NS:
            groups.append([])
        groups[-1].append(row)
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
