"""Judges a run by figures from its log alone, beside their limits.

Everything is read from the MCAP file, so that a run can be judged again at any time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import compress, pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.law.closed_reference import ROWS
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointEvent, JointState, Mode, PlannerStatus, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, ConfigError, RunError
from shared.joints import MODULES
from shared.mcap_log.sequence_stats import KeyCount
from tools.judge.stalls import (
    WORLD_STOPS,
    Disturbance,
    Stall,
    as_dicts,
    disturbances,
    drop_outs,
    goes_to_hold,
    inside,
    stalls_of,
)
from tools.judge.standing import (
    BY_KEY,
    soundness,
    tracking,
    why_not_sound,
    why_not_standing,
)
from tools.logs.impairment_intervals import Impaired, impairments, touches
from tools.logs.run_log import RunLog, robot_of

Summary = dict[str, Any]

KILLED, RESTARTED, FAULTED = (
    RunEventKind.KILLED, RunEventKind.RESTARTED, RunEventKind.FAULTED,
)  # fmt: skip

REAL_TIME_FACTOR_MIN: Final = 0.99
NEXT_CYCLE_MS: Final = 2.0
"""In virtual time a module sees the end of a process on its host in its next cycle, after up to
this time, ms: nothing is measured."""
LATE_MAX_S: Final = 0.05
"""More world time given up than this: the run was not in real time."""


class Course(NamedTuple):
    """The simulated world over a run."""

    t: Array
    """Time of each row, s: scenario time, or since the hoist's release if the scenario never
    started.
    """
    rows: list[SimTruth]
    began: bool
    """False if the robot fell before the scenario could begin."""
    zero_ns: int
    """Monotonic time of t = 0."""


def course(log: RunLog) -> Course:
    """Return a run's course."""
    rows: list[SimTruth] = log.messages(topics.SIM_TRUTH)
    scenario = [row for row in rows if row.scenario_s >= 0.0]
    if scenario:
        t = np.array([row.scenario_s for row in scenario])
        zero_ns = scenario[0].t_ns - round(scenario[0].scenario_s * NS_PER_S)
        return Course(t, scenario, began=True, zero_ns=zero_ns)
    let_go = [row for row in rows if row.hoist < 1.0]
    if not any(row.fallen for row in let_go):
        statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
        why = statuses[-1].why if statuses else ""
        because = f", for the planner did not lead: {why}" if why else "; nothing to judge"
        raise RunError(f"{log.path}: the scenario never began in this log{because}")
    zero_ns = let_go[0].t_ns
    t = np.array([(row.t_ns - zero_ns) / NS_PER_S for row in let_go])
    return Course(t, let_go, began=False, zero_ns=zero_ns)


