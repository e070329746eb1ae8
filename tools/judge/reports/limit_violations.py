"""First time at which each figure exceeds its limit, for the timeline. Pure.

The search for the cause of a fall begins at the earliest violation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import PlannerMode
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, MODULES
from tools.fleet import stalls
from tools.judge.reports.page_model import TimelineEvent
from tools.judge.reports.run_data import RunData
from tools.judge.standing import BY_KEY
from tools.judge.verdict import leading

TOGETHER_S: Final = 0.1
"""Equal violations of several modules or joints within this time share one row."""
TORQUE_DURATION_MIN_S: Final = 0.02
"""Shorter times at the torque limit, in total, are not reported."""
AT_LIMIT: Final = 0.999
"""Fraction of a module's torque limit from which the torque counts as limited."""

TORQUE: Final = "torque at its limit"

WORLD: Final = (
    ("COM x", "com", 0, 1e3, "alive_com_x_max_mm", "hold_com_x_max_mm"),
    ("COM y", "com", 1, 1e3, "alive_com_y_max_mm", "hold_com_y_max_mm"),
    ("roll", "angles", 0, 1.0, "alive_roll_max_rad", ""),
    ("yaw", "angles", 2, 1.0, "alive_yaw_max_rad", ""),
    ("right sole's tilt", "foot_right_tilt", 0, 1.0, "alive_sole_tilt_max_rad", ""),
    ("left sole's tilt", "foot_left_tilt", 0, 1.0, "alive_sole_tilt_max_rad", ""),
    ("operator's force", "operator_force", 2, 1.0, "operator_peak_n", ""),
    ("operator's force sideways", "operator_force", 1, 1.0, "operator_side_peak_n", ""),
)
"""(name, field of `SimTruth`, index in the field, scale, key of the verdict's limit while the
planner leads, key while it does not lead); an empty key: no limit."""


Beyond: TypeAlias = tuple[str, str, Array, NDArray[np.bool_], Array | None]
"""A limit, a figure, its times, where it is beyond; its values if the limit is a lower one."""


class Violation(NamedTuple):
    """Time that one figure spent beyond its limit."""

    what: str
    """The limit."""
    name: str
    """The figure, module or joint."""
    t: float
    """First time beyond the limit, s."""
    duration_s: float
    """Total time beyond the limit."""
    least: float = math.inf
    """Least value, of a figure that has a lower limit."""

    def joined(self, later: Violation) -> Violation:
        """Return it with what a later part of the run has of it."""
        return self._replace(
            duration_s=self.duration_s + later.duration_s, least=min(self.least, later.least)
        )


