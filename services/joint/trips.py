"""Trips that a joint service detects; it then holds, whatever its planner sends. Pure.

With gains that do not suit its drivetrain, the robot shakes within 0.1 s of being led. Only the six
services can detect that, at 500 Hz. Each service monitors its torque and speed while it tracks
(`shared.robot.trip_table`; limits: [trips] of the robot file):

    shaking   RMS of the torque above `SHAKE_ABOVE_HZ`, over `SHAKE_S`
    torque    a motor that stays at the limit of the torque diamond
    speed     a joint that turns faster than the planner ever leads it

The law's own torques stay below about 4 Hz (`GainSchedule.coupling_bandwidth_hz`). Shaking reached
4 N m on simulated plants with every error drawn at random, while they were led and pushed with 75 %
of the push that soles and motors withstand. On drivetrains on which the robot falls if the coupled
torque has no low-pass, shaking reaches 15 N m after 20 to 60 ms, and then 55 to 77 N m.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.joint.failsafe import Event
from shared.bus.messages import Pair
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.robot import trip_table

SHAKE_ABOVE_HZ: Final = 8.0
"""Frequency above which torque counts as shaking, Hz: above the bandwidths of law and hand."""
SHAKE_S: Final = 0.1
"""Time constant of the torque's mean square, s."""
AT_LIMIT: Final = 0.995
"""Share of the torque diamond at which a motor counts as being at its limit."""
_NONE: Final = Event.NONE  # returned in each cycle: docs/contributing.md


class _TripLimits(msgspec.Struct, frozen=True):
    """Trip limits of a module."""

    slow_share: float
    """Low-pass coefficient of the torque's slow part, per cycle."""
    mean_share: float
    """Low-pass coefficient of the rest's mean square, per cycle."""
    shaking: float
    """(N m)^2"""
    torque: float
    """N m, of |tau_phi| + |tau_theta|."""
    torque_ns: int
    speed: float
    """rad/s"""
    speed_ns: int


def limits_of(config: RobotConfig) -> _TripLimits:
    """Return the limits from the configuration."""
    trips, cycle_s = trip_table.limits_of(config), 1.0 / config.joint_service.rate_hz
    return _TripLimits(
        slow_share=1.0 - math.exp(-2.0 * math.pi * SHAKE_ABOVE_HZ * cycle_s),
        mean_share=1.0 - math.exp(-cycle_s / SHAKE_S),
        shaking=trips.shaking.limit**2,
        torque=AT_LIMIT * trips.torque_limit.limit * config.joint.tau_module_max,
        torque_ns=round(trips.torque_limit.after_ms * NS_PER_MS),
        speed=trips.speed.limit,
        speed_ns=round(trips.speed.after_ms * NS_PER_MS),
    )


class JointTrips(msgspec.Struct):
    """Measurements since the module began to track."""

    slow: Pair = (0.0, 0.0)
    """Torque below `SHAKE_ABOVE_HZ`, N m."""
    mean: Pair = (0.0, 0.0)
    """Mean square of the rest, (N m)^2."""
    at_limit_ns: int = 0
    """Time from which the torque is at its limit, ns; 0 if it is not."""
    fast_ns: int = 0
    """Time from which the joint turns too fast, ns; 0 if it does not."""

    def reset(self, tau: Pair) -> None:
        """Restart from the drive's torque, N m, because only a module in TRACK trips."""
        self.slow, self.mean = tau, (0.0, 0.0)
        self.at_limit_ns = self.fast_ns = 0

    def judge(self, now_ns: int, tau: Pair, v: Pair, limits: _TripLimits) -> Event:
        """Judge one cycle of TRACK; return SHAKING, TORQUE_LIMIT, TOO_FAST or NONE.

        Args:
            now_ns: this module's clock.
            tau: torque of the last cycle, N m.
            v: measured joint rates, rad/s.
            limits: the module's limits.
        """
        (phi, theta), (slow_phi, slow_theta) = tau, self.slow
        slow_phi += limits.slow_share * (phi - slow_phi)
        slow_theta += limits.slow_share * (theta - slow_theta)
        self.slow = (slow_phi, slow_theta)
        mean_phi, mean_theta = self.mean
        mean_phi += limits.mean_share * ((phi - slow_phi) ** 2 - mean_phi)
        mean_theta += limits.mean_share * ((theta - slow_theta) ** 2 - mean_theta)
        self.mean = (mean_phi, mean_theta)
        if mean_phi > limits.shaking or mean_theta > limits.shaking:
            return Event.SHAKING
        at_limit = abs(phi) + abs(theta) >= limits.torque
        fast = abs(v[0]) > limits.speed or abs(v[1]) > limits.speed
        self.at_limit_ns = (self.at_limit_ns or now_ns) if at_limit else 0
        self.fast_ns = (self.fast_ns or now_ns) if fast else 0
        if self.at_limit_ns and now_ns - self.at_limit_ns >= limits.torque_ns:
            return Event.TORQUE_LIMIT
        if self.fast_ns and now_ns - self.fast_ns >= limits.speed_ns:
            return Event.TOO_FAST
        return _NONE
