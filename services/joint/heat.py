"""Estimates how warm a module's motors and output stages are, and how long the load can last. Pure.

Two nodes for each motor, one for each output stage, with the figures of [heat] in the robot file;
Iq is a motor's current, by its torque:

    C_w T_w' = 1.5 R Iq^2 - (T_w - T_h) / R_wh        R = R_25 (1 + alpha (T_w - 25 C))
    C_h T_h' = (T_w - T_h) / R_wh - (T_h - T_a) / R_ha
    t_s T_s' = T_a + k_s Iq^2 - T_s

What the drive reports corrects the estimate. The seconds left are those until a winding or an
output stage is at its limit, if the mean load of the last `LOAD_S` goes on.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus.messages import LEFT_MAX_S, Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.run_directory import live_dir, mapped

STEP_S: Final = 0.5
"""Step of the estimate, and of the seconds left."""
GAP_S: Final = 5.0
"""Longest time for which the last load is taken to have gone on: a stopped process."""
LOAD_S: Final = 4.0
"""Time constant of the mean load: a squat takes 5 s."""
UNKNOWN_S: Final = -1.0
"""Seconds left where nothing is estimated."""
FOLLOW: Final = 0.5
"""Share of a thermistor's surprise that is believed, once a second, of winding and housing alike. A
housing that is off pulls its winding off by 2 % of that in a second: it is found in a minute."""
HOLDS_S: Final = 60.0
"""Time for which a drive is taken to have held on after its service ended; one is back in 5 s."""
COOLS_S: Final = 4.0 * 3600.0
"""A module is cold after so long."""
COPPER: Final = 0.00393
"""1/K, resistance of copper at 25 C."""
REFERENCE: Final = 25.0
"""C at which the resistance is given."""
_GRID_S: Final = tuple(LEFT_MAX_S * 1.35 ** (k - 29) for k in range(30))
"""Times at which a winding is looked at, s: from 0.6 s on."""


class HeatState(msgspec.Struct):
    """State of `HeatEstimate`, of axis0 and axis1, C."""

    winding: Pair = (0.0, 0.0)
    housing: Pair = (0.0, 0.0)
    stage: Pair = (0.0, 0.0)
    square: Pair = (0.0, 0.0)
    """Sum of the squared motor torques since the last step, (N m)^2."""
    cycles: int = 0
    """Cycles in it."""
    load: Pair = (0.0, 0.0)
    """Mean squared motor torques, (N m)^2."""
    stepped_ns: int = 0
    """Time of the last step; 0: none yet."""
    left_s: float = UNKNOWN_S
    """To a tenth."""
    shown: Pair = (0.0, 0.0)
    """Windings to a tenth, for the messages."""

    @property
    def kept(self) -> tuple[float, ...]:
        """Numbers that a service that starts after this one needs, C and (N m)^2."""
        return (*self.winding, *self.housing, *self.stage, *self.load)


class _Motor(NamedTuple):
    """The two nodes as a linear system, but for the load."""

    ambient: float
    exchange: float
    """From winding to housing over the winding's capacity, 1/s."""
    gain: float
    """The same over the housing's capacity, 1/s."""
    loss: float
    """The housing's to the air, 1/s."""
    heating: float
    """C/s of the winding at 25 C per (N m)^2."""


