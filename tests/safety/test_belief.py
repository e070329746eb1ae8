"""What a joint service believes, through its whole cycle: by its mode, and how late it is."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from services.joint.controller import JointController
from shared.bus.messages import Mode, Outside
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import Bench
from tests.joint.test_envelope import MODULE, Q, bounds_of, middle

BLEND_CYCLES = 150
"""300 ms at 500 Hz."""


class Wary(Bench):
    """A bench whose controller has its bounds; the planner leads by what is in their middle."""

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(robot, MODULE)
        self.controller = JointController(robot, MODULE)
        self.robot, self.q = robot, Q

    def told(self, *, late_ms: float = 0.0, **changes: Any) -> Outside:
        """Send one command, echoing a state from so long before the last; return what is told."""
        self.seq += 1
        sent = msgspec.structs.replace(
            middle(self.robot, **changes),
            seq=self.seq,
            t_ns=self.now_ns,
            echo_t_ns=self.now_ns - round(late_ms * NS_PER_MS),
        )
        self.cycle(sent)
        return self.controller.failsafe.outside

    def tracks(self, **changes: Any) -> None:
        """Come to TRACK."""
        self.to_hold()
        while self.mode is not Mode.TRACK:
            assert self.told(**changes) is Outside.NOTHING


@pytest.fixture
def wary(robot: RobotConfig) -> Wary:
    return Wary(robot)


def test_a_torque_that_jumps_is_refused_while_it_tracks_and_only_then(wary: Wary) -> None:
    jumps = {"tau_coupled": (0.0, 20.0)}
    wary.to_hold()
    assert wary.told() is Outside.NOTHING
    assert wary.told(**jumps) is Outside.NOTHING, "in HOLD nothing has come of the last"
    assert wary.controller.failsafe.refused == 0
    wary.tracks()
    assert wary.told() is Outside.NOTHING
    assert wary.told(**jumps) is Outside.TORQUE_STEP
    assert wary.controller.failsafe.refused == 1


def test_a_reference_is_judged_as_old_as_it_is_and_no_older_than_it_is_used(wary: Wary) -> None:
    """It moves at 5 rad/s; ages count up to 30 ms."""
    distance = wary.robot.envelope.q_ref_distance
    cycle_ms = wary.cycle_ns / NS_PER_MS
    wary.to_hold()
    moves = {"v_ref": (0.0, 5.0)}
    near = {"q_ref": (Q[0], Q[1] + distance - 5.0 * 0.021)}
    assert wary.told(late_ms=20.0 - cycle_ms, **near, **moves) is Outside.NOTHING
    assert wary.told(late_ms=22.0 - cycle_ms, **near, **moves) is Outside.Q_REF
    nearer = {"q_ref": (Q[0], Q[1] + distance - 5.0 * 0.031)}
    assert wary.told(late_ms=45.0, **nearer, **moves) is Outside.NOTHING


def test_a_spring_may_pull_harder_while_track_blends_in_and_not_after(wary: Wary) -> None:
    stiff = {"k_p": bounds_of(wary.robot).k_p[1]}
    wary.tracks(**stiff)
    pulled = 1.2 * wary.robot.envelope.spring_torque / stiff["k_p"][1]
    wary.q = (Q[0], Q[1] + pulled)  # the joint gives; what is told stays the same
    for cycle in range(BLEND_CYCLES + 10):
        found = wary.told(**stiff)
        if cycle < BLEND_CYCLES - 2:
            assert found is Outside.NOTHING
    assert found is Outside.Q_REF


def test_hold_stiffens_about_the_joint_and_track_about_the_reference(robot: RobotConfig) -> None:
    """A knee 0.2 rad off its reference, with a tenth of HOLD's stiffness."""
    bench = Bench(robot)
    soft = {"k_p": (300.0, 300.0), "q_ref": (bench.q[0], bench.q[1] + 0.2)}
    bench.to_track(**soft)
    assert bench.controller.setpoint.q_ref[1] == pytest.approx(bench.q[1] + 0.2)
    before = bench.controller.tau
    bench.run(400, hold=True, fresh=True, **soft)
    assert bench.mode is Mode.HOLD
    assert bench.controller.setpoint.q_ref[1] == pytest.approx(bench.q[1])
    assert bench.controller.tau == pytest.approx(before, abs=1.0)


def test_a_step_without_the_flag_does_not_listen(robot: RobotConfig) -> None:
    """Listening, a joint that jumps is where it is found; else the sample is not believed."""
    bench = Bench(robot)
    bench.to_hold()
    bench.q = (bench.q[0], bench.q[1] + 0.5)
    bench.cycle()
    assert bench.controller.samples.rejected_count == 1
    assert bench.controller.samples.q[1] == pytest.approx(bench.q[1] - 0.5)
