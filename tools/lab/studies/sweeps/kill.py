"""`xrl study kill`: kills the planner at random times, in random postures and under pushes.

The seed and the number of a case determine it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import msgspec
import numpy as np
from rich.progress import track

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import JointEvent, PlannerStatus, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS
from shared.config import gain_schedule
from shared.config.gain_table import GainSchedule
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from shared.extras import require
from shared.joints import MODULES
from shared.robot.robot_model import stand_pose
from tools.flags import Count
from tools.fleet.stalls import goes_to_hold
from tools.lab.design import split_program
from tools.lab.studies.sweeps import plants, pool, study
from tools.lab.studies.sweeps.figures import (
    NOBODY,
    CaseRun,
    Ended,
    Ending,
    Observer,
    com_max_mm,
    event_steps_nm,
    operator_peak_n,
    parted,
    run_fleet,
    scalars,
    sole_tilt_max_rad,
)
from tools.lab.studies.sweeps.plants import DIGITS, SHARE, PushFlags, PushRange, uniform
from tools.lab.studies.sweeps.study import FALL_COLOUR, Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.live.experiment import LawFlags
from tools.output import Picture, new_figure
from tools.sim.lockstep import Lockstep
from tools.terminal import Console

PAYLOADS: Final = 5
"""Number of payloads, evenly spaced from 0 to `mass.payload_max`; each needs its own gain
schedule."""
HEIGHT: Final = (0.79, 1.2)
"""m, torso above the ankles: from the crawl to standing."""
HEIGHT_UPRIGHT: Final = (0.85, 1.2)
"""m; for a squat with an upright torso."""
PITCH_MAX: Final = 1.2
"""rad, as in the crawl."""
LIMIT_MARGIN: Final = 0.05
"""Minimum distance of a posture from the joint limits, rad."""
PACE: Final = (0.8, 1.6)
"""Range of the factor on `SPEED`."""
SPEED: Final = (0.1, 0.24, 40.0)
"""m/s, rad/s, N/s: mean speeds of the squat (height) and of the crawl (pitch, assist)."""
LEG_MIN_S: Final = 1.0
START_S: Final = 0.5
"""Time that the robot stands still before it is led, s."""
STILL_S: Final = (0.3, 1.0)
"""Range of times that the robot stands still before the kill, if the case is not `moving`, s."""
LET_GO_S: Final = 1.0
"""Maximum time from letting go to the kill, s."""
PUSH_SHARE: Final = (0.1, 1.0)
"""Range of the drawn pushes, as fractions of the largest one (`PushRange`)."""
PUSH_S: Final = 0.3
PUSHES_MAX: Final = 3
PUSH_COLUMNS: Final = ("at_s", "x_n", "y_n")
POSES_MAX: Final = 2
AFTER_KILL_S: Final = 3.0
AFTER_PUSH_S: Final = 1.7
AFTER_LEAD_S: Final = 2.0
"""Time for which a case continues after the kill, the last push and, with the hand on, the end of
the way, s. An operator who keeps leading a holding robot tips it slowly."""
DELAY_MAX_MS: Final = 20.0


class KillCase(msgspec.Struct, frozen=True, kw_only=True):
    """A drawn case. SI units; times are the scenario's."""

    number: int
    seed: int
    payload_kg: float
    way: tuple[Keyframe, ...]
    """Standing, then one or two poses to which the operator leads."""
    pace: float
    moving: bool
    """True if killed on the way to the last pose, False if killed after it was reached."""
    way_end_s: float
    """Time at which the operator reaches the last pose, with the hand on."""
    kill_s: float
    let_go_s: float | None
    """Time at which the operator takes the hand off, or None. The resting weight stays."""
    delay_ms: float
    pushes: tuple[Push, ...]

    @property
    def end_s(self) -> float:
        """End of the case, when no effect is left to wait for."""
        quiet = [push.at + push.duration + AFTER_PUSH_S for push in self.pushes]
        if self.let_go_s is None:
            quiet.append(self.way_end_s + AFTER_LEAD_S)
        return max([self.kill_s + AFTER_KILL_S, *quiet])

    def scenario(self, _robot: RobotConfig) -> Scenario:
        """Return the case as a scenario, which does not include letting go."""
        return Scenario(
            name=f"kill-{self.seed}-{self.number}",
            about=f"case {self.number} of `xrl study kill --seed {self.seed}`",
            duration=self.end_s,
            keyframe=self.way,
            kill=(Kill(service="planner", at=self.kill_s),),
            push=self.pushes,
        )

    def true_plant(self) -> PlantConfig:
        """Return the simulated robot, with all errors drawn at random."""
        return plants.draw(f"kill {self.seed} {self.number}")


