"""Forces at the harness: assist, easing of the lead, overload (docs/law.md#harness). Pure.

The measured wrench is the operator's on the torso, at the harness point, in torso axes. The robot's
upward force on the operator is the negative of the wrench's force along world z.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from shared.arrays import Array
from shared.bus.messages import Pair, Vector3, Wrench
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import AssistConfig, HarnessConfig

ERROR_MIN: Final = 5.0
"""N; force that dry friction in the joints hides (0.3 N m per joint: 5 to 6 N at the harness).
Within this band the force does not follow the assist, so an integral would hunt."""
SETTLE_S: Final = 0.3
"""s; the integral waits this long after a change of request or pose."""
STILL_RATE_Z: Final = 0.02
"""m/s of the COM, up or down; above it the operator is leading."""
STILL_RATE_PITCH: Final = 0.05
"""rad/s of the torso's pitch; above it the operator is leading."""
LEAD_MAX: Final = (150.0, 60.0)
"""N and N m; maximum lead that is amplified. A leading hand stays below it."""
LEAD_FADE_S: Final = 0.1
"""s; fade time of the easing when the wrench is lost or returns."""
RELEASE_FRACTION: Final = 0.8
"""Fraction of the overload limits below which the harness counts as released."""


def force_up(force: Vector3, roll: float, pitch: float) -> float:
    """Return a force's component along world z, N, for R = Rz(yaw) Rx(roll) Ry(pitch).

    Args:
        force: N, torso axes.
        roll: torso roll, rad.
        pitch: torso pitch, rad.
    """
    x, y, z = force
    return math.sin(roll) * y + math.cos(roll) * (z * math.cos(pitch) - x * math.sin(pitch))


def wrench_in_world(wrench: Wrench, roll: float, pitch: float) -> tuple[Array, float]:
    """Return the operator's force (3,), N, and moment about pitch, N m, in world axes without yaw.

    The lateral force is set to 0, because no caller needs it.

    Args:
        wrench: operator's wrench on the torso.
        roll: torso roll, rad.
        pitch: torso pitch, rad; the moment is about its axis.
    """
    x, _, z = wrench.force
    ahead = math.cos(pitch) * x + math.sin(pitch) * z
    return np.array((ahead, 0.0, force_up(wrench.force, roll, pitch))), wrench.moment[1]


def is_still(rate_z: float, rate_pitch: float) -> bool:
    """Return True if the operator is not leading; COM rate in m/s, pitch rate in rad/s."""
    return abs(rate_z) <= STILL_RATE_Z and abs(rate_pitch) <= STILL_RATE_PITCH


class AssistState(msgspec.Struct):
    """State of `AssistLaw`."""

    ramp: float | None = None
    """N; None before the first tick."""
    wanted: float = 0.0
    still_s: float = 0.0
    integral: float = 0.0
    """N"""

    @property
    def assist(self) -> float:
        """Assist force in the feedforward, N."""
        return (self.ramp or 0.0) + self.integral


class AssistLaw:
    """Assist force: the rate-limited request plus a slow integral of the force error.

    assist = ramp + integral; while the request is constant and the pose is still

        d integral / dt = e / integral_s,  |integral| <= integral_max

    with e the part of wanted - measured beyond `ERROR_MIN`. The ramp is limited to `force_max` (N)
    and `rate_max` (N/s); an `integral_max` of 0 disables the integral.

    The integral is frozen without a reading (stale, invalid or saturated), in HOLD, while the
    request changes, and while the operator leads. The force of a leading hand is not an assist
    error: its integral would outlast the lead, and pull at the operator on the way up from a squat.
    Without a request, the integral decays to zero with the same time constant. It never makes the
    assist negative: the robot does not pull the operator down.

    For a hand of stiffness k and damping b and a robot of mass m, the loop without delay is stable
    if integral_s > m / b - b / k.
    """

    def __init__(self, config: AssistConfig) -> None:
        self._force_max, self._rate_max = config.force_max, config.rate_max
        self._integral_max, self._integral_s = config.integral_max, config.integral_s

    def advance(
        self,
        s: AssistState,
        wanted: float,
        measured: float | None,
        dt: float,
        *,
        still: bool,
        shed_rate: float = 0.0,
    ) -> float:
        """Advance by one tick; return the rate of the assist in N/s.

        Args:
            s: state of the assist; updated in place.
            wanted: requested upward force on the operator, N.
            measured: the same force measured at the harness, N; None if unknown.
            dt: time since the last tick, s.
            still: False while the robot holds or the operator leads.
            shed_rate: maximum rate at which the assist falls, N/s, if above `rate_max`.
        """
        wanted = clamp(wanted, 0.0, self._force_max)
        if s.ramp is None:
            # when the planner takes over, HOLD's feedforward already carries the assist
            s.ramp = wanted
        before = s.ramp + s.integral
        fall_max = max(self._rate_max, shed_rate) * dt
        s.ramp += clamp(wanted - s.ramp, -fall_max, self._rate_max * dt)
        steady = still and wanted == s.wanted == s.ramp
        s.wanted = wanted
        s.still_s = s.still_s + dt if steady else 0.0
        if wanted == 0.0:
            s.integral -= s.integral * min(1.0, dt / self._integral_s)
        elif measured is not None and s.still_s > SETTLE_S:
            error = wanted - measured
            error -= clamp(error, -ERROR_MIN, ERROR_MIN)
            s.integral += error * dt / self._integral_s
        low = max(-self._integral_max, -s.ramp)
        s.integral = clamp(s.integral, low, self._integral_max)
        return (s.ramp + s.integral - before) / dt if dt > 0.0 else 0.0


