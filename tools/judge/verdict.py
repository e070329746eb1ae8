"""Computes the figures of a run from its log, and judges the run.

The verdict needs only the MCAP file, so a run can be judged again at any time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from itertools import compress, pairwise
from typing import Annotated, Any, Final, NamedTuple, TypeAlias, get_type_hints

import msgspec
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
from tools.fleet.stalls import Disturbance, disturbances, goes_to_hold, inside, stalls_of
from tools.judge.standing import soundness, tracking, why_not_sound, why_not_standing
from tools.judge.wearer import WearerFigures, merged_figures, wearer_figures
from tools.logs.impairment_intervals import Impaired, impairments, touches
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, parts_of, robot_of

KILLED, RESTARTED = RunEventKind.KILLED, RunEventKind.RESTARTED
REAL_TIME_FACTOR_MIN: Final = 0.99
NEXT_CYCLE_MS: Final = 2.0
"""In virtual time a module detects the end of a process on its host in its next cycle, within this
time, ms. A value up to this is therefore not a measurement."""
LATE_MAX_S: Final = 0.05
"""Maximum world time that a run in real time may give up, s."""


class Percentiles(msgspec.Struct, frozen=True):
    """Distribution of a figure."""

    median: float
    p99: float


class ShownStall(msgspec.Struct, frozen=True):
    """One stall of the machine; times in scenario time."""

    at_s: float
    lasted_ms: float
    apart_until_s: float
    """End of the time that led and held figures exclude."""
    modules_held: int
    said: str
    """The stall as a line of text."""


def _worst(found: Sequence[Percentiles]) -> Percentiles:
    """Return the median of the medians and the worst 99th percentile."""
    return Percentiles(
        median=float(np.median([one.median for one in found])), p99=max(one.p99 for one in found)
    )


def _each_stall(found: Sequence[list[ShownStall]]) -> list[ShownStall]:
    """Return the stalls of all parts; for a stall in two parts, the later part knows more."""
    return list({row.at_s: row for part in found for row in part}.values())


Largest: TypeAlias = Annotated[float | None, max]
Smallest: TypeAlias = Annotated[float | None, min]
Spread: TypeAlias = Annotated[Percentiles | None, _worst]


class Summary(msgspec.Struct, kw_only=True):
    """Figures of a run, as in `summary.json`.

    The annotation of a field says how to merge the figures of the parts of a long run; a field
    without annotation has the value of the last part. A figure is None if the log does not give it.
    """

    stood: bool = False
    """True if the robot stands at the planned end of its scenario."""
    sound: bool = False
    why_not: str = ""
    """Reason why it does not stand at the end."""
    unsound: str = ""
    """Limits of soundness that were exceeded."""
    began: bool = False
    fallen_at_s: Smallest = None
    duration_s: float = 0.0
    pace: float = 1.0
    """Pace of the fleet's clock; below 1 the run was in slow motion."""
    real_time_factor: float | None = None
    world_time_lost_s: float | None = None
    in_real_time: Annotated[bool, all] = True
    com_x_max_mm: Largest = None
    com_y_max_mm: Largest = None
    roll_max_rad: Largest = None
    pitch_max_rad: Largest = None
    yaw_max_rad: Largest = None
    hold_com_x_max_mm: Largest = None
    """`hold_`: while held; `alive_`: while led, relative to the requested shift (`LIMITS`)."""
    hold_com_y_max_mm: Largest = None
    hold_roll_max_rad: Largest = None
    hold_pitch_max_rad: Largest = None
    hold_yaw_max_rad: Largest = None
    alive_com_x_max_mm: Largest = None
    alive_com_y_max_mm: Largest = None
    alive_roll_max_rad: Largest = None
    alive_pitch_max_rad: Largest = None
    alive_yaw_max_rad: Largest = None
    torso_height_min_m: Smallest = None
    torso_height_max_m: Largest = None
    sole_tilt_max_rad: Largest = None
    torque_at_limit_ms: Largest = None
    shaking_nm: Largest = None
    sinking_m_s: Largest = None
    overforce_s: Largest = None
    alive_sole_tilt_max_rad: Largest = None
    operator_peak_n: Largest = None
    hold_operator_peak_n: Largest = None
    operator_side_peak_n: Largest = None
    assist_error_n: Largest = None
    handover_ms: dict[str, float | None] | None = None
    """From the first kill to HOLD, by module."""
    handover_max_ms: Largest = None
    handover_torque_step_nm: Largest = None
    reengage_s: Largest = None
    """From the first restart to TRACK of the last module."""
    hold_entries: Annotated[int, max] = 0
    """Dropouts of the module that dropped out most often."""
    command_age_ms: Spread = None
    command_age_impaired_ms: Spread = None
    command_age_otherwise_ms: Spread = None
    links_impaired: int = 0
    impairments: list[str] = []
    """One line each: link, impairment, time, messages passed and lost."""
    pd_cycles_late_pct: Largest = None
    planner_tick_us: Spread = None
    stopped: list[str] = []
    """Processes that were suspended."""
    messages_recorded: int = 0
    """Up to the end of the last part, as for `sequence_gaps`."""
    sequence_gaps: int = 0
    stalls: Annotated[list[ShownStall], _each_stall] = []
    wearer: Annotated[WearerFigures | None, merged_figures] = None
    """Effect on the wearer; None without a harness."""
    fleet_cpu_pct: float | None = None
    """Only for a live run."""
    speed: float | None = None
    """As a multiple of real time; only for a run in virtual time."""