def payloads(robot: RobotConfig) -> tuple[float, ...]:
    """Return the payloads to draw from, kg."""
    highest = robot.mass.payload_max
    return tuple(round(highest * i / (PAYLOADS - 1), DIGITS) for i in range(PAYLOADS))


def with_payload(robot: RobotConfig, payload: float) -> RobotConfig:
    """Return the robot with another payload, kg; its gain schedule may then be stale."""
    mass = msgspec.structs.replace(robot.mass, payload=payload)
    return msgspec.structs.replace(robot, mass=mass)


class KillCases:
    """The cases of a robot."""

    def __init__(self, robot: RobotConfig, push: float = SHARE) -> None:
        """Store the robot, and the largest push as a fraction of what the body withstands."""
        self._robot, self._push = robot, push
        self._by_payload: dict[float, tuple[RobotConfig, PushRange]] = {}

    def draw(self, seed: int, number: int) -> KillCase:
        """Return one case, which does not depend on any other case."""
        dice = random.Random(f"kill {seed} {number}")
        payload = dice.choice(payloads(self._robot))
        loaded, pushes = self._of(payload)
        poses = [_draw_pose(dice, loaded) for _ in range(dice.choice((1, 1, POSES_MAX)))]
        pace = uniform(dice, *PACE)
        way = _way(self._robot, poses, pace)
        begin, end = way[-2].at, way[-1].at
        moving = dice.random() < 0.5
        kill = uniform(dice, *((begin, end) if moving else (end + STILL_S[0], end + STILL_S[1])))
        hand_off = dice.random() < 0.5
        at_the_kill = dice.random() < 0.5
        let_go = None
        if hand_off:
            let_go = kill if at_the_kill else uniform(dice, max(0.0, kill - LET_GO_S), kill)
        return KillCase(
            number=number,
            seed=seed,
            payload_kg=payload,
            way=way,
            pace=pace,
            moving=moving,
            way_end_s=end,
            kill_s=kill,
            let_go_s=let_go,
            delay_ms=uniform(dice, 0.0, DELAY_MAX_MS),
            pushes=tuple(_draw_pushes(dice, kill, pushes)),
        )

    def _of(self, payload: float) -> tuple[RobotConfig, PushRange]:
        if payload not in self._by_payload:
            loaded = with_payload(self._robot, payload)
            self._by_payload[payload] = loaded, PushRange(loaded, self._push)
        return self._by_payload[payload]


def _draw_pose(dice: random.Random, robot: RobotConfig) -> tuple[float, float, float]:
    """Draw height and pitch within reach, and in half of the cases a resting weight."""
    while True:
        upright = dice.random() < 0.5
        height = uniform(dice, *(HEIGHT_UPRIGHT if upright else HEIGHT))
        pitch = 0.0 if upright else uniform(dice, 0.0, PITCH_MAX)
        if reachable(robot, height, pitch):
            break
    resting = dice.random() < 0.5
    return height, pitch, uniform(dice, 0.0, robot.assist.force_max) if resting else 0.0


def _draw_pushes(dice: random.Random, kill_s: float, drawn_from: PushRange) -> list[Push]:
    """Draw pushes around and after the kill, without overlap."""
    count = dice.randint(1, PUSHES_MAX)
    around = dice.random() < 0.3
    early, late = (-0.5, 0.05) if around else (0.1, 0.8)
    at = uniform(dice, kill_s + early, kill_s + late)
    pushes = []
    for _ in range(count):
        pushes.append(drawn_from.draw(dice, PUSH_SHARE, at, PUSH_S))
        at = uniform(dice, at + PUSH_S + 0.2, at + PUSH_S + 0.9)
    return pushes


def reachable(robot: RobotConfig, height: float, pitch: float) -> bool:
    """Return True if the pose, with the COM over the ankles, is within the joint limits.

    The torso's masses are at its origin, so its pitch moves only the hips, not the COM.
    """
    pose = list(stand_pose(robot, height))
    for hip in (5, 11):
        pose[hip] += pitch
    return all(
        low + LIMIT_MARGIN <= angle <= high - LIMIT_MARGIN
        for angle, (low, high) in zip(pose, robot.joint_limits(), strict=True)
    )


