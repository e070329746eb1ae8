"""`xrl log explain`: explains one tick of the law from a run's log."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from services.planner.law.certificate import Weakest
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import (
    JointCommand,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    SplitSource,
    Trip,
    name_of,
)
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import JOINTS, MODULES, N_MODULES
from tools.flags import Arg, Flags, Number, Run
from tools.judge.run_parts import zero_ns
from tools.lab.design.push_limit import PushLimits
from tools.lab.design.torque_breakdown import TorqueBreakdown, torque_breakdown
from tools.logs.impairment_intervals import impairments
from tools.logs.reexecution.planner import BySeq
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, refuse_own_controller, robot_of
from tools.terminal import Console, marked

AWAY_S = 0.1
"""A tick older than this no longer describes the robot at the requested time, s."""
LONG_S: Final = 60.0
"""A longer run is read only within `AROUND_S` of the tick, s."""
AROUND_S: Final = 5.0
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
SPLIT_DESCRIPTION = {
    SplitSource.DIAGONAL: "diag(K_q)",
    SplitSource.SCHEDULE: "certified schedule",
    SplitSource.STIFFENED: "stiffened: the wanted gains do not meet the certificate",
    SplitSource.UNCERTIFIED: "no gains meet the certificate: hold",
}


class Tick(NamedTuple):
    """Tick as recorded in the log."""

    status: PlannerStatus
    commands: Sequence[JointCommand]
    states: list[JointState]
    """States that the tick used."""


EXAMPLES: Final = """
xrl log explain out/a/run.mcap --at 2.5
"""


class ExplainFlags(Flags):
    """Run, and time of the tick."""

    log: Run
    at: Annotated[Number | None, Arg(metavar="T")] = None
    """scenario time, s (default: the end)"""


def run(flags: ExplainFlags) -> int:
    """Print the explanation of one tick."""
    console = Console()
    index = RunIndex(flags.log)
    zero = zero_ns(index)
    log = _read_around(index, zero, flags.at)
    refuse_own_controller(log)
    robot = robot_of(log)
    tick = tick_at(log, flags.at, zero)
    _introduce(log, tick, flags.at, zero, console)
    q, v = (_joined(tick.states, name) for name in ("q", "v"))
    q_ref, v_ref = (_joined(tick.commands, name) for name in ("q_ref", "v_ref"))
    found = torque_breakdown(
        robot, q, v, q_ref, v_ref, tick.status.assist_n, tick.status.slope, tick.status.stance
    )
    found = found._replace(filtered=_joined(tick.commands, "tau_coupled") - found.coupled)
    show(robot, found, console)
    sent = _joined(tick.commands, "tau_ff")
    console.print(
        f"sent and recomputed: margins {tick.status.margin:.2f} and "
        f"{found.local.margins.service:.2f}, feedforward within "
        f"{np.abs(sent - found.gravity - found.assist).max():.2g} N m",
        style="dim",
    )
    return 0


def _read_around(index: RunIndex, zero: int, at_s: float | None) -> RunLog:
    """Read a run; if it is long, only the part around a time, by default its end."""
    if index.length_s <= LONG_S:
        return RunLog(index)
    at_s = (
        index.length_s if at_s is None else at_s + (zero - index.began_ns + index.offset_ns) / 1e9
    )
    at_s = min(max(at_s, 0.0), index.length_s)
    return RunLog(index, RunPart(max(0.0, at_s - AROUND_S), at_s + AROUND_S))


def tick_at(log: RunLog, at_s: float | None, zero_ns: int) -> Tick:
    """Return the planner's last tick at or before a time; by default the last."""
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    led = [row for row in statuses if row.mode != PlannerMode.WAITING]
    if not led:
        raise RunError(f"{log.path}: the planner never ticked with all six states")
    index = len(led) - 1
    if at_s is not None:
        at_ns = zero_ns + round(at_s * 1e9)
        index = bisect.bisect_right([row.t_ns for row in led], at_ns) - 1
        first, last = ((row.t_ns - zero_ns) / 1e9 for row in (led[0], led[-1]))
        if index < 0 or at_s > last + 1.0:
            raise RunError(
                f"--at {at_s:g}: must be within the planner's ticks, {first:.2f} to {last:.2f} s"
            )
    status = led[index]
    sent = [BySeq[JointState](log.messages(topics.JOINT_STATE, module)) for module in MODULES]
    tick = _complete(status, sent)
    if tick is None:
        nearest = min(
            (row.t_ns for row in led if _complete(row, sent) is not None),
            key=lambda t_ns: abs(t_ns - status.t_ns),
            default=None,
        )
        if nearest is None:
            raise RunError(f"{log.path}: contains no tick with all commands and states")
        raise RunError(
            f"{log.path}: a command or a state of the tick at {_seconds(status.t_ns, zero_ns)} is "
            f"missing; the nearest complete tick is at {_seconds(nearest, zero_ns)}"
        )
    return tick


