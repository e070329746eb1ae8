"""What a controller remembers, and what it tells of itself."""

from __future__ import annotations

import msgspec
import pytest

from services.joint.controller import ControllerSnapshot, JointController, row_of
from services.joint.neighbours import NeighbourRow, NeighbourView
from services.joint.sinking import SinkingState
from services.joint.torque_limiter import limits_of
from services.joint.trips import JointTrips
from shared.bus.messages import Cause, Mode
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import Bench

COUPLED = (4.0, -6.0)


@pytest.fixture
def bench(robot: RobotConfig) -> Bench:
    return Bench(robot)


def test_a_controller_restored_from_a_snapshot_shares_nothing_with_it(
    bench: Bench, robot: RobotConfig
) -> None:
    bench.to_track(tau_coupled=COUPLED)
    sinking = SinkingState(-2.2, 0.1, -0.3, 0.4, caught=True, doubt_ns=7)
    taken = bench.controller.snapshot()
    state = msgspec.structs.replace(
        taken.state,
        last_cycle_ns=12,
        initial_torque=(1.0, 2.0),
        cause=3,
        tau=(4.0, 5.0),
        cycle=6,
        late=7,
        events=8,
        states=9,
        takeover_offset=(0.1, 0.2),
        resumed_ns=10,
        trips=JointTrips(slow=(1.0, 2.0), mean=(3.0, 4.0), at_limit_ns=5, fast_ns=6),
    )
    law = msgspec.structs.replace(taken.law, changed_ns=11, stiffened_ns=13, sinking=sinking)
    snapshot = ControllerSnapshot(state=state, law=law)
    before = msgspec.msgpack.encode(snapshot)
    other = JointController(believing(robot), "knee_right")
    other.restore(snapshot)
    assert other.snapshot() == snapshot
    other.step(bench.now_ns, None, bench.fresh(), True)
    assert msgspec.msgpack.encode(snapshot) == before


def test_a_snapshot_shares_nothing_with_the_controller_that_it_was_taken_from(bench: Bench) -> None:
    bench.to_track(tau_coupled=COUPLED)
    snapshot = bench.controller.snapshot()
    before = msgspec.msgpack.encode(snapshot)
    bench.run(3, fresh=True)
    bench.run(60)
    assert bench.controller.failsafe.dropouts.count == 1
    assert msgspec.msgpack.encode(snapshot) == before


@pytest.mark.parametrize("axis", [0, 1])
def test_a_joint_at_its_soft_stop_is_inside_and_beyond_it_is_not(
    robot: RobotConfig, axis: int
) -> None:
    limits = limits_of(robot, "knee_right")
    stops = (limits.phi, limits.theta)[axis]
    middle = [0.5 * sum(limits.phi), 0.5 * sum(limits.theta)]
    for theta, inside in (
        (stops[0] - 1e-6, False),
        (stops[0], True),
        (stops[1], True),
        (stops[1] + 1e-6, False),
    ):
        controller = JointController(robot, "knee_right")
        at = middle.copy()
        at[axis] = theta
        controller.samples.q = (at[0], at[1])
        assert controller.inside_limits() is inside


def test_neighbours_are_given_the_joints_position_and_state(bench: Bench) -> None:
    bench.v = (0.3, -0.2)
    bench.to_hold()
    row = row_of(bench.controller)
    assert row == NeighbourRow(
        bench.now_ns, pytest.approx(bench.q[1]), pytest.approx(-0.2), Mode.HOLD, 0
    )
    bench.cycle(estop=True)
    unheard = NeighbourView(sinks=False)
    for _ in range(200):
        bench.now_ns += bench.cycle_ns
        bench.controller.step(bench.now_ns, bench.reading(), None, True, near=unheard)
    assert row_of(bench.controller)[3:] == (Mode.DAMP, 1)


def test_cycles_are_counted_one_by_one_and_before_any_change_there_is_no_cause(
    bench: Bench,
) -> None:
    before = bench.controller.state(bench.now_ns)
    assert (before.cause, before.stiffened) == (0, False)
    for count in (1, 2, 3):
        bench.cycle()
        assert bench.controller.cycle == count


def test_a_module_that_holds_with_all_it_has_reports_it_from_the_first_cycle(bench: Bench) -> None:
    taken = bench.controller.snapshot()
    for stiffened_ns, stiffened in ((0, False), (1, True)):
        law = msgspec.structs.replace(taken.law, stiffened_ns=stiffened_ns)
        bench.controller.restore(msgspec.structs.replace(taken, law=law))
        assert bench.controller.state(bench.now_ns).stiffened is stiffened


def test_motors_at_their_limit_take_the_module_out_of_track(
    robot: RobotConfig, bench: Bench
) -> None:
    beyond = (0.0, -2.0 * robot.joint.tau_module_max)
    bench.to_track(tau_ff=beyond)  # it blends in: at once it would be shaking
    results = bench.run(500, fresh=True, tau_ff=beyond)
    causes = [result.event.cause for result in results if result.event is not None]
    assert causes[0] == Cause.TORQUE_LIMIT
