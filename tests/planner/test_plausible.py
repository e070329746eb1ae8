"""States that no joint can have measured: the planner neither uses them nor ends by them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.planner.planner import Planner
from services.planner.watch.plausible import BEYOND_RAD, SPEED_MAX, TURN_MAX, Plausible
from shared.bus.messages import Attitude, PlannerMode, Vector3
from shared.joints import N_JOINTS
from tests.planner.states import (
    ROBOT,
    SESSION,
    START_NS,
    TICK_NS,
    closed,
    lead,
    state,
    ticked,
    wrench,
)

ANY = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, 64.0, -64.0, 0.0, math.pi / 2]),
    st.floats(-4.0, 4.0),
)


@pytest.mark.parametrize("joint", range(N_JOINTS))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_angle_is_taken_up_to_half_a_radian_beyond_its_soft_stop(
    joint: int, side: float
) -> None:
    """At its very bounds, and at those of its speed, a state is still one."""
    plausible, module, q = Plausible(ROBOT), joint // 2, np.zeros(N_JOINTS)
    bound = ROBOT.joint_limits()[joint][side > 0.0] + side * BEYOND_RAD
    for angle, taken in ((bound, True), (np.nextafter(bound, side * np.inf), False)):
        q[joint] = angle
        fastest = state(module, q, v=(SPEED_MAX, -SPEED_MAX))
        assert plausible.is_state(module, fastest) is taken


@pytest.mark.parametrize("speed", [math.nan, math.inf, -math.inf, 1e300, -101.0])
def test_a_speed_that_is_none_is_no_state(speed: float) -> None:
    for v in ((speed, 0.0), (0.0, speed)):
        assert not Plausible(ROBOT).is_state(2, state(2, np.zeros(N_JOINTS), v=v))


@pytest.mark.parametrize("angle", [math.nan, 1e308, 64.0])
def test_absurd_angles_alone_are_silence(planner: Planner, angle: float) -> None:
    q = closed(1.188)
    now_ns, wrong = lead(planner, q), q.copy()
    wrong[4] = angle
    for seq in range(10, 40):
        now_ns += TICK_NS
        commands, status = ticked(planner, wrong, now_ns, seq)
    assert all(command.hold for command in commands)
    assert status.mode == PlannerMode.WAITING
    assert status.state_seq[2] < 10 <= status.state_seq[3]
    assert all(math.isfinite(value) for command in commands for value in command.q_ref)


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(ANY, min_size=N_JOINTS, max_size=N_JOINTS), ANY, st.booleans())
def test_whatever_angles_come_no_tick_ends_and_it_leads_again_by_good_ones(
    angles: list[float], speed: float, led: bool
) -> None:
    planner, good = Planner(ROBOT, SESSION), closed(1.188)
    now_ns = lead(planner, good) if led else START_NS
    for seq in range(10, 14):
        now_ns += TICK_NS
        ticked(planner, np.array(angles), now_ns, seq, v=(speed, 0.0))
    for seq in range(20, 2600):
        now_ns += TICK_NS
        commands, status = ticked(planner, good, now_ns, seq)
        if seq > 22 and not commands[0].hold:
            break
    assert status.mode == PlannerMode.LEADING
    assert all(math.isfinite(value) for command in commands for value in command.tau_coupled)


def test_a_wrench_is_taken_up_to_what_the_cells_together_can_carry() -> None:
    plausible, most = Plausible(ROBOT), 6.0 * ROBOT.harness.leg_force_max
    for force, taken in ((most, True), (-most, True), (1.001 * most, False), (-1e300, False)):
        assert plausible.is_wrench(wrench(force)) is taken
    harness = ROBOT.harness
    most *= harness.base_radius + harness.platform_radius + harness.height
    for moment, taken in ((most, True), (-1.001 * most, False), (-1e300, False)):
        assert plausible.is_wrench(wrench(moment=(0.0, moment, 0.0))) is taken


@pytest.mark.parametrize(
    ("up", "rate", "valid", "taken"),
    [
        ((0.0, 0.0, 1.0), 0.0, True, True),
        ((0.0, 0.0, 1.05), 99.0, True, True),
        ((0.0, 0.0, 1.2), 0.0, True, False),
        ((0.0, 0.0, 0.0), 0.0, True, False),
        ((0.0, 0.0, 0.0), 0.0, False, True),
        ((0.0, 0.0, 1.1), 0.0, False, True),
        ((0.0, 0.0, 1.2), 0.0, False, False),
        ((1e300, 0.0, 0.0), 0.0, False, False),
        ((0.0, 0.0, 1.0), TURN_MAX, True, True),
        ((0.0, 0.0, 1.0), 1e300, True, False),
    ],
)
def test_an_attitude_is_a_direction_and_a_rate_that_a_torso_can_turn_at(
    up: Vector3, rate: float, valid: bool, taken: bool
) -> None:
    attitude = Attitude(t_ns=1, seq=1, up=up, rate=(rate, 0.0, 0.0), valid=valid, age_ns=0)
    assert Plausible(ROBOT).is_attitude(attitude) is taken


@pytest.mark.parametrize("force", [1e300, 8999.0])
def test_a_second_of_an_absurd_wrench_leaves_no_trace(planner: Planner, force: float) -> None:
    """1e300 N left a load of 300 digits behind: MISLOADED until the planner was killed."""
    q = closed(1.188)
    now_ns = lead(planner, q)
    for seq in range(10, 2500):
        now_ns += TICK_NS
        planner.receive_wrench(wrench(force if seq < 260 else 0.0, seq=seq), now_ns)
        commands, status = ticked(planner, q, now_ns, seq)
        if seq > 300 and status.mode == PlannerMode.LEADING:
            break
    assert status.mode == PlannerMode.LEADING
    assert abs(status.load[0]) < (ROBOT.law.load_correction[0] if force < 9000.0 else 0.1)
    assert status.refused == (250 if force > 9000.0 else 0)
    assert max(abs(tau) for command in commands for tau in command.tau_coupled) < 1.0
