"""Networks that are bad unevenly, every command within the age rule: all six track, and it stands.

tau_coupled fades out there. What stands in its place has to damp sway as well: with the certified
gains alone a push in y swung on by 0.84 from side to side, and a second one in step with it, or
one of 60 N, made the robot fall.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import find_peaks

from shared.config import RobotConfig
from shared.messages import Mode
from shared.scenario import Inject, Push
from tests.lockstep.runs import Run, push, run, still, story


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
    assert {c.failsafe.mode for c in result.lockstep.controllers} == {Mode.TRACK}
    assert np.abs(result.com_mm[:, :2]).max() < 50.0
    assert np.abs(result.operator_n).max() < 45.0


@pytest.mark.parametrize("pushes", [IN_STEP, ALL_WAYS], ids=["in_step", "all_ways"])
@pytest.mark.parametrize("network", UNEVEN)
def test_it_stands_through_pushes_while_all_six_track(
    robot: RobotConfig, network: str, pushes: tuple[Push, ...]
) -> None:
    told = story("squat", duration=7.0, kill=(), push=pushes, inject=UNEVEN[network])
    assert_it_stood_and_tracked(run(robot, told))


@pytest.mark.parametrize("module", ["ankle_left", "hip_left"])
def test_so_it_does_with_any_other_module_late(robot: RobotConfig, module: str) -> None:
    told = still(5.0, height=1.0, push=(push(2.4, 0.0, 60.0, 0.0),), inject=one_late(module, 22.0))
    assert_it_stood_and_tracked(run(robot, told))


def test_without_tau_coupled_sway_is_damped_as_well_as_in_hold(robot: RobotConfig) -> None:
    pushed = (push(1.5, 0.0, 40.0, 0.0),)
    networks = {
        "track": one_late("knee_right", 20.0),
        "hold": (Inject(link="all", at=0.5, partition=True),),
    }
    swings = {}
    for name, network in networks.items():
        result = run(robot, still(6.5, push=pushed, inject=network))
        assert result.stood
        assert {c.failsafe.mode for c in result.lockstep.controllers} == {Mode[name.upper()]}
        peaks, _ = find_peaks(np.abs(result.com_mm[result.t > 1.6, 1]), distance=40)
        heights = np.abs(result.com_mm[result.t > 1.6, 1])[peaks]
        swings[name] = heights[1] / heights[0]
    assert swings["track"] < 0.65
    assert swings["track"] < swings["hold"] + 0.05
