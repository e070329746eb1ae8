"""`xrl study wearer`: random persons rest, let go, go limp, bump and pull, with park off and on.

Each person and plant runs twice; only `park.enabled` differs. The seed and the number of a trial
determine it.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from rich.table import Table

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import PlannerStatus, Wearing
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Act, Keyframe, Scenario
from tools.flags import Count
from tools.lab.studies.sweeps import plants, study
from tools.lab.studies.sweeps.figures import (
    EXIT_CODES,
    NOBODY,
    CaseRun,
    Ended,
    Ending,
    Observer,
    run_fleet,
)
from tools.lab.studies.sweeps.plants import uniform
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.output import Picture, new_figure
from tools.sim.network import BASE

KINDS: Final = ("squat", "slow", "fast", "let go", "limp", "bump", "pull", "tremor")
"""slow and fast: the person rests, with 40 to 80 N/s or with 150 to 500 N/s, and gets up again
within half a second."""
ACTS_S: Final = 4.0
"""Time at which the person, who has crouched until then, acts according to the kind, s."""
RESTS_S: Final = 8.0
TREMBLES_S: Final = 4.0
AFTER_S: Final = 2.0
UP_S: Final = 0.5
"""Time in which a resting person gets up, s."""
SETTLED_S: Final = 0.5
"""Time from the full weight to the measurement of the carried force, s."""
LIMP_N: Final = 200.0
BUMPS: Final = 5


class _WearerTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A person who wears a robot."""

    number: int
    seed: int
    kind: str
    height: float
    """Torso height in the crouch, m."""
    crouch_s: float
    force: float
    """N"""
    ramp: float
    """s"""
    mass: float
    """Mass of the person, kg."""
    payload_scale: float
    park: bool = False

    def true_plant(self) -> PlantConfig:
        """Return the trial's simulated robot and person."""
        plant = plants.draw(f"wearer {self.seed} {self.number}")
        person = {"person.mass": self.mass}
        if self.payload_scale:
            person["body.payload_scale"] = self.payload_scale
        return changed(plant, person)

    def scenario(self, robot: RobotConfig) -> Scenario:
        """Return the trial as a scenario."""
        stand = robot.simulation.stand_height
        way = [Keyframe(0.0, stand), Keyframe(self.crouch_s, self.height)]
        if self.kind == "squat":
            way.append(Keyframe(2.0 * self.crouch_s, stand))
        acts = self._acts()
        ends = max((act.at + act.duration for act in acts), default=2.0 * self.crouch_s)
        return Scenario(
            name=f"wearer-{self.seed}-{self.number}",
            about=f"trial {self.number} of `xrl study wearer --seed {self.seed}`",
            duration=round(ends + AFTER_S * (self.kind != "limp"), 3),
            keyframe=tuple(way),
            act=acts,
        )

    def _acts(self) -> tuple[Act, ...]:
        if self.kind in ("slow", "fast"):
            return (Act("rest", ACTS_S, RESTS_S, self.force, self.ramp, UP_S),)
        if self.kind == "let go":
            return (Act("let_go", ACTS_S, 3.0),)
        if self.kind == "limp":
            return (Act("limp", ACTS_S, TREMBLES_S + AFTER_S, LIMP_N, self.ramp),)
        if self.kind == "pull":
            return (Act("pull", ACTS_S, 1.5, self.force, 0.5),)
        if self.kind == "tremor":
            return (Act("tremor", ACTS_S, TREMBLES_S, self.force, 0.5),)
        dice = random.Random(f"bumps {self.seed} {self.number}")
        return tuple(
            Act(
                "bump", ACTS_S + 1.0 + 0.9 * index, uniform(dice, 0.02, 0.05),
                dice.choice((-1, 1)) * uniform(dice, 40.0, 150.0),
            )
            for index in range(BUMPS * (self.kind == "bump"))
        )  # fmt: skip


