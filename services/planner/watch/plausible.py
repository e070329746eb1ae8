"""Plausibility of measurements, and trust in the harness. Pure.

`Plausible` refuses measurements that no sensor can have made.

`HarnessTrust` checks the harness's wrench against the joint torques. The weight that the joints
support beyond the robot file and the wrench counts as load (`services.planner.law.load`). A load
hardly ever changes while a person wears the robot, but a sensor can fail: a cell drifts, sticks or
changes sign. From the first lead on, the load must therefore stay within `CHANGE_MAX` of its first
value. In 40 leads drawn at random it changed by at most 1.0 kg and 2.3 N m, although the persons'
weight on the harness differed from the assist by up to 24 N.

The planner ignores a distrusted wrench: it does not estimate the load from it or ease the lead. The
assist cannot be checked then, so it fades within `EASE_S`. A new zero (`xrl drive tare`) or a
restart of the planner ends this. A load that a person really added looks the same, so the status
text mentions that case.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.planner.law.load import LoadState
from shared.bus.messages import Attitude, JointState, Tare, Vector3, Wrench
from shared.clamp import clamp
from shared.config.robot_config import RobotConfig
from shared.joints import N_MODULES

BEYOND_RAD: Final = 0.5
"""Largest angle beyond a soft stop, from the joint's elasticity or an error of its zero."""
SPEED_MAX: Final = 100.0
"""rad/s of a joint, about five times the speed that the drives allow it."""
TURN_MAX: Final = 100.0
"""rad/s, three times the range of the IMU in `docs/bring-up.md`; faster than any torso turns."""
UNIT_ERROR: Final = 0.1
"""Maximum deviation of the length of `up` from 1."""
N_CELLS: Final = 6


class Plausible:
    """Bounds of each module's angles and speeds, of the wrench and of the attitude.

    The planner drops a measurement beyond them, so the sensor goes stale. A single angle or force
    of 1e300 would stay in the law's filters forever.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._force_max = N_CELLS * config.harness.leg_force_max
        arms = config.harness.base_radius + config.harness.platform_radius + config.harness.height
        self._moment_max = arms * self._force_max
        stops = [(low - BEYOND_RAD, high + BEYOND_RAD) for low, high in config.joint_limits()]
        self._stops = [(stops[2 * i], stops[2 * i + 1]) for i in range(N_MODULES)]

    def is_state(self, module: int, state: JointState) -> bool:
        """Return True if the module's angles and speeds are within the bounds."""
        (phi_low, phi_high), (theta_low, theta_high) = self._stops[module]
        phi, theta = state.q
        v_phi, v_theta = state.v
        return (
            phi_low <= phi <= phi_high
            and theta_low <= theta <= theta_high
            and abs(v_phi) <= SPEED_MAX
            and abs(v_theta) <= SPEED_MAX
        )

    def is_wrench(self, wrench: Wrench) -> bool:
        """Return True if the load cells together can have measured it."""
        return all(abs(part) <= self._force_max for part in wrench.force) and all(
            abs(part) <= self._moment_max for part in wrench.moment
        )

    def is_attitude(self, attitude: Attitude) -> bool:
        """Return True if up is a unit vector (shorter if invalid), the rate within `TURN_MAX`."""
        length = math.hypot(*attitude.up)
        return (
            (not attitude.valid or abs(length - 1.0) <= UNIT_ERROR)
            and length <= 1.0 + UNIT_ERROR
            and all(abs(part) <= TURN_MAX for part in attitude.rate)
        )


CHANGE_MAX: Final = (3.0, 7.0)
"""Maximum change of the load, kg and N m."""
AFTER_S: Final = 0.5
"""Time after which a larger change counts, s: a robot that trips and holds swings for a moment."""
EASE_S: Final = 10.0
"""Time in which the whole assist fades out or in, s: 20 N/s for the maximum of 200 N."""


class HarnessTrust(msgspec.Struct):
    """Comparison of the load with its value at the first lead."""

    load: Vector3 = (0.0, 0.0, 0.0)
    """kg, a and b (N m) of the load when the planner first led."""
    has_led: bool = False
    beyond_s: float = 0.0
    """Time for which the load has been beyond `CHANGE_MAX`, s."""
    change: Vector3 = (0.0, 0.0, 0.0)
    """Change of the load when the wrench was first distrusted; units as in `load`."""
    doubted: bool = False
    scale: float = 1.0
    """Fraction of the requested assist that remains."""

    def advance(self, load: LoadState, tare: int, dt: float, *, leads: bool) -> float:
        """Advance by one tick; return the fraction of the requested assist that remains.

        Args:
            load: estimated load; reset to that of the first lead when the wrench becomes
                distrusted.
            tare: `Tare` of the newest wrench.
            dt: time since the last tick, s.
            leads: True while the planner is engaged.
        """
        if tare != Tare.DONE:
            self.doubted = self.has_led = False
        now = load.kg, load.a, load.b
        if not self.has_led:
            self.load, self.has_led = now, leads
        elif not self.doubted:
            kg, a, b = (x - before for x, before in zip(now, self.load, strict=True))
            beyond = abs(kg) > CHANGE_MAX[0] or max(abs(a), abs(b)) > CHANGE_MAX[1]
            self.beyond_s = self.beyond_s + dt if beyond else 0.0
            if self.beyond_s > AFTER_S:
                self.doubted, self.change, self.beyond_s = True, (kg, a, b), 0.0
                load.kg, load.a, load.b = self.load
                load.refused, load.weighing_s = False, 0.0
        step = dt / EASE_S
        self.scale = clamp(self.scale + (-step if self.doubted else step), 0.0, 1.0)
        return self.scale

    def describe(self) -> str:
        """Return a message that the wrench is distrusted, with the remedy; "" if it is trusted."""
        if not self.doubted:
            return ""
        kg, a, b = self.change
        moment = max(a, b, key=abs)
        return (
            f"harness and joints disagree by {kg:+.1f} kg and {moment:+.0f} N m since the "
            "robot was led: the assist ramps down. Take all weight off the harness, then run "
            "`xrl drive tare`. If the robot's load has changed, run `xrl kill planner`"
        )