def _complete(status: PlannerStatus, sent: Sequence[BySeq[JointState]]) -> Tick | None:
    """Return a tick with the states that it used; None if the log lacks a part of it."""
    found = (one.at(seq, status.t_ns) for one, seq in zip(sent, status.state_seq, strict=True))
    states = [state for state in found if state is not None]
    if len(states) < N_MODULES or len(status.commands) < N_MODULES:
        return None
    return Tick(status, status.commands, states)


def _seconds(t_ns: int, zero_ns: int) -> str:
    """Return a time in ms, rounded up, so that the last tick until then is the one meant."""
    return f"{-((zero_ns - t_ns) // NS_PER_MS) / 1e3:.3f} s"


def _joined(messages: Sequence[Any], name: str) -> Array:
    return np.array([getattr(message, name) for message in messages], dtype=float).ravel()


def _introduce(log: RunLog, tick: Tick, at_s: float | None, zero_ns: int, console: Console) -> None:
    status = tick.status
    ages = max(status.state_age_ns) / NS_PER_MS
    trip = f" ({name_of(Trip, status.trip)})" if status.trip else ""
    console.print(
        marked(
            "[bold]tick {}[/] at {:.3f} s: planner {}{}{}, states up to {:.1f} ms old, "
            "assist {:.1f} N, IK {} steps, residual {:.1e}",
            status.seq,
            (status.t_ns - zero_ns) / 1e9,
            name_of(PlannerMode, status.mode),
            trip,
            " with hold" if status.hold else "",
            ages,
            status.assist_n,
            status.ik_iterations,
            status.ik_residual,
        )
    )
    words = _modules(tick.states)
    console.print(f"modules, and the age of their commands: {words}", style="dim")
    at_ns = status.t_ns if at_s is None else zero_ns + round(at_s * 1e9)
    late_s = (at_ns - status.t_ns) / 1e9
    if late_s > AWAY_S:
        words = _modules([log.newest(topics.JOINT_STATE, name).at(at_ns) for name in MODULES])
        console.print(
            marked(
                "[yellow]the planner did not tick at {:g} s: its last tick, {:.2f} s earlier, "
                "is shown. The modules at {:g} s: {}[/]",
                at_s,
                late_s,
                at_s,
                words,
            )
        )
    if network := _network(log, at_ns, zero_ns):
        console.print(f"network: {network}", style="yellow", markup=False, highlight=False)


def _modules(states: Sequence[JointState | None]) -> str:
    """Return each module's mode, and the age of its newest command."""
    found = []
    for module, state in zip(MODULES, states, strict=True):
        words = "no state yet"
        if state is not None:
            age = "no command" if state.age_ns < 0 else f"{state.age_ns / NS_PER_MS:.1f} ms"
            words = f"{name_of(Mode, state.mode)} {age}"
        found.append(f"{module} {words}")
    return ", ".join(found)


def _network(log: RunLog, at_ns: int, zero_ns: int) -> str:
    """Return the impairments in force at a monotonic time; "" for a run without impairments."""
    done = impairments(log.messages(topics.LINK_EVENT))
    now = [f"{row.title}, {row.when(zero_ns)}" for row in done if row.at(at_ns)]
    return "; ".join(now) or ("not impaired at this time" if done else "")


