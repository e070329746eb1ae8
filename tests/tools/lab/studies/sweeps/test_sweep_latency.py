"""`xrl study sweep latency`: its grid, its trials, its figures, and the verb around them."""

from __future__ import annotations

import argparse
import csv
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from shared.bus.messages import JointEvent, Mode
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.links import DIRECTIONS
from tools import cli
from tools.lab.studies.sweeps import kill, latency, latency_picture
from tools.lab.studies.sweeps.latency_trial import (
    CONTROLS,
    DURATION_S,
    PUSH_S,
    LatencyTrial,
    Network,
    fleet_of,
    hold_share,
    robot_of,
)
from tools.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[5]
GOOD = Network(0.0, 0.0, 0.0)
SOON_DOWN = (
    "--control", "centralised", "--delay", "200", "--loss", "0", "--trials", "1", "--workers", "1",
)  # fmt: skip


def sweep(*flags: str) -> int:
    return cli.main(["study", "sweep", "latency", *flags])


def grid(*flags: str) -> list[LatencyTrial]:
    parser = argparse.ArgumentParser()
    latency.add_flags(parser)
    return latency.trials_of(parser.parse_args(flags))


def trial(**changes: Any) -> LatencyTrial:
    fields: dict[str, Any] = {
        "number": 0,
        "repeat": 0,
        "seed": 1,
        "control": "distributed",
        "network": GOOD,
    }
    return LatencyTrial(**(fields | changes))


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0:200:50", (0.0, 50.0, 100.0, 150.0, 200.0)),
        ("10,0,10", (0.0, 10.0)),
        ("0:20:10,100", (0.0, 10.0, 20.0, 100.0)),
        ("0:25:10", (0.0, 10.0, 20.0)),
        ("5:5:1", (5.0,)),
        (".5", (0.5,)),
    ],
)
def test_values_are_written_as_a_range_or_a_list(text: str, values: tuple[float, ...]) -> None:
    assert latency.values_in(0.0, 1000.0)(text) == values


def test_steps_of_a_tenth_end_at_their_end() -> None:
    assert latency.values_in(0.0, 1.0)("0:0.5:0.1") == (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)