class Course(NamedTuple):
    """The simulated world over a run."""

    t: Array
    """Time of each row, s: scenario time, or time since the hoist's release if the scenario never
    started.
    """
    rows: list[SimTruth]
    began: bool
    """False if the robot fell before the scenario could start."""
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
        because = f", because the planner did not lead: {why}" if why else "; nothing to judge"
        raise RunError(f"{log.path}: the scenario never started in this log{because}")
    zero_ns = let_go[0].t_ns
    t = np.array([(row.t_ns - zero_ns) / NS_PER_S for row in let_go])
    return Course(t, let_go, began=False, zero_ns=zero_ns)


def summarise(log: RunLog, duration_s: float, counts: dict[str, KeyCount] | None = None) -> Summary:
    """Return the figures of a run or of a part of it, without the time after a fall.

    `duration_s` is the planned length of its scenario. `counts` cover the messages up to the end
    of the part; None if the log is the whole run.
    """
    t, truth, began, zero_ns = course(log)
    counted = (log.gaps() if counts is None else counts).values()
    summary = Summary(
        began=began,
        messages_recorded=sum(one.count for one in counted),
        sequence_gaps=sum(one.missing for one in counted),
    )
    fall = next((index for index, row in enumerate(truth) if row.fallen), None)
    if fall is not None:
        t, truth = t[: fall + 1], truth[: fall + 1]
        log = log.until(truth[-1].t_ns)
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    kills = [row for row in events if row.kind == KILLED]
    network = impairments(log.messages(topics.LINK_EVENT))
    changes = [row for name in MODULES for row in log.messages(topics.JOINT_EVENT, name)]
    disturbed = disturbances(events, changes, truth[-1].t_ns)
    _add_end(summary, log, t, truth, duration_s)
    if not _is_virtual(log):
        _add_real_time(summary, log, truth, zero_ns, disturbed)
    _add_motion(summary, log, t, truth, kills, disturbed)
    _add_handover(summary, log, kills)
    summary.reengage_s = _reengage(log, events)
    summary.hold_entries = max(len(_holds(log, name, truth[0].t_ns)) for name in MODULES)
    _add_command_ages(summary, log, truth[0].t_ns, network)
    summary.links_impaired = len(network)
    summary.impairments = [shown(row, zero_ns) for row in network]
    summary.stopped = sorted({row.subject for row in kills if row.detail == "STOP"})
    summary.stalls = [
        _shown_stall(row, zero_ns) for row in disturbed if row.stall.begin_ns >= truth[0].t_ns
    ]
    return summary