def show(robot: RobotConfig, found: TorqueBreakdown, console: Console) -> None:
    """Print the explanation."""
    poses = _table("Body", DIRECTIONS)
    for row, values, digits in (
        ("p: m, rad", found.p, 4), ("p_ref: m, rad", found.p_ref, 4),
        ("pdot: m/s, rad/s", found.pdot, 4), ("F: N, N m", found.F, 1),
    ):  # fmt: skip
        poses.add_row(row, *_numbers(values, digits))
    S = ("led" if s else "held" for s in robot.law.S)
    poses.add_row("S", *S)
    console.print(poses)
    console.print(f"J's singular values: {', '.join(_numbers(found.singular_values, 3))}")
    eigenvalues = np.linalg.eigvalsh(found.K_q)
    console.print(f"K_q's eigenvalues: {eigenvalues[0]:.0f} .. {eigenvalues[-1]:.0f} N m/rad")
    console.print()
    console.print(_gains(found))
    onboard = robot.joint_service.loop == "onboard"
    console.print(
        "Each drive's own loop holds with D averaged over its module; the rest is sent as torque."
        if onboard
        else "The drives get torques only.",
        style="dim",
    )
    console.print(f"local gains: {SPLIT_DESCRIPTION[found.local.source]}")
    for who, weakest in (
        ("joint services alone", found.weakest), ("drives alone", found.weakest_onboard),
    ):  # fmt: skip
        console.print(marked("margin, {}: {}", who, describe(weakest)))
    for name, limits in found.pushes.items():
        console.print(f"push {name}: {_describe_limits(limits)}", highlight=False, soft_wrap=True)
    console.print()
    console.print(_torques(found))


def describe(weakest: Weakest) -> Text:
    """Return, for example, "0.24; weakest: lean forward, 71 N/m of 300"."""
    parts = ", ".join(
        f"{name} {value:.2f}"
        for name, value in zip(DIRECTIONS, weakest.p / np.abs(weakest.p).max(), strict=True)
        if abs(value) > 0.05 * np.abs(weakest.p).max()
    )
    outcome = "" if weakest.margin > 0.0 else ": [red]falls[/]"
    return marked(
        f"{{:.2f}}{outcome}; weakest: {{}}, {{:.0f}} {{}} of {{:.0f}} "
        "(as a motion in m and rad: {})",
        weakest.margin,
        weakest.direction,
        weakest.stiffness,
        weakest.unit,
        weakest.required,
        parts,
    )


def _describe_limits(limits: PushLimits) -> str:
    """Return, for example, "led 72 N (left sole's toe), planner dead 56 N (...), ..."."""
    who = ("led", "planner dead", "drives alone", "soles and motors bear")
    return ", ".join(
        f"{name} {limit.force_n:.0f} N ({limit.part})"
        for name, limit in zip(who, limits, strict=True)
    )


def _gains(found: TorqueBreakdown) -> Table:
    table = _table(
        "Gains, N m/rad and N m s/rad",
        ("K_q", "D: service", "B_q", "D_B: service"),
    )
    K_q, B_q, local = found.K_q.diagonal(), found.B_q.diagonal(), found.local
    for index, joint in enumerate(JOINTS):
        stiffness = np.array((K_q[index], local.D[index]))
        damping = np.array((B_q[index], local.D_B[index]))
        table.add_row(joint, *_numbers(stiffness, 0), *_numbers(damping, 1))
    return table


def _torques(found: TorqueBreakdown) -> Table:
    table = _table(
        "Torques by origin, N m",
        ("gravity", "assist", "local PD", "coupled", "low-pass, push, lead", "total"),
    )
    rows = (found.gravity, found.assist, found.local_pd, found.coupled, found.filtered, found.total)
    for joint, torques in zip(JOINTS, np.array(rows).T, strict=True):
        table.add_row(joint, *_numbers(torques, 2))
    return table


def _table(title: str, columns: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _numbers(values: Array, digits: int) -> list[str]:
    """Return numbers with `digits` decimals; -0 is written as 0."""
    return [f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0]