@pytest.mark.parametrize("text", ["", "a", "-1", "0:10", "10:0:1", "0:10:0", "0:10000:0.001", "2"])
def test_values_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        latency.values_in(0.0, 1.0)(text)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--loss", "1.5"), "from 0 to 1"),
        (("--control", "distributed,mine"), "'mine'; some of distributed, diagonal, centralised"),
        (("--delay", "0-200"), "FROM:TO:STEP"),
        (("--trials", "0"), "--trials: '0': must be a whole number of at least 1"),
        (("--lead-easing", "2"), "lead_easing"),
    ],
)
def test_bad_input_is_refused_with_what_would_be_right(
    flags: tuple[str, str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = sweep(*flags)
    except SystemExit as left:
        code = int(left.code or 0)
    assert code == 2
    assert words in capsys.readouterr().err


def test_the_default_grid_has_300_trials_and_goes_to_200_ms_and_half_lost() -> None:
    trials = grid()
    assert len(trials) >= 300
    assert {t.control for t in trials} == {"distributed", "diagonal", "centralised"}
    assert max(t.network.delay_ms for t in trials) == 200.0
    assert max(t.network.loss for t in trials) == 0.5


def test_every_network_meets_every_control_and_more_trials_come_behind() -> None:
    few, more = grid("--trials", "2"), grid("--trials", "3")
    assert more[: len(few)] == few
    assert [t.number for t in more] == list(range(len(more)))
    points = {(t.network, t.control, t.repeat) for t in more}
    assert len(points) == len(more) == 7 * 4 * 3 * 3


def test_trials_are_paired_over_delays_and_controls_and_independent_at_one_delay(
    robot: RobotConfig,
) -> None:
    """So that curves over the delay compare like with like, and their bounds are true."""
    pushes = {trial(control=name).scenario(robot_of(robot, name)).push for name in CONTROLS}
    assert len(pushes) == 1
    by_draw: dict[object, set[tuple[float, str]]] = {}
    for t in grid("--trials", "2"):
        by_draw.setdefault(t.draw, set()).add((t.network.delay_ms, t.control))
    assert len(by_draw) == 2 * 4
    assert all(len(points) == 7 * 3 for points in by_draw.values())
    assert trial(seed=2).draw not in by_draw


def lost(robot: RobotConfig, of: int, **network: float) -> set[int]:
    """Return which messages of a link are lost in a trial over such a network."""
    t = trial(network=Network(**({"delay_ms": 0.0, "jitter_ms": 0.0} | network)))
    links = fleet_of(t, robot, lambda *_: None).network
    links.advance(3.0, 10**9)
    direction = links._links["planner->ankle_left"].direction
    return {number for number in range(of) if not direction.passes(10**9, 0)}


def test_another_loss_loses_other_messages_and_another_delay_the_same(robot: RobotConfig) -> None:
    """Else the trials at one delay would be one trial told four times."""
    few, more = lost(robot, 4000, loss=0.1), lost(robot, 4000, loss=0.3)
    assert len(few) == pytest.approx(400, abs=80)
    assert len(few & more) / len(few) == pytest.approx(0.3, abs=0.1)
    assert lost(robot, 4000, loss=0.1, delay_ms=100.0) == few
    assert lost(robot, 4000, loss=0.1, jitter_ms=5.0) != few


def test_the_command_is_of_this_study_whatever_its_numbers_are(robot: RobotConfig) -> None:
    flags = (
        "--loss",
        "0.1234567,0.1234568",
        "--delay",
        "12345.67,0.00001",
        "--lead-easing",
        "1e-7",
    )
    parser = argparse.ArgumentParser()
    latency.add_flags(parser)
    args = parser.parse_args(flags)
    command = latency._command(args)
    assert "--delay 0.00001,12345.67 --loss 0.1234567,0.1234568" in command
    again = parser.parse_args(command.split()[4:])
    assert latency.trials_of(again) == latency.trials_of(args)
    assert again.lead_easing == args.lead_easing
    assert latency._joined(args.loss) == "0.1234567,0.1234568"
    assert len({(t.draw, t.repeat) for t in latency.trials_of(args)}) == 2 * 4
    assert {latency.row_of(t)["delay_ms"] for t in latency.trials_of(args)} == {
        "0.00001",
        "12345.67",
    }


def test_no_draw_is_beyond_the_study() -> None:
    angles, begins = [], []
    for repeat in range(200):
        draw = trial(repeat=repeat).draw
        begins.append(draw.impaired_from_s)
        for shove in draw.shoves:
            assert 0.2 <= shove.share <= 0.75
            assert shove.at >= draw.impaired_from_s
            assert shove.at + PUSH_S <= DURATION_S - 1.5, "time to fall"
            angles.append(shove.angle)
        assert len(draw.shoves) == 3
        assert all(b.at >= a.at + PUSH_S for a, b in pairwise(draw.shoves))
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


def test_all_links_take_the_delay_that_was_asked_for(robot: RobotConfig) -> None:
    fleet = Lockstep(robot, trial(network=Network(30.0, 0.0, 0.0)).scenario(robot))
    fleet.network.advance(3.0, 10**9)
    releases = {
        name: link.direction.passes(10**9, 0)[0] - 10**9
        for name, link in ((n, fleet.network._links[n]) for n in DIRECTIONS)
    }
    assert set(releases.values()) == {30_000_000}


def test_a_control_differs_in_what_its_name_states(robot: RobotConfig) -> None:
    assert robot_of(robot, "distributed") is robot
    assert robot_of(robot, "centralised") is robot
    assert robot_of(robot, "diagonal").law.split == "diagonal"
    assert CONTROLS["distributed"].fleet is CONTROLS["diagonal"].fleet is Lockstep


def event(t_ns: int, after: Mode) -> JointEvent:
    return JointEvent(
        t_ns=t_ns,
        seq=0,
        mode_before=0,
        mode_after=int(after),
        cause=0,
        age_ns=0,
        tau_before=(0.0, 0.0),
        tau_after=(0.0, 0.0),
    )


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
    events = [(name, event(t, after)) for name, t, after in rows]
    assert hold_share(events, 0, 100) == pytest.approx(share)


def test_the_digest_has_every_tool_that_decides_a_run_and_no_picture() -> None:
    """Whatever lockstep imports, and so on from there, with no list to be kept."""
    design = "tools/lab/design/split_program.py"
    for code, own in (
        (
            kill.CODE,
            {*(f"tools/lab/studies/sweeps/{name}.py" for name in ("cases", "outcome")), design},
        ),
        (
            latency.CODE,
            {"tools/lab/studies/sweeps/latency_trial.py", "tools/sim/centralised/control.py"},
        ),
    ):
        runs = ("lockstep", "network", "virtual_drive", "virtual_harness", "virtual_network")
        assert {"services", "shared", *(f"tools/sim/{name}.py" for name in runs)} | own <= {*code}
        assert [part for part in code if "picture" in part or "report" in part] == []


@pytest.fixture(scope="module")
def fallen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of one trial, in which the baseline falls: no failure of the shipped control."""
    out = tmp_path_factory.mktemp("latency")
    assert sweep(*SOON_DOWN, "--out", str(out)) == 0
    return out


def row_in(out: Path) -> dict[str, str]:
    with (out / "latency.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    return row


def test_a_study_is_tabled_and_drawn(fallen: Path) -> None:
    row = row_in(fallen)
    assert row["ending"] == "fell"
    assert 0.5 < float(row["fell_at_s"]) < DURATION_S
    assert float(row["hold_share"]) == 0.0
    for name in (latency_picture.FALLS, latency_picture.EFFORT):
        assert (fallen / name).stat().st_size > 10_000


def test_a_study_is_gone_on_with_and_another_one_is_refused(
    fallen: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(*SOON_DOWN, "--out", str(fallen)) == 0
    assert "1 of 1 cases are done already" in capsys.readouterr().out
    assert sweep(*SOON_DOWN, "--delay", "100", "--out", str(fallen)) == 2
    assert "another delay" in capsys.readouterr().err


def test_one_trial_alone_is_the_trial_of_the_study(
    fallen: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(*SOON_DOWN, "--only", "0") == 1
    lines = (line.split() for line in capsys.readouterr().out.splitlines())
    alone = {words[0]: words[1] for words in lines if len(words) == 2}
    row = row_in(fallen)
    for name in ("ending", "control"):
        assert alone[name] == row[name]
    for name in ("fell_at_s", "operator_peak_n", "com_max_mm", "torque_step_nm"):
        assert float(alone[name]) == pytest.approx(float(row[name]), rel=1e-3)