def _way(
    robot: RobotConfig, poses: Sequence[tuple[float, float, float]], pace: float
) -> tuple[Keyframe, ...]:
    """Return a path from standing through the poses (height, pitch, assist), in order."""
    way = [Keyframe(at=START_S, height=robot.simulation.stand_height)]
    for pose in poses:
        last = way[-1]
        before = last.height, last.pitch, last.assist
        times = [abs(b - a) / speed for a, b, speed in zip(before, pose, SPEED, strict=True)]
        at = round(last.at + max(LEG_MIN_S, max(times) / pace), DIGITS)
        way.append(Keyframe(at, pose[0], pitch=pose[1], assist=pose[2]))
    return tuple(way)


def row_of(case: KillCase) -> dict[str, object]:
    """Return every draw by its column; None for draws that the case lacks."""
    row = scalars(case) | {"moving": int(case.moving)}
    units = {"height": "m", "pitch": "rad", "assist": "n"}
    for index in range(1, POSES_MAX + 1):
        pose = case.way[index] if index < len(case.way) else None
        row |= {f"pose{index}_{key}_{unit}": getattr(pose, key, None)
                for key, unit in units.items()}  # fmt: skip
    for index in range(PUSHES_MAX):
        push = case.pushes[index] if index < len(case.pushes) else None
        values = (push.at, *push.force[:2]) if push else (None,) * 3
        names = (f"push{index + 1}_{name}" for name in PUSH_COLUMNS)
        row |= dict(zip(names, values, strict=True))
    return row


class _KillResult(Ended, frozen=True, kw_only=True):
    """The figures of a case; None where nothing was measured.

    "After" is the time from the kill, "before" from the scenario's start to the kill.
    """

    kill_height_m: float | None = None
    """Height of the torso at the kill."""
    kill_pitch_rad: float | None = None
    kill_margin: float | None = None
    """Margin of the last commands (docs/law.md#certificate)."""
    kill_margin_onboard: float | None = None
    holds_before: int = 0
    """Dropouts from TRACK of the module with the most, while the planner is alive."""
    operator_peak_before_n: float | None = None
    """Vertical force of the hand."""
    com_before_max_mm: float | None = None
    """Largest horizontal distance of the COM from midway between the ankles."""
    hold_ms: float | None = None
    """Time from the kill to HOLD, slowest module; None if a module already held."""
    torque_step_nm: float | None = None
    """Largest step of a joint's torque at the hand-over."""
    foot_load_min_n: float | None = None
    """Smallest normal force under either foot after the kill."""
    com_x_min_mm: float | None = None
    com_x_max_mm: float | None = None
    com_y_min_mm: float | None = None
    com_y_max_mm: float | None = None
    com_max_mm: float | None = None
    roll_max_rad: float | None = None
    yaw_max_rad: float | None = None
    sole_tilt_max_rad: float | None = None
    slip_max_mm: float | None = None
    """Largest distance of an ankle from its initial position, mm."""


def run_case(case: KillCase, robot: RobotConfig, observer: Observer = NOBODY) -> _KillResult:
    """Run a case to its end or to the fall, and measure it.

    The robot has the case's payload and a gain schedule that fits (`robots_of`).
    """

    def let_go_in_time(fleet: Lockstep, row: SimTruth) -> None:
        if case.let_go_s is not None and row.scenario_s >= case.let_go_s:
            fleet.world.let_go()

    network = Impairment(delay_ms=case.delay_ms)
    run = run_fleet(
        case, robot, observer, network, seed=case.number, kept=(PlannerStatus, RunEvent),
        each=let_go_in_time,
    )  # fmt: skip
    return measure(case, run, robot)