class HeatEstimate:
    """Temperatures of one module.

    Attributes:
        enabled: [heat] of the robot file says what the motors are.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Take the figures; motors and output stages begin as warm as the air."""
        heat = config.heat
        self.enabled = heat.estimate
        per_torque2 = 1.0 / config.drive.torque_constant**2
        self._motor = _Motor(
            ambient=heat.ambient,
            exchange=1.0 / (heat.winding_capacity * heat.winding_to_housing),
            gain=1.0 / (heat.housing_capacity * heat.winding_to_housing),
            loss=1.0 / (heat.housing_capacity * heat.housing_to_air),
            heating=1.5 * heat.resistance * per_torque2 / heat.winding_capacity,
        )
        self._stage_rise = heat.stage_per_square_ampere * per_torque2
        self._stage_s = heat.stage_s
        self._winding_max, self._stage_max = heat.winding_max, heat.stage_max

    def cold(self) -> HeatState:
        """Return the state of a module that is as warm as the air."""
        if not self.enabled:
            return HeatState()
        start: Pair = (self._motor.ambient, self._motor.ambient)
        return HeatState(winding=start, housing=start, stage=start)

    def advance(
        self, s: HeatState, now_ns: int, motor_torque: Pair, fet: Pair | None, motor: Pair | None
    ) -> None:
        """Update the estimate with one cycle.

        Args:
            s: the estimate, which changes.
            now_ns: this module's clock.
            motor_torque: of the two motors, N m.
            fet: what the drive reports of its output stages, C; None: nothing new.
            motor: what its motors' thermistors report, C; None: nothing new, or there are none.
        """
        a, b = motor_torque
        s.square = (s.square[0] + a * a, s.square[1] + b * b)
        s.cycles += 1
        report(s, fet, motor)
        if not s.stepped_ns:
            s.stepped_ns = now_ns
        elif now_ns - s.stepped_ns >= STEP_S * NS_PER_S:
            dt_s = min((now_ns - s.stepped_ns) / NS_PER_S, GAP_S)
            s.stepped_ns = now_ns
            mean = (s.square[0] / s.cycles, s.square[1] / s.cycles)
            s.square, s.cycles = (0.0, 0.0), 0
            share = 1.0 - math.exp(-dt_s / LOAD_S)
            s.load = (
                s.load[0] + share * (mean[0] - s.load[0]),
                s.load[1] + share * (mean[1] - s.load[1]),
            )
            self._step(s, mean, dt_s)
            self._show(s)

    def resume(self, s: HeatState, kept: tuple[float, ...], passed_s: float) -> None:
        """Start as warm as an earlier service left the module, cooled since.

        A drive may have held the robot meanwhile, by its own loop: the load goes on for `HOLDS_S`.

        Args:
            s: the estimate, which changes.
            kept: `HeatState.kept` of the earlier service.
            passed_s: time since then, s.
        """
        a, b, c, d, e, f, g, h = kept
        s.winding, s.housing, s.stage, s.load = (a, b), (c, d), (e, f), (g, h)
        held_s = min(passed_s, HOLDS_S)
        self.skip(s, held_s)
        s.load = (0.0, 0.0)
        self.skip(s, min(passed_s - held_s, COOLS_S))
        s.load = (g, h)

    def skip(self, s: HeatState, seconds: float) -> None:
        """Let time pass for the temperatures alone, under the present mean load (lockstep)."""
        while seconds > 0.0:
            self._step(s, s.load, min(STEP_S, seconds))
            seconds -= STEP_S
        self._show(s)

    def _show(self, s: HeatState) -> None:
        left_s = (min(self._stage_left_s(s, i), self._winding_left_s(s, i)) for i in (0, 1))
        s.left_s = round(min(left_s), 1)
        s.shown = (round(s.winding[0], 1), round(s.winding[1], 1))

    def _step(self, s: HeatState, square: Pair, dt_s: float) -> None:
        """Advance the temperatures under a mean squared torque, (N m)^2."""
        m = self._motor
        winding, housing, stage = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        for i in (0, 1):
            hot, warm = s.winding[i], s.housing[i]
            copper = m.heating * square[i] * (1.0 + COPPER * (hot - REFERENCE))
            winding[i] = hot + dt_s * (copper - m.exchange * (hot - warm))
            housing[i] = warm + dt_s * (m.gain * (hot - warm) - m.loss * (warm - m.ambient))
            end = m.ambient + self._stage_rise * square[i]
            stage[i] = s.stage[i] + min(1.0, dt_s / self._stage_s) * (end - s.stage[i])
        s.winding, s.housing = (winding[0], winding[1]), (housing[0], housing[1])
        s.stage = (stage[0], stage[1])

    def _stage_left_s(self, s: HeatState, i: int) -> float:
        most = self._stage_max
        end = self._motor.ambient + self._stage_rise * s.load[i]
        if s.stage[i] >= most:
            return 0.0
        if end <= most:
            return LEFT_MAX_S
        left_s = self._stage_s * math.log((end - s.stage[i]) / (end - most))
        return min(LEFT_MAX_S, left_s)

    def _winding_left_s(self, s: HeatState, i: int) -> float:
        """Return when the winding crosses its limit, by the exact solution on a grid of times.

        With the resistance that rises the system stays linear:

            x' = A x + B, x = (T_w - T_a, T_h - T_a), A = [[h - e, e], [g, -g - l]]
        """
        m = self._motor
        hot, warm = s.winding[i] - m.ambient, s.housing[i] - m.ambient
        most = self._winding_max - m.ambient
        if hot >= most:
            return 0.0
        drive = m.heating * s.load[i]
        B = drive * (1.0 + COPPER * (m.ambient - REFERENCE))
        a, e, g, d = drive * COPPER - m.exchange, m.exchange, m.gain, -m.gain - m.loss
        determinant = a * d - e * g
        if abs(determinant) < 1e-15:
            return LEFT_MAX_S
        # at rest A x = -B; (hot, warm) minus that decays along two eigenvectors (e, lambda - a)
        hot_end, warm_end = -d * B / determinant, g * B / determinant
        root = math.sqrt((a - d) ** 2 + 4.0 * e * g)
        fast, slow = 0.5 * (a + d - root), 0.5 * (a + d + root)
        x, y = hot - hot_end, warm - warm_end
        c_slow = (e * y - (fast - a) * x) / root  # share of x along the slow eigenvector
        c_fast = x - c_slow
        before_s, before = 0.0, hot
        for t in _GRID_S:
            now = hot_end + c_slow * math.exp(slow * t) + c_fast * math.exp(fast * t)
            if now >= most:
                return before_s + (t - before_s) * (most - before) / (now - before)
            before_s, before = t, now
        return LEFT_MAX_S


