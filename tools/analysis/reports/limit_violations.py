"""First time at which each figure exceeds its limit, for the timeline. Pure.

The search for the cause of a fall begins at the earliest violation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.bus import topics
from shared.bus.messages import PlannerMode
from shared.clock import NS_PER_S
from shared.robot.joints import JOINTS, MODULES
from tools.analysis.reports.page_model import TimelineEvent
from tools.analysis.reports.run_data import RunData
from tools.analysis.reports.signals import Array
from tools.runs.verdict import leading
from tools.runs.verdict_limits import LIMITS

TOGETHER_S: Final = 0.1
"""Equal violations of several modules or joints within this time share one row."""
TORQUE_DURATION_MIN_S: Final = 0.02
"""Shorter times at the torque limit, in total, are not reported."""
AT_LIMIT: Final = 0.999
"""Fraction of a module's torque limit from which the torque counts as limited."""

ALLOWED: Final = {row.key: (row.limit, row.unit) for row in LIMITS}
WORLD: Final = (
    ("COM x", "com", 0, 1e3, "alive_com_x_max_mm", "hold_com_x_max_mm"),
    ("COM y", "com", 1, 1e3, "alive_com_y_max_mm", "hold_com_y_max_mm"),
    ("roll", "angles", 0, 1.0, "alive_roll_max_rad", ""),
    ("yaw", "angles", 2, 1.0, "alive_yaw_max_rad", ""),
    ("right sole's tilt", "foot_right_tilt", 0, 1.0, "alive_sole_tilt_max_rad", ""),
    ("left sole's tilt", "foot_left_tilt", 0, 1.0, "alive_sole_tilt_max_rad", ""),
    ("operator's force", "operator_force", 2, 1.0, "operator_peak_n", ""),
)
"""(name, field of `SimTruth`, index in the field, scale, key of the verdict's limit while the
planner leads, key while it does not lead); an empty key: no limit."""


class Violation(NamedTuple):
    """Time that one figure spent beyond its limit."""

    name: str
    t: float
    """First time beyond the limit, s."""
    duration_s: float
    """Total time beyond the limit."""


def limit_violations(run: RunData) -> Iterator[TimelineEvent]:
    """Yield the first violation of each limit, in no order.

    The simulated world has the limits of the verdict (docs/results.md#targets); torques, joints
    and margins have those of the robot file.
    """
    yield from _world(run)
    yield from _torques(run)
    yield from _stops(run)
    yield from _margins(run)


def first_violation(name: str, t: Array, beyond: NDArray[np.bool_]) -> Violation | None:
    """Return the first time beyond a limit and the total duration; None if there is none.

    Args:
        name: the figure, module or joint.
        t: times, s, not falling.
        beyond: True where the limit is exceeded; one for each time.
    """
    if not beyond.any():
        return None
    steps = np.append(np.diff(t), 0.0)
    usual = float(np.median(steps[:-1])) if len(steps) > 1 else 0.0
    duration = float(np.minimum(steps, 5.0 * usual)[beyond].sum())
    return Violation(name, float(t[int(np.argmax(beyond))]), duration)


def _world(run: RunData) -> Iterator[TimelineEvent]:
    """Yield violations of the verdict's limits, over the time that the verdict judges."""
    if run.course is None:
        return
    t = run.course.t
    leads = leading(run.log, np.round(t * NS_PER_S).astype(np.int64) + run.zero_ns)
    for name, field, index, scale, leading_key, other_key in WORLD:
        rows = np.array([getattr(row, field) for row in run.course.rows], dtype=np.float64)
        values = np.abs(rows if rows.ndim == 1 else rows[:, index]) * scale
        for key, mask, condition in (
            (leading_key, leads, "while the planner leads"),
            (other_key, ~leads, "while the planner does not lead"),
        ):
            if not key:
                continue
            most, unit = ALLOWED[key]
            found = first_violation(name, t, (values > most) & mask)
            if found is not None:
                yield _event([found], f"over {most:g} {unit}, the limit {condition}")


def _torques(run: RunData) -> Iterator[TimelineEvent]:
    if run.robot is None:
        return
    most = run.robot.joint.tau_module_max
    found = []
    for module in MODULES:
        (tau,) = run.columns(topics.JOINT_STATE, module, "tau")
        if not len(tau):
            continue
        t = run.times(topics.JOINT_STATE, module)
        at_limit = first_violation(module, t, np.abs(tau).sum(axis=1) >= AT_LIMIT * most)
        if at_limit is not None and at_limit.duration_s >= TORQUE_DURATION_MIN_S:
            found.append(at_limit)
    for group in _together(found):
        yield _event(group, f"torque at its limit of {most:g} N m")


def _stops(run: RunData) -> Iterator[TimelineEvent]:
    if run.robot is None:
        return
    found = []
    limits = run.robot.joint_limits()
    armed_s = run.armed_s()
    for number, joint in enumerate(JOINTS):
        module = MODULES[number // 2]
        (q,) = run.columns(topics.JOINT_STATE, module, "q")
        if not len(q):
            continue
        low, high = limits[number]
        angle = q[:, number % 2]
        t = run.times(topics.JOINT_STATE, module)
        outside = (angle < low) | (angle > high)
        at_stop = first_violation(joint, t, outside & (t >= armed_s))
        if at_stop is not None:
            found.append(at_stop)
    for group in _together(found):
        yield _event(group, "beyond a soft stop")


def _margins(run: RunData) -> Iterator[TimelineEvent]:
    if run.robot is None:
        return
    certificate = run.robot.certificate
    mode, service, onboard = run.columns(
        topics.PLANNER_STATUS, "", "mode", "margin", "margin_onboard"
    )
    t = run.times(topics.PLANNER_STATUS)
    has_margin = ~np.isin(mode, (PlannerMode.WAITING, PlannerMode.MISPLACED))
    for name, values, least in (
        ("margin of the joint services alone", service, certificate.margin_min),
        ("margin of the drives alone", onboard, certificate.onboard_margin_min),
    ):
        below = (values < least) & has_margin
        found = first_violation(name, t, below)
        if found is not None:
            yield _event([found], f"under {least:g}, down to {values[below].min():.3g}")


def _together(found: Sequence[Violation]) -> list[list[Violation]]:
    """Group violations that began at about the same time."""
    groups: list[list[Violation]] = []
    for one in sorted(found, key=lambda violation: violation.t):
        if groups and one.t - groups[-1][0].t <= TOGETHER_S:
            groups[-1].append(one)
        else:
            groups.append([one])
    return groups


def _event(group: Sequence[Violation], what: str) -> TimelineEvent:
    names = ", ".join(one.name for one in group)
    longest = max(one.duration_s for one in group)
    text = f"{names}: {what}, for the first time; {longest:.2f} s in total"
    return TimelineEvent(group[0].t, "limit", text)