def _shown_stall(row: Disturbance, zero_ns: int) -> ShownStall:
    at_s, held = (row.stall.begin_ns - zero_ns) / NS_PER_S, row.held
    who = f": {'all six' if held == len(MODULES) else held} held" if held else ""
    return ShownStall(
        at_s=at_s,
        lasted_ms=row.stall.lasted_ms,
        apart_until_s=(row.end_ns - zero_ns) / NS_PER_S,
        modules_held=held,
        said=f"{at_s:.2f} s: {row.stall.words}{who}",
    )


def summarise_parts(index: RunIndex, duration_s: float) -> Summary:
    """Return the figures of a run that is read in parts; RunError if it cannot be judged."""
    found: list[Summary] = []
    counts: dict[str, KeyCount] = {}
    why: RunError | None = None
    for part in parts_of(index):
        part.count_into(counts)
        try:
            found.append(summarise(part, duration_s, counts))
        except RunError as error:  # the scenario has not started in this part
            why = why or error
    if not found:
        raise why or RunError(f"{index.path}: contains nothing to judge")
    return merged(found)


def merged(parts: Sequence[Summary]) -> Summary:
    """Return the figures of a run from those of its parts, in order."""
    last = parts[-1]
    if len(parts) == 1:
        return last
    summary = msgspec.structs.replace(last)
    for name, hint in get_type_hints(Summary, include_extras=True).items():
        merge: Sequence[Callable[[list[Any]], Any]] = getattr(hint, "__metadata__", ())
        found = [value for part in parts if (value := getattr(part, name)) is not None]
        if merge and found:
            setattr(summary, name, merge[0](found))
    summary.stood = last.stood and summary.fallen_at_s is None
    summary.unsound = why_not_sound(summary) if summary.stood else ""
    summary.sound = summary.stood and not summary.unsound
    return summary


def fell(summary: Summary) -> bool:
    """Return True if the robot has fallen, or is about to fall."""
    return summary.fallen_at_s is not None or bool(summary.why_not)


def exit_code(summary: Summary) -> int:
    """Return the exit code of a judged run; standing, but not soundly, is a fault."""
    if summary.sound:
        return 0
    return FELL_EXIT_CODE if fell(summary) else FAULT_EXIT_CODE


def _is_virtual(log: RunLog) -> bool:
    return bool(log.metadata.get("run", {}).get("lockstep"))


def _add_end(
    summary: Summary, log: RunLog, t: Array, truth: Sequence[SimTruth], duration_s: float
) -> None:
    """Add whether the robot stands at the end, and how soundly it stood until then."""
    last, end_s = truth[-1], float(t[-1])
    reached = summary.began and end_s >= duration_s - 0.1
    robot = None
    with contextlib.suppress(RunError, ConfigError):  # no robot in the log, or another version
        robot = robot_of(log)
    if robot is not None:
        summary.wearer = wearer_figures(log, robot, truth[0].t_ns)
        for name, value in soundness(log, truth, robot)._asdict().items():
            setattr(summary, name, value)
        summary.why_not = why_not_standing(last, robot) if reached else ""
    summary.stood = reached and not last.fallen and not summary.why_not
    summary.unsound = why_not_sound(summary) if summary.stood else ""
    summary.sound = summary.stood and not summary.unsound
    summary.fallen_at_s = end_s if last.fallen else None
    summary.duration_s = end_s
    summary.pace = _pace(log)


