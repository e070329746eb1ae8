"""Impairments as a person writes them, and what a run over a bad network is judged by."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.messages import Mode
from shared.config import scenarios
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject
from shared.exceptions import ConfigError
from shared.links import DIRECTIONS
from tests.lockstep.runs import still
from tests.tools.live.test_experiment import parse
from tools.judge import verdict
from tools.live import describe_inject, experiment
from tools.logs.run_log import RunLog, read_run
from tools.sim.network import BASE
from tools.sim.recorded_lockstep import simulate


@pytest.mark.parametrize(
    ("text", "inject"),
    [
        (
            "planner->joints delay=30 jitter=10 at=3 for=4",
            Inject(link="planner->joints", at=3.0, duration=4.0, delay_ms=30.0, jitter_ms=10.0),
        ),
        ("all loss=.2, burst=5", Inject(link="all", at=0.0, loss=0.2, burst=5.0)),
        (
            "knee_left->planner  partition ordered at=1e1",
            Inject(link="knee_left->planner", at=10.0, partition=True, ordered=True),
        ),
        (
            "harness->planner distribution=pareto jitter=3 duplicate=0.1 rate=1000",
            Inject(
                link="harness->planner", at=0.0, jitter_ms=3.0, distribution="pareto",
                duplicate=0.1, rate=1000.0,
            ),
        ),
    ],
)  # fmt: skip
def test_an_impairment_is_read_from_its_words(text: str, inject: Inject) -> None:
    assert describe_inject.parse_inject(text) == inject


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("", "planner->MODULE"),
        ("elbow delay=1", "planner->MODULE"),
        ("all", "add a delay"),
        ("all delya=3", "perhaps 'delay'; LINK KEY=VALUE"),
        ("planner->joint delay=3", "perhaps 'planner->joints'; use one of"),
        ("planner- delay=3", "put the argument in quotes"),
        ("all delay=3 loss=1 delay=4", "a second delay; remove one of them"),
        ("all partition delay=10", "remove all but ordered"),
        ("all delay=soon", "delay: 'soon' is not valid; write 30 (ms), 0.03s or 500us"),
        ("all partition=3", "words: partition"),
        ("all loss=1.5", "must be from 0 to 1 (1 is 100 %); write 0.2 or 20%"),
        ("all delay=100s", "delay: '100s' is out of range"),
        ("all delay=1 for=0", "for: '0' is out of range; must be from 0.001"),
        ("all delay=1 at=1e999", "at: '1e999' is out of range"),
        ("all rate=1mbit", "bytes"),
        ("all distribution=wild jitter=1", "one of uniform, normal, pareto"),
        ("all burst=3", "loss between 0 and 1"),
        ("all reorder=0.1", "give a delay"),
    ],
)
def test_what_makes_no_sense_is_refused_with_what_would_be_right(text: str, right: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError) as caught:
        describe_inject.parse_inject(text)
    assert right in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "texts", "value"),
    [
        ("delay", ("30", "30ms", "0.03s", "30000us", "3e1ms"), 30.0),
        ("jitter", ("0.5", ".5ms", "500us", "0.0005s"), 0.5),
        ("loss", ("0.07", "7%", "7.0%"), 0.07),
        ("duplicate", ("1", "100%"), 1.0),
        ("rate", ("1e4", "10000"), 1e4),
        ("for", ("4", "4s", "4000ms"), 4.0),
        ("at", ("0.25", "250ms"), 0.25),
    ],
)
def test_a_number_is_the_same_in_each_of_its_units(
    word: str, texts: tuple[str, ...], value: float
) -> None:
    for text in texts:
        words = {"burst": "1", "delay": "1", word: text}
        inject = describe_inject.parse_inject(
            f"all {' '.join(f'{key}={one}' for key, one in words.items())}"
        )
        assert getattr(inject, describe_inject.NUMBERS[word].field) == value


SHARES = st.floats(0.0, 1.0)


@given(
    st.builds(
        Impairment, delay_ms=st.floats(1e-3, 6e4), jitter_ms=st.floats(1e-3, 6e4), loss=SHARES,
        duplicate=SHARES, rate=st.floats(0.0, 1e10), ordered=st.booleans(),
        distribution=st.sampled_from(["uniform", "normal", "pareto"]),
    )
)  # fmt: skip
def test_words_come_back_exactly_from_what_they_made(what: Impairment) -> None:
    inject = describe_inject.parse_inject(f"all {what.describe()}")
    assert {name: getattr(inject, name) for name in what.__struct_fields__} == (
        msgspec.structs.asdict(what)
    )


def test_an_action_is_reported_with_units_and_fractions_in_percent() -> None:
    what = describe_inject.parse_inject("all delay=0.03s jitter=10 loss=1 burst=1 duplicate=.125")
    assert what.describe() == "delay=30ms jitter=10ms loss=100% duplicate=12.5%"


def test_a_flag_replaces_the_impairments_of_the_scenario_and_is_reported() -> None:
    shipped = experiment.make_scenario(parse("--scenario", "bad_network"))
    assert len(shipped.inject) == 4
    scenario = experiment.make_scenario(
        parse("--scenario", "bad_network", "--inject", "all loss=0.1 at=2 for=1")
    )
    assert [row.link for row in scenario.inject] == ["all"]
    assert "all loss=10% at 2 s for 1 s" in experiment.describe(scenario)


def test_a_scenario_with_impairments_comes_back_from_its_own_toml(tmp_path: Path) -> None:
    scenario = experiment.make_scenario(parse("--scenario", "bad_network"))
    path = tmp_path / "x.toml"
    path.write_text(scenarios.to_toml(scenario))
    assert scenarios.load(path) == scenario


@pytest.mark.parametrize(
    ("inject", "key"),
    [
        (Inject(link="elbow", at=0.0, loss=0.1), "inject[0].link"),
        (Inject(link="all", at=99.0, loss=0.1), "inject[0].at"),
        (Inject(link="all", at=0.0, loss=1.1), "inject[0].loss"),
        (Inject(link="all", at=0.0, duration=-1.0, loss=0.1), "inject[0].duration"),
        (Inject(link="all", at=0.0, ordered=True, reorder=0.1), "inject[0]"),
    ],
)
def test_a_scenario_refuses_an_impairment_by_its_key(inject: Inject, key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        scenarios.check("x.toml", still(2.0, inject=(inject,)))
    assert caught.value.key == key


@pytest.fixture(scope="module")
def cut(robot: RobotConfig, tmp_path_factory: pytest.TempPathFactory) -> RunLog:
    """Record a stand with one leg cut off for a while, and a delay on top of it."""
    scenario = still(
        3.0,
        inject=(
            Inject(link="planner->left", at=0.5, duration=0.6, partition=True),
            Inject(link="harness->planner", at=0.7, duration=0.2, delay_ms=5.0),
            Inject(link="knee_left->planner", at=2.0, delay_ms=1.0),
        ),
    )
    folder = tmp_path_factory.mktemp("cut")
    simulate(robot, scenario, BASE, 0, folder)
    return read_run(folder / "run.mcap")


def test_every_beginning_and_end_is_in_the_log_with_what_was_lost(cut: RunLog) -> None:
    events = cut.messages(topics.LINK_EVENT)
    assert [event.seq for event in events] == list(range(1, len(events) + 1))
    left = [event for event in events if event.requested == "planner->left"]
    assert {event.link for event in left} < set(DIRECTIONS)
    assert [event.active for event in left] == [True] * 3 + [False] * 3
    assert len({event.number for event in left}) == 1
    lost = [event.lost for event in left if not event.active]
    assert all(149 <= number <= 151 for number in lost), "0.6 s at 250 Hz"
    (late,) = [e for e in events if e.link == "harness->planner" and not e.active]
    assert (late.passed, late.lost, late.detail) == (50, 0, "delay=5ms")


def test_what_lasts_to_the_end_of_a_run_is_in_its_log_with_its_counts(cut: RunLog) -> None:
    (ended,) = [e for e in cut.messages(topics.LINK_EVENT) if e.number == 3 and not e.active]
    assert ended.passed == pytest.approx(250, abs=3), "1 s at 250 Hz"


def test_one_leg_cut_off_makes_all_six_hold_and_they_lead_again(cut: RunLog) -> None:
    for module in ("knee_right", "knee_left"):
        modes = [event.mode_after for event in cut.messages(topics.JOINT_EVENT, module)]
        assert modes[-2:] == [Mode.HOLD, Mode.TRACK]


def test_the_time_in_hold_is_not_judged_as_the_planner_leading(cut: RunLog) -> None:
    summary = verdict.summarise(cut, 3.0)
    assert summary.stood
    assert summary.links_impaired == 3
    assert summary.hold_com_x_max_mm is not None
    assert summary.handover_max_ms is None, "nobody was killed"
    assert 0.0 <= (summary.handover_torque_step_nm or 0.0) < 5.0
    assert summary.command_age_ms is not None
    assert 3.0 < summary.command_age_ms.median < 12.0
