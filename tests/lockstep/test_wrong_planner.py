"""Whatever is wrong with the planner: joint services refuse it or bear it, the robot stands.

Without the envelope 5 of 51 made it fall: references negative, half a radian off or drifting, and
two modules' commands swapped. Each of them begins at each of three moments; by default one in 47 of
those runs is made, all of them in seven minutes of two cores by

    XRL_ALL_WRONG=1 ./deploy/test tests/lockstep/test_wrong_planner.py
"""

from __future__ import annotations

import os
from typing import Final, NamedTuple

import pytest

from shared.bus.messages import Mode, Outside
from shared.bus.traces import SimTruth
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import moment_of, push, run, variant
from tests.lockstep.wrong_planners import faults, wrong
from tests.robots import ROBOT
from tools.sim.lockstep import FleetMoment, Lockstep

NAMES: Final = tuple(faults())
assert len(NAMES) >= 300
EVERY: Final = 1 if os.environ.get("XRL_ALL_WRONG") else 47
MOMENTS: Final = (("squat", 1.0), ("stand", 0.5), ("crawl", 3.0))
"""On the way down, standing, and low with the torso pitched."""
WRONG_S: Final = 2.0
STEP_NM: Final = 7.0
"""HOLD lets a coupled torque of 60 N m fade within 20 ms, which is 6 N m a cycle."""


class Begin(NamedTuple):
    """A moment at which the planner leads."""

    name: str
    at: float
    moment: FleetMoment


class End(NamedTuple):
    """How it came out."""

    fell: bool
    step_nm: float
    """Largest step of a joint's torque at a change of mode."""
    outside: set[Outside]
    modes: set[Mode]
    rise: float
    """Fastest way up of the torso, m/s."""


@pytest.fixture(scope="module")
def begins() -> list[Begin]:
    return [begin(ROBOT, name, at) for name, at in MOMENTS]


def begin(robot: RobotConfig, name: str, at: float) -> Begin:
    scenario = variant(name, duration=20.0, kill=(), push=())
    return Begin(name, at, moment_of(robot, scenario, at, stands=False))


def end(robot: RobotConfig, begin: Begin, name: str, lasts_s: float = WRONG_S) -> End:
    """Be wrong for two seconds, or less, pushed from the side after 0.8 s."""

    class Fleet(Lockstep):
        planner_type = wrong(faults()[name])

    at = begin.at
    pushed = (push(at + 0.8, 0.0, 30.0, 0.0),)
    outside: set[Outside] = set()

    def look(fleet: Lockstep, _row: SimTruth) -> None:
        outside.update(Outside(each.failsafe.outside) for each in fleet.controllers)

    scenario = variant(begin.name, duration=at + lasts_s, kill=(), push=pushed)
    ended = run(robot, scenario, start=begin.moment, fleet_type=Fleet, each=look)
    step_nm = max(ended.steps_nm(), default=0.0)
    fell = ended.rows[-1].fallen
    return End(fell, step_nm, outside - {Outside.NOTHING}, set(ended.modes), ended.rising)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("number", range(0, len(NAMES) * len(MOMENTS), EVERY))
def test_it_stands_whatever_its_planner_sends(begins: list[Begin], number: int) -> None:
    which, moment = divmod(number, len(MOMENTS))
    ended = end(ROBOT, begins[moment], NAMES[which])
    assert not ended.fell, NAMES[which]
    assert ended.step_nm < STEP_NM, NAMES[which]


@pytest.mark.parametrize(
    ("name", "outside", "lasts_s"),
    [
        ("k_p of all zero", Outside.K_P, 0.8),
        ("k_d of all zero", Outside.K_D, 0.8),
        ("tau_ff of knee_left negative", Outside.TAU_FF, 0.8),
        ("q_ref of hip_right theta off by 0.5 rad", Outside.Q_REF, 0.8),
        ("tau_coupled noisy", Outside.TORQUE_STEP, 0.8),
        ("margin 0", Outside.MARGIN, 0.8),
        ("tau_coupled of all ramps up in 1 s, +0 +0 +0 +1 +0 +1", Outside.COUPLED_WORK, 2.0),
        ("tau_coupled of all ramps up in 1 s, +0 +0 +0 +1 +0 -1", Outside.COUPLED_ENERGY, 2.0),
    ],
)
def test_it_holds_and_reports_what_it_does_not_believe(
    begins: list[Begin], name: str, outside: Outside, lasts_s: float
) -> None:
    ended = end(ROBOT, begins[0], name, lasts_s)
    assert not ended.fell
    assert outside in ended.outside
    assert ended.modes == {Mode.HOLD}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("module", ["ankle_left", "ankle_right"])
@pytest.mark.parametrize("moment", range(len(MOMENTS)))
def test_it_stands_though_a_planner_whose_reference_drifts_leads_again_and_again(
    begins: list[Begin], module: str, moment: int
) -> None:
    """Before references had to go as their rates say, it fell in the squat and in the stand."""
    assert not end(ROBOT, begins[moment], f"q_ref of {module} theta drifts", 3.0).fell


@pytest.mark.parametrize("moment", range(len(MOMENTS)))
def test_coupled_torques_that_take_the_robot_along_do_not_throw_it(
    begins: list[Begin], moment: int
) -> None:
    """Without `envelope.coupled_energy` it left the floor on its way into the crawl, and fell."""
    ended = end(ROBOT, begins[moment], "tau_coupled of all ramps up in 0.3 s, +0 +0 +0 +1 +0 -1")
    assert not ended.fell
    assert ended.rise < 1.5


@pytest.mark.parametrize(("rate", "moment"), [("+0.1", 1), ("-0.1", 2)])
def test_a_reference_that_drifts_as_its_rate_says_trips_before_the_com_is_over_the_toes(
    begins: list[Begin], rate: str, moment: int
) -> None:
    """Without `trips.balance` both fall: no module can see what is wrong."""
    name = f"q_ref of ankle_right theta drifts and says so, {rate} rad/s"
    assert not end(ROBOT, begins[moment], name, 3.0).fell


def test_without_the_envelope_it_falls(begins: list[Begin]) -> None:
    """A robot that stands here would prove nothing above, where this planner is the first."""
    assert NAMES[0] == "q_ref of all negative"
    assert end(believing(ROBOT), begins[0], NAMES[0]).fell