class _WearerResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial; None where nothing was measured. `_park`: with park on."""

    carried_pct: float | None = None
    """Part of the resting weight that the robot carries."""
    carried_pct_park: float | None = None
    sinks_mm: float | None = None
    """Sinking during the act, from the height at its start."""
    sinks_mm_park: float | None = None
    hand_n: float | None = None
    """Largest vertical force of the hand, in a squat or after the act."""
    hand_n_park: float | None = None
    held: bool = False
    """True if a module went to HOLD during or after the act."""
    held_park: bool = False
    opened: float | None = None
    """Fraction of the bumps that unparked the robot."""


class WearerStudyFlags(StudyFlags):
    """Number of persons."""

    n: Count = 20
    """number of persons of each kind"""


EXAMPLES: Final = """
xrl study wearer
xrl study wearer --n 60 --out out/wearer
xrl study wearer --only 9 --out out/trial9
"""


def draw(seed: int, number: int) -> _WearerTrial:
    """Return one trial, which does not depend on any other trial."""
    dice = random.Random(f"wearer {seed} {number}")
    kind = KINDS[number % len(KINDS)]
    force = {"pull": (25.0, 50.0), "tremor": (3.0, 10.0)}.get(kind, (40.0, 150.0))
    size = uniform(dice, *force)
    ramps = {
        "slow": (size / 80.0, size / 40.0),
        "fast": (size / 500.0, size / 150.0),
        "limp": (0.15, 0.4),
    }.get(kind, (0.2, 0.2))
    return _WearerTrial(
        number=number,
        seed=seed,
        kind=kind,
        height=uniform(dice, 0.9, 1.0),
        crouch_s=uniform(dice, 1.5, 2.9),
        force=size,
        ramp=uniform(dice, *ramps),
        mass=uniform(dice, 55.0, 100.0),
        payload_scale=dice.choice((0.8, 1.2)) if kind == "let go" else 0.0,
    )


def run_trial(
    trial: _WearerTrial, robot: RobotConfig, observer: Observer = NOBODY
) -> _WearerResult:
    """Run a trial twice, with park off and on; the observer receives the second run."""
    found: dict[str, object] = {}
    endings = []
    for park, watches in ((False, NOBODY), (True, observer)):
        worn = msgspec.structs.replace(
            robot, park=msgspec.structs.replace(robot.park, enabled=park)
        )
        run = run_fleet(trial, worn, watches, BASE, seed=trial.number, kept=(PlannerStatus,))
        end = run.ended(trial.scenario(robot).duration, robot)
        endings.append(end)
        if run.began:
            suffix = "_park" if park else ""
            found |= {f"{name}{suffix}": value for name, value in _measured(trial, run).items()}
            if park and trial.kind == "bump":
                found["opened"] = _opened(run) / BUMPS
    worse = max(endings, key=lambda end: end["ending"] is not Ending.STOOD)
    return _WearerResult(**worse, **found)  # type: ignore[arg-type]


def _measured(trial: _WearerTrial, run: CaseRun) -> dict[str, object]:
    rows = [row for row in run.rows if row.scenario_s >= 0.0]
    acts = trial._acts()  # noqa: SLF001 - defined in this file
    end_s = acts[0].at + acts[0].duration if acts else 0.0
    inside = [row for row in rows if ACTS_S <= row.scenario_s <= end_s]
    after = [row for row in rows if row.scenario_s > end_s]
    found: dict[str, object] = {"hand_n": _hand(after)}
    if inside and trial.kind not in ("bump", "squat"):
        found["sinks_mm"] = 1e3 * max(0.0, inside[0].torso[2] - min(r.torso[2] for r in inside))
    if trial.kind in ("slow", "fast"):
        begin_s, until_s = ACTS_S + trial.ramp + SETTLED_S, end_s - UP_S
        rests = [row for row in inside if begin_s <= row.scenario_s <= until_s]
        borne = [-row.operator_force[2] + row.load_n for row in rests]
        found["carried_pct"] = 100.0 * float(np.mean(borne)) / trial.force if borne else None
    from_ns = next((row.t_ns for row in rows if row.scenario_s >= ACTS_S), 0)
    found["held"] = any(event.mode_after == 1 and event.t_ns >= from_ns for _, event in run.events)
    return found


def _hand(rows: Sequence[SimTruth]) -> float | None:
    return max((abs(row.operator_force[2]) for row in rows), default=None)


def _opened(run: CaseRun) -> int:
    """Return how often the robot unparked, counted from the start of the first bump."""
    begin_ns = next(row.t_ns for row in run.rows if row.scenario_s >= ACTS_S + 1.0)
    seen = [
        row.wearer == Wearing.LEADS
        for _, row in run.messages
        if isinstance(row, PlannerStatus) and row.t_ns >= begin_ns
    ]
    return sum(b and not a for a, b in itertools.pairwise(seen))


FIGURES: Final = (
    ("carried_pct", "carried part of the resting weight", "%", -1.0),
    ("sinks_mm", "sinks", "mm", 1.0),
    ("hand_n", "hand, in a squat or after the act", "N", 1.0),
)
"""Column, description, unit, and the sign of the worse direction."""


def _report(finished: StudyRun) -> None:
    """Print a table for each kind: median and worst, with park off and on."""
    for index, kind in enumerate(KINDS):
        rows = [row for row in finished.rows if int(row["number"]) % len(KINDS) == index]
        unled = sum(row["ending"] == Ending.UNREADY for row in rows)
        fell = sum(row["ending"] != Ending.STOOD for row in rows) - unled
        title = f"{kind}: {len(rows)} persons, {fell} fell, {unled} were not led"
        table = Table()
        for heading in ("median (worst)", "park off", "park on", ""):
            table.add_column(
                heading, justify="left" if heading in ("median (worst)", "") else "right"
            )
        for column, words, unit, sign in FIGURES:
            cells = [_cell(rows, f"{column}{suffix}", sign) for suffix in ("", "_park")]
            if any(cells):
                table.add_row(words, *cells, unit)
        held = [sum(str(row[name]) == "True" for row in rows) for name in ("held", "held_park")]
        table.add_row("went to HOLD", *map(str, held), "")
        opened = [float(row["opened"]) for row in rows if row["opened"] is not None]
        if opened:
            table.add_row("bumps that unparked", "-", f"{100 * np.mean(opened):.0f}", "%")
        finished.console.print(title, style="bold", highlight=False)
        finished.console.print(table)


def _cell(rows: Sequence[Row], column: str, sign: float) -> str:
    known = sorted(
        (float(row[column]) for row in rows if row[column] is not None), key=lambda x: sign * x
    )
    return f"{known[len(known) // 2]:.0f} ({known[-1]:.0f})" if known else ""


def _draw(finished: StudyRun) -> Picture:
    """Draw the sinking under the resting weight, with park off and on."""
    figure = new_figure(9, 5)
    axis = figure.subplots()
    for suffix, label, colour in (("", "park off", "#c0392b"), ("_park", "park on", "#1f5f8b")):
        rows = [row for row in finished.rows if row["kind"] in ("slow", "fast")]
        known = [row for row in rows if row[f"sinks_mm{suffix}"] is not None]
        axis.scatter(
            [float(row["force"]) for row in known],
            [float(row[f"sinks_mm{suffix}"]) for row in known],
            color=colour, label=label, s=18,
        )  # fmt: skip
    axis.set(xlabel="weight that the person rests on the harness, N", ylabel="sinks, mm")
    axis.legend()
    figure.suptitle(f"Persons who rest, seed {finished.flags.seed}", x=0.01, ha="left")
    return figure


STUDY: Final = Study[_WearerTrial](
    name="wearer",
    case="trial",
    table="wearers.csv",
    total=lambda flags: int(flags.n) * len(KINDS),
    cases=lambda flags, _robot: lambda number: draw(flags.seed, number),
    figures=_WearerResult,
    trial=run_trial,
    report=_report,
    # the planner does not lead a payload that is too far from the file, which is not a fault
    exit_code=lambda row: 0 if row["ending"] == Ending.UNREADY else EXIT_CODES[row["ending"]],
    draw=_draw,
)


def run(flags: WearerStudyFlags) -> int:
    """Run the study, or one trial of it."""
    return study.run(STUDY, flags)
