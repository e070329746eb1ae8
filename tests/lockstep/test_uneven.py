"""Networks that are bad unevenly, or that come and go: it stands, and drops out six times a minute.

With every command within the age rule, tau_coupled fades out. What stands in its place has to damp
sway as well: with the certified gains alone a push in y swung on by 0.84 from side to side, and a
second one in step with it, or one of 60 N, made the robot fall. A study found 39 drop-outs in 11 s
(docs/results.md). How the planner waits is in `tests/planner/test_engagement_fsm.py`.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.signal import find_peaks

from shared.bus.messages import Cause, Mode
from shared.bus.traces import SimTruth
from shared.config.scenarios import Inject, Keyframe, Push, Scenario
from tests.lockstep.runs import Run, led_to, modes_of, push, run, still, variant
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep


def one_late(module: str, delay_ms: float) -> tuple[Inject, ...]:
    links = (f"planner->{module}", f"{module}->planner")
    return tuple(Inject(link=link, at=0.3, delay_ms=delay_ms) for link in links)


UNEVEN = {
    "one knee 10 ms late each way": one_late("knee_right", 10.0),
    "20 ms of jitter on every stream": (Inject(link="all", at=0.3, jitter_ms=20.0, ordered=True),),
    "one hip's states unsteady": (
        Inject(link="hip_right->planner", at=0.3, delay_ms=14.0, jitter_ms=14.0),
    ),
}

IN_STEP = (push(2.4, 0.0, 40.0, 0.0), push(4.4, 0.0, 40.0, 0.0))
"""Two seconds apart: in step with the sway of the certified gains."""

ALL_WAYS = (
    push(1.0, 28.0, 28.0, 0.0),
    push(2.4, 0.0, 40.0, 0.0),
    push(4.0, -40.0, 0.0, 0.0),
    push(5.4, 0.0, -40.0, 0.0),
)


def assert_it_stood_and_tracked(result: Run) -> None:
    assert result.stood
    assert set(result.modes) == {Mode.TRACK}
    assert np.abs(result.com_mm[:, :2]).max() < 50.0
    assert np.abs(result.operator_n).max() < 45.0


@pytest.mark.sampled(3)
@pytest.mark.parametrize("pushes", [IN_STEP, ALL_WAYS], ids=["in_step", "all_ways"])
@pytest.mark.parametrize("network", UNEVEN)
def test_it_stands_through_pushes_while_all_six_track(
    network: str, pushes: tuple[Push, ...]
) -> None:
    scenario = variant("squat", duration=7.0, kill=(), push=pushes, inject=UNEVEN[network])
    assert_it_stood_and_tracked(run(ROBOT, scenario))


@pytest.mark.parametrize("module", ["ankle_left", "hip_left"])
def test_so_it_does_with_any_other_module_late(module: str) -> None:
    happens = {"push": (push(2.4, 0.0, 60.0, 0.0),), "inject": one_late(module, 22.0)}
    assert_it_stood_and_tracked(run(ROBOT, still(5.0, height=1.0, **happens)))


class Steps(Lockstep):
    """Watches how far the joint torques go from one cycle to the next."""

    largest_nm = 0.0

    def advance(self) -> None:
        before = [controller.tau for controller in self.controllers]
        super().advance()
        if self.world.scenario_s > 0.0:
            changes = np.subtract([controller.tau for controller in self.controllers], before)
            self.largest_nm = max(self.largest_nm, float(np.abs(changes).max()))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("delay_ms", [3.5, 4.7])
def test_two_hips_a_bit_late_shake_no_legs(delay_ms: float) -> None:
    """At 49 Hz, by 40 N m a cycle, it did from 4.5 s on, unpushed, with all of tau_coupled."""
    late = (*one_late("hip_right", delay_ms), *one_late("hip_left", delay_ms))
    squat = variant("squat", duration=6.0, kill=(), push=(), inject=late)
    outcome = run(ROBOT, squat, fleet_type=Steps)
    assert outcome.stood
    assert isinstance(outcome.lockstep, Steps)
    assert outcome.lockstep.largest_nm < 5.0


def test_a_drop_out_in_the_middle_of_a_sway_is_not_held_off_centre() -> None:
    """Led from where the sway was, and lost again, HOLD stood 25 mm to the side, and fell."""
    pushes = tuple(push(t, 0.0, 40.0, 0.0) for t in (1.6, 3.1, 4.6))
    lossy = (Inject(link="ankle_left->planner", at=0.3, loss=0.7, burst=5),)
    scenario = led_to((1.0, 1.188), (3.0, 0.948), duration=6.0, push=pushes, inject=lossy)
    outcome = run(ROBOT, scenario, seed=2038, stands=False)
    assert outcome.stood
    assert np.abs(outcome.com_mm[:, 1]).max() < 55.0


def test_without_tau_coupled_sway_is_damped_as_well_as_in_hold() -> None:
    cut = (Inject(link="all", at=0.5, partition=True),)
    swings = {}
    for mode, network in {Mode.TRACK: one_late("knee_right", 20.0), Mode.HOLD: cut}.items():
        result = run(ROBOT, still(4.5, push=(push(1.5, 0.0, 40.0, 0.0),), inject=network))
        assert result.stood
        assert set(result.modes) == {mode}
        sway = np.abs(result.com_mm[result.t > 1.6, 1])
        heights = sway[find_peaks(sway, distance=40)[0]]
        swings[mode] = heights[1] / heights[0]
    assert swings[Mode.TRACK] < 0.65
    assert swings[Mode.TRACK] < swings[Mode.HOLD] + 0.05


# ---- a link that comes and goes


def squats(seconds: float) -> tuple[Keyframe, ...]:
    heights = (1.188, 0.948)
    return tuple(Keyframe(at=2.5 * n, height=heights[n % 2]) for n in range(2 + int(seconds / 2.5)))


@pytest.mark.timeout(600)  # a minute of virtual time, on a machine that may be busy
@pytest.mark.parametrize(
    ("ordered", "seconds", "tracked"),
    [
        pytest.param(True, 60.0, 0.06, id="a minute of a stream", marks=pytest.mark.wide),
        pytest.param(True, 10.0, 0.06, id="a stream"),
        pytest.param(False, 8.0, 0.9, id="datagrams"),
    ],
)
def test_20_ms_jitter_and_10_percent_loss(ordered: bool, seconds: float, tracked: float) -> None:
    """Before ages were watched and the planner waited, the robot fell in 12 s on streams.

    Jitter is about the delay, and none is given: what it would take off is clipped at 0, so half
    of the messages have no delay and the others up to 20 ms more.

    It is no network to TRACK on for a minute: on streams six drop-outs, each with a longer wait,
    leave 11 % of the time (two seeds: 0.108 and 0.113); as datagrams, where what is overtaken is
    left out, 99 % with one drop-out, and the coupled torques faded to a quarter.
    """
    link = Inject(link="all", at=0.0, jitter_ms=20.0, loss=0.1, ordered=ordered)
    frames = squats(seconds)
    scenario = Scenario(name="flap", about="", duration=seconds, keyframe=frames, inject=(link,))
    tracking: list[bool] = []

    def look(fleet: Lockstep, _row: SimTruth) -> None:
        tracking.append(set(modes_of(fleet)) == {Mode.TRACK})

    outcome = run(ROBOT, scenario, each=look)
    assert outcome.stood
    assert sum(tracking) > tracked * len(tracking), "it comes back, and does not only HOLD"
    events = outcome.lockstep.events
    entries = Counter(name for name, event in events if event.mode_after == Mode.HOLD)
    assert max(entries.values(), default=0) <= 6
    if ordered:
        assert any(event.cause == Cause.COMMAND_STALE for _, event in events), "it is a bad link"
    assert max(outcome.steps_nm(), default=0.0) <= 5.0
    assert np.abs(outcome.com_mm[:, 0]).max() < 60.0
    assert np.abs(outcome.com_mm[:, 1]).max() < 20.0
    assert np.abs(outcome.angles[:, 0]).max() < 0.05