def _add_real_time(
    summary: Summary,
    log: RunLog,
    truth: Sequence[SimTruth],
    zero_ns: int,
    disturbed: Sequence[Disturbance],
) -> None:
    """Add the figures that only a live run has."""
    start_ns, last = truth[0].t_ns, truth[-1]
    stalls = stalls_of(log.messages(topics.RUN_EVENT))
    stalled_ms = sum(row.lasted_ms for row in stalls if zero_ns < row.end_ns <= last.t_ns)
    summary.in_real_time = _in_real_time(last, stalled_ms / 1e3)
    summary.real_time_factor, summary.world_time_lost_s = last.real_time_factor, last.late_s
    summary.pd_cycles_late_pct = _late_share(log, start_ns, disturbed)
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    ticks_us = [row.tick_us for row in statuses if row.t_ns >= start_ns]
    summary.planner_tick_us = _percentiles(np.array(ticks_us))


def _in_real_time(last: SimTruth, stalled_s: float) -> bool:
    """Return True if the world kept up with the clock, apart from stalls of the machine."""
    factor = last.real_time_factor
    if stalled_s and last.scenario_s > 0.0:
        wall_s = last.scenario_s / max(factor, 1e-9)
        factor = last.scenario_s / max(wall_s - stalled_s, 1e-9)
    return factor >= REAL_TIME_FACTOR_MIN and last.late_s - stalled_s <= LATE_MAX_S


def _add_motion(
    summary: Summary,
    log: RunLog,
    t: Array,
    truth: Sequence[SimTruth],
    kills: Sequence[RunEvent],
    disturbed: Sequence[Disturbance],
) -> None:
    """Add extremes of the robot's motion and of the hand's force: overall, led and held."""
    times_ns = np.array([row.t_ns for row in truth])
    apart = inside(disturbed, times_ns)
    led = leading(log, times_ns)
    led, held = led & ~apart, ~led & ~apart
    poses = np.array([(*row.over, row.com[2], *row.angles) for row in truth])
    deviations = poses - _requested(log, truth)
    for prefix, rows in (
        ("", poses[t >= 0.0]),
        ("hold_", poses[held]),
        ("alive_", deviations[led]),
    ):
        for name, scale, column in POSES:
            setattr(summary, prefix + name, _max(np.abs(rows[:, column]) * scale))
    heights = [row.torso[2] for row in truth]
    summary.torso_height_min_m, summary.torso_height_max_m = min(heights), max(heights)
    tilt = np.array([max(row.foot_right_tilt, row.foot_left_tilt) for row in truth])
    summary.sole_tilt_max_rad, summary.alive_sole_tilt_max_rad = _max(tilt), _max(tilt[led])
    _, side, force = np.abs([row.operator_force for row in truth]).T
    summary.operator_peak_n, summary.hold_operator_peak_n = _max(force[led]), _max(force[held])
    summary.operator_side_peak_n = _max(side[led]) if side.any() else None
    kill_s = kills[0].scenario_s if kills else np.inf
    summary.assist_error_n = _assist_error(list(compress(truth, (t < kill_s) & ~apart)))


POSES: Final = (
    ("com_x_max_mm", 1e3, 0), ("com_y_max_mm", 1e3, 1), ("roll_max_rad", 1.0, 3),
    ("pitch_max_rad", 1.0, 4), ("yaw_max_rad", 1.0, 5),
)  # fmt: skip
"""Figure, scale and column of a pose: COM over the soles and its height, m, roll, pitch, yaw."""


def _requested(log: RunLog, truth: Sequence[SimTruth]) -> Array:
    """Return the requested shift, as the planner's rate-limited reference, at each row.

    (n, 6): COM x, y over the floor along gravity, z, roll, pitch, yaw; zeros where nothing is
    requested.
    """
    found = np.zeros((len(truth), 6))
    rows: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    if not any(any(row.shift_requested) for row in rows):
        return found
    t, p_ref = [row.t_ns for row in rows], np.array([row.p_ref for row in rows])
    times_ns = [row.t_ns for row in truth]
    for row in ROWS:
        found[:, row] = np.interp(times_ns, t, p_ref[:, row])
    # on a slope the reference is relative to gravity, like `SimTruth.over`
    found[:, :2] -= [(row.lean[0] * row.com[2], row.lean[1] * row.com[2]) for row in truth]
    return found