def report(s: HeatState, fet: Pair | None, motor: Pair | None) -> None:
    """Correct an estimate by what the drive reports, C; None: nothing new."""
    if fet is not None:
        s.stage = fet
    if motor is not None:
        (a, b), (c, d) = s.winding, s.housing
        first, second = FOLLOW * (motor[0] - a), FOLLOW * (motor[1] - b)
        s.winding, s.housing = (a + first, b + second), (c + first, d + second)


_KEPT: Final = struct.Struct("<q8d")
_POSSIBLE: Final = (-60.0, 400.0)
"""C; a file with anything else is none."""


class HeatFile:
    """A module's temperatures in its live directory: a service that restarts finds it warm.

    The file is mapped: writing it is a store, which the control path may do. The supervisor
    copies it to the disk (`tools.fleet.kept_state`). Times are of the monotonic clock; after a
    restart of the host nothing counts as cooled.
    """

    def __init__(self, run_dir: Path, module: str) -> None:
        """Open it, or make it; the directory is there.

        Raises:
            FleetError: it cannot be made.
        """
        self._memory = mapped(live_dir(run_dir) / f"{module}.heat", _KEPT.size)
        self._written_ns = 0

    def restore(self, estimate: HeatEstimate, s: HeatState, now_ns: int) -> None:
        """Make an estimate's state go on from what the file holds, if it holds anything."""
        then_ns, *kept = _KEPT.unpack(self._memory[:])
        low, high = _POSSIBLE
        possible = all(low < one < high for one in kept) and min(kept[6:]) >= 0.0
        if then_ns > 0 and possible and estimate.enabled:
            estimate.resume(s, tuple(kept), max(0, now_ns - then_ns) / NS_PER_S)

    def write(self, s: HeatState) -> None:
        """Write the state if the estimate has made a step since."""
        if s.stepped_ns != self._written_ns:
            self._written_ns = s.stepped_ns
            self._memory[:] = _KEPT.pack(s.stepped_ns, *s.kept)
