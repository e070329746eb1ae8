"""Effect of a robot on its wearer, from any log that has harness, planner and joints.

Definitions (docs/law.md#wearer): f is the upward force and m the moment about pitch of the person
on the robot at the harness. M is the payload with the extra load that the planner found, A the
requested assist. v and omega are the rates of the harness point and of the torso's pitch:

    carried = M g - f          weight of payload and person that the robot carries, N
    asked   = M g + A
    share   = mean(carried) / mean(asked)
    work    = integral of max(0, f v + m omega)      by the person, J
    bump    = |f - f, low-passed by `SLOW_S`| > `BUMP_N` for less than `BUMP_S`
    resting : -f > `RESTS_N` while the robot is still

While the hand leads, its force is part of f.

`thresholds_of` measures what park must know about a person (docs/law.md#park), from a log in which
they stood, squatted and rested. It measures how hard they pull when they lead up, how hard they
pull unintentionally, and how long they pause at the turn of a squat.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, get_type_hints

import msgspec
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from services.planner.law.assist import STILL_RATE_PITCH, STILL_RATE_Z
from services.planner.law.hocca import KNEES
from services.planner.law.kinematics import Kinematics
from services.planner.watch.park import BENT, LASTS_NS, PITCHED
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointState, PlannerMode, PlannerStatus, Wearing, Wrench
from shared.clock import NS_PER_S
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.sections import WearerThresholds
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.logs.run_log import RunLog

SLOW_S: Final = 0.3
BUMP_N: Final = 22.0
"""N; a led squat has peaks of this size."""
BUMP_S: Final = 0.05
RESTS_N: Final = 20.0
SQUATS_MIN: Final = 2
WORK_MIN_S: Final = 5.0
IDLE_MARGIN: Final = 1.25
"""Factor on the largest pull of a person who does not intend to lead."""
PAUSE_MARGIN: Final = 1.25
PAUSE_MAX_S: Final = 2.0
STILL_MIN_S: Final = 0.5
LEADS_FROM_S: Final = 0.4
"""Time before and after a motion that does not count as rest, because the person may pull, s."""
GRID_S: Final = 0.04
"""Rates are differences over this time, s."""
PHASES: Final = ("stand", "down", "work", "up")


class _Phase(msgspec.Struct, frozen=True):
    """Means over the time that the robot spent in a phase."""

    seconds: float
    carried_n: float
    asked_n: float

    @property
    def share(self) -> float:
        """Fraction of payload and assist that the robot carried."""
        return self.carried_n / self.asked_n if self.asked_n else 0.0


class WearerFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a run, or of a part of it."""

    phases: dict[str, _Phase]
    """Figures of each phase that occurred (`PHASES`), and of `all`."""
    work_j: float
    force_rms_n: float
    """Root mean square of the force on the person, all directions."""
    force_peak_n: float
    bumps: int
    bump_peak_n: float
    resting_s: float

    def describe(self) -> str:
        """Return the figures in one line."""
        whole = self.phases["all"]
        each = ", ".join(
            f"{name} {100 * row.share:.0f} %" for name, row in self.phases.items() if name != "all"
        )
        bumps = "no bumps"
        if self.bumps:
            bumps = f"{self.bumps} bump{'s' * (self.bumps > 1)} of up to {self.bump_peak_n:.0f} N"
        return (
            f"The wearer: the robot carried {100 * whole.share:.0f} % of {whole.asked_n:.0f} N "
            f"({each}); force {self.force_rms_n:.1f} N rms, at most {self.force_peak_n:.0f} N, "
            f"{self.work_j:.1f} J of work, {bumps}, {self.resting_s:.1f} s of rest"
        )


class _Motion(NamedTuple):
    """The robot's motion by planner ticks, `GRID_S` apart."""

    t_ns: NDArray[np.int64]
    phase: NDArray[np.intp]
    """Index of `PHASES`."""
    still: NDArray[np.bool_]
    rates: Array
    """(n, 2): harness point, m/s, and pitch, rad/s."""
    turned: Array
    """(n, 2): roll and pitch, rad."""
    load: Array
    """M g, N."""
    assist: Array
    """A, N."""
    led: NDArray[np.bool_]
    """True while the planner leads and the robot is not parked."""


