"""A person's path by hand: recorded, and led again bit for bit."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from services.simulator.physics.led_hand import HEIGHT_MAX_RATE
from shared.bus import topics
from shared.bus.messages import HandLead, Mode
from shared.bus.traces import SimTruth
from tests.lockstep.runs import run, still
from tests.robots import ROBOT
from tools import cli
from tools.logs.hand_path import HandRow, hand_path
from tools.logs.run_log import read_run
from tools.sim import recorded_lockstep
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

PUSH, NO_PUSH = (0.0, 30.0, 0.0), (0.0, 0.0, 0.0)
PATH = (
    (0.2, HandLead(t_ns=0, seq=0, leads=False, height=0.0, pitch=0.0, push=PUSH, source="test")),
    (0.5, HandLead(t_ns=0, seq=0, leads=True, height=1.0, pitch=0.1, push=NO_PUSH, source="test")),
    (1.7, HandLead(t_ns=0, seq=0, leads=True, height=1.1, pitch=0.0, push=PUSH, source="test")),
)
DURATION_S = 3.0


@pytest.fixture(scope="module")
def run_of_a_person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("hand")
    rows = tuple(HandRow(at, hand) for at, hand in PATH)
    recorded_lockstep.simulate(ROBOT, still(DURATION_S), BASE, 0, out, hand=rows)
    return out / "run.mcap"


def test_the_robot_follows_the_hand_that_is_led_and_is_pushed_by_it(run_of_a_person: Path) -> None:
    truths: list[SimTruth] = read_run(run_of_a_person).messages(topics.SIM_TRUTH)
    at = {round(row.scenario_s, 2): row for row in truths}
    assert at[0.1].push == (0.0, 0.0, 0.0)
    assert at[0.3].push == PUSH
    assert at[0.6].push == (0.0, 0.0, 0.0), "it ended by itself"
    assert at[1.6].torso[2] < at[0.4].torso[2] - 0.12
    assert at[2.9].torso[2] == pytest.approx(1.1, abs=0.015)
    assert not truths[-1].fallen
    fastest = max(abs(b.torso[2] - a.torso[2]) for a, b in itertools.pairwise(truths))
    assert fastest < 2.0 * HEIGHT_MAX_RATE * 0.01


def test_the_same_path_is_the_same_run(run_of_a_person: Path, tmp_path: Path) -> None:
    log = read_run(run_of_a_person)
    assert [row.at for row in hand_path(log)] == pytest.approx([0.2, 0.5, 1.7], abs=0.002)
    scenario = run_of_a_person.parent / "scenario.toml"
    words = ["--scenario", str(scenario), "--hand", str(run_of_a_person), "--out", str(tmp_path)]
    assert cli.main(["sim", *words]) == 0
    again = read_run(tmp_path / "run.mcap")
    for topic in (topics.SIM_TRUTH, topics.SIM_STATE, topics.OPERATOR_HAND, topics.PLANNER_STATUS):
        assert again.messages(topic) == log.messages(topic)


def test_a_moment_of_it_has_the_hand(run_of_a_person: Path) -> None:
    log = read_run(run_of_a_person)
    state = next(row for row in log.messages(topics.SIM_STATE) if row.scenario_s >= 1.0)
    assert state.hand[0] == 1.0, "somebody leads"
    fleet = Lockstep(ROBOT, still(DURATION_S), BASE, hand=hand_path(log))
    fleet.resume(FleetMoment(state, {}, None))
    assert fleet.world.outside.led_hand is not None
    assert fleet.world.outside.led_hand.numbers() == state.hand
    led = run(ROBOT, still(0.8), hand=hand_path(log))
    assert led.lockstep.moment().state.hand != state.hand
    assert set(led.modes) == {Mode.TRACK}
