"""The wearer study: every kind is drawn, and a person who rests is carried with park on alone."""

from __future__ import annotations

import msgspec
import pytest

from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from tests.tools.lab.studies.sweeps.tables import finished, printed
from tools.lab.studies.sweeps import wearer
from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.wearer import KINDS, WearerStudyFlags, draw, run_trial


def test_each_kind_is_a_scenario_that_a_file_could_hold(robot: RobotConfig) -> None:
    drawn = [draw(1, number) for number in range(3 * len(KINDS))]
    assert {trial.kind for trial in drawn} == set(KINDS)
    for trial in drawn:
        scenario = trial.scenario(robot)
        scenarios.check("drawn", scenario)
        assert bool(scenario.act) == (trial.kind != "squat")
        assert all(act.at >= wearer.ACTS_S > trial.crouch_s for act in scenario.act)


def test_a_person_who_rests_is_carried_with_park_on_and_hardly_with_park_off(
    robot: RobotConfig,
) -> None:
    trial = msgspec.structs.replace(draw(1, KINDS.index("fast")), force=100.0)
    found = run_trial(trial, robot)
    assert found.ending is Ending.STOOD
    assert found.carried_pct is not None
    assert found.carried_pct_park is not None
    assert found.carried_pct < 25.0 < 75.0 < found.carried_pct_park
    assert found.sinks_mm is not None
    assert found.sinks_mm_park is not None
    assert found.sinks_mm_park < 0.5 * found.sinks_mm


def test_the_report_has_a_table_for_each_kind_with_the_worst_of_both(robot: RobotConfig) -> None:
    rows = [
        msgspec.structs.asdict(draw(1, number))
        | msgspec.structs.asdict(
            wearer._WearerResult(
                ending=Ending.STOOD, sinks_mm=10.0 + number, sinks_mm_park=1.0, held=number == 1,
                opened=0.2 if number % len(KINDS) == KINDS.index("bump") else None,
            )
        )
        for number in range(2 * len(KINDS))
    ]  # fmt: skip
    text = printed(wearer._report, finished(rows, robot, WearerStudyFlags(n=2)))
    for kind in KINDS:
        assert f"{kind}: 2 persons, 0 fell, 0 were not led" in text
    slow = text.partition("slow: ")[2].partition("fast: ")[0]
    assert "19 (19)" in slow
    assert "1 (1)" in slow
    assert "20" in text.partition("bump: ")[2].partition("pull: ")[0]


@pytest.mark.parametrize("number", range(len(KINDS)))
def test_a_trial_follows_from_its_number_alone(number: int) -> None:
    assert draw(3, number) == draw(3, number)
    assert draw(3, number) != draw(4, number)
