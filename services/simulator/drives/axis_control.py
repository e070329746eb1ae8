"""Control law of the emulated axes (docs/drives.md), as one graph over all twelve.

Firmware 0.5.6, pass-through: torque = input_torque + vel_gain (clamp(input_vel +
pos_gain (input_pos - pos)) - vel) + integrator, clamped to current_lim; input_vel and
input_torque are each clamped to the same limits first. The firmware runs this loop at 8 kHz; the
emulation evaluates it once per step.

The torque excludes the current loop's lag of 1 ms, which the plant adds (`drive.lag_s`). The
measured current follows the loop's bandwidth. A change of the motor's speed disturbs it through the
EMF e, by e s / ((L s + R) (s + w)), until the loop has compensated. Beyond current_lim plus its
margin of 8 A the firmware disarms. The estimates come from
`services.simulator.drives.axis_encoders`.

Pure: no clock, no I/O. Arrays are indexed by axis, shape (12,). Units at the motor: turns,
turn/s, N m, A.
"""

from __future__ import annotations

import functools
import math
from typing import Final, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_encoders import AxisEncoders
from services.simulator.drives.axis_settings import (
    PHASE_INDUCTANCE,
    PHASE_RESISTANCE,
    Settings,
)
from services.simulator.drives.axis_watches import BANDWIDTH
from shared.can.cansimple import ControlMode
from shared.joints import N_JOINTS
from shared.robot.compiled_graph import CompiledGraph

Vector = NDArray[np.float64]

FIRMWARE_RATE_HZ: Final = 8000.0
INTEGRATOR_DECAY: Final = 0.99
"""Factor on the integrator in each firmware cycle in which the torque is limited."""

_SETTINGS: Final = (
    "controller.config.control_mode",
    "controller.config.pos_gain",
    "controller.config.vel_gain",
    "controller.config.vel_integrator_gain",
    "controller.config.vel_limit",
    "controller.config.enable_vel_limit",
    "controller.config.enable_torque_mode_vel_limit",
    "controller.config.enable_overspeed_error",
    "controller.config.vel_limit_tolerance",
    "controller.config.vel_integrator_limit",
    "motor.config.current_lim",
    "motor.config.torque_constant",
    "motor.config.phase_resistance",
    "motor.config.current_lim_margin",
    "motor.config.current_control_bandwidth",
)
"""The axis settings that the law reads."""


_ROWS: Final = 5
"""Rows of the current loops' state: see `_LawResults.loops`."""
_POWER: Final = 4 * N_JOINTS
"""Start of their last row."""


class _LawResults(NamedTuple):
    """Results of the law in a step; arrays (12,) unless another shape is given."""

    torque: Vector
    integrator: Vector
    too_fast: Vector
    """1 beyond the OVERSPEED limit."""
    power: Vector
    """Electrical power of each motor, W."""
    mechanical: Vector
    """Mechanical power of each motor, W."""
    over_current: Vector
    """1 beyond the current limit plus its margin."""
    loops: Vector
    """(60,), five rows: current, the EMF's rate behind the winding, the current that the EMF
    drives, the motor's true speed, and the filtered power of the torque that the controller
    requests, armed or not; A, A/s, A, turn/s, W."""
    broken: Vector
    """1 if the torque is NaN."""
    extremes: Vector
    """(3,): number of axes beyond a limit, minimum and maximum power, W."""
    asked: Vector
    """Torque that the controller requests, armed or not."""