def measure(case: KillCase, run: CaseRun, robot: RobotConfig) -> _KillResult:
    """Return the figures of a run."""
    rows, events, _ = run
    figures = run.ended(case.end_s, robot)
    if not run.began:
        return _KillResult(**figures)
    before = [row for row in rows if row.scenario_s < case.kill_s]
    if before:
        figures["operator_peak_before_n"] = operator_peak_n(before)
        figures["com_before_max_mm"] = com_max_mm(before)
    killed = [m.t_ns for _, m in run.messages
              if isinstance(m, RunEvent) and m.kind == RunEventKind.KILLED]  # fmt: skip
    after = [row for row in rows if row.scenario_s >= case.kill_s]
    if after and killed:
        figures |= _after(after) | _handover(events, killed[0])
    statuses = [message for _, message in run.messages if isinstance(message, PlannerStatus)]
    if statuses:
        figures["kill_margin"] = statuses[-1].margin
        figures["kill_margin_onboard"] = statuses[-1].margin_onboard
    until_ns = killed[0] if killed else rows[-1].t_ns
    return _KillResult(holds_before=_drop_outs(events, rows[0].t_ns, until_ns), **figures)


def _after(rows: Sequence[SimTruth]) -> dict[str, float]:
    x, y = 1e3 * np.array([row.over for row in rows]).T
    return {
        "kill_height_m": rows[0].torso[2],
        "kill_pitch_rad": rows[0].angles[1],
        "com_x_min_mm": float(x.min()),
        "com_x_max_mm": float(x.max()),
        "com_y_min_mm": float(y.min()),
        "com_y_max_mm": float(y.max()),
        "com_max_mm": com_max_mm(rows),
        "foot_load_min_n": min(
            min(row.foot_right_force[2], row.foot_left_force[2]) for row in rows
        ),
        "roll_max_rad": max(abs(row.angles[0]) for row in rows),
        "yaw_max_rad": max(abs(row.angles[2]) for row in rows),
        "sole_tilt_max_rad": sole_tilt_max_rad(rows),
        "slip_max_mm": 1e3 * max(row.feet_slip for row in rows),
    }


def _drop_outs(events: Sequence[tuple[str, JointEvent]], from_ns: int, to_ns: int) -> int:
    count = dict.fromkeys(MODULES, 0)
    for module, event in events:
        count[module] += from_ns <= event.t_ns < to_ns and goes_to_hold(event)
    return max(count.values())


def _handover(events: Sequence[tuple[str, JointEvent]], kill_ns: int) -> dict[str, float]:
    late = {m: e for m, e in reversed(events) if e.t_ns >= kill_ns and goes_to_hold(e)}
    figures = {}
    if len(late) == len(MODULES):
        figures["hold_ms"] = max(event.t_ns - kill_ns for event in late.values()) / NS_PER_MS
    if late:
        figures["torque_step_nm"] = max(event_steps_nm(late.values()))
    return figures


def robots_of(
    cases: Sequence[KillCase], robot: RobotConfig, workers: int, console: Console
) -> list[RobotConfig]:
    """Return the robot with the payload of each case, and a gain schedule that fits.

    A certified schedule depends on the payload and takes seconds to compute, so several processes
    compute them.

    Raises:
        RunError: no local gains meet the certificate with a payload; names it.
        MissingPackageError: a schedule is missing, and CVXPY is not installed.
    """
    weights = sorted({case.payload_kg for case in cases})
    ready = {weight: with_payload(robot, weight) for weight in weights}
    certified = robot.law.split == "certified"
    tasks = [weight for weight in weights if certified and gain_schedule.why_stale(ready[weight])]
    if tasks:
        require("design")
        solved = pool.results(
            _solve,
            [ready[weight] for weight in tasks],
            workers,
            lambda one: f"gain schedule with a payload of {one.mass.payload:g} kg",
        )
        for loaded, schedule in track(
            solved, "gain schedules", total=len(tasks), console=console, transient=True
        ):
            made = msgspec.structs.replace(loaded, gain_schedule=schedule)
            ready[loaded.mass.payload] = made
    return [ready[case.payload_kg] for case in cases]


def _solve(robot: RobotConfig) -> GainSchedule:
    shipped = robot.gain_schedule
    # damping and coupling hardly depend on the payload, and their search takes minutes
    design = None if shipped is None else split_program.design_of(shipped)
    return split_program.solve(robot, design=design, check=False)


FIGURES: Final = (
    ("com_x_max_mm", "COM forward", "mm", 1.0),
    ("com_x_min_mm", "COM backward", "mm", -1.0),
    ("com_y_max_mm", "COM to the left", "mm", 1.0),
    ("com_y_min_mm", "COM to the right", "mm", -1.0),
    ("sole_tilt_max_rad", "tilt of a sole", "rad", 1.0),
    ("foot_load_min_n", "load on the lighter foot", "N", -1.0),
    ("slip_max_mm", "slip of a foot", "mm", 1.0),
    ("torque_step_nm", "torque step at the hand-over", "N m", 1.0),
    ("hold_ms", "kill to HOLD", "ms", 1.0),
    ("operator_peak_before_n", "operator's force before the kill", "N", 1.0),
)
"""Column, description, unit, and the sign of the worse direction."""

