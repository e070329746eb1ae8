"""Split of the local law between joint service and drive (docs/drives.md). Pure.

Each motor's own loop applies the module's mean stiffness and damping about the references. The
rest (difference of the two axes, feedforward, the limiter's reduction) is sent as torque, computed
for each sample. So at every sample the drive gives exactly the torque of the service. Between
samples, and after the service has died, the drive's own law

    torque + vel_gain (clamp(vel_turns + pos_gain (pos_turns - pos)) - vel)

continues. In motor space a module's stiffness is 1/4N^2 [[k1 + k2, k1 - k2], [k1 - k2, k1 + k2]]
per rad, with k1 and k2 of theta and phi.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.joint import pd_law
from services.joint.differential import joint_torque, motor_from_joint, motor_torque
from services.joint.drivers.base import MotorTarget
from services.joint.pd_law import Setpoint
from shared.bus.messages import Mode, Pair
from shared.clamp import clamp
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of

GAIN_CHANGE: Final = 0.02
"""Relative change of the gains below which the drive keeps its old gains. The difference is sent as
torque, which saves traffic on the bus."""
GAIN_UPDATE_MIN_MS: Final = 8
"""Minimum time between two changes of the drive's gains, ms; the difference is sent as torque.
Without it, a blend changed the gains in every cycle, and by its end three modules on one CAN bus
were 15 to 20 ms late."""
POS_GAIN_MAX: Final = 400.0
"""Maximum position gain, 1/s: a stiffness with hardly any damping gets more damping."""
INPUT_TORQUE_SHARE: Final = 0.75
"""Fraction of current_lim's torque that may be sent as input_torque, which the firmware clamps
separately. The excess is sent through the position. Without that, a hip held with (900, 26) N m/rad
(463 on both motors) had a stiffness of 463 in theta instead of 26, beyond 0.25 rad from its
reference."""

HOLD_SHARE: Final = {"ankle": 1.0, "knee": 0.2, "hip": 0.0}
"""Fraction by which a drive's own gains rise from the module's towards HOLD's, by kind of module.

An ankle's gains rise fully. On TRACK's gains, with at most 4 N m s/rad on its phi and all six
services dead, the sway after a sideways push decayed by a factor of 0.72 each half swing, and 7 of
26 pairs of pushes in step with the sway made the robot fall. A knee's gains rise by a fifth, to
about 600 N m/rad. Without that, a knee whose service froze was soft while the other knee was stiff,
and the robot moved by 450 mm and fell; with it, the robot moves by 23 mm. If a knee's gains rose
fully, the hand would feel them, because the service subtracts them 2 ms late: 26 N in the squat,
compared with 18 N without a rise and 19.8 N with a fifth. A module that HOLD stiffens only in phi
keeps its gains, because half of a rise would act on theta.
"""


class DriveGains(msgspec.Struct):
    """The drive's present gains."""

    stiffness: float = 0.0
    """N m/turn"""
    damping: float = 0.0
    """N m s/turn"""
    changed_ns: int = 0
    """Monotonic time of their last change, ns; 0 before the first."""