def summarise(log: RunLog, duration_s: float) -> Summary:
    """Return the figures of a run; what follows a fall does not count."""
    t, truth, began, zero_ns = course(log)
    whole = log
    fall = next((index for index, row in enumerate(truth) if row.fallen), None)
    if fall is not None:
        t, truth = t[: fall + 1], truth[: fall + 1]
        log = log.until(truth[-1].t_ns)
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    kills = [row for row in events if row.kind == KILLED]
    kill_s = kills[0].scenario_s if kills else np.inf
    last = truth[-1]
    fallen = last.fallen
    reached = began and bool(t[-1] >= duration_s - 0.1)
    robot = None
    with contextlib.suppress(RunError, ConfigError):  # none in it, or one of another version
        robot = robot_of(log)
    sound = soundness(log, truth, robot) if robot is not None else {}
    why_not = why_not_standing(last, robot) if robot is not None and reached else ""
    stands = reached and not fallen and not why_not
    unsound = why_not_sound(sound) if stands else ""
    summary: Summary = {
        "stood": stands,
        "sound": stands and not unsound,
        "why_not": why_not,
        "unsound": unsound,
        "began": began,
        "fallen_at_s": float(t[-1]) if fallen else None,
        "duration_s": float(t[-1]),
        "pace": _pace(log),
        "real_time_factor": last.real_time_factor,
        "world_time_lost_s": last.late_s,
        "in_real_time": _in_real_time(
            last, [row for row in stalls_of(events) if zero_ns < row.end_ns <= last.t_ns]
        ),
    }
    times_ns = np.array([row.t_ns for row in truth])
    disturbed = disturbances(log, truth[0].t_ns, last.t_ns)
    apart = inside(disturbed, times_ns)
    led = leading(log, times_ns)
    led, held = led & ~apart, ~led & ~apart
    poses = np.array([(*row.over, row.com[2], *row.angles) for row in truth])
    for prefix, mask in (("", t >= 0.0), ("hold_", held)):
        summary |= _extent(prefix, poses[mask])
    summary |= _extent("alive_", (poses - _asked(log, truth))[led])
    heights = [row.torso[2] for row in truth]
    summary["torso_height_min_m"] = min(heights)
    summary["torso_height_max_m"] = max(heights)
    tilt = np.array([max(row.foot_right_tilt, row.foot_left_tilt) for row in truth])
    summary["sole_tilt_max_rad"] = _max(tilt)
    summary |= sound
    summary["alive_sole_tilt_max_rad"] = _max(tilt[led])
    _, side, force = np.abs([row.operator_force for row in truth]).T
    summary["operator_peak_n"] = _max(force[led])
    summary["hold_operator_peak_n"] = _max(force[held])
    summary["operator_side_peak_n"] = _max(side[led]) if side.any() else None
    judged = (t < kill_s) & ~apart
    summary["assist_error_n"] = _assist_error(list(compress(truth, judged)))
    summary |= _handover(log, kills)
    summary["reengage_s"] = _reengage(log, events)
    entries = [len(_drop_outs(log, module, truth[0].t_ns)) for module in MODULES]
    summary["hold_entries"] = max(entries)
    network = impairments(log.messages(topics.LINK_EVENT))
    summary |= _command_age(log, truth[0].t_ns, network)
    summary["links_impaired"] = len(network)
    summary["impairments"] = [row.as_dict(zero_ns) for row in network]
    summary["pd_cycles_late_pct"] = _late_share(log, truth[0].t_ns, disturbed)
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    ticks_us = [row.tick_us for row in statuses if row.t_ns >= truth[0].t_ns]
    summary["planner_tick_us"] = _middle_and_most(np.array(ticks_us))
    summary["stopped"] = sorted({row.subject for row in kills if row.detail == "STOP"})
    summary["messages_recorded"] = sum(whole.count(key) for key in whole.keys())  # noqa: SIM118 - not a dict
    summary["sequence_gaps"] = sum(count.missing for count in whole.gaps().values())
    summary["stalls"] = as_dicts(log, disturbed, truth, zero_ns)
    summary["across_stalls"] = _across(summary, events, disturbed)
    done_ns = [row.t_ns for row in events if row.kind in (KILLED, FAULTED)]
    until_ns = min([*done_ns, last.t_ns])
    summary["drop_outs"] = []
    if not network and not log.metadata.get("run", {}).get("lockstep"):
        begin_ns = max(zero_ns, truth[0].t_ns)
        summary["drop_outs"] = drop_outs(log, disturbed, zero_ns, begin_ns, until_ns)
    return summary


def _in_real_time(last: SimTruth, stalls: Sequence[Stall]) -> bool:
    """Return True if the world kept up with the clock, but for the stalls in which it stopped."""
    stood_still_s = sum(row.lasted_ms for row in stalls if row.who in WORLD_STOPS) / 1e3
    factor = last.real_time_factor
    if stood_still_s and last.scenario_s > 0.0:
        wall_s = last.scenario_s / max(factor, 1e-9)
        factor = last.scenario_s / max(wall_s - stood_still_s, 1e-9)
    return factor >= REAL_TIME_FACTOR_MIN and last.late_s - stood_still_s <= LATE_MAX_S


def _across(
    summary: Summary, events: Sequence[RunEvent], disturbed: Sequence[Disturbance]
) -> list[str]:
    """Return the keys of figures over their limits that would be within them but for a stall."""
    found = []
    for kind, key, unit_s in ((KILLED, "handover_max_ms", 1e-3), (RESTARTED, "reengage_s", 1.0)):
        begins_ns = [event.t_ns for event in events if event.kind == kind]
        if not begins_ns or summary[key] is None:
            continue
        begin_ns, end_ns = begins_ns[0], begins_ns[0] + summary[key] * unit_s * NS_PER_S
        overlaps_ns = [
            max(0.0, min(end_ns, row.stall.end_ns) - max(begin_ns, row.begin_ns))
            for row in disturbed
        ]
        without = summary[key] - sum(overlaps_ns) / NS_PER_S / unit_s
        if without <= BY_KEY[key].limit < summary[key]:
            found.append(key)
    return found + _lost_in_stalls(summary)


def _lost_in_stalls(summary: Mapping[str, Any]) -> list[str]:
    lost = sum(row["messages_lost"] for row in summary["stalls"])
    return ["sequence_gaps"] if lost and lost >= summary["sequence_gaps"] else []


def fell(summary: Mapping[str, Any]) -> bool:
    """Return True if the robot of a run is down, or cannot recover."""
    return summary["fallen_at_s"] is not None or bool(summary["why_not"])


def exit_code(summary: Mapping[str, Any]) -> int:
    """Return the exit code of a run that was judged: standing, but not soundly, is a fault."""
    if summary["sound"]:
        return 0
    return FELL_EXIT_CODE if fell(summary) else FAULT_EXIT_CODE


