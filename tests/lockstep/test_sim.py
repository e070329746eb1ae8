"""`xrl sim`, the verb around lockstep; and runs that are the same to the last bit."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.scenarios import Fault, Scenario
from shared.joints import MODULES
from tests.lockstep.runs import kill, push, restart, still
from tests.robots import ROBOT
from tests.tools.exit_codes import exit_code
from tools import cli
from tools.logs.run_log import read_run
from tools.sim import lockstep
from tools.sim.standing_start import begin_standing

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
    """The same seed gives the same one: below, and in `test_hand.py`."""
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


def test_a_stance_that_is_not_led_is_reported_in_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "READY_NS", 5 * NS_PER_S)
    far = ("--plant", "feet.offset_right=[0.2,0,0]")
    assert sim(tmp_path, "--duration", "1", *far) == 2
    output = capsys.readouterr().err
    assert "the planner did not lead" in output
    assert "ahead of the left" in output


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
