"""Estimates the temperatures of motors and output stages, and the time left at their load. Pure.

Each motor has two nodes (winding T_w, housing T_h) and each output stage one (T_s), with the
figures of [heat] in the robot file. T_a is the air's temperature, and Iq a motor's current, from
its torque:

    C_w T_w' = 1.5 R Iq^2 - (T_w - T_h) / R_wh        R = R_25 (1 + alpha (T_w - 25 C))
    C_h T_h' = (T_w - T_h) / R_wh - (T_h - T_a) / R_ha
    t_s T_s' = T_a + k_s Iq^2 - T_s

The drive's readings correct the estimate. The seconds left are the time until a winding or an
output stage reaches its limit, if the mean load of the last `LOAD_S` continues.
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
"""Period of the estimate, s."""
GAP_S: Final = 5.0
"""Maximum time for which the load is assumed to continue while the process is stopped, s."""
LOAD_S: Final = 4.0
"""Time constant of the mean load, s; a squat takes 5 s."""
UNKNOWN_S: Final = -1.0
"""Value of `left_s` without an estimate."""
FOLLOW: Final = 0.5
"""Share of a thermistor's deviation that corrects both winding and housing, once a second. An error
in the housing shifts its winding by 2 % of the error every second, so the readings correct it
within a minute."""
HOLDS_S: Final = 60.0
"""Time for which a drive is assumed to hold after its service ended, s."""
COOLS_S: Final = 4.0 * 3600.0
"""Time without load after which a module is cold, s."""
COPPER: Final = 0.00393
"""Temperature coefficient of copper's resistance at 25 C, 1/K."""
REFERENCE: Final = 25.0
"""Temperature at which the resistance is given, C."""
_GRID_S: Final = tuple(LEFT_MAX_S * 1.35 ** (k - 29) for k in range(30))
"""Times at which a winding's temperature is predicted, s; the first is 0.6 s."""


class HeatState(msgspec.Struct):
    """State of `HeatEstimate`; pairs are of axis0 and axis1, temperatures in C."""

    winding: Pair = (0.0, 0.0)
    housing: Pair = (0.0, 0.0)
    stage: Pair = (0.0, 0.0)
    square: Pair = (0.0, 0.0)
    """Sum of the squared motor torques since the last step, (N m)^2."""
    cycles: int = 0
    """Cycles in that sum."""
    load: Pair = (0.0, 0.0)
    """Mean squared motor torques, (N m)^2."""
    stepped_ns: int = 0
    """Time of the last step, ns; 0 before the first."""
    left_s: float = UNKNOWN_S
    """Seconds left at the mean load, to a tenth."""
    shown: Pair = (0.0, 0.0)
    """Winding temperatures for the messages, to a tenth."""

    @property
    def kept(self) -> tuple[float, ...]:
        """Values from which the next service starts, C and (N m)^2."""
        return (*self.winding, *self.housing, *self.stage, *self.load)


class _Motor(NamedTuple):
    """The two nodes as a linear system, without the load."""

    ambient: float
    exchange: float
    """Conductance from winding to housing over the winding's capacity, 1/s."""
    gain: float
    """The same conductance over the housing's capacity, 1/s."""
    loss: float
    """Conductance from housing to air over the housing's capacity, 1/s."""
    heating: float
    """Heating of the winding at 25 C, C/s per (N m)^2."""


class HeatEstimate:
    """Estimates the temperatures of one module.

    Attributes:
        enabled: True if [heat] of the robot file describes the motors.
    """

    def __init__(self, config: RobotConfig) -> None:
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
        """Return the state of a module at the temperature of the air."""
        if not self.enabled:
            return HeatState()
        start: Pair = (self._motor.ambient, self._motor.ambient)
        return HeatState(winding=start, housing=start, stage=start)

    def advance(
        self, s: HeatState, now_ns: int, motor_torque: Pair, fet: Pair | None, motor: Pair | None
    ) -> None:
        """Update the estimate with one cycle.

        Args:
            s: the estimate, updated in place.
            now_ns: this module's clock.
            motor_torque: torques of the two motors, N m.
            fet: readings of the output stages, C; None without new ones.
            motor: readings of the motors' thermistors, C; None without new ones.
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
        """Start from the temperatures of an earlier service, and let them cool.

        The drive may have held the robot meanwhile, so the load is assumed to continue for
        `HOLDS_S`.

        Args:
            s: the estimate, updated in place.
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
        """Advance only the temperatures, under the present mean load; lockstep uses this too."""
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
        """Return the time until the winding reaches its limit, s: exact at a grid of times.

        The system stays linear although the resistance rises with the temperature:

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
        # in equilibrium A x = -B; the rest of (hot, warm) decays along eigenvectors (e, lambda - a)
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
    """Correct an estimate with the drive's readings, C; None without new ones."""
    if fet is not None:
        s.stage = fet
    if motor is not None:
        (a, b), (c, d) = s.winding, s.housing
        first, second = FOLLOW * (motor[0] - a), FOLLOW * (motor[1] - b)
        s.winding, s.housing = (a + first, b + second), (c + first, d + second)


_KEPT: Final = struct.Struct("<q8d")
_POSSIBLE: Final = (-60.0, 400.0)
"""Range of valid values; a file with a value outside it is ignored."""


class HeatFile:
    """A module's temperatures in its live directory, for a service that restarts.

    The file is mapped, so writing it is only a store, which the control path may do. The supervisor
    copies it to the disk (`tools.fleet.kept_state`). Times are on the monotonic clock, so after a
    restart of the host no cooling is assumed.
    """

    def __init__(self, run_dir: Path, module: str) -> None:
        """Open the file, or create it; the directory must exist.

        Raises:
            FleetError: the file cannot be created.
        """
        self._memory = mapped(live_dir(run_dir) / f"{module}.heat", _KEPT.size)
        self._written_ns = 0

    def restore(self, estimate: HeatEstimate, s: HeatState, now_ns: int) -> None:
        """Continue an estimate from the file's values, if they are valid."""
        then_ns, *kept = _KEPT.unpack(self._memory[:])
        low, high = _POSSIBLE
        possible = all(low < one < high for one in kept) and min(kept[6:]) >= 0.0
        if then_ns > 0 and possible and estimate.enabled:
            estimate.resume(s, tuple(kept), max(0, now_ns - then_ns) / NS_PER_S)

    def write(self, s: HeatState) -> None:
        """Write the state if the estimate has made a step since the last write."""
        if s.stepped_ns != self._written_ns:
            self._written_ns = s.stepped_ns
            self._memory[:] = _KEPT.pack(s.stepped_ns, *s.kept)
