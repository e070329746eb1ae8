"""`xrl study crash`: makes parts of a live fleet fail, case by case, and judges the robot.

The verdict comes from the live bus, not from the log, because the recorder may be the dead service.
"""

from __future__ import annotations

import difflib
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from rich.table import Table
from rich.text import Text

from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.codec import Decoder
from shared.bus.messages import Cause, JointEvent, Mode, RunEvent, RunEventKind
from shared.bus.session import Session
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import lead
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, FleetError, RunError
from shared.extras import require
from shared.joints import MODULES
from shared.robot.trip_table import JOINT_TRIPS
from tools.flags import Arg, ConfigFlags, Natural
from tools.fleet.status_table import warn_of_others
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.supervisor_client import ServiceInfo
from tools.judge.standing import why_not_standing
from tools.judge.verdict import LATE_MAX_S, REAL_TIME_FACTOR_MIN
from tools.lab.studies.crash.cases import (
    CASES,
    CRASH_S,
    REQUEST_S,
    CrashCase,
    CrashVerdict,
    describe,
    scenario_of,
)
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.figures import (
    END_TOLERANCE_S,
    event_steps_nm,
    sole_tilt_max_rad,
    worst,
)
from tools.lab.studies.sweeps.study import bar, digest_of
from tools.lab.studies.sweeps.table import CaseTable, Row
from tools.live import experiment
from tools.live.live import run_live
from tools.live.scenario_runner import LiveSnapshot, ScenarioRunner
from tools.terminal import Console, marked

Show = Callable[[LiveSnapshot], None]

TRIES: Final = 2
"""Maximum number of tries. A run is repeated if the machine disturbed it or it ended too early,
but never after a fall, whose log is kept."""
SANK_M: Final = 0.05
"""A robot has sunk if its torso is this far below both its height at the crash and the
hand's lowest height, m. HOLD's springs and the hand yield by 0.01 m."""
UNSAFE: Final = (Mode.FAULT, Mode.DAMP, Mode.DISARMED)
"""Modes that the modules in `CrashCase.others` must not enter."""


class CrashMessages(NamedTuple):
    """Messages of a run."""

    truth: Sequence[SimTruth]
    events: Sequence[tuple[str, JointEvent]]
    """Changes of mode with their modules, in order for each module."""
    actions: Sequence[RunEvent]
    """Kills, restarts and other actions on the run."""
    modes: Sequence[str]
    """Modes of the modules at the end, as in `scenario_runner.LiveSnapshot`."""
    died: Sequence[str] = ()
    """Services that ended without a request."""