LAST_COUNTS: Final = ("world_time_lost_s", "real_time_factor", "duration_s", "pace", "began")
"""Figures that a later part has of the whole run."""
COUNTED: Final = ("messages_recorded", "sequence_gaps")
"""Figures that parts with margins cannot tell: `joined` is given them."""
LEAST: Final = ("torso_height_min_m",)


def joined(parts: Sequence[Summary], counts: Iterable[KeyCount]) -> Summary:
    """Return the figures of a run from those of its parts, in their order.

    Extremes are those of the run. A percentile or a mean is that of the worst part, a median
    the median of the parts.
    """
    if len(parts) == 1:
        return parts[0]
    counted = list(counts)
    last, summary = parts[-1], dict(parts[-1])
    for key in last:
        found = [part[key] for part in parts if part[key] is not None]
        if not found or key in LAST_COUNTS or not isinstance(found[0], int | float | dict):
            continue
        if isinstance(found[0], dict):
            if "p99" in found[0]:
                summary[key] = {
                    "median": float(np.median([one["median"] for one in found])),
                    "p99": max(one["p99"] for one in found),
                }
        elif not isinstance(found[0], bool):
            summary[key] = min(found) if key in LEAST else max(found)
    told = {(row["at_s"], row["who"]): row for part in parts for row in part["stalls"]}
    summary["stalls"] = list(told.values())
    summary["drop_outs"] = list(dict.fromkeys(line for p in parts for line in p["drop_outs"]))
    totals = sum(one.count for one in counted), sum(one.missing for one in counted)
    summary |= dict(zip(COUNTED, totals, strict=True))
    across = {key for part in parts for key in part["across_stalls"]} - {"sequence_gaps"}
    summary["across_stalls"] = sorted(across) + _lost_in_stalls(summary)
    fallen = [part["fallen_at_s"] for part in parts if part["fallen_at_s"] is not None]
    summary["fallen_at_s"] = min(fallen, default=None)
    summary["stood"] = last["stood"] and not fallen
    summary["unsound"] = why_not_sound(summary) if summary["stood"] else ""
    summary["sound"] = summary["stood"] and not summary["unsound"]
    summary["in_real_time"] = all(part["in_real_time"] for part in parts)
    return summary


POSES: Final = (
    ("com_x_max_mm", 1e3, 0), ("com_y_max_mm", 1e3, 1), ("roll_max_rad", 1.0, 3),
    ("pitch_max_rad", 1.0, 4), ("yaw_max_rad", 1.0, 5),
)  # fmt: skip
"""Figure, scale and column of a pose: COM over the soles and its height, m, roll, pitch, yaw."""


def _extent(prefix: str, poses: Array) -> Summary:
    return {prefix + name: _max(np.abs(poses[:, n]) * scale) for name, scale, n in POSES}


def _asked(log: RunLog, truth: Sequence[SimTruth]) -> Array:
    """Return the closed directions that the operator requested, at the planner's rate of reference.

    (n, 6): COM x, y over the floor along gravity, z, roll, pitch, yaw; zeros where none was
    requested.
    """
    asked = np.zeros((len(truth), 6))
    rows: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    if not any(any(row.shift_requested) for row in rows):
        return asked
    t, p_ref = [row.t_ns for row in rows], np.array([row.p_ref for row in rows])
    times_ns = [row.t_ns for row in truth]
    for row in ROWS:
        asked[:, row] = np.interp(times_ns, t, p_ref[:, row])
    # on a slope the reference goes with gravity, as `SimTruth.over` does
    asked[:, :2] -= [(row.lean[0] * row.com[2], row.lean[1] * row.com[2]) for row in truth]
    return asked


def _max(values: Array) -> float | None:
    return float(values.max()) if len(values) else None


def _assist_error(truth: Sequence[SimTruth]) -> float | None:
    """Return the mean error while a load rests steadily on the harness, N."""
    errors = [
        abs(b.harness_force_z - b.load_n)
        for a, b in zip(truth, truth[100:], strict=False)
        if b.load_n > 1.0 and abs(a.load_n - b.load_n) < 1e-6
    ]
    return float(np.mean(errors)) if errors else None


