"""Motors and joint, and the onboard loop: drive and service hold one law (docs/drives.md)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from services.joint.differential import (
    joint_from_motor,
    joint_torque,
    motor_from_joint,
    motor_torque,
)
from services.joint.drive_setpoint import (
    GAIN_CHANGE,
    GAIN_UPDATE_MIN_MS,
    INPUT_TORQUE_SHARE,
    POS_GAIN_MAX,
    DriveGains,
    DriveSetpointLaw,
)
from services.joint.drivers.base import MotorTarget
from services.joint.drivers.resend_policy import DRIFT_MS
from services.joint.pd_law import ZERO, Setpoint
from services.joint.pd_law import torque as law_torque
from shared.bus.messages import Pair
from shared.clock import NS_PER_MS
from tests.joint.helpers import firmware

gear_ratios = st.floats(1.0, 200.0)

motor_pairs = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))


@given(joint=motor_pairs, n=gear_ratios)
def test_angles_and_torques_come_back_from_the_motors(joint: Pair, n: float) -> None:
    np.testing.assert_allclose(joint_from_motor(motor_from_joint(joint, n), n), joint, atol=1e-9)
    np.testing.assert_allclose(joint_torque(motor_torque(joint, n), n), joint, atol=1e-9)


@given(tau=motor_pairs, v=motor_pairs, n=gear_ratios)
def test_power_is_the_same_on_both_sides(tau: Pair, v: Pair, n: float) -> None:
    """The motor that works harder carries the sum of both torques."""
    motor_rates = 2.0 * math.pi * np.array(motor_from_joint(v, n))  # rad/s
    at_motors = np.array(motor_torque(tau, n)) @ motor_rates
    assert at_motors == pytest.approx(np.array(tau) @ np.array(v), rel=1e-9, abs=1e-6)
    harder = max(abs(torque) for torque in motor_torque(tau, n))
    assert 2.0 * n * harder == pytest.approx(abs(tau[0]) + abs(tau[1]), rel=1e-12, abs=1e-12)


def test_first_motor_turns_both_axes_forward_and_the_second_turns_phi_back() -> None:
    turn = math.pi / 17.5  # rad at the joint: one motor turn, through the gear, halved
    assert joint_from_motor((1.0, 0.0), 17.5) == pytest.approx((turn, turn))
    assert joint_from_motor((0.0, 1.0), 17.5) == pytest.approx((-turn, turn))


# ---- the onboard loop

N = 17.5

VEL_LIMIT = 60.0

NOW = 5_000_000_000

CYCLE_NS = 2 * NS_PER_MS

TORQUE_MAX = 3.3
"""What current_lim gives, N m a motor; the firmware clamps input_torque to it."""

angle = st.floats(-3.0, 3.0)

rate = st.floats(-5.0, 5.0)

gain = st.floats(0.0, 6000.0)

damping = st.floats(0.0, 400.0)

torque = st.floats(-115.0, 115.0)


def pairs(values: st.SearchStrategy[float]) -> st.SearchStrategy[Pair]:
    return st.tuples(values, values)


setpoints = st.builds(
    Setpoint, pairs(angle), pairs(rate), pairs(torque), pairs(torque), pairs(gain), pairs(damping)
)


def given_by_drive(
    target: MotorTarget, pos: Pair, vel: Pair, input_torque_max: float = math.inf
) -> Pair:
    """Return the joint torques of a drive with this target, N m."""
    motors = firmware(target, pos, vel, vel_limit=VEL_LIMIT, input_torque_max=input_torque_max)
    return joint_torque(motors, N)


@given(setpoints, pairs(torque), pairs(angle), pairs(rate), pairs(angle), pairs(rate))
def test_the_service_knows_what_a_drive_that_it_left_alone_gives_anywhere(
    setpoint: Setpoint, tau: Pair, q: Pair, v: Pair, later_q: Pair, later_v: Pair
) -> None:
    onboard = DriveSetpointLaw(N, VEL_LIMIT)
    at = motor_from_joint(q, N)
    target = onboard.target(DriveGains(), NOW, setpoint, tau, at, motor_from_joint(v, N))
    pos, vel = motor_from_joint(later_q, N), motor_from_joint(later_v, N)
    expected = given_by_drive(target, pos, vel)
    np.testing.assert_allclose(onboard.carried(target, pos, vel), expected, atol=1e-7)


@given(st.lists(setpoints, min_size=1, max_size=5), pairs(angle), pairs(rate), pairs(torque))
def test_the_drive_gives_the_torque_asked_with_whatever_gains_it_has(
    course: list[Setpoint], q: Pair, v: Pair, tau: Pair
) -> None:
    """At the sample, for any gains, references and rates, whatever the clamp does."""
    law, gains = DriveSetpointLaw(N, VEL_LIMIT), DriveGains()
    pos, vel = motor_from_joint(q, N), motor_from_joint(v, N)
    for cycle, setpoint in enumerate(course):
        target = law.target(gains, NOW + cycle * CYCLE_NS, setpoint, tau, pos, vel)
        np.testing.assert_allclose(given_by_drive(target, pos, vel), tau, atol=1e-7)


@given(pairs(st.floats(1.0, 1500.0)), pairs(st.floats(8.0, 200.0)), pairs(torque))
def test_left_alone_it_holds_with_the_mean_of_its_axes(k_p: Pair, k_d: Pair, tau: Pair) -> None:
    """And carries on with the last torque: the target stays, only the motors move."""
    setpoint = Setpoint((0.1, -1.0), ZERO, ZERO, ZERO, k_p, k_d)
    at = motor_from_joint(setpoint.q_ref, N)
    target = DriveSetpointLaw(N, VEL_LIMIT).target(DriveGains(), NOW, setpoint, tau, at, ZERO)
    mean_p, mean_d = sum(k_p) / 2.0, sum(k_d) / 2.0
    for axis in range(2):
        e = np.eye(2)[axis]
        moved = motor_from_joint((0.1 + 1e-4 * e[0], -1.0 + 1e-4 * e[1]), N)
        held = np.subtract(given_by_drive(target, moved, ZERO), tau) / 1e-4
        np.testing.assert_allclose(held, -mean_p * e, rtol=1e-4, atol=0.05)
        turning = motor_from_joint((1e-3 * e[0], 1e-3 * e[1]), N)
        damped = np.subtract(given_by_drive(target, at, turning), tau) / 1e-3
        np.testing.assert_allclose(damped, -mean_d * e, rtol=1e-4, atol=0.05)


def gains_only(k_p: Pair, k_d: Pair) -> Setpoint:
    return Setpoint(ZERO, ZERO, ZERO, ZERO, k_p, k_d)


def test_small_changes_of_the_gains_are_not_sent_and_large_ones_are() -> None:
    """At once after a pause, and sooner than drifting ones are sent again: else each went twice."""
    law, gains = DriveSetpointLaw(N, VEL_LIMIT), DriveGains()
    sent = []
    for at, share in enumerate((1.0, 1.0 + 0.9 * GAIN_CHANGE, 1.0 + 1.1 * GAIN_CHANGE, 0.0)):
        now_ns = NOW + at * GAIN_UPDATE_MIN_MS * NS_PER_MS
        setpoint = gains_only((500.0 * share, 700.0 * share), (5.0, 7.0))
        sent.append(law.target(gains, now_ns, setpoint, ZERO, ZERO, ZERO).pos_gain)
    assert sent[0] == sent[1] != sent[2]
    assert gains.stiffness == 0.0
    assert GAIN_UPDATE_MIN_MS < DRIFT_MS


def test_in_a_blend_the_gains_change_at_most_every_few_ms_and_in_the_end_they_are_there() -> None:
    """A bus that three modules share has no room for them in every cycle."""
    law, gains = DriveSetpointLaw(N, VEL_LIMIT), DriveGains()
    changed, before = [], None
    for cycle in range(150):
        share = min(1.0, cycle / 100)
        setpoint = gains_only((900.0 * share, 26.0), (60.0, 5.0 + 55.0 * share))
        target = law.target(gains, NOW + cycle * CYCLE_NS, setpoint, ZERO, ZERO, ZERO)
        if (target.pos_gain, target.vel_gain) != before:
            before = (target.pos_gain, target.vel_gain)
            changed.append(cycle)
    assert min(np.diff(changed)) * CYCLE_NS == GAIN_UPDATE_MIN_MS * NS_PER_MS
    after = DriveGains()
    law.target(after, NOW, setpoint, ZERO, ZERO, ZERO)
    assert gains.stiffness == pytest.approx(after.stiffness, rel=GAIN_CHANGE)
    assert gains.damping == pytest.approx(after.damping, rel=GAIN_CHANGE)


@pytest.mark.parametrize("k_d", [0.0, 1e-6])
def test_stiffness_without_damping_gets_a_little_and_no_endless_position_gain(k_d: float) -> None:
    """Without any gains only torque is left."""
    law, gains = DriveSetpointLaw(N, VEL_LIMIT), DriveGains()
    setpoint = gains_only((100.0, 50.0), (k_d, k_d))
    target = law.target(gains, NOW, setpoint, ZERO, ZERO, ZERO)
    assert max(target.pos_gain) <= POS_GAIN_MAX + 1e-9
    stiffness = target.pos_gain[0] * target.vel_gain[0] * (2 * N) ** 2 / (2 * math.pi)
    assert stiffness == pytest.approx(150.0)
    limp = Setpoint((0.1, 0.2), (1.0, 1.0), ZERO, ZERO, ZERO, ZERO)
    law, gains = DriveSetpointLaw(N, VEL_LIMIT), DriveGains()
    target = law.target(gains, NOW, limp, (3.0, -4.0), (1.0, 2.0), (3.0, 4.0))
    assert target.vel_gain == (0.0, 0.0)
    assert joint_torque(target.torque, N) == pytest.approx((3.0, -4.0))


@given(setpoints, pairs(angle), pairs(rate), pairs(torque))
def test_the_firmware_clamps_no_input_torque_if_any_target_gives_the_torque_asked_for(
    setpoint: Setpoint, q: Pair, v: Pair, tau: Pair
) -> None:
    """Else the module got another torque; without a spring nothing but input torque gives it."""
    assume(sum(setpoint.k_p) > 1.0)
    pos, vel = motor_from_joint(q, N), motor_from_joint(v, N)
    law = DriveSetpointLaw(N, VEL_LIMIT, TORQUE_MAX)
    target = law.target(DriveGains(), NOW, setpoint, tau, pos, vel)
    most = INPUT_TORQUE_SHARE * TORQUE_MAX
    for wanted, gain, now in zip(motor_torque(tau, N), target.vel_gain, vel, strict=True):
        assume(gain * (-VEL_LIMIT - now) - most <= wanted <= gain * (VEL_LIMIT - now) + most)
    assert max(map(abs, target.torque)) <= most + 1e-9
    np.testing.assert_allclose(given_by_drive(target, pos, vel, TORQUE_MAX), tau, atol=1e-6)


@given(setpoints, pairs(angle), pairs(rate), pairs(torque))
def test_targets_within_the_clamp_stay(setpoint: Setpoint, q: Pair, v: Pair, tau: Pair) -> None:
    pos, vel = motor_from_joint(q, N), motor_from_joint(v, N)
    free = DriveSetpointLaw(N, VEL_LIMIT).target(DriveGains(), NOW, setpoint, tau, pos, vel)
    most = max(map(abs, free.torque)) + 1e-9
    ample = DriveSetpointLaw(N, VEL_LIMIT, most / INPUT_TORQUE_SHARE).target(
        DriveGains(), NOW, setpoint, tau, pos, vel
    )
    assert ample == free
    assert free.pos_turns == motor_from_joint(setpoint.q_ref, N), "the reference as it is"


@pytest.mark.parametrize("phi_off", [0.0, 0.05])
@pytest.mark.parametrize("off", [-0.35, -0.3, 0.3])
def test_a_hip_far_off_its_reference_stays_as_soft_as_commanded(off: float, phi_off: float) -> None:
    """HOLD's (900, 26) N m/rad is 463 on both motors: its theta was 463 stiff from 0.25 rad on."""
    hip = Setpoint(ZERO, ZERO, (0.0, -10.0), ZERO, (900.0, 26.0), (30.0, 4.0))
    law, gains = DriveSetpointLaw(N, VEL_LIMIT, TORQUE_MAX), DriveGains()
    thetas = np.linspace(off, off + 0.05, 11)
    torques = []
    for theta in thetas:
        q = (phi_off, float(theta))
        pos = motor_from_joint(q, N)
        target = law.target(gains, NOW, hip, law_torque(hip, q, ZERO), pos, ZERO)
        torques.append(given_by_drive(target, pos, ZERO, TORQUE_MAX))
    phi, theta = np.transpose(torques)
    np.testing.assert_allclose(np.diff(theta) / np.diff(thetas), -26.0, rtol=1e-6)
    np.testing.assert_allclose(phi, -900.0 * phi_off, atol=1e-7)