class LimitViolations:
    """The violations of a run, whose parts are taken one after the other.

    The simulated world has the limits of the verdict (docs/results.md#targets); torques, joints
    and margins have those of the robot file.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], Violation] = {}

    def add(self, run: RunData) -> None:
        """Add a run, or the next part of it."""
        figures = [_world(run)]
        if run.robot is not None:
            figures += [look(run, run.robot) for look in (_torques, _stops, _margins)]
        for what, name, t, passed, values in chain.from_iterable(figures):
            beyond = passed & run.inside(t)
            new = first_violation(what, name, t, beyond)
            if new is None:
                continue
            if values is not None:
                new = new._replace(least=float(values[beyond].min()))
            old = self._found.get((what, name))
            self._found[what, name] = new if old is None else old.joined(new)

    def events(self) -> Iterator[TimelineEvent]:
        """Yield the first violation of each limit; modules and joints that pass it together."""
        found = [
            one
            for one in self._found.values()
            if one.duration_s >= TORQUE_DURATION_MIN_S or not one.what.startswith(TORQUE)
        ]
        rows = [(one.t, one) for one in sorted(found, key=lambda one: (one.what, one.t))]
        for group in together(rows, _shared, TOGETHER_S):
            t, first = group[0]
            names = ", ".join(one.name for _, one in group)
            longest = max(one.duration_s for _, one in group)
            least = min(one.least for _, one in group)
            down = f", down to {least:.3g}" if math.isfinite(least) else ""
            text = f"{names}: {first.what}{down}, for the first time; {longest:.2f} s in total"
            yield TimelineEvent(t, "limit", text)


def _shared(row: tuple[float, Violation]) -> tuple[str, str]:
    """Return what violations that share a row have in common."""
    _, one = row
    return one.what, "" if one.name in (*MODULES, *JOINTS) else one.name


def first_violation(what: str, name: str, t: Array, beyond: NDArray[np.bool_]) -> Violation | None:
    """Return the first time beyond a limit and the total duration; None if there is none.

    The times `t`, s, do not fall; `beyond` is True where the limit is exceeded.
    """
    if not beyond.any():
        return None
    steps = np.append(np.diff(t), 0.0)
    usual = float(np.median(steps[:-1])) if len(steps) > 1 else 0.0
    duration = float(np.minimum(steps, 5.0 * usual)[beyond].sum())
    return Violation(what, name, float(t[int(np.argmax(beyond))]), duration)


def _world(run: RunData) -> Iterator[Beyond]:
    """Yield the figures of the world, over the time that the verdict judges."""
    if run.course is None:
        return
    t = run.course.t + run.at(run.course.zero_ns)
    times_ns = np.array([row.t_ns for row in run.course.rows])
    leads = leading(run.log, times_ns)
    changes = [row for m in MODULES for row in run.log.messages(topics.JOINT_EVENT, m)]
    disturbed = stalls.disturbances(run.log.messages(topics.RUN_EVENT), changes, times_ns[-1])
    stalled = stalls.inside(disturbed, times_ns)
    for name, field, index, scale, leading_key, other_key in WORLD:
        rows = np.array([getattr(row, field) for row in run.course.rows], dtype=np.float64)
        values = np.abs(rows if rows.ndim == 1 else rows[:, index]) * scale
        for key, mask, condition in (
            (leading_key, leads, "while the planner leads"),
            (other_key, ~leads, "while the planner does not lead"),
        ):
            if key:
                row = BY_KEY[key]
                what = f"over {row.limit:g} {row.unit}, the limit {condition}"
                yield what, name, t, (values > row.limit) & mask & ~stalled, None


def _torques(run: RunData, robot: RobotConfig) -> Iterator[Beyond]:
    most = robot.joint.tau_module_max
    for module in MODULES:
        tau = run.wide(topics.JOINT_STATE, "tau", 2, module)
        t = run.times(topics.JOINT_STATE, module)
        at_limit = np.abs(tau).sum(axis=1) >= AT_LIMIT * most
        yield f"{TORQUE} of {most:g} N m", module, t, at_limit, None


def _stops(run: RunData, robot: RobotConfig) -> Iterator[Beyond]:
    limits, armed_s = robot.joint_limits(), run.armed_s()
    for number, joint in enumerate(JOINTS):
        module = MODULES[number // 2]
        t = run.times(topics.JOINT_STATE, module)
        angle = run.wide(topics.JOINT_STATE, "q", 2, module)[:, number % 2]
        low, high = limits[number]
        outside = ((angle < low) | (angle > high)) & (t >= armed_s)
        yield "beyond a soft stop", joint, t, outside, None


def _margins(run: RunData, robot: RobotConfig) -> Iterator[Beyond]:
    certificate = robot.certificate
    mode, service, onboard = run.columns(
        topics.PLANNER_STATUS, "", "mode", "margin", "margin_onboard"
    )
    has_margin = ~np.isin(mode, (PlannerMode.WAITING, PlannerMode.MISPLACED))
    t = run.times(topics.PLANNER_STATUS)
    for name, values, least in (
        ("margin of the joint services alone", service, certificate.margin_min),
        ("margin of the drives alone", onboard, certificate.onboard_margin_min),
    ):
        yield f"under {least:g}", name, t, (values < least) & has_margin, values


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