class _Felt(NamedTuple):
    """Measurements of the harness, by its own samples."""

    t: Array
    """s"""
    force: Array
    """(n, 3), N, torso axes."""
    f: Array
    """N, upwards."""
    moment: Array
    """About pitch, N m."""
    at: NDArray[np.intp]
    """Index of the motion at each sample."""


class _MeasuredThresholds(NamedTuple):
    """A person's thresholds for park, and how they were found."""

    thresholds: WearerThresholds
    squats: int
    why: tuple[str, ...]
    """Each threshold with its derivation."""
    doubts: tuple[str, ...]


def thresholds_of(log: RunLog, robot: RobotConfig) -> _MeasuredThresholds:
    """Return a person's thresholds for park, within the ranges of the robot file.

    Args:
        log: a person stood, squatted at least twice, and rested in a crouch, while leading.
        robot: the robot of the log; its `open_back_nm` remains if the torso was never pitched.

    Raises:
        RunError: the log does not contain that motion.
    """
    motion, felt = _read(log, robot)
    if motion is None or felt is None:
        raise RunError(
            f"{log.path}: has no data from harness, planner or joints, or the planner never led"
        )
    led, phase = motion.led, motion.phase
    still = led & motion.still
    rests = _eroded(still, round(LEADS_FROM_S / GRID_S))
    work_s = float(np.count_nonzero(still & (phase == PHASES.index("work")))) * GRID_S
    pauses = _pauses(np.where(led, phase, -1), motion.t_ns / NS_PER_S)
    if len(pauses) < SQUATS_MIN or work_s < WORK_MIN_S:
        raise RunError(
            f"{log.path}: too little motion while led: squats: {len(pauses)}, at least "
            f"{SQUATS_MIN} needed; rest in a crouch: {work_s:.0f} s, at least "
            f"{WORK_MIN_S:.0f} s needed. Record again with park off: stand, squat three times "
            "without stopping, then rest in a crouch"
        )
    up, idle = (led & (phase == PHASES.index("up")))[felt.at], rests[felt.at]
    park, doubts = robot.park, []
    leads_n, rests_n = (_lasting(felt.f, inside, felt.t) for inside in (up, idle))
    open_n = max(leads_n, IDLE_MARGIN * rests_n)
    if rests_n * IDLE_MARGIN > leads_n:
        doubts.append(
            f"this person pulls with up to {rests_n:.0f} N at rest, but leads up with "
            f"{leads_n:.0f} N: with open_n below {open_n:.0f} N, the robot would unpark on its own"
        )
    why = [f"open_n: led up with {leads_n:.1f} N, at rest at most {rests_n:.1f} N"]
    open_back_nm = park.open_back_nm
    if np.ptp(motion.turned[led, 1]) > PITCHED:
        back, idle_back = (_lasting(-felt.moment, inside, felt.t) for inside in (up, idle))
        open_back_nm = max(back, IDLE_MARGIN * idle_back)
        why.append(f"open_back_nm: led back with {back:.1f} N m, at rest {idle_back:.1f} N m")
    else:
        why.append("open_back_nm: as in the robot file; the torso was never pitched")
    why.append(f"still_s: the longest pause at the turn of a squat is {max(pauses):.2f} s")
    return _MeasuredThresholds(
        WearerThresholds(
            open_n=_in_range("open_n", open_n),
            open_back_nm=_in_range("open_back_nm", open_back_nm),
            still_s=_in_range("still_s", max(STILL_MIN_S, PAUSE_MARGIN * max(pauses))),
        ),
        len(pauses), tuple(why), tuple(doubts),
    )  # fmt: skip


