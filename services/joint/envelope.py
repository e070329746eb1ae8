"""Envelope of the commands that a joint service accepts from its planner. Pure.

A planner may be wrong in any way: zero gains, a sign, a unit, a bit. Each module compares a command
with the law's bounds over all poses (`GainSchedule.bounds`, made by `xrl gains`), with the joint's
position, and with the command before. A command outside is refused, counted and reported
(`JointState.outside`). If a planner goes on like that its last good command becomes too old, and
the module holds.

The coupled torque answers to what the body's pose lacks, so in each module it pulls the way the
local spring pulls. One that drives the joint away from its reference is wrong however small it is:
ramped up together inside their bounds, those of knees and hips made the robot fall. Nor does it do
much work on a joint that moves: 2 J under a push, and 6 J when a hand leads up by 0.45 m in a
second, because the eased part of a lead comes with it. One that does more takes the robot along:
ramped up in 0.3 s, knees and hips threw it off the floor.

A reference comes with its rate, so an ankle's goes the way its rate says: to 0.3 mrad while a
person leads, 20 mrad while the height follows a reference of its own. One that goes another way by
more than `q_ref_astray` / `ASTRAY_S` is wrong: drifting by 0.3 rad/s it took the robot over.

A command with `hold` is obeyed anyway, but a module that refused its numbers is not ready to track
(`Failsafe.ready`), so no planner leads with such numbers.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.joint import pd_law
from shared.bus.messages import JointCommand, Outside, Pair
from shared.clamp import clamp
from shared.clock import NS_PER_S
from shared.config.gain_table import Bounds, ModuleBounds
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of

ROUNDING = 0.02
"""Share of a gain that is allowed beyond: the schedule interpolates between rounded nodes."""
GAP_TICKS = 4
"""The step that is allowed grows with the time between commands no longer than so: a wrong torque
that is refused again and again would be within it in the end."""
UNSETTLED: Final = 0.5
"""Share of a spring's torque that counts in HOLD, and until TRACK has blended in: a robot that was
held off centre still moves to the reference."""
ASTRAY_S: Final = 0.5
"""s; a way that the rate does not explain is forgotten with this time constant."""
ENERGY_S: Final = 0.3
"""s; work of the coupled torque is forgotten with this time constant."""
_INSIDE: Final = Outside.NOTHING  # returned in each cycle: docs/contributing.md


class Lately(msgspec.Struct, gc=False, frozen=True):
    """What the tracked commands have done that none of them shows alone."""

    astray: Pair = pd_law.ZERO
    """How far the reference has gone another way than its rate says, rad."""
    energy: float = 0.0
    """Work of the coupled torque, J; what it took counts as none."""
    at_ns: int = 0
    """When the newest came, on this module's clock; 0 before the first."""


NOTHING_YET: Final = Lately()


