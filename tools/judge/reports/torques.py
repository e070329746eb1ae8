"""Joint panels: torques against their limit and by origin, angles, rates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import msgspec
import numpy as np

from services.joint import pd_law
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointCommand, JointState, Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import AXES, MODULES
from tools.judge.reports.page_model import Choice, LevelLine, Line, Lines, Panel, Plot
from tools.judge.reports.panels import NO_STATES
from tools.judge.reports.run_data import RunData

ORIGINS_NOTE: Final = (
    "The origins belong to the command in use, while the service is in TRACK. In HOLD the "
    "service repeats a frozen command, and the log holds only the total."
)


class TorqueTerms(msgspec.Struct):
    """Torques of one module by origin, (n, 2): phi, theta; N m."""

    feedforward: Array
    coupled: Array
    """Coupled torque after scaling."""
    local: Array
    """k_p (q_ref - q) + k_d (v_ref - v), with the gains active at that time."""
    removed: Array
    """Torque that the service sent minus the three others: the part cut by the torque limiter,
    and the part of a step that remains after a service stopped for a while."""


def joints(run: RunData) -> Iterator[Panel]:
    """Yield the panels of the joints."""
    robot = run.robot
    sums: list[Line] = []
    torques: dict[str, Lines] = {}
    angles: dict[str, Lines] = {}
    rates: dict[str, Lines] = {}
    peaks: dict[str, float] = {}
    for number, module in enumerate(MODULES):
        t = run.times(topics.JOINT_STATE, module)
        if not len(t):
            continue
        tau, q, v = run.columns(topics.JOINT_STATE, module, "tau", "q", "v")
        sums.append(Line(module, t, np.abs(tau).sum(axis=1), number))
        found = torque_terms(run, robot, module) if robot is not None else None
        t_ref = run.times(topics.JOINT_COMMAND, module)
        q_ref, v_ref = (run.wide(topics.JOINT_COMMAND, n, 2, module) for n in ("q_ref", "v_ref"))
        for axis, name in enumerate(AXES):
            joint = f"{module}_{name}"
            peaks[joint] = float(np.abs(tau[:, axis]).max())
            most = (
                [] if robot is None else [robot.joint.tau_module_max, -robot.joint.tau_module_max]
            )
            torques[joint] = Lines(_torques(t, tau, found, axis), _levels("limit", most))
            stops = [] if robot is None else robot.joint_limits()[2 * number + axis]
            angles[joint] = Lines(
                [Line("q", t, q[:, axis], 0), Line("q_ref", t_ref, q_ref[:, axis], 1)],
                _levels("soft stop", stops),
            )
            rates[joint] = Lines(
                [Line("v", t, v[:, axis], 0), Line("v_ref", t_ref, v_ref[:, axis], 1)]
            )
    yield Plot(
        "Torque of each module against its limit", "N m",
        "|tau_phi| + |tau_theta|: both motors of a module act along one axis.", NO_STATES,
        lines=sums,
        limits=[] if robot is None else [LevelLine(robot.joint.tau_module_max, "limit")],
    )  # fmt: skip
    note = f"Origins unknown: {run.without_robot}." if robot is None else ORIGINS_NOTE
    hardest = max(peaks, key=lambda joint: peaks[joint], default="")
    for title, unit, choices, words in (
        ("Torque of one joint, by origin", "N m", torques, note),
        ("Angle of one joint", "rad", angles, ""),
        ("Rate of one joint", "rad/s", rates, ""),
    ):
        yield Choice(
            title, unit, words, NO_STATES, group="joint", choices=choices, initial=hardest,
            weight=peaks.get(hardest, 0.0),
        )  # fmt: skip


def _levels(label: str, values: Iterable[float]) -> list[LevelLine]:
    return [LevelLine(value, label, shown=False) for value in values]


def torque_terms(run: RunData, robot: RobotConfig, module: str) -> TorqueTerms:
    """Return the terms of the PD law at each state of a module; NaN where they are unknown.

    They are known in TRACK, after the blend to the commands. They belong to the command that the
    state names, extrapolated by its age as the service does.
    """
    states: list[JointState] = run.log.messages(topics.JOINT_STATE, module)
    commands: list[JointCommand] = run.log.messages(topics.JOINT_COMMAND, module)
    known = {(command.session, command.seq): command for command in commands}
    shape = (len(states), 2)
    found = TorqueTerms(*(np.full(shape, np.nan) for _ in range(4)))
    blend_ns = robot.joint_service.blend_ms * NS_PER_MS
    aging_max_s = robot.joint_service.command_aging_max_ms / 1e3
    tracking_since_ns: int | None = None
    for index, state in enumerate(states):
        if state.mode != Mode.TRACK:
            tracking_since_ns = None
            continue
        if tracking_since_ns is None:
            tracking_since_ns = state.t_ns
        command = known.get((state.session, state.command_seq))
        if command is None or state.t_ns - tracking_since_ns < blend_ns or state.age_ns < 0:
            continue
        age_s = min(state.age_ns / NS_PER_S, aging_max_s)
        used = pd_law.extrapolate(command, age_s)
        found.feedforward[index] = used.tau_ff
        found.coupled[index] = used.tau_coupled
        found.local[index] = pd_law.torque(used, state.q, state.v)
    sent = np.array([state.tau for state in states]).reshape(shape)
    found.local -= found.feedforward + found.coupled
    found.removed = sent - found.feedforward - found.coupled - found.local
    return found


def _torques(t: Array, tau: Array, found: TorqueTerms | None, axis: int) -> list[Line]:
    lines = [Line("total, after the torque limiter", t, tau[:, axis], 0)]
    if found is not None:
        lines += [
            Line("tau_ff", t, found.feedforward[:, axis], 1),
            Line("tau_coupled", t, found.coupled[:, axis], 2),
            Line("local PD", t, found.local[:, axis], 3),
            Line("removed by the service", t, found.removed[:, axis], 5, hidden=True),
        ]
    sibling = f"total of {AXES[1 - axis]}"
    return [*lines, Line(sibling, t, tau[:, 1 - axis], 4, hidden=True, dashed=True)]
