"""The robustness study: its trials, a ranking that finds the cause, a robot that stands."""

from __future__ import annotations

import math
import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from shared.bus.messages import JointEvent, Mode
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from tests.messages import filled, sample
from tests.tools.lab.studies.sweeps.tables import finished, printed
from tools.lab.studies.sweeps import figures, robust
from tools.lab.studies.sweeps.figures import Ending, Observer
from tools.lab.studies.sweeps.plants import PushRange
from tools.lab.studies.sweeps.robust import KINDS, draw, row_of, run_trial
from tools.output import save_figure
from tools.sim.lockstep import Lockstep


@pytest.fixture(scope="module")
def pushes(robot: RobotConfig) -> PushRange:
    return PushRange(robot)


@pytest.fixture(scope="module")
def drawn(pushes: PushRange) -> list[dict[str, object]]:
    return [row_of(draw(pushes, 1, number)) for number in range(60)]


def rows_by(drawn: list[dict[str, object]], cause: str) -> list[dict[str, object]]:
    """Return made-up rows in which one error alone moves the COM."""
    dice = random.Random(cause)
    rows = []
    for row in drawn:
        far = 100.0 * abs(float(str(row[cause]))) + dice.uniform(0.0, 1e-3)
        rows.append(row | {"ending": Ending.STOOD, "com_led_max_mm": far})
    return rows


def test_every_trial_is_a_scenario_that_ends_after_its_kill(
    robot: RobotConfig, pushes: PushRange
) -> None:
    assert {draw(pushes, 1, number).kind for number in range(3)} == set(KINDS)
    for number in range(30):
        trial = draw(pushes, 1, number)
        scenario = trial.scenario(robot)
        assert scenario.duration > trial.kill_s + 2.0
        assert all(push.at + push.duration < scenario.duration for push in scenario.push)


AT_REST: SimTruth = filled(SimTruth, {bool: False, int: 0, float: 0.0})


def test_a_change_of_mode_after_the_fall_does_not_count(
    robot: RobotConfig, pushes: PushRange
) -> None:
    """A recorded trial goes on for a second after the fall."""

    def event(t_s: float, step: float) -> tuple[str, JointEvent]:
        times = {"t_ns": round(t_s * NS_PER_S), "mode_after": int(Mode.HOLD)}
        return "hip_left", sample(JointEvent, **times, tau_before=(0, 0), tau_after=(0, step))

    class Fleet:
        def __init__(self, *_: object, **__: object) -> None:
            self.events = [event(0.5, 1.41), event(2.5, 115.6)]

        def run(self) -> list[SimTruth]:
            return [
                msgspec.structs.replace(
                    AT_REST, t_ns=t_s * NS_PER_S, scenario_s=float(t_s), fallen=t_s >= 2
                )
                for t_s in range(4)
            ]

    trial: Any = draw(pushes, 1, 0)
    run = figures.run_fleet(
        trial, robot, Observer(after_fall_s=1.0), Impairment(), seed=1, fleet_type=Fleet,  # type: ignore[arg-type]
    )  # fmt: skip
    assert run.ended(9.0, robot)["fell_at_s"] == 2.0
    assert [event.t_ns for _, event in run.events] == [NS_PER_S // 2]


def test_a_person_who_reacts_stops_leading_where_the_robot_is_some_time_after_it_holds() -> None:
    fleet = SimpleNamespace(
        controllers=[SimpleNamespace(failsafe=SimpleNamespace(mode=Mode.TRACK))]
    )
    led: list[tuple[float, float]] = []
    person = figures.ReactingPerson(0.3)
    for tick in range(-100, 300):
        t_s = tick / 100
        if t_s >= 1.0:
            fleet.controllers[0].failsafe.mode = Mode.HOLD
        fleet.lead = lambda hand, t_s=t_s: led.append((t_s, hand.height))
        row = msgspec.structs.replace(AT_REST, scenario_s=t_s, torso=(0.0, 0.0, 2.0 - t_s))
        person(cast(Lockstep, fleet), row)
    assert led == [(1.3, pytest.approx(0.7))]


@pytest.mark.parametrize("cause", ["body.com_offset", "drive.lag_s", "floor.slope"])
def test_the_ranking_finds_the_error_that_moves_the_com(
    drawn: list[dict[str, object]], cause: str
) -> None:
    ranked = robust.ranking(rows_by(drawn, cause))
    assert ranked[0][0] == cause
    assert ranked[0][1] > 0.9
    assert abs(ranked[1][1]) < 0.6


@pytest.mark.parametrize("few", [True, False])
def test_of_a_few_trials_no_error_is_ranked(
    robot: RobotConfig, drawn: list[dict[str, object]], few: bool
) -> None:
    figures = dict.fromkeys(key for key, *_ in robust.FIGURES)
    rows = [figures | row for row in rows_by(drawn, "drive.lag_s")[: robust.RANKED_LEAST - few]]
    said = printed(robust.report, finished(rows, robot, robust.RobustStudyFlags()))
    assert ("ranking needs at least" in said) is few
    assert ("drive.lag_s" in said) is not few


def test_a_picture_is_drawn_and_falls_are_in_it(
    robot: RobotConfig, drawn: list[dict[str, object]], tmp_path: Path
) -> None:
    rows = rows_by(drawn, "drive.lag_s")
    rows[3] |= {"ending": Ending.FELL, "com_led_max_mm": None}
    figure = robust.draw_excursions(finished(rows, robot, robust.RobustStudyFlags()))
    save_figure(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000


@pytest.mark.sampled(2)
@pytest.mark.parametrize("number", [2, 4])
def test_with_every_error_drawn_it_is_led_pushed_killed_and_stands(
    robot: RobotConfig, pushes: PushRange, number: int
) -> None:
    """A lean and a crawl among those that `xrl study robust` runs, not pushed into HOLD."""
    outcome = run_trial(draw(pushes, 1, number), robot)
    assert outcome.stood
    assert outcome.operator_peak_n is not None
    assert outcome.operator_peak_n < 80.0


@pytest.mark.parametrize("number", [142, 160, 175])
def test_shoved_from_the_side_on_its_way_into_the_crawl_it_stands(
    robot: RobotConfig, pushes: PushRange, number: int
) -> None:
    """By 106 to 111 N: led on until its sole had tipped it fell; in trials 49 and 61 it does."""
    trial = draw(pushes, 1, number)
    assert trial.kind == "crawl"
    assert run_trial(trial, robot).ending is Ending.STOOD


def test_a_slope_that_is_asked_for_has_its_size_and_any_direction_and_all_else_as_drawn(
    pushes: PushRange,
) -> None:
    angles = []
    for number in range(40):
        plain = draw(pushes, 1, number).true_plant()
        sloping = draw(pushes, 1, number, 1.0, 5.0).true_plant()
        x, y = sloping.floor.slope
        assert math.hypot(x, y) == pytest.approx(math.radians(5.0), abs=1e-5)
        angles.append(math.atan2(y, x))
        floor = msgspec.structs.replace(sloping.floor, slope=plain.floor.slope)
        assert msgspec.structs.replace(sloping, floor=floor) == plain
    assert min(angles) < -2.0
    assert max(angles) > 2.0
