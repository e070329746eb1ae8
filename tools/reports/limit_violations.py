"""When a figure first went beyond its limit: where a search for a cause begins. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared import topics
from shared.clock import NS_PER_S
from shared.joints import JOINTS, MODULES
from shared.messages import PlannerMode
from tools.reports.page_model import TimelineEvent
from tools.reports.run_data import RunData
from tools.reports.signals import Array
from tools.runs.verdict import leading
from tools.runs.verdict_limits import LIMITS

TOGETHER_S: Final = 0.1
"""The same of several modules or joints within this time is told in one line."""
LASTING_S: Final = 0.02
"""Torques at their limit for less, all together, are not told."""
AT_LIMIT: Final = 0.999
"""Share of a module's torque limit at which the gate is taken to hold it back."""

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
"""(what, field of `SimTruth`, its place, scale, the verdict's limit while the planner leads, and
while it does not); no limit: not told."""


class Violation(NamedTuple):
    """A stretch of time that began beyond a limit."""

    who: str
    t: float
    """First time beyond it, s."""
    lasts_s: float
    """Time beyond it, all together."""


def limit_violations(run: RunData) -> Iterator[TimelineEvent]:
    """Yield when each figure first went beyond its limit, not in the order of time.

    The limits are the verdict's (docs/results.md#targets) for the world, and the robot file's for
    torques, joints and margins.
    """
    yield from _world(run)
    yield from _torques(run)
    yield from _stops(run)
    yield from _margins(run)


def first_violation(who: str, t: Array, beyond: NDArray[np.bool_]) -> Violation | None:
    """Return when something first was beyond a limit, and for how long in all; None if never.

    Args:
        who: what or whose it is.
        t: times, s, not falling.
        beyond: True where it is, one for each time.
    """
    if not beyond.any():
        return None
    steps = np.append(np.diff(t), 0.0)
    usual = float(np.median(steps[:-1])) if len(steps) > 1 else 0.0
    lasts = float(np.minimum(steps, 5.0 * usual)[beyond].sum())
    return Violation(who, float(t[int(np.argmax(beyond))]), lasts)


def _world(run: RunData) -> Iterator[TimelineEvent]:
    """Tell what the verdict judges, with its limits, over the time that it judges."""
    if run.course is None:
        return
    t = run.course.t
    is_led = leading(run.log, np.round(t * NS_PER_S).astype(np.int64) + run.zero_ns)
    for what, field, place, scale, led, held in WORLD:
        rows = np.array([getattr(row, field) for row in run.course.rows], dtype=np.float64)
        values = np.abs(rows if rows.ndim == 1 else rows[:, place]) * scale
        for key, when, while_ in (
            (led, is_led, "while led"),
            (held, ~is_led, "while not led"),
        ):
            if not key:
                continue
            most, unit = ALLOWED[key]
            found = first_violation(what, t, (values > most) & when)
            if found is not None:
                yield _told([found], f"over {most:g} {unit}, the limit {while_}")


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
        if at_limit is not None and at_limit.lasts_s >= LASTING_S:
            found.append(at_limit)
    for group in _together(found):
        yield _told(group, f"torque at its limit of {most:g} N m")


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
        yield _told(group, "beyond a soft stop")


def _margins(run: RunData) -> Iterator[TimelineEvent]:
    if run.robot is None:
        return
    asked = run.robot.certificate
    mode, service, onboard = run.columns(
        topics.PLANNER_STATUS, "", "mode", "margin", "margin_onboard"
    )
    t = run.times(topics.PLANNER_STATUS)
    for who, values, least in (
        ("margin of the joint services alone", service, asked.margin_min),
        ("margin of the drives alone", onboard, asked.onboard_margin_min),
    ):
        told = (values < least) & ~np.isin(mode, (PlannerMode.WAITING, PlannerMode.MISPLACED))
        found = first_violation(who, t, told)
        if found is not None:
            yield _told([found], f"under {least:g}, down to {values[told].min():.3g}")


def _together(found: Sequence[Violation]) -> list[list[Violation]]:
    """Return what began at about the same time, together."""
    groups: list[list[Violation]] = []
    for one in sorted(found, key=lambda crossing: crossing.t):
        if groups and one.t - groups[-1][0].t <= TOGETHER_S:
            groups[-1].append(one)
        else:
            groups.append([one])
    return groups


def _told(group: Sequence[Violation], what: str) -> TimelineEvent:
    who = ", ".join(one.who for one in group)
    longest = max(one.lasts_s for one in group)
    text = f"{who}: {what}, for the first time; {longest:.2f} s in all"
    return TimelineEvent(group[0].t, "limit", text)