def _max(values: Array) -> float | None:
    return float(values.max()) if len(values) else None


def _assist_error(truth: Sequence[SimTruth]) -> float | None:
    """Return the mean error while a steady load rests on the harness, N."""
    errors = [
        abs(b.harness_force_z - b.load_n)
        for a, b in zip(truth, truth[100:], strict=False)
        if b.load_n > 1.0 and abs(a.load_n - b.load_n) < 1e-6
    ]
    return float(np.mean(errors)) if errors else None


def leading(log: RunLog, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return, for each time, True if the limits of a leading planner apply.

    They apply until the first kill. In a run with network impairments, they apply only while all
    six modules track, since HOLD is expected. In any other run, they also apply during dropouts.
    """
    events: list[RunEvent] = log.messages(topics.RUN_EVENT)
    kills = [row.t_ns for row in events if row.kind == KILLED]
    led = times_ns < (kills[0] if kills else np.iinfo(np.int64).max)
    if not log.count(topics.LINK_EVENT.key(log.robot)):
        return led
    return led & tracking(log, times_ns)


def shown(row: Impaired, zero_ns: int) -> str:
    """Return an impairment in one line, with times in s after a stamp."""
    return f"{row.title}: {row.when(zero_ns)}; {row.counts()}"


def _add_command_ages(
    summary: Summary, log: RunLog, start_ns: int, network: Sequence[Impaired]
) -> None:
    """Add the age of the newest command of each tracking module, from the start on, ms.

    There are three distributions: overall, while a link of that module was impaired, and otherwise.
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
    summary.command_age_ms = _percentiles(age)
    summary.command_age_impaired_ms = _percentiles(age[mask])
    summary.command_age_otherwise_ms = _percentiles(age[~mask])


def _percentiles(values: Array) -> Percentiles | None:
    return Percentiles(*np.percentile(values, [50, 99]).tolist()) if len(values) else None


def _holds(log: RunLog, module: str, from_ns: int) -> list[JointEvent]:
    """Return each change of a module from TRACK to HOLD."""
    events: list[JointEvent] = log.messages(topics.JOINT_EVENT, module)
    return [row for row in events if row.t_ns >= from_ns and goes_to_hold(row)]


def _add_handover(summary: Summary, log: RunLog, kills: Sequence[RunEvent]) -> None:
    """Add the time from the first kill to HOLD, and the largest torque step into HOLD.

    Steps count from the first kill or the first impairment of the network, whichever is earlier.
    """
    impaired = [row.t_ns for row in log.messages(topics.LINK_EVENT)]
    begins = [row.t_ns for row in kills[:1]] + impaired[:1]
    times: dict[str, float | None] = dict.fromkeys(MODULES)
    steps = []
    for module in MODULES if begins else ():
        entries = _holds(log, module, min(begins))
        steps += [abs(b - a) for row in entries
                  for a, b in zip(row.tau_before, row.tau_after, strict=True)]  # fmt: skip
        after = [row.t_ns for row in entries if kills and row.t_ns >= kills[0].t_ns]
        if after:
            times[module] = (after[0] - kills[0].t_ns) / NS_PER_MS
    known = [value for value in times.values() if value is not None]
    slowest = max(known) if len(known) == len(MODULES) else None
    if _is_virtual(log) and slowest is not None and slowest <= NEXT_CYCLE_MS:
        slowest = None
    summary.handover_ms = times if kills else None
    summary.handover_max_ms = slowest
    summary.handover_torque_step_nm = max(steps, default=None)


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

    The counts of a service that restarts begin at 0.
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
    """Return the pace of the fleet's clock; 1 if the log does not contain it."""
    text = log.metadata.get("run", {}).get("pace", "1")
    try:
        pace = float(text)
    except ValueError:
        pace = math.nan
    if not 0.0 < pace <= 1.0:
        right = "must be above 0 and at most 1"
        raise RunError(f"{log.path}: run.pace is {text[:40]!r}; it {right}")
    return pace
