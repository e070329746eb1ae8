"""The picture of `xrl study heat --poses --out`: a squat held until the robot stands up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import HeatAction
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from tools.lab.studies.sweeps.heat_trial import AHEAD_S, HELD_S, LEAD_S
from tools.output import new_figure, save_figure
from tools.sim.lockstep import Lockstep
from tools.sim.standing_start import begin_standing

SQUAT: Final = 0.948
"""m"""
AMBIENT: Final = 35.0
"""C, of the plant; the robot file says what the estimate takes it to be."""
SAMPLE_S: Final = 2.0
"""Skipped time from one sample to the next."""
DURATION_S: Final = 75.0
COLOURS: Final = {
    HeatAction.NONE: "#ffffff", HeatAction.EASES: "#fbe3c4", HeatAction.STANDS_UP: "#f2a65a",
    HeatAction.RESTS: "#cfe5d4",
}  # fmt: skip
WORDS: Final = {
    HeatAction.EASES: "told",
    HeatAction.STANDS_UP: "stands up",
    HeatAction.RESTS: "rests",
}


class HeldMoment(NamedTuple):
    """One moment, skipped time counted."""

    t_s: float
    height: float
    """Of the torso, m."""
    true: float
    """Warmest winding, C."""
    estimated: float
    left_s: float
    hand: float
    """Vertical force of a hand that stays at the squat, N."""
    action: HeatAction


def samples(robot: RobotConfig) -> Iterator[HeldMoment]:
    """Run a squat held by a hand that clings, on the default plant."""
    frames = (Keyframe(0.0, robot.simulation.stand_height), Keyframe(LEAD_S, SQUAT))
    scenario = Scenario(name="held", about="a squat held", duration=DURATION_S, keyframe=frames)
    plant = changed(PlantConfig(), {"heat.ambient": AMBIENT})
    fleet = Lockstep(robot, scenario, plant=plant)
    begin_standing(fleet)
    skipped_s = 0.0

    def sample(row: SimTruth) -> HeldMoment:
        states = [law.heat.state for law in fleet.controllers]
        planner = fleet.planner
        status = None if planner is None else planner.status(fleet.now_ns, 0.0)
        return HeldMoment(
            row.scenario_s + skipped_s, row.torso[2], float(fleet.bank.heat.winding.max()),
            max(max(state.winding) for state in states), min(state.left_s for state in states),
            row.operator_force[2], HeatAction(0 if status is None else status.heat),
        )  # fmt: skip

    for number, row in enumerate(fleet.run()):
        if row.scenario_s >= LEAD_S + HELD_S and skipped_s == 0.0:
            until_s = robot.heat.ease_s + AHEAD_S
            while min(law.heat.state.left_s for law in fleet.controllers) > until_s:
                fleet.skip_heat(SAMPLE_S)
                skipped_s += SAMPLE_S
                yield sample(row)
        if number % 20 == 0:
            yield sample(row)


def draw(robot: RobotConfig, path: Path) -> None:
    """Draw it into a PNG file: all of it, and the end at a larger scale."""
    rows = list(samples(robot))
    t_s = np.array([row.t_s for row in rows])
    acts = [k for k, row in enumerate(rows) if row.action is not HeatAction.NONE]
    begin_s = t_s[acts[0]] - 10.0 if acts else 0.0
    figure = new_figure(12.0, 6.5)
    grid = figure.subplots(3, 2, sharex="col", sharey="row", height_ratios=(2.2, 1.2, 1.5))
    for column, (t, unit) in enumerate(((t_s / 60.0, "min"), (t_s - begin_s, "s"))):
        _draw_column(grid[:, column], t, rows, robot)
        grid[2, column].set_xlabel(unit)
    grid[0, 1].set_xlim(0.0, t_s[-1] - begin_s)
    labels = ("warmest winding, C", "left at this\nload, s", "torso, m")
    for axis, label in zip(grid[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    grid[1, 0].set_ylim(1.0, 2000.0)
    grid[0, 0].legend(fontsize=8, loc="lower right")
    for number, begin in enumerate(_starts(rows)):
        if rows[begin].action in WORDS:
            y = robot.heat.winding_max + 2.0 + 4.0 * (number % 2)
            words = WORDS[rows[begin].action]
            grid[0, 1].text(t_s[begin] - begin_s + 0.5, y, words, fontsize=8)
    grid[0, 0].set_ylim(top=robot.heat.winding_max + 11.0)
    title = f"A squat at {SQUAT:g} m held by a hand that clings to it, until the robot stands up"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    save_figure(figure, path)


def _draw_column(
    axes: Sequence[Any], t: NDArray[np.float64], rows: Sequence[HeldMoment], robot: RobotConfig
) -> None:
    temperature, left, height = axes
    temperature.plot(t, [row.estimated for row in rows], color="#c8553d", label="estimated")
    truth = f"true, air {AMBIENT:g} C"
    temperature.plot(t, [row.true for row in rows], color="#1f4e79", label=truth)
    temperature.axhline(robot.heat.winding_max, color="#c0392b", lw=1.0, ls="--", label="limit")
    left.plot(t, [min(row.left_s, 1200.0) for row in rows], color="#444444")
    left.set_yscale("log")
    for limit_s in (robot.heat.ease_s, robot.heat.stand_s):
        left.axhline(limit_s, color="#7f7f7f", lw=0.8, ls=":")
    height.plot(t, [row.height for row in rows], color="#1f4e79")
    force = height.twinx()
    force.plot(t, [row.hand for row in rows], color="#5b8c5a", lw=0.9)
    force.set_ylabel("hand, N", color="#5b8c5a")
    starts = _starts(rows)
    for begin, end in zip(starts, [*starts[1:], len(rows) - 1], strict=True):
        for axis in axes:
            axis.axvspan(t[begin], t[end], color=COLOURS[rows[begin].action], lw=0.0, alpha=0.6)


def _starts(rows: Sequence[HeldMoment]) -> list[int]:
    """Return where each action begins."""
    return [0, *(k for k in range(1, len(rows)) if rows[k].action != rows[k - 1].action)]