EXAMPLES: Final = """
xrl study kill
xrl study kill --n 500 --seed 1 --out out/kill
xrl study kill --only 137 --seed 1 --out out/case137
"""


class KillStudyFlags(StudyFlags, LawFlags, PushFlags):
    """Number of cases, and the law."""

    n: Count = 500
    """number of cases"""


def describe(row: Row) -> str:
    """Return a case in one line."""
    words = [f"case {row['number']}: payload {row['payload_kg']:g} kg"]
    if row["kill_height_m"] is not None:
        words.append(
            f"killed at {row['kill_s']:g} s, {row['kill_height_m']:.2f} m, "
            f"pitch {row['kill_pitch_rad']:.2f} rad"
        )
    if row["fell_at_s"] is not None:
        words.append(f"fell at {row['fell_at_s']:.2f} s")
    elif row["ending"] == Ending.FELL:
        words.append("fell before the scenario started")
    words.append(f"delay {row['delay_ms']:g} ms")
    hand_off = row["let_go_s"]
    words.append("hand on" if hand_off is None else f"hand off at {hand_off:g} s")
    pushes = [f"{x:g},{y:g} N at {at:g} s" for at, x, y in _pushes(row)]
    return ", ".join([*words, "push " + " and ".join(pushes)])


def _pushes(row: Row) -> list[tuple[float, float, float]]:
    """Return time, x and y of each push of a row."""
    found = [[row[f"push{i}_{name}"] for name in PUSH_COLUMNS] for i in range(1, PUSHES_MAX + 1)]
    return [(at, x, y) for at, x, y in found if at is not None]


def draw(finished: StudyRun) -> Picture:
    """Draw the largest distance of the COM by the direction of the strongest push."""
    rows = [row for row in finished.rows if row["com_max_mm"] is not None]
    standing, fallen = parted(rows)
    edge = 1.15 * max((row["com_max_mm"] for row in standing), default=100.0)
    figure = new_figure(8, 8)
    axis: Any = figure.add_subplot(projection="polar")
    groups = (
        ("stood, hand on", [row for row in standing if row["let_go_s"] is None], "o", "#1f5f8b"),
        ("stood, hand off", [row for row in standing if row["let_go_s"] is not None], ".", "#777"),
        ("fell (on the edge)", fallen, "x", FALL_COLOUR),
    )
    for label, some, marker, colour in groups:
        strongest = [max(_pushes(row), key=lambda push: math.hypot(*push[1:])) for row in some]
        angles = [math.atan2(y, x) for _, x, y in strongest]
        distances = [min(row["com_max_mm"], edge) for row in some]
        axis.scatter(angles, distances, marker=marker, color=colour, label=label)
    for row in fallen:
        _, x, y = max(_pushes(row), key=lambda push: math.hypot(*push[1:]))
        axis.annotate(row["number"], (math.atan2(y, x), edge), color=FALL_COLOUR, fontsize=8)
    axis.set_rlim(0.0, 1.05 * edge)
    axis.set_theta_zero_location("N")  # forward is up, left is left
    axis.set_thetagrids((0, 90, 180, 270), ("forward", "left", "back", "right"))
    axis.set_title("COM, largest distance after the kill in mm, by direction of the strongest push")
    axis.legend(loc="lower left", bbox_to_anchor=(-0.1, -0.1), fontsize=8)
    pushed = plants.describe(finished.flags)
    figure.suptitle(
        f"Planner killed, {len(rows)} cases, seed {finished.flags.seed}, {pushed}: "
        f"{len(fallen)} fell",
        x=0.01,
        ha="left",
    )
    return figure


STUDY: Final = Study[KillCase](
    name="kill",
    table="cases.csv",
    load=experiment.make_robot,
    cases=lambda flags, robot: partial(KillCases(robot, flags.push).draw, flags.seed),
    decided_by=("push",),
    row=row_of,
    figures=_KillResult,
    trial=run_case,
    robots=robots_of,
    report=partial(study.show_outcome, figures=FIGURES, describe=describe),
    draw=draw,
)


def run(flags: KillStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