class Envelope:
    """The bounds of one module."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take the bounds; without a schedule that has them every command is inside."""
        schedule = config.gain_schedule
        table = schedule.bounds if config.law.split == "certified" and schedule else None
        self._bounds = bounds = table[kind_of(module)] if table else None
        own, least = config.envelope, config.certificate
        if bounds is not None:
            self._k_p, self._k_d = _widened(bounds.k_p), _widened(bounds.k_d)
            self._v_ref = [min(own.v_ref, most) for most in bounds.v_ref]
        self._room = own.tau_ff_margin
        self._distance, self._spring = own.q_ref_distance, own.spring_torque
        self._astray = own.q_ref_astray if kind_of(module) == "ankle" else math.inf
        self._coupled, self._dtau_ff = own.tau_coupled, own.dtau_ff
        self._work, self._energy = -own.coupled_work, own.coupled_energy
        self._step, self._rate = own.torque_step, own.torque_rate
        self._gap_s = GAP_TICKS / config.planner.rate_hz
        self._margin = (1.0 - ROUNDING) * least.margin_min
        self._margin_onboard = (1.0 - ROUNDING) * least.onboard_margin_min

    def judge(
        self,
        command: JointCommand,
        last: JointCommand | None,
        q: Pair,
        v: Pair,
        *,
        age_s: float = 0.0,
        settled: bool = True,
        lately: Lately = NOTHING_YET,
    ) -> Outside:
        """Return the first part of a command that lies outside.

        Written so that a NaN is outside: every comparison with it is false.

        Args:
            command: the received command.
            last: the command that the module tracks; None if it does not track.
            q: joint angles, rad.
            v: joint rates, rad/s.
            age_s: time by which the reference is extrapolated, s.
            settled: True if TRACK has blended in.
            lately: `lately` of this command.
        """
        bounds, c = self._bounds, command
        if bounds is None:
            return _INSIDE
        if not (c.margin >= self._margin and c.margin_onboard >= self._margin_onboard):
            return Outside.MARGIN
        if not _within(c.k_p, self._k_p):
            return Outside.K_P
        if not _within(c.k_d, self._k_d):
            return Outside.K_D
        lowest, highest = self._tau_ff_at(bounds, q[1])
        work = 0.0
        for axis in (0, 1):
            if not lowest[axis] - self._room <= c.tau_ff[axis] <= highest[axis] + self._room:
                return Outside.TAU_FF
            if not abs(c.dtau_ff[axis]) <= self._dtau_ff:
                return Outside.DTAU_FF
            if not abs(c.tau_coupled[axis]) <= self._coupled:
                return Outside.TAU_COUPLED
            if not abs(c.v_ref[axis]) <= self._v_ref[axis]:
                return Outside.V_REF
            deflection = c.q_ref[axis] + age_s * c.v_ref[axis] - q[axis]
            work += c.tau_coupled[axis] * deflection
            distance = abs(deflection)
            spring = c.k_p[axis] * distance * (1.0 if settled else UNSETTLED)
            if not (distance <= self._distance and spring <= self._spring):
                return Outside.Q_REF
            if not abs(lately.astray[axis]) <= self._astray:
                return Outside.Q_REF_ASTRAY
        if not work >= self._work:
            return Outside.COUPLED_WORK
        if not lately.energy <= self._energy:
            return Outside.COUPLED_ENERGY
        if last is None or last.hold or last.session != c.session:
            return _INSIDE
        most = self._step + self._rate * clamp(1e-9 * (c.t_ns - last.t_ns), 0.0, self._gap_s)
        (phi, theta), (last_phi, last_theta) = pd_law.torque(c, q, v), pd_law.torque(last, q, v)
        if not (abs(phi - last_phi) <= most and abs(theta - last_theta) <= most):
            return Outside.TORQUE_STEP
        return _INSIDE

    def lately(
        self, command: JointCommand, last: JointCommand | None, before: Lately, v: Pair, now_ns: int
    ) -> Lately:
        """Return what this command adds to what the tracked ones have done.

        Args:
            command: the received command.
            last: the command that the module tracks; None if it does not track.
            before: the same of the last command.
            v: joint rates, rad/s.
            now_ns: this module's clock.
        """
        if last is None or last.hold or last.session != command.session:
            return Lately(at_ns=now_ns)
        phi, theta = command.tau_coupled
        dt = (now_ns - before.at_ns) / NS_PER_S if before.at_ns else 0.0
        energy = max(0.0, 1.0 - dt / ENERGY_S) * before.energy + dt * (phi * v[0] + theta * v[1])
        astray = pd_law.ZERO
        if self._astray < math.inf and not command.hold:
            astray = _astray(command, last, before.astray)
        return Lately(astray, max(energy, 0.0), now_ns)  # NaN stays NaN

    @staticmethod
    def _tau_ff_at(bounds: ModuleBounds, theta: float) -> Bounds:
        """Return the bounds of tau_ff where the joint is."""
        (low, high), rows = bounds.theta, bounds.tau_ff
        part = int(len(rows) * (theta - low) / max(high - low, 1e-9))
        return rows[min(len(rows) - 1, max(0, part))]


def _astray(command: JointCommand, last: JointCommand, before: Pair) -> Pair:
    """Return how far a reference has gone another way than its rate says, rad."""
    dt = 1e-9 * (command.t_ns - last.t_ns)
    kept = max(0.0, 1.0 - dt / ASTRAY_S)
    (phi, theta), (last_phi, last_theta) = command.q_ref, last.q_ref
    (rate_phi, rate_theta), (last_rate_phi, last_rate_theta) = command.v_ref, last.v_ref
    return (
        kept * before[0] + phi - last_phi - 0.5 * dt * (rate_phi + last_rate_phi),
        kept * before[1] + theta - last_theta - 0.5 * dt * (rate_theta + last_rate_theta),
    )


def _widened(gains: Bounds) -> Bounds:
    """Return bounds of gains with the rounding that is allowed."""
    (phi_low, theta_low), (phi_high, theta_high) = gains
    return (
        ((1.0 - ROUNDING) * phi_low, (1.0 - ROUNDING) * theta_low),
        ((1.0 + ROUNDING) * phi_high, (1.0 + ROUNDING) * theta_high),
    )


def _within(gains: Pair, bounds: Bounds) -> bool:
    (phi, theta), ((phi_low, theta_low), (phi_high, theta_high)) = gains, bounds
    return phi_low <= phi <= phi_high and theta_low <= theta <= theta_high