class AxisControl:
    """Inputs and torque of all axes; no state machine, no errors.

    Attributes:
        armed: 1.0 in closed loop, else 0.0.
        connected: 1.0 from the first closed loop since start-up on; the controller then reads the
            encoder, in IDLE too.
        derating: fraction of current_lim that remains after derating for heat.
        warmth: resistance of each winding divided by its resistance at 25 C.
    """

    def __init__(self, settings: Settings, encoders: AxisEncoders) -> None:
        """Bind the settings, and the estimates that the law uses."""
        self._settings, self._encoders = settings, encoders
        self._seen = -1
        self._mode = settings.axis("controller.config.control_mode")
        self.input_pos, self.input_vel, self.input_torque = np.zeros((3, N_JOINTS))
        self.armed, self.connected, self.integrator = np.zeros((3, N_JOINTS))
        self.derating, self.warmth = np.ones((2, N_JOINTS))
        self._loops = np.zeros(_ROWS * N_JOINTS)
        self._speed = np.zeros(N_JOINTS)  # of the motors, turn/s
        self._dt_s = 0.0
        self._graph = graph = CompiledGraph(law_graph())
        columns = [settings.axis(name) for name in _SETTINGS]
        # the true resistance heats the winding, not the calibrated one
        true_resistance = np.full(N_JOINTS, PHASE_RESISTANCE)
        columns[_SETTINGS.index("motor.config.phase_resistance")] = true_resistance
        live = (
            encoders.pos_estimate, encoders.vel_estimate, self.input_pos, self.input_vel,
            self.input_torque, self.armed, self.connected, self.derating, self.integrator,
            self.warmth, self._loops, self._speed,
        )  # fmt: skip
        for index, array in enumerate((*columns, *live)):
            graph.bind(index, array)
        self._step = graph.arguments[-1]
        self.results = _LawResults(*graph.results)

    def regulates(self) -> bool:
        """Return True if any axis in closed loop has a position or velocity loop."""
        if self._seen != self._settings.version:
            self._seen = self._settings.version
            self._regulates = (self._mode >= ControlMode.VELOCITY).astype(np.float64)
        return bool(np.dot(self._regulates, self.armed) > 0.0)

    def hold_here(self, axis: int) -> None:
        """In position mode, move the target to the motor's position (`control_mode_updated`)."""
        if self._mode[axis] >= ControlMode.POSITION:
            self.input_pos[axis] = self._encoders.pos_estimate[axis]

    def arm(self, axis: int) -> None:
        """Enable an axis's torque at its present position; `input_torque` is unchanged."""
        self.hold_here(axis)
        self.integrator[axis] = self._loops[_POWER + axis] = 0.0
        self.armed[axis] = self.connected[axis] = 1.0

    def start(self, vel_turns: Vector) -> None:
        """Set the motors' previous true speeds, so that the first step sees no change."""
        self._loops[3 * N_JOINTS : _POWER] = vel_turns

    def turn(self, vel_turns: Vector) -> None:
        """Set the motors' true speeds after a step."""
        self._speed[:] = vel_turns

    def control(self) -> tuple[float, float, float]:
        """Compute torques and powers, and check the limits; the integrators are unchanged.

        Returns:
            Number of axes that exceed their OVERSPEED or current limit or have a NaN torque (listed
            by `failing`), and the minimum and maximum power of an axis, W.
        """
        if self._dt_s != self._encoders.dt_s:
            self._dt_s = self._encoders.dt_s
            self._step[:] = self._dt_s, INTEGRATOR_DECAY ** (FIRMWARE_RATE_HZ * self._dt_s)
        self._graph()
        beyond, least, most = self.results.extremes.tolist()
        return beyond, least, most

    def integrate(self) -> None:
        """Store the integrators and current loops of the last `control`."""
        self.integrator[:] = self.results.integrator
        self._loops[:] = self.results.loops

    def failing(self) -> list[tuple[int, str]]:
        """Return the axes to disarm after the last `control`, each with its fault's name.

        OVERSPEED is checked in IDLE too, the others only on armed axes.
        """
        law = self.results
        checks = {
            "OVERSPEED": law.too_fast,
            "MODULATION_IS_NAN": law.broken,
            "CURRENT_LIMIT": law.over_current,
        }
        return [(int(n), name) for name, axes in checks.items() for n in np.flatnonzero(axes)]

    def asked_power(self, axis: int) -> float:
        """Return the filtered power of the torque that an axis's controller requests, W."""
        return float(self._loops[_POWER + axis])