class DriveSetpointLaw:
    """Computes the drive's targets."""

    def __init__(self, gear_ratio: float, vel_limit: float, torque_max: float = math.inf) -> None:
        """Set the gear ratio N, the drive's velocity limit, turn/s, and its torque limit, N m."""
        self._input_max = INPUT_TORQUE_SHARE * torque_max
        self._gear_ratio = gear_ratio
        self._per_turn = 2.0 * math.pi / (4.0 * gear_ratio * gear_ratio)
        self._vel_limit = vel_limit

    def target(
        self, gains: DriveGains, now_ns: int, setpoint: Setpoint, tau: Pair, pos: Pair, vel: Pair
    ) -> MotorTarget:
        """Return the target under which the motors give the joint torques tau at this sample.

        Args:
            gains: the drive's gains, updated in place.
            now_ns: this module's monotonic clock.
            setpoint: the local law of this instant.
            tau: joint torques (phi, theta) for this sample, N m, after the limiter.
            pos: motor positions of the sample, turns.
            vel: motor velocities of the sample, turn/s.
        """
        s = setpoint
        if now_ns - gains.changed_ns >= GAIN_UPDATE_MIN_MS * NS_PER_MS or not gains.changed_ns:
            stiffness, damping = s.k_p[0] + s.k_p[1], s.k_d[0] + s.k_d[1]
            _follow(gains, now_ns, self._per_turn * stiffness, self._per_turn * damping)
        vel_gain = gains.damping
        pos_gain = gains.stiffness / vel_gain if vel_gain > 0.0 else 0.0
        pos_ref = motor_from_joint(s.q_ref, self._gear_ratio)
        vel_ref = motor_from_joint(s.v_ref, self._gear_ratio)
        wanted = motor_torque(tau, self._gear_ratio)
        limit = self._vel_limit
        a = clamp(vel_ref[0] + pos_gain * (pos_ref[0] - pos[0]), -limit, limit)
        b = clamp(vel_ref[1] + pos_gain * (pos_ref[1] - pos[1]), -limit, limit)
        torque = (wanted[0] - vel_gain * (a - vel[0]), wanted[1] - vel_gain * (b - vel[1]))
        most = self._input_max
        if (abs(torque[0]) > most or abs(torque[1]) > most) and pos_gain > 0.0:
            # torque beyond the firmware's clamp is sent through the position
            a += (torque[0] - clamp(torque[0], -most, most)) / vel_gain
            b += (torque[1] - clamp(torque[1], -most, most)) / vel_gain
            a, b = clamp(a, -limit, limit), clamp(b, -limit, limit)
            pos_ref = (
                pos[0] + (a - vel_ref[0]) / pos_gain,
                pos[1] + (b - vel_ref[1]) / pos_gain,
            )
            torque = (wanted[0] - vel_gain * (a - vel[0]), wanted[1] - vel_gain * (b - vel[1]))
        return MotorTarget(pos_ref, vel_ref, torque, (pos_gain, pos_gain), (vel_gain, vel_gain))

    def carried(self, target: MotorTarget, pos: Pair, vel: Pair) -> Pair:
        """Return the joint torques, N m, that the drive's last target causes at a sample.

        Args:
            target: the last target that was sent.
            pos: motor positions of the sample, turns.
            vel: motor velocities of the sample, turn/s.
        """
        t, limit = target, self._vel_limit
        a = t.vel_turns[0] + t.pos_gain[0] * (t.pos_turns[0] - pos[0])
        b = t.vel_turns[1] + t.pos_gain[1] * (t.pos_turns[1] - pos[1])
        motors = (
            t.torque[0] + t.vel_gain[0] * (clamp(a, -limit, limit) - vel[0]),
            t.torque[1] + t.vel_gain[1] * (clamp(b, -limit, limit) - vel[1]),
        )
        return joint_torque(motors, self._gear_ratio)


def _follow(gains: DriveGains, now_ns: int, stiffness: float, damping: float) -> None:
    """Adopt gains that have changed by more than `GAIN_CHANGE`; N m/turn and N m s/turn."""
    damping = max(damping, stiffness / POS_GAIN_MAX)
    if abs(stiffness - gains.stiffness) > GAIN_CHANGE * gains.stiffness:
        gains.stiffness, gains.changed_ns = stiffness, now_ns
    if abs(damping - gains.damping) > GAIN_CHANGE * gains.damping:
        gains.damping, gains.changed_ns = damping, now_ns


class DriveFallback:
    """Law with which a drive continues when its joint service dies."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        self._hold_k_p, self._hold_k_d = config.hold_gains(module)
        self._share = HOLD_SHARE[kind_of(module)] if self._hold_k_p[1] > 0.0 else 0.0

    def law(self, setpoint: Setpoint, mode: Mode) -> Setpoint:
        """Return the fallback for a setpoint; unchanged in DAMP, so the drive keeps sinking."""
        if self._share == 0.0 or mode is Mode.DAMP:
            return setpoint
        return pd_law.raise_gains(setpoint, self._hold_k_p, self._hold_k_d, self._share)
