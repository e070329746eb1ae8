"""`xrl study latency`: its grid, its trials, its figures, its words and its pictures."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import pytest

from shared.bus.messages import JointEvent, Mode
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from tests.messages import sample
from tests.tools.lab.studies.sweeps.tables import finished, printed
from tools.flags import add_flags, read_flags
from tools.lab.studies.sweeps import latency
from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.latency import (
    CONTROLS,
    DURATION_S,
    PUSH_S,
    LatencyTrial,
    Network,
    hold_share,
    robot_of,
    row_of,
)
from tools.lab.studies.sweeps.study import command_of
from tools.lab.studies.sweeps.table import Row
from tools.output import save_figure
from tools.sim.lockstep import Lockstep

GOOD = Network(0.0, 0.0, 0.0)


def grid(*flags: str) -> list[LatencyTrial]:
    return trials_of(parsed(*flags))


def parsed(*flags: str) -> latency.LatencyStudyFlags:
    parser = argparse.ArgumentParser()
    add_flags(parser, latency.LatencyStudyFlags)
    return read_flags(latency.LatencyStudyFlags, parser.parse_args(flags))


def trials_of(args: latency.LatencyStudyFlags) -> list[LatencyTrial]:
    grid, total = latency.grid_of(args), latency.STUDY.total(args)
    return [latency.trial_of(grid, args.seed, number) for number in range(total)]


def trial(**changes: Any) -> LatencyTrial:
    fields: dict[str, Any] = {
        "number": 0,
        "repeat": 0,
        "seed": 1,
        "control": "distributed",
        "network": GOOD,
    }
    return LatencyTrial(**(fields | changes))


def test_values_are_sorted_and_come_once() -> None:
    assert latency.values_up_to(1000.0)("10,.5,10,0") == (0.0, 0.5, 10.0)


@pytest.mark.parametrize("text", ["", "a", "-1", "nan", "0:10", "2"])
def test_values_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        latency.values_up_to(1.0)(text)


def test_every_network_meets_every_control_and_more_trials_come_behind() -> None:
    few, more = grid("--n", "2"), grid("--n", "3")
    assert more[: len(few)] == few
    assert [t.number for t in more] == list(range(len(more)))
    points = {(t.network, t.control, t.repeat) for t in more}
    assert len(points) == len(more) == 7 * 4 * 3 * 3
    assert {t.control for t in more} == {"distributed", "diagonal", "centralised"}
    assert max(t.network.delay_ms for t in more) == 200.0
    assert max(t.network.loss for t in more) == 0.5
    assert len(grid()) >= 300


def test_trials_are_paired_over_delays_and_controls_and_independent_at_one_delay(
    robot: RobotConfig,
) -> None:
    """So that curves over the delay compare like with like, and their bounds are true."""
    pushes = {trial(control=name).scenario(robot_of(robot, name)).push for name in CONTROLS}
    assert len(pushes) == 1
    by_draw: dict[object, set[tuple[float, str]]] = {}
    for t in grid("--n", "2"):
        by_draw.setdefault(t.draw, set()).add((t.network.delay_ms, t.control))
    assert len(by_draw) == 2 * 4
    assert all(len(points) == 7 * 3 for points in by_draw.values())
    assert trial(seed=2).draw not in by_draw


def lost(robot: RobotConfig, of: int, **network: float) -> set[int]:
    """Return which messages of a link are lost in a trial over such a network."""
    t = trial(network=Network(**({"delay_ms": 0.0, "jitter_ms": 0.0} | network)))
    links = Lockstep(robot, t.scenario(robot), seed=t.draw.fleet_seed).network
    links.advance(3.0, 10**9)
    direction = links.links["planner->ankle_left"].direction
    return {number for number in range(of) if not direction.passes(10**9, 0)}


def test_another_loss_loses_other_messages_and_another_delay_the_same(robot: RobotConfig) -> None:
    """Else the trials at one delay would be one trial told four times."""
    few, more = lost(robot, 4000, loss=0.1), lost(robot, 4000, loss=0.3)
    assert len(few) == pytest.approx(400, abs=80)
    assert len(few & more) / len(few) == pytest.approx(0.3, abs=0.1)
    assert lost(robot, 4000, loss=0.1, delay_ms=100.0) == few
    assert lost(robot, 4000, loss=0.1, jitter_ms=5.0) != few


def test_the_command_is_of_this_study_whatever_its_numbers_are() -> None:
    flags = "--loss 0.1234567,0.1234568 --delay 12345.67,0.00001"
    args = parsed(*flags.split())
    command = command_of(latency.STUDY, args)
    assert "--delay 0.00001,12345.67 --loss 0.1234567,0.1234568" in command
    again = parsed(*command.split()[3:])
    assert trials_of(again) == trials_of(args)
    assert len({(t.draw, t.repeat) for t in trials_of(args)}) == 2 * 4
    assert {row_of(t)["delay_ms"] for t in trials_of(args)} == {"0.00001", "12345.67"}


def test_no_draw_is_beyond_the_study() -> None:
    angles, begins = [], []
    for repeat in range(200):
        draw = trial(repeat=repeat).draw
        begins.append(draw.impaired_from_s)
        for at, share, angle in draw.shoves:
            assert 0.2 <= share <= 0.75
            assert at >= draw.impaired_from_s
            assert at + PUSH_S <= DURATION_S - 1.5, "time to fall"
            angles.append(angle)
        assert len(draw.shoves) == 3
        assert all(b[0] >= a[0] + PUSH_S for a, b in pairwise(draw.shoves))
    assert {math.floor(2 * angle / math.pi) for angle in angles} == {-2, -1, 0, 1}
    assert min(begins) < 0.3 < 2.3 < max(begins) <= 2.5


def test_the_network_is_good_until_the_scenario_has_begun_and_then_bad_to_its_end(
    robot: RobotConfig,
) -> None:
    scenario = trial(network=Network(30.0, 5.0, 0.2)).scenario(robot)
    scenarios.check("trial", scenario)
    (inject,) = scenario.inject
    assert (inject.delay_ms, inject.jitter_ms, inject.loss) == (30.0, 5.0, 0.2)
    begins = trial(network=Network(30.0, 5.0, 0.2)).draw.impaired_from_s
    assert (inject.link, inject.at, inject.duration) == ("all", begins, None)
    assert not inject.ordered, "datagrams: what is late does not hold up the rest"
    assert trial().scenario(robot).inject == ()


def test_a_control_differs_in_what_its_name_states(robot: RobotConfig) -> None:
    assert robot_of(robot, "distributed") is robot
    assert robot_of(robot, "centralised") is robot
    assert robot_of(robot, "diagonal").law.split == "diagonal"
    assert CONTROLS["distributed"].fleet is CONTROLS["diagonal"].fleet is Lockstep


@pytest.mark.parametrize(
    ("rows", "share"),
    [
        ([], 0.0),
        ([("a", 20, Mode.HOLD)], 0.8),
        ([("a", 20, Mode.HOLD), ("a", 50, Mode.TRACK)], 0.3),
        ([("a", 20, Mode.HOLD), ("b", 40, Mode.HOLD), ("a", 50, Mode.TRACK)], 0.8),
        ([("b", 40, Mode.HOLD), ("b", 60, Mode.TRACK), ("a", 20, Mode.HOLD),
          ("a", 50, Mode.TRACK), ("a", 90, Mode.HOLD)], 0.5),
        ([("a", -20, Mode.HOLD)], 1.0),
        ([("a", -20, Mode.HOLD), ("a", 30, Mode.TRACK)], 0.3),
        ([("a", -20, Mode.HOLD), ("a", -10, Mode.TRACK), ("a", 120, Mode.HOLD)], 0.0),
        ([("a", 20, Mode.HOLD), ("a", 60, Mode.DAMP)], 0.4),
    ],
)  # fmt: skip
def test_the_robot_holds_while_any_module_does_that_did_before_the_network_got_bad_included(
    rows: list[tuple[str, int, Mode]], share: float
) -> None:
    events = [(name, sample(JointEvent, t_ns=t, mode_after=int(after))) for name, t, after in rows]
    assert hold_share(events, 0, 100) == pytest.approx(share)


def made_up(fell: Callable[[str, float, float], bool]) -> list[Row]:
    """Return rows of a whole grid, two trials each."""
    columns = ("operator_peak_n", "hold_share", "com_max_mm", "torque_step_nm", "hold_step_nm")
    grid = product(("centralised", "distributed"), (0.0, 50.0), (0.0, 0.5), range(2))
    return [
        {
            "number": number,
            "control": control,
            "delay_ms": f"{delay:g}",
            "jitter_ms": "0",
            "loss": f"{loss:g}",
            "ending": Ending.FELL if fell(control, delay, loss) else Ending.STOOD,
            **dict.fromkeys(columns, 10.0 + number),
        }
        for number, (control, delay, loss, _) in enumerate(grid)
    ]


def shown(rows: Sequence[Row], robot: RobotConfig) -> str:
    done = finished(rows, robot, latency.LatencyStudyFlags(), "xrl study latency")
    return printed(latency.report, done)


def test_falls_are_counted_by_delay_and_control_with_bounds_of_their_own(
    robot: RobotConfig,
) -> None:
    """The worst of several delays is chosen: 95 % of it would be 83 %."""
    rows = made_up(lambda control, delay, _loss: control == "centralised" and delay == 50.0)
    cells = latency.cells_of(rows)
    assert list(dict.fromkeys(name for name, _ in cells)) == ["distributed", "centralised"]
    assert (cells["centralised", 50.0].fallen, cells["centralised", 50.0].of) == (4, 4)
    assert cells["centralised", 0.0].fallen == 0
    output = shown(rows, robot)
    assert "mix: 0, 50 % lost" in " ".join(output.split())
    assert "4/4 51-100 %" in " ".join(output.split())
    assert output.count("0/4") == 3
    assert "centralised: 4 of 8 fell" in output
    assert "distributed: 0 of 8 fell" in output
    assert "xrl study latency --only 4" in output
    both = [{**row, "jitter_ms": jitter} for row in rows for jitter in ("0", "5")]
    assert latency.mix(both) == "0, 50 % lost, 0, 5 ms"


def test_pictures_are_drawn_of_what_there_is(robot: RobotConfig, tmp_path: Path) -> None:
    """A study that was stopped early, and one in which everything fell at once."""
    rows = made_up(lambda *_: True)
    short = [{**row, "operator_peak_n": None, "hold_share": None} for row in rows[:3]]
    for some in (rows, short):
        save_figure(
            latency.draw(finished(some, robot, latency.LatencyStudyFlags())), tmp_path / "a.png"
        )
        assert 10_000 < (tmp_path / "a.png").stat().st_size < 150_000