class CrashResult(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a case; None where nothing was measured."""

    verdict: CrashVerdict
    fell_after_s: float | None = None
    """Time from the crash to the fall, s."""
    safe_ms: float | None = None
    """Time from the crash to HOLD, slowest of the modules not hit; None if not all held."""
    torque_step_nm: float | None = None
    """Largest step of these modules' torques on entering HOLD, N m."""
    torque_step_back_nm: float | None = None
    """Largest step of any module's torque at a change of mode after the request, N m."""
    leads_again_s: float | None = None
    """Restart to last TRACK, s; None if a module does not track at the end, or none left TRACK."""
    com_x_mm: float | None = None
    """Largest distance of the COM from the middle after the crash, with its sign."""
    com_y_mm: float | None = None
    sank_mm: float | None = None
    """Distance of the torso below both its height at the crash and the hand's lowest height."""
    sole_tilt_max_rad: float | None = None
    in_real_time: bool = True
    """False if the machine was too slow for the figures to be valid."""
    remarks: str | None = None
    """Deviations from the expected outcome, as text."""
    tries: int = 1
    wall_s: float = 0.0
    """Includes start and stop of the fleet."""


def unjudged(reason: str) -> CrashResult:
    """Return the outcome of a run that cannot be judged."""
    return CrashResult(verdict=CrashVerdict.UNJUDGED, remarks=reason)


def measure(case: CrashCase, messages: CrashMessages, robot: RobotConfig) -> CrashResult:
    """Return the figures of a run."""
    truth = [row for row in messages.truth if row.scenario_s >= 0.0]
    if not truth:
        return unjudged("the scenario never started")
    zero_ns = truth[0].t_ns - round(truth[0].scenario_s * NS_PER_S)
    crash_s = _crash_s(case, messages.actions)
    if crash_s is None:
        return unjudged("the kill was never triggered: the modules did not track again in time")
    after = [row for row in truth if row.scenario_s >= crash_s]
    if not after:
        return unjudged(f"ended at {truth[-1].scenario_s:.1f} s, before the crash")
    crash_ns = zero_ns + round(crash_s * NS_PER_S)
    request_ns = zero_ns + round(REQUEST_S * NS_PER_S)
    fall = next((row for row in truth if row.fallen), None)
    events = [row for row in messages.events if fall is None or row[1].t_ns <= fall.t_ns]
    reaction = [(name, e) for name, e in events if crash_ns <= e.t_ns < request_ns]
    safe_ms = _safe_ms(case, events, crash_ns, request_ns)
    holds = [e for name, e in reaction if name in case.others and e.mode_after == Mode.HOLD]
    later = [event for _, event in events if event.t_ns >= request_ns]
    fell_at = None if fall is None else fall.scenario_s
    standing = [row for row in after if not row.fallen] or after[:1]
    scenario = scenario_of(case)
    lowest_hand = min(lead(scenario, row.scenario_s).height for row in after)
    sank = max(0.0, min(after[0].torso[2], lowest_hand) - min(row.torso[2] for row in standing))
    last = truth[-1]
    verdict = CrashVerdict.STOOD
    remarks = []
    if fell_at is not None:
        verdict = CrashVerdict.FELL
    elif last.scenario_s < scenario.duration - END_TOLERANCE_S:
        return unjudged(f"ended at {last.scenario_s:.1f} s of {scenario.duration:g} s")
    elif why_not_standing(last, robot):
        verdict = CrashVerdict.FELL
        remarks.append("tipping at the end, but not fallen yet")
    elif sank > SANK_M:
        verdict = CrashVerdict.SANK
    remarks += _remarks(case, safe_ms, reaction)
    remarks += [f"{name} ended on its own" for name in messages.died]
    leads = all(mode == "T" for mode in messages.modes)
    if verdict is not CrashVerdict.FELL and not leads and case.leads_again:
        remarks.append(f"does not lead again: {''.join(messages.modes)}")
    in_real_time = last.real_time_factor >= REAL_TIME_FACTOR_MIN and last.late_s <= LATE_MAX_S
    if not in_real_time:
        remarks.append("not in real time: the machine was too slow")
    tracks = [event.t_ns for event in later if event.mode_after == Mode.TRACK]
    restarts = [row for row in messages.actions if row.kind == RunEventKind.RESTARTED]
    backs = [row.t_ns for row in restarts if row.scenario_s >= REQUEST_S]
    x, y = ([1e3 * row.over[axis] for row in standing] for axis in (0, 1))
    return CrashResult(
        verdict=verdict,
        fell_after_s=None if fell_at is None else fell_at - crash_s,
        safe_ms=safe_ms,
        torque_step_nm=max(event_steps_nm(holds), default=None),
        torque_step_back_nm=max(event_steps_nm(later), default=None),
        leads_again_s=(max(tracks) - backs[0]) / NS_PER_S if leads and tracks and backs else None,
        com_x_mm=max(x, key=abs),
        com_y_mm=max(y, key=abs),
        sank_mm=1e3 * sank,
        sole_tilt_max_rad=sole_tilt_max_rad(standing),
        in_real_time=in_real_time,
        remarks="; ".join(remarks) or None,
    )


def _crash_s(case: CrashCase, actions: Sequence[RunEvent]) -> float | None:
    """Return the scenario time of the crash, s; None if a triggered kill did not happen."""
    until_s = REQUEST_S - END_TOLERANCE_S
    kills = [row.scenario_s for row in actions if row.kind == RunEventKind.KILLED]
    kills = [at_s for at_s in kills if at_s < until_s]
    if case.triggered_kill is not None:
        led_up = sum(1 for row in scenario_of(case).kill if row.at < CRASH_S)
        return kills[led_up] if len(kills) > led_up else None
    return kills[0] if kills else CRASH_S


def _safe_ms(
    case: CrashCase, events: Sequence[tuple[str, JointEvent]], crash_ns: int, request_ns: int
) -> float | None:
    """Return the time until every module not hit is in HOLD, ms; None if one never was."""
    took = []
    for module in case.others:
        own = [event for name, event in events if name == module and event.t_ns < request_ns]
        before = [event for event in own if event.t_ns < crash_ns]
        held = before[-1:] + own[len(before) :]
        holds = [max(0, e.t_ns - crash_ns) for e in held if e.mode_after == Mode.HOLD]
        if not holds:
            return None
        took.append(holds[0] / NS_PER_MS)
    return max(took, default=None)


def _remarks(
    case: CrashCase, safe_ms: float | None, reaction: Sequence[tuple[str, JointEvent]]
) -> list[str]:
    """Return the unexpected reactions of modules that were not hit, and all trips, as text."""
    others = [(name, event) for name, event in reaction if name in case.others]
    changed = sorted({name for name, _ in others})
    words = []
    if case.holds and case.others and safe_ms is None:
        words.append("not all of the other modules held")
    if not case.holds and changed:
        words.append(f"left TRACK: {', '.join(changed)}")
    words += [
        f"{name} went to {Mode(event.mode_after).name}"
        for name, event in others
        if event.mode_after in UNSAFE
    ]
    words += [
        f"{name} tripped: {Cause(event.cause).name}"
        for name, event in reaction
        if event.cause in JOINT_TRIPS
    ]
    return words


def run_case(
    case: CrashCase, robot: RobotConfig, out: Path, show: Show, *, seed: int = 0
) -> CrashResult:
    """Run a case, and repeat it if the first try was disturbed or ended too early (`TRIES`).

    `out` is the folder of the case; `show` receives the run's snapshots.
    """
    begin_s = time.monotonic()
    tries = 0
    while tries < TRIES:
        tries += 1
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        outcome = _run_once(case, robot, out, show, seed)
        judged = outcome.in_real_time and outcome.verdict is not CrashVerdict.UNJUDGED
        if judged or outcome.verdict is CrashVerdict.FELL:
            break
    wall_s = time.monotonic() - begin_s
    outcome = msgspec.structs.replace(outcome, tries=tries, wall_s=wall_s)
    allowed = is_good({"verdict": outcome.verdict, "expected": case.expected})
    if allowed and outcome.verdict is not CrashVerdict.FELL:
        for log in out.glob("*.mcap"):
            log.unlink()  # 6 MB each, and without a fault to search for
    return outcome


def _run_once(case: CrashCase, robot: RobotConfig, out: Path, show: Show, seed: int) -> CrashResult:
    scenario = scenario_of(case)
    down = {row.service for row in scenario.kill}

    def conduct(fleet: SupervisedFleet, session: Session) -> CrashMessages:
        modules = {topics.JOINT_EVENT.key(session.robot, name): name for name in MODULES}
        stream = session.stream([topics.JOINT_EVENT.key(session.robot, "*")])
        decoder, modes = Decoder(JointEvent), ["-"] * len(MODULES)
        truth, events = list[SimTruth](), list[tuple[str, JointEvent]]()

        def listen() -> None:
            while (sample := stream.take()) is not None:
                event = decoder.decode(sample[1])
                if event is not None:
                    events.append((modules[sample[0]], event))

        def see(snapshot: LiveSnapshot) -> None:
            if snapshot.truth is not None:
                truth.append(snapshot.truth)
            modes[:] = snapshot.modes
            listen()
            show(snapshot)

        conductor = ScenarioRunner(fleet, session, scenario, see, case.triggered_kill)
        conductor.run()
        listen()
        return CrashMessages(
            truth, events, conductor.said, modes, died_of(fleet.info(), conductor.said)
        )

    try:
        run = run_live(
            out, robot, scenario, conduct,
            verb="crash", seed=seed, true_plant=PlantConfig(), no_restart=down,
        )  # fmt: skip
    except (RunError, FleetError) as error:
        lines = str(error).splitlines()  # the last line of a service's log is its error
        return unjudged(": ".join(dict.fromkeys((lines[0], lines[-1].strip()))))
    return measure(case, run, robot)


def died_of(services: Sequence[ServiceInfo], actions: Sequence[RunEvent]) -> list[str]:
    """Return the services that ended without a request, by their states and the run's actions."""
    last = {row.subject: row.kind for row in actions}
    return [
        service.name
        for service in services
        if (service.pid is None and last.get(service.name) != RunEventKind.KILLED)
        or (service.restarts > 0 and service.name not in last)
    ]


TABLE: Final = "cases.csv"
CASE_S: Final = 14.0
"""Duration of a case including start and stop of its fleet, s."""
UNJUDGED_MAX: Final = 3
"""After this many unjudged cases in a row the machine is at fault, not the robot."""
SHOWN: Final = {
    CrashVerdict.STOOD: (0, "green"),
    CrashVerdict.SANK: (FAULT_EXIT_CODE, "yellow"),
    CrashVerdict.FELL: (FELL_EXIT_CODE, "red"),
    CrashVerdict.UNJUDGED: (RunError.exit_code, "magenta"),
}
"""Exit code and colour of each verdict."""
COLUMNS: Final = (
    ("fell", "fell_after_s", ".2f"),
    ("safe", "safe_ms", ".0f"),
    ("step", "torque_step_nm", ".2f"),
    ("back", "torque_step_back_nm", ".2f"),
    ("leads", "leads_again_s", ".2f"),
    ("x", "com_x_mm", "+.0f"),
    ("y", "com_y_mm", "+.0f"),
)
"""Heading, figure, format."""
LEGEND: Final = (
    "may: allowed outcome other than stood; fell: s after the crash; safe: ms from the crash to "
    "HOLD, slowest of the modules not hit; step: N m, largest torque step of these modules then; "
    "back: N m, largest of any module after the request; leads: s from the restart to the last "
    "TRACK; x, y: mm, largest distance of the COM from the middle after the crash"
)

EXAMPLES: Final = """
xrl study crash --quick
xrl study crash --out out/matrix
xrl study crash --only kill-knee_left
xrl study crash --only 'pair-*' --only 'disarmed-*'
"""


class CrashFlags(ConfigFlags):
    """Cases to run."""

    quick: bool = False
    """run one case of each kind; takes less than 5 minutes"""
    only: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """only this case or pattern, such as 'kill-*'; repeatable"""
    list: bool = False
    """only list the cases"""
    out: Annotated[
        Path | None,
        Arg(
            metavar="DIR",
            help=f"folder for {TABLE} and the cases, in which an interrupted study resumes; a case "
            "that fell or was worse than expected keeps its run.mcap (default: out/crash-<time>)",
        ),
    ] = None
    seed: Natural = 0
    """seed of sensor noise, network losses and delays"""


def run(flags: CrashFlags) -> int:
    """Run the matrix; return 0 only if no case was worse than allowed."""
    console = Console()
    cases = select(CASES, quick=flags.quick, only=flags.only)
    if flags.list:
        _print_cases(cases, console)
        return 0
    require("sim")
    robot = experiment.load_robot(flags.config)
    out = flags.out or Path("out") / time.strftime("crash-%Y%m%d-%H%M%S")
    warn_of_others(console)
    inputs = {"study": "crash", "seed": str(flags.seed), "robot": digest_of(robot),
              "code": pool.code_digest()}  # fmt: skip
    with CaseTable(out / TABLE, list(map(row_of, cases)), CrashResult, inputs) as table:
        try:
            _fill(table, cases, robot, flags.seed, out, console)
        except (KeyboardInterrupt, SystemExit, RunError):
            show(table.rows, console)
            console.print(f"stopped; {len(table.rows)} of {len(cases)} cases are in {out}/{TABLE}")
            raise
        rows = table.rows
    show(rows, console)
    console.print(f"{out}/{TABLE}", style="dim", highlight=False, soft_wrap=True)
    return exit_code(rows)


def select(cases: Sequence[CrashCase], *, quick: bool, only: Sequence[str]) -> list[CrashCase]:
    """Return the selected cases, in their original order."""
    for name in only:
        if not any(fnmatchcase(case.name, name) for case in cases):
            near = difflib.get_close_matches(name, [case.name for case in cases], n=3, cutoff=0.4)
            hint = f"perhaps {', '.join(near)}; " if near else ""
            raise RunError(f"--only {name}: no such case; {hint}`xrl study crash --list` lists all")
    return [
        case
        for case in cases
        if (case.quick or not quick)
        and (not only or any(fnmatchcase(case.name, name) for name in only))
    ]


def row_of(case: CrashCase) -> dict[str, object]:
    """Return a case by its columns."""
    return {
        "number": CASES.index(case),
        "name": case.name,
        "what": describe(case),
        "expected": case.expected,
    }


def is_good(row: Mapping[str, Any]) -> bool:
    """Return True if a case was no worse than allowed."""
    order = list(CrashVerdict)
    return order.index(row["verdict"]) <= order.index(row["expected"])


def exit_code(rows: Sequence[Row]) -> int:
    """Return the exit code of the cases that were worse than allowed."""
    return worst(SHOWN[row["verdict"]][0] for row in rows if not is_good(row))


def _fill(
    table: CaseTable,
    cases: Sequence[CrashCase],
    robot: RobotConfig,
    seed: int,
    out: Path,
    console: Console,
) -> None:
    """Run the cases that the table lacks, and write each when it is done."""
    unjudged = 0
    words = "{task.completed}/{task.total}  {task.fields[case]}  {task.fields[now]}"
    with bar(words, console) as progress:
        shown = progress.add_task("", total=len(cases), case="", now="")

        def see(snapshot: LiveSnapshot) -> None:
            if snapshot.truth is not None:
                now_s, modes = max(0.0, snapshot.truth.scenario_s), "".join(snapshot.modes)
                progress.update(
                    shown, now=f"{now_s:4.1f} s {snapshot.truth.torso[2]:.2f} m {modes}"
                )

        for case in cases:
            row = row_of(case)
            if row["number"] not in table.numbers:
                progress.update(shown, case=case.name, now="starting")
                done = table.add(row, run_case(case, robot, out / case.name, see, seed=seed))
                console.print(_line_of(done), highlight=False, soft_wrap=True)
                unjudged = unjudged + 1 if done["verdict"] == CrashVerdict.UNJUDGED else 0
                if unjudged == UNJUDGED_MAX:
                    reason = done["remarks"]
                    raise RunError(f"{UNJUDGED_MAX} cases in a row cannot be judged: {reason}")
            progress.update(shown, advance=1)


def _print_cases(cases: Sequence[CrashCase], console: Console) -> None:
    table = Table(title=f"{len(cases)} cases", title_justify="left")
    table.add_column("name", no_wrap=True)
    table.add_column("at worst")
    table.add_column("why", overflow="fold")
    for case in cases:
        name = marked("{} [dim](quick)[/]", case.name) if case.quick else case.name
        table.add_row(name, Text(case.expected, SHOWN[case.expected][1]), case.why)
    console.print(table)


def _line_of(row: Row) -> Text:
    words = [marked("{} {}", Text(f"{row['verdict'].upper():8}", SHOWN[row["verdict"]][1]),
                    row["name"])]  # fmt: skip
    if not is_good(row):
        words.append(marked("[bold red]expected at worst: {}[/]", row["expected"]))
    if row["remarks"]:
        words.append(Text(row["remarks"], "yellow"))
    return Text(", ").join(words)


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the verdict table, and a summary line below it."""
    table = Table(title="Verdict", title_justify="left", box=None, padding=(0, 1, 0, 0))
    for heading in ("case", "verdict", "may", *(heading for heading, _, _ in COLUMNS)):
        is_text = heading in ("case", "verdict", "may")
        table.add_column(heading, justify="left" if is_text else "right", no_wrap=True)
    for row in rows:
        may = "" if row["expected"] == CrashVerdict.STOOD else str(row["expected"])
        figures = [(row[name], form) for _, name, form in COLUMNS]
        cells = ("" if value is None else f"{value:{form}}" for value, form in figures)
        verdict = Text(row["verdict"], SHOWN[row["verdict"]][1])
        table.add_row(row["name"], verdict, may, *cells)
    console.print(table)
    console.print(LEGEND, style="dim", highlight=False)
    for row in rows:
        if row["remarks"] or not is_good(row):
            console.print(_line_of(row), highlight=False)
    good = sum(map(is_good, rows))
    verdicts = [row["verdict"] for row in rows]
    counts = ", ".join(f"{verdicts.count(one)} {one}" for one in CrashVerdict if one in verdicts)
    colour = "green" if good == len(rows) else "red"
    text = f"[bold {colour}]{{}} of {{}} as expected or better[/]: {{}}"
    console.print(marked(text, good, len(rows), counts), highlight=False)