class EasingState(msgspec.Struct):
    """State of `LeadEasing`."""

    lead: Pair = (0.0, 0.0)
    """N and N m, within `LEAD_MAX`."""
    left: float = 0.0
    """Fraction of the lead in use, 0 .. 1; fades out without a reading."""


class LeadEasing:
    """Amplifies the operator's lead by the force alpha S w_h (docs/law.md#harness).

    w_h is the operator's wrench beyond the assist: the upward force, f + assist, and the moment
    about the torso's pitch axis. Easing lowers the robot's apparent mass from M to M / (1 + alpha).
    Like the assist, its force acts at the harness point, not at the COM. It is part of tau_coupled,
    which HOLD drops; in tau_ff it would outlast the hand. For stable values of alpha, see
    `lead_easing` in deploy/robot.toml.
    """

    def __init__(self, alpha: float) -> None:
        """Set alpha in [0, 1); 0 disables the easing."""
        self._alpha = alpha

    def ease(
        self, s: EasingState, up: float | None, moment_pitch: float, assist: float, dt: float
    ) -> Pair:
        """Return alpha w_h: N along the world's z at the harness, N m about the pitch axis.

        Args:
            s: state of the easing; updated in place.
            up: operator's upward force, N, world; None if unknown, which fades the easing out.
            moment_pitch: operator's moment about the torso's y, N m.
            assist: assist force in the feedforward, N.
            dt: time since the last tick, s.
        """
        if up is None:
            s.left = max(0.0, s.left - dt / LEAD_FADE_S)
        else:
            s.left = min(1.0, s.left + dt / LEAD_FADE_S)
            force_max, moment_max = LEAD_MAX
            s.lead = (
                clamp(up + assist, -force_max, force_max),
                clamp(moment_pitch, -moment_max, moment_max),
            )
        gain = self._alpha * s.left
        return gain * s.lead[0], gain * s.lead[1]


class OverloadState(msgspec.Struct):
    """State of `Overload`."""

    beyond_since_ns: int | None = None
    below_since_ns: int | None = None
    hold: bool = False
    """True during an overload."""


class Overload:
    """Detector of harness overloads, during which all six modules must hold.

    An overload starts when force or moment has exceeded its limit for `after_ns`, or at once if a
    cell saturates. It ends when both have been below `RELEASE_FRACTION` of their limits for
    `release_ns`. An invalid reading restarts only the second of these timers. If it restarted the
    first, one invalid reading in ten would hide an overload of 600 N forever.
    """

    def __init__(self, config: HarnessConfig) -> None:
        self._force_max, self._moment_max = config.overload_force, config.overload_moment
        self._after_ns = round(config.overload_after_ms * NS_PER_MS)
        self._release_ns = round(config.overload_release_s * NS_PER_S)

    def receive(self, s: OverloadState, wrench: Wrench, now_ns: int) -> None:
        """Update the state with a wrench that arrived now."""
        load_ratio = max(
            math.hypot(*wrench.force) / self._force_max,
            math.hypot(*wrench.moment) / self._moment_max,
        )
        beyond = wrench.valid and load_ratio > 1.0
        below = wrench.valid and load_ratio < RELEASE_FRACTION
        if wrench.valid:
            s.beyond_since_ns = _since(s.beyond_since_ns, now_ns, beyond)
        s.below_since_ns = _since(s.below_since_ns, now_ns, below)
        if wrench.saturated or _lasted(s.beyond_since_ns, now_ns, self._after_ns):
            s.hold = True
        elif _lasted(s.below_since_ns, now_ns, self._release_ns):
            s.hold = False


def _since(since_ns: int | None, now_ns: int, condition: bool) -> int | None:
    if not condition:
        return None
    return now_ns if since_ns is None else since_ns


def _lasted(since_ns: int | None, now_ns: int, duration_ns: int) -> bool:
    return since_ns is not None and now_ns - since_ns >= duration_ns
