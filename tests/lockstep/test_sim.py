"""`xrl sim`, the verb around lockstep; runs that are the same to the last bit; a hand's path."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.simulator.physics.operator import HEIGHT_MAX_RATE
from shared.bus import topics
from shared.bus.messages import HandLead, Mode, PlannerStatus
from shared.bus.traces import SimTruth
from shared.config.impairment import Impairment
from shared.config.scenarios import Fault, Scenario
from shared.joints import MODULES
from tests.lockstep.runs import kill, push, restart, run, still
from tests.robots import ROBOT
from tests.tools.exit_codes import exit_code
from tools import cli
from tools.logs.hand_path import HandRow, hand_path
from tools.logs.run_log import read_run
from tools.sim import lockstep, recorded_lockstep
from tools.sim.lockstep import FleetMoment, Lockstep, begin_standing
from tools.sim.network import BASE

NOT_HERE = (topics.ATTITUDE, topics.OPERATOR_INTENT, topics.TOOLS)
"""Periodic topics that a run in virtual time does not have: no IMU is fitted, the scenario requests
without a message, and no tool links."""


def sim(out: Path, *flags: str) -> int:
    return exit_code(["sim", "--out", out, *flags])


def statuses_of(out: Path) -> list[PlannerStatus]:
    return read_run(out / "run.mcap").messages(topics.PLANNER_STATUS)


def summary_of(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "summary.json").read_text()))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded")
    flags = ("--duration", "3", "--kill", "planner@1", "--restart", "planner@1.6")
    assert sim(out, *flags) == 0
    return out


def test_a_run_is_recorded_judged_and_drawn(recorded: Path) -> None:
    summary = summary_of(recorded)
    assert summary["stood"] is True
    assert summary["reengage_s"] < 1.5
    assert max(summary["handover_ms"].values()) <= 4.0, "its process is on the same host"
    assert (recorded / "run.png").stat().st_size > 20_000
    assert len({status.session for status in statuses_of(recorded)}) == 2
    log = read_run(recorded / "run.mcap")
    lacking = {
        topic.name
        for topic in topics.TOPICS
        if topic.recorded and topic.rate_hz > 0.0 and topic not in NOT_HERE
        if not log.count(topic.key(log.robot, MODULES[0] if topic.per_module else ""))
    }
    assert lacking == set(), "publish it in tools/sim/virtual_*.py as the service does live"


def test_another_seed_gives_another_log(recorded: Path, tmp_path: Path) -> None:
    """The same seed gives the same one: below."""
    assert sim(tmp_path, "--duration", "0.2", "--seed", "6") == 0
    first, other = (read_run(folder / "run.mcap") for folder in (recorded, tmp_path))
    for key in ((topics.JOINT_STATE, "knee_left"), (topics.WRENCH,)):
        count = len(other.messages(*key))
        assert count > 100
        assert other.messages(*key) != first.messages(*key)[:count]


def test_what_a_hand_that_leans_feels_sideways_is_in_the_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sim(tmp_path, "--scenario", "lean", "--duration", "1.5") == 0
    peak = summary_of(tmp_path)["operator_side_peak_n"]
    assert 10.0 < peak < 40.0
    assert f"operator's force sideways, led {peak:.1f} N" in " ".join(
        capsys.readouterr().out.split()
    )


def test_a_lean_that_was_asked_for_is_no_excursion_and_comes_out_again(tmp_path: Path) -> None:
    """`xrl log resim` hears what was asked from the record."""
    assert sim(tmp_path, "--scenario", "shift", "--duration", "2.5", "--kill", "planner@2.4") == 0
    summary = summary_of(tmp_path)
    assert summary["com_y_max_mm"] > 35.0
    assert summary["alive_com_y_max_mm"] < 10.0
    asked = max(status.shift_requested[1] for status in statuses_of(tmp_path))
    assert asked == pytest.approx(0.04, abs=1e-4)
    assert cli.main(["log", "resim", str(tmp_path), "--service", "planner"]) == 0


# ---- two robots in one process

CALM = still(1.5, height=1.1, push=(push(0.2, 20.0, 10.0, 0.0),))
BROWN_OUT = Fault(module="hip_left", kind="brown_out", at=1.2)
HARD = still(1.5, height=1.0, kill=kill(0.4), restart=restart(0.9), fault=(BROWN_OUT,))


def test_two_robots_side_by_side_run_as_each_alone_to_the_last_bit() -> None:
    """Twelve joint services and two planners in one process: neither knows of the other."""

    def rows_of(scenario: Scenario, seed: int) -> Iterator[SimTruth]:
        network = Impairment(delay_ms=2.0, jitter_ms=1.0, loss=0.01)
        fleet = lockstep.Lockstep(ROBOT, scenario, network, seed=seed)
        assert begin_standing(fleet)
        return fleet.run()

    alone = [list(rows_of(CALM, 1)), list(rows_of(HARD, 2))]
    pairs = list(itertools.zip_longest(rows_of(CALM, 1), rows_of(HARD, 2)))
    together = [[row for row in rows if row is not None] for rows in zip(*pairs, strict=True)]
    assert together == alone
    assert all(rows[-1].scenario_s > 1.4 and not rows[-1].fallen for rows in together)
    assert together[0][-1].com != together[1][-1].com


# ---- a person's path by hand: recorded, and led again bit for bit

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
