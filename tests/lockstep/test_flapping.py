"""A link that comes and goes: no more than six drop-outs a minute, and nothing shaken down.

A study found 39 drop-outs in 11 s (docs/results.md). With ages of 4 to 46 ms, all within the
rule, the robot fell in TRACK (by 12 s with 20 ms of jitter on streams). How the planner waits is in
`tests/planner/test_engagement_fsm.py`.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from shared.bus.messages import Cause, Mode, SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Scenario
from tests.lockstep.runs import modes_of, run
from tools.lab.studies.sweeps.figures import event_steps_nm
from tools.sim.lockstep import Lockstep


def squats(seconds: float) -> tuple[Keyframe, ...]:
    heights = (1.188, 0.948)
    return tuple(Keyframe(at=2.5 * n, height=heights[n % 2]) for n in range(2 + int(seconds / 2.5)))


@pytest.mark.timeout(600)  # a minute of virtual time, on a machine that may be busy
@pytest.mark.parametrize(
    ("ordered", "seconds", "tracked"),
    [
        pytest.param(True, 60.0, 0.06, id="a minute of a stream", marks=pytest.mark.wide),
        pytest.param(True, 15.0, 0.06, id="a stream"),
        pytest.param(False, 15.0, 0.9, id="datagrams"),
    ],
)
def test_20_ms_jitter_and_10_percent_loss(
    ordered: bool, seconds: float, tracked: float, robot: RobotConfig
) -> None:
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

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s >= 0.0:
            tracking.append(set(modes_of(fleet)) == {Mode.TRACK})

    outcome = run(robot, scenario, stands=False, each=look)
    assert outcome.stood
    assert sum(tracking) > tracked * len(tracking), "it comes back, and does not only HOLD"
    began_ns = outcome.rows[0].t_ns
    events = [(name, event) for name, event in outcome.lockstep.events if event.t_ns >= began_ns]
    entries = Counter(name for name, event in events if event.mode_after == Mode.HOLD)
    assert max(entries.values(), default=0) <= 6
    if ordered:
        assert any(event.cause == Cause.COMMAND_STALE for _, event in events), "it is a bad link"
    assert max(event_steps_nm(event for _, event in events), default=0.0) <= 5.0
    assert np.abs(outcome.com_mm[:, 0]).max() < 60.0
    assert np.abs(outcome.com_mm[:, 1]).max() < 20.0
    assert np.abs(outcome.angles[:, 0]).max() < 0.05
