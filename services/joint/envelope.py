"""Envelope of the commands that a joint service accepts from its planner. Pure.

A planner may be wrong in any way: zero gains, a wrong sign or unit, a flipped bit. Each module
compares a command with the law's bounds over all poses (`GainSchedule.bounds`, made by
`xrl gains`), with the joint's position, and with the previous command. A command outside the
envelope is refused, counted and reported (`JointState.outside`). If a planner sends only such
commands, its last good command becomes stale, and the module holds.

The coupled torque corrects the pose of the whole body, so in each module it pulls the same way as
the local spring. A coupled torque that drives the joint away from its reference is wrong, even if
it is within its bound: wrong torques of knees and hips, ramped up together within their bounds,
made the robot fall.
The coupled torque also does little work on a moving joint: 2 J under a push, and 6 J when a hand
leads the robot up by 0.45 m in a second, because it includes the eased lead. More work moves the
robot: torques of knees and hips that rose within 0.3 s threw it off the floor.

A reference comes with its rate, and an ankle's reference follows its rate: within 0.3 mrad while a
person leads, within 20 mrad while the height follows its own reference. A reference that drifts
from its rate by more than `q_ref_astray` / `ASTRAY_S`, rad/s, is wrong: one that drifted by
0.3 rad/s tipped the robot.

A command with `hold` is accepted even outside the envelope. But the module is then not ready to
track (`Failsafe.ready`), so no planner leads with such numbers.
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
"""Relative tolerance of the gain bounds: the schedule interpolates between rounded nodes."""
GAP_TICKS = 4
"""Number of ticks for which the allowed torque step grows with the time between commands. Without
this limit, a wrong torque that is refused repeatedly would finally be accepted."""
UNSETTLED: Final = 0.5
"""Share of a spring's torque that counts in HOLD, and until TRACK has blended in. A robot held off
centre is then still away from the reference."""
ASTRAY_S: Final = 0.5
"""Time constant with which motion that the rate does not explain decays, s."""
ENERGY_S: Final = 0.3
"""Time constant with which the coupled torque's work decays, s."""
_INSIDE: Final = Outside.NOTHING  # returned in each cycle: docs/contributing.md


class Lately(msgspec.Struct, gc=False, frozen=True):
    """Cumulative effect of the tracked commands."""

    astray: Pair = pd_law.ZERO
    """Motion of the reference that its rate does not explain, rad."""
    energy: float = 0.0
    """Work of the coupled torque, J; never below 0."""
    at_ns: int = 0
    """Arrival of the newest command on this module's clock, ns; 0 before the first."""


NOTHING_YET: Final = Lately()


class Envelope:
    """Bounds on the commands of one module."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Read the bounds of a certified split; without bounds, every command is inside."""
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
        """Return the first part of a command that is outside; NOTHING if it is inside.

        Written so that a NaN is outside: every comparison with it is false.

        Args:
            command: the received command.
            last: the command that the module tracks; None if it does not track.
            q: joint angles, rad.
            v: joint rates, rad/s.
            age_s: time by which the reference is extrapolated, s.
            settled: True if TRACK has blended in.
            lately: result of `accumulated` for this command.
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

    def accumulated(
        self, command: JointCommand, last: JointCommand | None, before: Lately, v: Pair, now_ns: int
    ) -> Lately:
        """Return the cumulative effect of the tracked commands and this one.

        Args:
            command: the received command.
            last: the command that the module tracks; None if it does not track.
            before: the cumulative effect up to the last command.
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
        """Return the bounds of tau_ff at a joint angle theta, rad."""
        (low, high), rows = bounds.theta, bounds.tau_ff
        part = int(len(rows) * (theta - low) / max(high - low, 1e-9))
        return rows[min(len(rows) - 1, max(0, part))]


def _astray(command: JointCommand, last: JointCommand, before: Pair) -> Pair:
    """Return the motion of a reference that its rate does not explain, rad."""
    dt = 1e-9 * (command.t_ns - last.t_ns)
    kept = max(0.0, 1.0 - dt / ASTRAY_S)
    (phi, theta), (last_phi, last_theta) = command.q_ref, last.q_ref
    (rate_phi, rate_theta), (last_rate_phi, last_rate_theta) = command.v_ref, last.v_ref
    return (
        kept * before[0] + phi - last_phi - 0.5 * dt * (rate_phi + last_rate_phi),
        kept * before[1] + theta - last_theta - 0.5 * dt * (rate_theta + last_rate_theta),
    )


def _widened(gains: Bounds) -> Bounds:
    (phi_low, theta_low), (phi_high, theta_high) = gains
    return (
        ((1.0 - ROUNDING) * phi_low, (1.0 - ROUNDING) * theta_low),
        ((1.0 + ROUNDING) * phi_high, (1.0 + ROUNDING) * theta_high),
    )


def _within(gains: Pair, bounds: Bounds) -> bool:
    (phi, theta), ((phi_low, theta_low), (phi_high, theta_high)) = gains, bounds
    return phi_low <= phi <= phi_high and theta_low <= theta <= theta_high