def _eroded(inside: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return True for samples that, with `by` neighbours on each side, are all inside."""
    padded = np.pad(inside, by, constant_values=True)
    return np.asarray(sliding_window_view(padded, 2 * by + 1).all(axis=1))


def _in_range(key: str, value: float) -> float:
    """Return a rounded threshold, within its range of the robot file."""
    hint = get_type_hints(WearerThresholds, include_extras=True)[key]
    low, high, _ = hint.__metadata__[0]
    return float(round(min(high, max(low, value)), 2))


def _lasting(values: Array, inside: NDArray[np.bool_], t: Array) -> float:
    """Return the largest value that lasts as long as an input that unparks; at least 0."""
    width = max(1, round(LASTS_NS / NS_PER_S / float(np.median(np.diff(t)))))
    kept = np.where(inside, values, 0.0)
    if len(kept) < width:
        return 0.0
    return max(0.0, float(sliding_window_view(kept, width).min(axis=1).max()))


def _pauses(phase: NDArray[np.intp], t: Array) -> list[float]:
    """Return the duration of the still crouch between each way down and the way up, s.

    A longer stay than `PAUSE_MAX_S` does not count as a turn.
    """
    down, work, rise = (PHASES.index(name) for name in ("down", "work", "up"))
    bounds = np.flatnonzero(np.diff(phase, prepend=-2))
    runs = [(int(phase[i]), float(t[i])) for i in bounds]
    runs.append((-1, float(t[-1])))
    found = []
    for (before, _), (now, from_s), (after, to_s) in zip(runs, runs[1:], runs[2:], strict=False):
        if (before, now, after) == (down, work, rise) and to_s - from_s < PAUSE_MAX_S:
            found.append(to_s - from_s)
        elif (now, after) == (down, rise):
            found.append(0.0)
    return found


def wearer_figures(log: RunLog, robot: RobotConfig, from_ns: int = 0) -> WearerFigures | None:
    """Return the figures from a time on, or from when the planner first led; None without data.

    Args:
        log: the run, or a part of it.
        robot: the robot of the log.
        from_ns: monotonic time; 0 for the first time that the planner leads in it.
    """
    motion, felt = _read(log, robot, from_ns)
    if motion is None or felt is None:
        return None
    t, at, f, moment, force = felt.t, felt.at, felt.f, felt.moment, felt.force
    dt = np.minimum(np.diff(t, append=t[-1]), GRID_S)
    power = f * motion.rates[at, 0] + moment * motion.rates[at, 1]
    size = np.linalg.norm(force, axis=1)
    bumps = _bumps(f, t)
    carried, asked = motion.load[at] - f, motion.load[at] + motion.assist[at]
    return WearerFigures(
        phases=_by_phase(motion.phase[at], dt, carried, asked),
        work_j=float(np.maximum(0.0, power) @ dt),
        force_rms_n=float(np.sqrt(np.average(size * size, weights=dt))),
        force_peak_n=float(size.max()),
        bumps=len(bumps),
        bump_peak_n=max(bumps, default=0.0),
        resting_s=float(dt[(-f > RESTS_N) & motion.still[at]].sum()),
    )


def _read(log: RunLog, robot: RobotConfig, from_ns: int = 0) -> tuple[_Motion | None, _Felt | None]:
    """Return the robot's motion and the harness data; None where the log has no data."""
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    leads = (row.t_ns for row in statuses if row.mode == PlannerMode.LEADING)
    from_ns = from_ns or next(leads, 1 << 62)
    wrenches: list[Wrench] = [
        row
        for row in log.messages(topics.WRENCH)
        if row.valid and row.t_ns >= from_ns and log.holds(row.t_ns)
    ]
    motion = _motion(log, robot, [row for row in statuses if row.t_ns >= from_ns])
    if motion is None or len(wrenches) < 2:
        return motion, None
    t_ns = np.array([row.t_ns for row in wrenches])
    at = np.clip(np.searchsorted(motion.t_ns, t_ns, side="right") - 1, 0, None)
    force = np.array([row.force for row in wrenches])
    moment = np.array([row.moment[1] for row in wrenches])
    roll, pitch = motion.turned[at].T
    x, y, z = force.T
    f = np.sin(roll) * y + np.cos(roll) * (z * np.cos(pitch) - x * np.sin(pitch))
    return motion, _Felt((t_ns - from_ns) / NS_PER_S, force, f, moment, at)


def merged_figures(parts: Sequence[WearerFigures]) -> WearerFigures:
    """Return the figures of a run from those of its parts."""
    seconds = [row.phases["all"].seconds for row in parts]
    square = sum(s * row.force_rms_n**2 for s, row in zip(seconds, parts, strict=True))
    phases = {
        name: _mean([row.phases[name] for row in parts if name in row.phases])
        for name in ("all", *PHASES)
        if any(name in row.phases for row in parts)
    }
    return WearerFigures(
        phases=phases,
        work_j=sum(row.work_j for row in parts),
        force_rms_n=float(np.sqrt(square / sum(seconds))),
        force_peak_n=max(row.force_peak_n for row in parts),
        bumps=sum(row.bumps for row in parts),
        bump_peak_n=max(row.bump_peak_n for row in parts),
        resting_s=sum(row.resting_s for row in parts),
    )


def _mean(rows: Sequence[_Phase]) -> _Phase:
    seconds = sum(row.seconds for row in rows)
    carried = sum(row.seconds * row.carried_n for row in rows) / seconds
    return _Phase(seconds, carried, sum(row.seconds * row.asked_n for row in rows) / seconds)


def _by_phase(
    phase: NDArray[np.intp], dt: Array, carried: Array, asked: Array
) -> dict[str, _Phase]:
    found = {}
    for name, inside in (
        ("all", np.full(len(phase), True)),
        *((name, phase == index) for index, name in enumerate(PHASES)),
    ):
        seconds = float(dt[inside].sum())
        if seconds > 0.0:
            means = [float(np.average(row[inside], weights=dt[inside])) for row in (carried, asked)]
            found[name] = _Phase(seconds, *means)
    return found


def _motion(log: RunLog, robot: RobotConfig, statuses: Sequence[PlannerStatus]) -> _Motion | None:
    every = max(1, round(GRID_S * robot.planner.rate_hz))
    rows = statuses[::every]
    states = [log.newest(topics.JOINT_STATE, module) for module in MODULES]
    poses = [[one.at(row.t_ns) for one in states] for row in rows]
    known = [i for i, pose in enumerate(poses) if None not in pose]
    if len(known) < 3:
        return None
    rows = [rows[i] for i in known]
    kinematics, heights, knees = Kinematics(robot), [], []
    for i, row in zip(known, rows, strict=True):
        seen: list[JointState | None] = poses[i]
        q = np.array([state.q for state in seen if state is not None]).ravel()
        kinematics.stance[:] = row.stance
        kinematics.update(q)
        heights.append(float(kinematics.r_harness[2]))
        knees.append(max(q[list(KNEES)]))
    t_ns = np.array([row.t_ns for row in rows])
    p, pdot = np.array([row.p for row in rows]), np.array([row.pdot for row in rows])
    up = np.gradient(np.array(heights), t_ns / NS_PER_S)
    still = (np.abs(pdot[:, 2]) <= STILL_RATE_Z) & (np.abs(pdot[:, 4]) <= STILL_RATE_PITCH)
    works = (np.array(knees) < BENT) | (p[:, 4] > PITCHED)
    falls = np.where(np.abs(pdot[:, 2]) > STILL_RATE_Z, pdot[:, 2] < 0.0, pdot[:, 4] > 0.0)
    stand, down, work, rise = range(len(PHASES))
    phase = np.where(still, np.where(works, work, stand), np.where(falls, down, rise))
    led = [row.mode == PlannerMode.LEADING and row.wearer == Wearing.LEADS for row in rows]
    kg = robot.mass.payload + np.array([row.load[0] for row in rows])
    return _Motion(
        t_ns=t_ns,
        phase=phase,
        still=still,
        rates=np.stack([up, pdot[:, 4]], axis=1),
        turned=p[:, 3:5],
        load=GRAVITY * kg,
        assist=np.array([row.assist_requested_n for row in rows]),
        led=np.array(led),
    )


def _bumps(f: Array, t: Array) -> list[float]:
    """Return the size of each bump, N."""
    slow, fast = float(f[0]), np.zeros(len(f))
    for index, (value, dt) in enumerate(zip(f.tolist(), np.diff(t, prepend=t[0]), strict=True)):
        slow += min(1.0, dt / SLOW_S) * (value - slow)
        fast[index] = value - slow
    edges = np.diff(np.concatenate(([0], (np.abs(fast) > BUMP_N).astype(int), [0])))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [
        float(np.abs(fast[begin:end]).max())
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)
        if t[end - 1] - t[begin] < BUMP_S
    ]