@functools.cache
def law_graph() -> ca.Function:
    """Return the law: settings, estimates, inputs and state of twelve axes -> `_LawResults`."""
    names = [name.rpartition(".")[2] for name in _SETTINGS]
    inputs = (
        "pos", "vel", "input_pos", "input_vel", "input_torque", "armed", "connected", "derating",
        "integrator", "warmth",
    )  # fmt: skip
    of = {name: ca.SX.sym(name, N_JOINTS) for name in (*names, *inputs)}
    loops, speed = ca.SX.sym("loops", _ROWS * N_JOINTS), ca.SX.sym("speed", N_JOINTS)
    step = ca.SX.sym("step", 2)
    dt_s, decay = step[0], step[1]
    vel, vel_limit = of["vel"], of["vel_limit"]
    # a NaN limit limits nothing and trips nothing (`std::clamp`, Motor::effective_current_lim)
    current_lim = ca.if_else(of["current_lim"] < 0.0, 0.0, of["current_lim"])
    limit = current_lim * of["torque_constant"] * of["derating"]
    position = of["control_mode"] >= ControlMode.POSITION
    regulates = of["control_mode"] >= ControlMode.VELOCITY
    torque = _clamp(of["input_torque"], -limit, limit)
    # in torque mode no axis is driven beyond its velocity limit: vel_gain (+-vel_limit - vel)
    slowed = _clamp(torque, -of["vel_gain"] * (vel_limit + vel), of["vel_gain"] * (vel_limit - vel))
    limited = ca.logic_and(of["enable_torque_mode_vel_limit"] > 0.0, ca.logic_not(regulates))
    torque = ca.if_else(limited, slowed, torque)
    # the velocity loop, with the position loop around it, if the mode has them
    clamp = ca.if_else(of["enable_vel_limit"] > 0.0, vel_limit, ca.inf)
    wanted = ca.if_else(position, of["pos_gain"] * (of["input_pos"] - of["pos"]), 0.0)
    wanted += _clamp(of["input_vel"], -clamp, clamp)
    v_err = ca.if_else(regulates, _clamp(wanted, -clamp, clamp) - vel, 0.0)
    # the firmware resets the integrator in torque mode; it decays where the torque is limited
    integrator = ca.if_else(regulates, of["integrator"], 0.0)
    torque += v_err * of["vel_gain"] + integrator
    saturated = ca.fabs(torque) > limit
    gained = v_err * of["vel_integrator_gain"] * dt_s * of["armed"]
    integrator = ca.if_else(saturated, integrator * decay, integrator + gained)
    most = of["vel_integrator_limit"]
    asked = _clamp(torque, -limit, limit)
    armed = of["armed"] > 0.0
    is_number = ca.logic_or(asked <= 0.0, asked > 0.0)  # CasADi simplifies asked == asked
    broken = ca.logic_and(armed, ca.logic_not(is_number))
    torque = ca.if_else(armed, asked, 0.0)
    tolerance = ca.if_else(of["enable_overspeed_error"] > 0.0, of["vel_limit_tolerance"], ca.inf)
    too_fast = (ca.fabs(vel) > vel_limit * tolerance) * of["connected"]
    mechanical = 2.0 * math.pi * vel * torque
    copper = 1.5 * of["phase_resistance"] * of["warmth"] / of["torque_constant"] ** 2
    # never -0.0: of two zeros, C and CasADi may take either as the smaller
    power = ca.if_else(torque == 0.0, 0.0, copper * torque * torque + mechanical)
    loops_next, over_current = _currents(of, torque, loops, speed, dt_s)
    asked_power = loops[_POWER:]
    gain = (2.0 * math.pi * vel * asked - asked_power) * (1.0 - ca.exp(-BANDWIDTH * dt_s))
    gain = ca.if_else(of["connected"] > 0.0, gain, 0.0)
    loops_next = ca.vertcat(loops_next, asked_power + gain)
    beyond = ca.sum1(too_fast) + ca.sum1(over_current) + ca.sum1(broken)
    extremes = ca.vertcat(beyond, ca.mmin(power), ca.mmax(power))
    return ca.Function(
        "axes",
        [*of.values(), loops, speed, step],
        [
            ca.densify(one)
            for one in (
                torque, _clamp(integrator, -most, most), too_fast, power, mechanical, over_current,
                loops_next, broken, extremes, asked,
            )
        ],
        {"cse": True},
    )  # fmt: skip


def _currents(
    of: dict[str, ca.SX], torque: ca.SX, loops: ca.SX, speed: ca.SX, dt_s: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the current loops after the step, and the axes beyond the limit plus its margin.

    The EMF's rate x1 and the current x2 that it drives follow x1' = z - R / L x1, x2' = x1 - w x2
    with z = e' / L, for a speed that ramps over the step. A lowered limit is compared with the
    current that still flows.
    """
    current, x1, x2, speed_before, _ = ca.vertsplit(loops, N_JOINTS)
    w, kt, resistance = (
        of[name] for name in ("current_control_bandwidth", "torque_constant", "phase_resistance")
    )
    wanted = torque / kt
    before, current = current, wanted + (current - wanted) * ca.exp(-w * dt_s)
    rate = ca.if_else(dt_s > 0.0, (speed - speed_before) / dt_s, 0.0)
    z = -2.0 / 3.0 * kt * 2.0 * math.pi * rate / PHASE_INDUCTANCE
    # the winding's pole must differ from the loop's, because the formula divides by the difference
    pole = resistance / PHASE_INDUCTANCE
    pole = ca.if_else(ca.fabs(pole - w) < 1e-3 * w, 1.001 * w, pole)
    pole = ca.fmax(pole, 1.0)
    fade_1, fade_2 = ca.exp(-pole * dt_s), ca.exp(-w * dt_s)
    rest = z / pole
    x1_next = rest + (x1 - rest) * fade_1
    x2_next = x2 * fade_2 + rest * (1.0 - fade_2) / w
    x2_next += (x1 - rest) * (fade_1 - fade_2) / (w - pole)
    limit = of["current_lim"] * of["derating"] + of["current_lim_margin"]
    most = ca.fmax(ca.fabs(before), ca.fabs(current + x2_next))
    over = ca.logic_and(of["armed"] > 0.0, most > limit)
    kept = ca.if_else(of["armed"] > 0.0, 1.0, 0.0)
    return ca.vertcat(current * kept, x1_next * kept, x2_next * kept, speed), over


def _clamp(value: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    """Return a value within its limits; NaN stays NaN, as in the firmware's `std::clamp`."""
    return ca.if_else(value < low, low, ca.if_else(value > high, high, value))
