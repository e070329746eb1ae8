"""Small faults of the code that no test noticed once: each of them fails one of these."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.joint.controller import JointController
from services.joint.failsafe import (
    RETIRED_SESSIONS_KEPT,
    Event,
    Failsafe,
    Timing,
    timing_of,
)
from services.planner.planner import Planner
from services.planner.watch.engagement_fsm import GRACE_NS, Engagement
from shared.bus.messages import Cause, Mode, PlannerMode, Refusal, Wrench
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tests.joint.helpers import SESSION, T0, Bench, command
from tests.planner.test_planner import SESSION as PLANNER
from tests.planner.test_planner import START_NS, lead, receive_all

GENTLE = (3.0, -5.0)
"""N m"""


@pytest.fixture(scope="module")
def timing(robot: RobotConfig) -> Timing:
    return timing_of(robot)


def test_commands_that_came_before_the_drive_was_armed_do_not_count_for_track(
    timing: Timing,
) -> None:
    failsafe, now_ns = Failsafe(), T0
    for seq in range(1000):
        now_ns += 2 * NS_PER_MS
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, timing)
        failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert failsafe.fresh_since_ns == -1
    failsafe.advance(now_ns, timing, Event.DRIVE_ARMED, estop=False)
    armed_ns, seq = now_ns, 1000
    while failsafe.mode is not Mode.TRACK:
        assert failsafe.mode is Mode.HOLD
        now_ns, seq = now_ns + 2 * NS_PER_MS, seq + 1
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, timing)
        failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert now_ns - armed_ns >= timing.engage_after_ns


@pytest.mark.parametrize("name", ["tau_ff", "tau_coupled"])
def test_the_largest_torque_of_a_command_is_what_both_motors_can_give_twice(
    robot: RobotConfig, timing: Timing, name: str
) -> None:
    most = 4.0 * robot.joint.tau_module_max
    for torque, refusal in ((most, Refusal.NONE), (1.001 * most, Refusal.OUT_OF_LIMITS)):
        told = command(**{name: (torque, 0.0)})
        assert Failsafe().offer(told, T0, timing) is refusal


def test_a_knee_that_is_caught_is_damped_and_not_only_sprung(robot: RobotConfig) -> None:
    stand = robot.stand_gains("knee_left")
    bench = Bench(robot, "knee_left")
    bench.to_hold()
    bench.cycle(estop=True)
    bench.run(3000)
    stop = robot.joint_service.damp_knee_stop
    bench.move((bench.q[0], stop - 0.02))
    still = bench.run(5)[-1].tau[1]
    bench.v = (0.0, -0.1)
    moving = bench.run(200)[-1].tau[1]
    assert moving - still == pytest.approx(0.1 * stand.k_d[1], rel=0.05)


def test_a_knee_that_is_lower_than_the_stop_is_caught_where_it_is(robot: RobotConfig) -> None:
    """Not pushed up to the stop: the robot would rise by itself after an emergency stop."""
    bench = Bench(robot, "knee_left")
    low = robot.joint_service.damp_knee_stop - 0.1
    bench.q = (0.02, low)
    bench.to_hold()
    bench.cycle(estop=True)
    bench.run(3000)
    assert bench.cycle().tau[1] == pytest.approx(0.0, abs=1e-6)
    bench.move((0.02, low - 0.01))
    caught = bench.run(5)[-1].tau[1]
    assert caught == pytest.approx(0.01 * robot.stand_gains("knee_left").k_p[1], rel=1e-3)


@pytest.mark.parametrize("module", ["ankle_left", "knee_left", "hip_right"])
def test_in_damp_what_does_not_sink_comes_to_the_stand_gains(
    robot: RobotConfig, module: str
) -> None:
    bench = Bench(robot, module)
    soft = {"k_p": (100.0, 90.0), "k_d": (5.0, 4.0), "tau_ff": GENTLE}
    bench.to_track(**soft)
    bench.cycle(estop=True)
    bench.run(round(robot.joint_service.damp_fade_s * robot.joint_service.rate_hz) + 50)
    setpoint, stand = bench.controller.setpoint, robot.stand_gains(module)
    sinks = kind_of(module) in robot.joint_service.damp_sinks
    for axis in (0,) if sinks else (0, 1):
        assert setpoint.k_p[axis] == pytest.approx(max(stand.k_p[axis], soft["k_p"][axis]))
        assert setpoint.k_d[axis] == pytest.approx(max(stand.k_d[axis], soft["k_d"][axis]))


@pytest.mark.parametrize("carried", [(200.0, 0.0), (-90.0, 90.0), (1e4, -1e4)])
def test_what_a_drive_carried_in_a_gap_goes_on_within_the_motors_limits(
    robot: RobotConfig, carried: tuple[float, float]
) -> None:
    bench = Bench(robot)
    bench.to_hold()
    phi, theta = bench.controller.resume(bench.now_ns, carried)
    most = robot.joint.tau_module_max + 1e-9
    assert abs(phi + theta) <= most
    assert abs(theta - phi) <= most
    assert np.sign(theta) == np.sign(carried[1]) or carried[1] == 0.0


@pytest.mark.parametrize(("age_ms", "taken"), [(49, True), (51, False)])
def test_a_drive_is_taken_over_on_the_commands_gains_only_while_the_command_is_usable(
    robot: RobotConfig, age_ms: int, *, taken: bool
) -> None:
    controller = JointController(believing(robot), "knee_right")
    bench = Bench(robot)
    told = command(hold=True, k_p=(600.0, 12.0), k_d=(40.0, 3.0), echo_t_ns=T0)
    controller.failsafe.offer(told, T0, controller.timing)
    bench.now_ns = T0 + age_ms * NS_PER_MS
    reading = msgspec.structs.replace(bench.reading(), torque=(1.0, -1.0))
    controller.step(bench.now_ns, reading, None, estop=False)
    assert controller.failsafe.mode is Mode.HOLD
    assert (controller.setpoint.k_p == told.k_p) is taken


def test_a_module_has_150_ms_to_report_track() -> None:
    assert GRACE_NS == 150 * NS_PER_MS
    fresh, modes = [True] * len(MODULES), [int(Mode.HOLD)] * len(MODULES)
    for after_ms, mode in ((150, PlannerMode.LEADING), (151, PlannerMode.ALIGNING)):
        engagement = Engagement(PlannerMode.LEADING, T0)
        engagement.advance(T0 + after_ms * NS_PER_MS, fresh, fresh, modes)
        assert engagement.mode is mode


def test_an_old_wrench_eases_nothing(robot: RobotConfig) -> None:
    """A hand that pulled with 60 N as the harness fell silent would pull for ever."""
    q = np.array(stand_pose(robot, 1.188))
    heard, deaf = Planner(robot, PLANNER), Planner(robot, PLANNER)
    now_ns = lead(heard, q)
    assert lead(deaf, q) == now_ns
    pull = Wrench(
        t_ns=now_ns,
        seq=1,
        force=(0.0, 0.0, 60.0),
        moment=(0.0, 0.0, 0.0),
        valid=True,
        saturated=False,
        tare=0,
        age_ns=0,
    )
    heard.receive_wrench(pull, now_ns)
    eased = []
    for seq in range(5, 400):
        now_ns += 4 * NS_PER_MS
        torques = []
        for planner in (heard, deaf):
            receive_all(planner, q, now_ns, seq)
            torques.append([c.tau_coupled for c in planner.tick(now_ns)])
        eased.append(float(np.abs(np.subtract(*torques)).max()))
    assert max(eased[:5]) > 0.1, "it was heard at first"
    assert eased[-1] < 1e-6
    assert now_ns - START_NS > NS_PER_S


def test_a_clock_that_starts_at_nought_is_a_clock(timing: Timing) -> None:
    failsafe = Failsafe(mode=Mode.HOLD, fresh_since_ns=0)
    assert failsafe.ready(timing.engage_after_ns, timing)
    assert not failsafe.ready(timing.engage_after_ns - 1, timing)


def test_the_last_256_sessions_never_become_current_again(timing: Timing) -> None:
    failsafe, now_ns = Failsafe(), T0
    for session in range(1, RETIRED_SESSIONS_KEPT + 4):
        now_ns += timing.max_command_age_ns + 1
        told = command(session=session, echo_t_ns=now_ns)
        assert failsafe.offer(told, now_ns, timing) is Refusal.NONE
    assert failsafe.retired == tuple(range(3, RETIRED_SESSIONS_KEPT + 3))


def test_the_failsafes_times_and_limits_are_the_robot_files(robot: RobotConfig) -> None:
    service = robot.joint_service
    assert timing_of(robot) == Timing(
        max_command_age_ns=round(1e6 * service.max_command_age_ms),
        engage_after_ns=round(1e6 * service.engage_after_ms),
        engage_after_max_ns=round(1e6 * service.engage_after_max_ms),
        dropout_forget_ns=round(1e9 * service.dropout_forget_s),
        dropouts_max=5,  # 100 ms, doubled five times, are the 3.2 s at most
        k_p_max=service.k_p_max,
        k_d_max=service.k_d_max,
        v_max=service.v_max,
        tau_max=4.0 * robot.joint.tau_module_max,
    )


def test_at_the_first_instant_of_a_clock_commands_are_fresh_as_at_any_other(
    timing: Timing,
) -> None:
    failsafe = Failsafe(mode=Mode.HOLD)
    for seq in range(3):
        failsafe.offer(command(seq=seq, echo_t_ns=seq), seq, timing)
        failsafe.advance(seq, timing, Event.NONE, estop=False)
        assert failsafe.fresh_since_ns == 0
    tracking = Failsafe(mode=Mode.TRACK, session=SESSION, fresh_since_ns=0)
    tracking.offer(command(echo_t_ns=1), 1, timing)
    assert tracking.advance(1, timing, Event.NONE, estop=False) is not Cause.COMMAND_STALE
