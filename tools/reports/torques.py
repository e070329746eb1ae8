"""The panels of the joints: torques against their limit and by origin, angles."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec
import numpy as np

from services.joint import pd_law
from shared import topics
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import RobotConfig
from shared.joints import AXES, MODULES
from shared.messages import JointCommand, JointState, Mode
from tools.reports.page_model import LevelLine, Line, PageModel
from tools.reports.run_data import RunData
from tools.reports.signals import Array

Sets: TypeAlias = dict[str, tuple[list[Line], list[LevelLine]]]
"""Lines and levels of each joint."""

NO_STATES: Final = "no joint/*/state in this log"


class TorqueTerms(msgspec.Struct):
    """Torques of one module by where they come from, (n, 2): phi, theta; N m."""

    feedforward: Array
    coupled: Array
    """What was used of it."""
    local: Array
    """k_p (q_ref - q) + k_d (v_ref - v), the gains as stiff as they then were."""
    taken_off: Array
    """What the service sent less these: what the gate cut off, and what is left of a step that
    a service that was frozen did not make."""


def add_joints(run: RunData, model: PageModel) -> None:
    """Add the joints' panels."""
    robot = run.robot
    most = robot.joint.tau_module_max if robot is not None else None
    sums: list[Line] = []
    torques: Sets = {}
    angles: Sets = {}
    rates: Sets = {}
    peaks: dict[str, float] = {}
    for number, module in enumerate(MODULES):
        t = run.times(topics.JOINT_STATE, module)
        if not len(t):
            continue
        tau, q, v = run.columns(topics.JOINT_STATE, module, "tau", "q", "v")
        sums.append(Line(module, t, np.abs(tau).sum(axis=1), number))
        found = torque_terms(run, robot, module) if robot is not None else None
        t_ref, q_ref, v_ref = _references(run, module)
        for axis, name in enumerate(AXES):
            joint = f"{module}_{name}"
            peaks[joint] = float(np.abs(tau[:, axis]).max())
            torques[joint] = (_torques(t, tau, found, axis), _torque_limits(most))
            angles[joint] = (
                [Line("q", t, q[:, axis], 0), Line("q_ref", t_ref, q_ref[:, axis], 1)],
                _stops(run, module, axis),
            )
            rates[joint] = (
                [Line("v", t, v[:, axis], 0), Line("v_ref", t_ref, v_ref[:, axis], 1)],
                [],
            )
    model.plot(
        "Torque of each module against its limit", "N m", sums,
        limits=[LevelLine(most, "limit")] if most is not None else [],
        note="|tau_phi| + |tau_theta|: both motors of a module add up along one axis.",
        if_empty=NO_STATES,
    )  # fmt: skip
    note = (
        "The torque_terms are those of the command in use, while the service tracks it. In HOLD the "
        "service goes on with what it froze, and only the total is in the log."
    )
    if robot is None:
        note = f"Without torque_terms: {run.without_robot}."
    hardest = max(peaks, key=lambda joint: peaks[joint], default="")
    model.choice("Torque of one joint, by origin", "N m", "joint", torques, initial=hardest,
                 note=note, if_empty=NO_STATES)  # fmt: skip
    model.choice("Angle of one joint", "rad", "joint", angles, initial=hardest, if_empty=NO_STATES)
    model.choice("Rate of one joint", "rad/s", "joint", rates, initial=hardest, if_empty=NO_STATES)


def torque_terms(run: RunData, robot: RobotConfig, module: str) -> TorqueTerms:
    """Return the law's terms at each state of a module; NaN where the log does not tell.

    They are those of the command that the state names, aged as the service ages it, and
    only while it tracks, once it has blended over to the commands.
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
    found.taken_off = sent - found.feedforward - found.coupled - found.local
    return found


def _torques(t: Array, tau: Array, found: TorqueTerms | None, axis: int) -> list[Line]:
    lines = [Line("total, after the gate", t, tau[:, axis], 0)]
    if found is not None:
        lines += [
            Line("tau_ff", t, found.feedforward[:, axis], 1),
            Line("tau_coupled", t, found.coupled[:, axis], 2),
            Line("local PD", t, found.local[:, axis], 3),
            Line("taken off by the service", t, found.taken_off[:, axis], 5, hidden=True),
        ]
    sibling = f"total of {AXES[1 - axis]}"
    return [*lines, Line(sibling, t, tau[:, 1 - axis], 4, hidden=True, dashed=True)]


def _torque_limits(most: float | None) -> list[LevelLine]:
    if most is None:
        return []
    return [LevelLine(most, "limit", shown=False), LevelLine(-most, "limit", shown=False)]


def _references(run: RunData, module: str) -> tuple[Array, Array, Array]:
    t = run.times(topics.JOINT_COMMAND, module)
    q_ref, v_ref = run.columns(topics.JOINT_COMMAND, module, "q_ref", "v_ref")
    if q_ref.ndim != 2:
        q_ref = v_ref = np.zeros((0, 2))
    return t, q_ref, v_ref


def _stops(run: RunData, module: str, axis: int) -> list[LevelLine]:
    if run.robot is None:
        return []
    low, high = run.robot.joint_limits()[2 * MODULES.index(module) + axis]
    return [LevelLine(low, "soft stop", shown=False), LevelLine(high, "soft stop", shown=False)]