def leading(log: RunLog, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return, for each time, True if the run is judged by the limits of a leading planner.

    True until the first kill. While the network is impaired on purpose, only while all six modules
    track: HOLD is expected then. A module that drops out at any other time is judged.
    """
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    kills = [row.t_ns for row in events if row.kind == KILLED]
    led = times_ns < (kills[0] if kills else np.iinfo(np.int64).max)
    if not log.count(topics.LINK_EVENT.key(log.robot)):
        return led
    return led & tracking(log, times_ns)


def _command_age(log: RunLog, start_ns: int, network: Sequence[Impaired]) -> Summary:
    """Return how old the newest command of each module that tracks was, from the start on, ms.

    All in all, while a link of that module was impaired, and otherwise.
    """
    ages, impaired = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for module in MODULES:
        rows: list[JointState] = [
            row
            for row in log.messages(topics.JOINT_STATE, module)
            if row.t_ns >= start_ns and row.mode == Mode.TRACK
        ]
        ages.append(np.array([row.age_ns / NS_PER_MS for row in rows]))
        impaired.append(touches(network, module, np.array([row.t_ns for row in rows], np.int64)))
    age, mask = np.concatenate(ages), np.concatenate(impaired)
    return {
        "command_age_ms": _middle_and_most(age),
        "command_age_impaired_ms": _middle_and_most(age[mask]),
        "command_age_otherwise_ms": _middle_and_most(age[~mask]),
    }


def _middle_and_most(values: Array) -> dict[str, float] | None:
    """Return the median and the 99th percentile; None of nothing."""
    if not len(values):
        return None
    median, p99 = np.percentile(values, [50, 99])
    return {"median": float(median), "p99": float(p99)}


def _drop_outs(log: RunLog, module: str, from_ns: int) -> list[JointEvent]:
    """Return each time that a module went from TRACK to HOLD."""
    events: list[JointEvent] = log.messages(topics.JOINT_EVENT, module)
    return [row for row in events if row.t_ns >= from_ns and goes_to_hold(row)]


def _handover(log: RunLog, kills: Sequence[RunEvent]) -> Summary:
    """Return the time from the first kill to HOLD, and the largest torque step into HOLD.

    Steps count from the first kill on, or from when the network was first impaired.
    """
    impaired = [row.t_ns for row in log.messages(topics.LINK_EVENT)]
    begins = [row.t_ns for row in kills[:1]] + impaired[:1]
    times: dict[str, float | None] = dict.fromkeys(MODULES)
    steps = []
    for module in MODULES if begins else ():
        entries = _drop_outs(log, module, min(begins))
        steps += [abs(b - a) for row in entries
                  for a, b in zip(row.tau_before, row.tau_after, strict=True)]  # fmt: skip
        after = [row.t_ns for row in entries if kills and row.t_ns >= kills[0].t_ns]
        if after:
            times[module] = (after[0] - kills[0].t_ns) / NS_PER_MS
    known = [value for value in times.values() if value is not None]
    slowest = max(known) if len(known) == len(MODULES) else None
    is_virtual = bool(log.metadata.get("run", {}).get("lockstep"))
    if is_virtual and slowest is not None and slowest <= NEXT_CYCLE_MS:
        slowest = None
    return {
        "handover_ms": times if kills else None,
        "handover_max_ms": slowest,
        "handover_torque_step_nm": max(steps, default=None),
    }


def _reengage(log: RunLog, events: Sequence[RunEvent]) -> float | None:
    """Return the time from the first restart to the last module's TRACK, s."""
    begin_ns = next((row.t_ns for row in events if row.kind == RESTARTED), math.inf)
    tracks_ns = []
    for module in MODULES:
        rows: list[JointEvent] = log.messages(topics.JOINT_EVENT, module)
        back = [row.t_ns for row in rows if row.mode_after == Mode.TRACK and row.t_ns > begin_ns]
        tracks_ns += back[:1]
    return (max(tracks_ns) - begin_ns) / NS_PER_S if len(tracks_ns) == len(MODULES) else None


def _late_share(log: RunLog, start_ns: int, disturbed: Sequence[Disturbance]) -> float | None:
    """Return the fraction of late PD cycles outside of stalls, %.

    A service that restarts counts from 0.
    """
    late = cycles = 0
    for module in MODULES:
        states: list[JointState] = [
            row for row in log.messages(topics.JOINT_STATE, module) if row.t_ns >= start_ns
        ]
        apart = inside(disturbed, np.array([row.t_ns for row in states]))
        for (before, after), is_apart in zip(pairwise(states), apart[1:], strict=True):
            if after.cycle > before.cycle and not is_apart:
                late += after.late - before.late
                cycles += after.cycle - before.cycle
    return 100.0 * late / cycles if cycles else None


def _pace(log: RunLog) -> float:
    """Return the pace of the fleet's clock; 1 where the log does not say it."""
    text = log.metadata.get("run", {}).get("pace", "1")
    try:
        pace = float(text)
    except ValueError:
        pace = math.nan
    if not 0.0 < pace <= 1.0:
        right = "above 0 and up to 1 is right"
        raise RunError(f"{log.path}: run.pace is {text[:40]!r}; {right}")
    return pace
