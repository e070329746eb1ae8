"""Heat of the emulated axes: motors, output stages, thermistors, and derating. Pure.

Each motor has two thermal nodes, each output stage one; Iq is the motor's current:

    C_w T_w' = 1.5 R Iq^2 - (T_w - T_h) / R_wh        R = R_25 (1 + alpha (T_w - 25 C))
    C_h T_h' = (T_w - T_h) / R_wh - (T_h - T_a) / R_ha
    t_s T_s' = T_a + k_s Iq^2 - T_s

A thermistor's reading passes two low-passes of 0.1 s, as in firmware 0.5.6. Between its two
temperature limits the current limit falls linearly to zero; `OVER_TEMP_MARGIN` above the upper
limit the axis disarms. A stage that heats up suddenly thus derates first and disarms 0.5 s later.
"""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_control import AxisControl
from services.simulator.drives.axis_settings import PHASE_RESISTANCE, Settings
from shared.joints import N_JOINTS
from shared.toml_file import Range, Section

Vector = NDArray[np.float64]

OVER_TEMP_MARGIN: Final = 5.0
"""Excess over `temp_limit_upper` at which the firmware disarms, C."""
FILTER_S: Final = 0.1
"""Time constant of each of a thermistor's two low-passes, s."""
SETTLED: Final = 0.05
"""Maximum error of a settled reading, C."""
EVERY_S: Final = 0.1
"""Time step of the temperatures, s."""
COPPER: Final = 0.00393
"""Temperature coefficient of copper's resistance at 25 C, 1/K."""
REFERENCE: Final = 25.0
"""Temperature at which the resistance is given, C."""
_FET: Final = "motor.fet_thermistor.config."
_MOTOR: Final = "motor.motor_thermistor.config."

Kelvins = Annotated[float, Range(-50.0, 200.0, "K")]


class Heat(Section, frozen=True):
    """Thermal model of motors and output stages, the same for all motors and axes.

    The motors' values are assumed; measure your motors.
    """

    ambient: Annotated[float, Range(-40.0, 60.0, "C")] = 25.0
    warm: Kelvins = 0.0
    """Initial temperature of motors and output stages, relative to the air."""
    resistance: Annotated[float, Range(0.001, 10.0, "ohm")] = PHASE_RESISTANCE
    """Resistance of a phase at 25 C. Assumed: an outrunner of some 80 mm with 100 rpm/V."""
    winding_capacity: Annotated[float, Range(1.0, 1e4, "J/K")] = 100.0
    """0.2 kg of copper (385 J/(kg K)) and a share of the stator's teeth. Assumed."""
    winding_to_housing: Annotated[float, Range(0.01, 20.0, "K/W")] = 0.5
    """Gives a time constant of 50 s with `winding_capacity`, usual for this size. Assumed."""
    housing_capacity: Annotated[float, Range(1.0, 1e5, "J/K")] = 1500.0
    """Half of a module's 8.73 kg belongs to each motor; 3 kg of steel and aluminium heat up with
    it. Assumed."""
    housing_to_air: Annotated[float, Range(0.01, 50.0, "K/W")] = 1.2
    """0.08 m^2 of housing and links at 10 W/(m^2 K), free convection and radiation. Assumed."""
    stage_per_square_ampere: Annotated[float, Range(0.0, 1.0, "K/A^2")] = 0.054
    """Temperature rise that an output stage's thermistor reads. On a v3.5 with 48 V, a user
    measured at most 40 A continuously, with the heat sink in still air at 13 C (ODrive's forum,
    thread 972). The thermistor is assumed to read 100 C at that current."""
    stage_s: Annotated[float, Range(1.0, 1e4, "s")] = 200.0
    """Time constant of the heat sink. Assumed."""
    motor_thermistor: bool = False
    """True if each winding has a thermistor, wired to its drive. The drive uses it if its setting
    `motor.motor_thermistor.config.enabled` is True."""


class AxisHeat:
    """Temperatures of the twelve axes; every array is indexed by axis, (12,), C.

    Attributes:
        winding: windings of the motors.
        housing: housings of the motors.
        stage: output stages.
        fet: readings of the output stages' thermistors.
        motor: readings of the motors' thermistors; 0 without a thermistor.
        load: mean squared torques of the last slow step, (N m)^2.
        hot: axes that the firmware disarms; True for the motor, False for the output stage.
    """

    def __init__(self, settings: Settings, control: AxisControl, heat: Heat) -> None:
        """Start at the plant's temperatures; derate the current limits of `control`."""
        self._settings, self._control, self._heat = settings, control, heat
        start = heat.ambient + heat.warm
        self.winding, self.housing, self.stage = np.full((3, N_JOINTS), start)
        self.fet = self.stage.copy()
        self.motor = self.winding.copy() if heat.motor_thermistor else np.zeros(N_JOINTS)
        self.hot: dict[int, bool] = {}
        self._forced: dict[int, float] = {}
        self._half = self.fet.copy()
        self._filtering = False
        self._torque = control.results.torque
        self.load: Vector = np.zeros(N_JOINTS)
        self._square: Vector = np.zeros(N_JOINTS)
        """Integral of the squared torque since the last slow step."""
        self._passed_s = 0.0
        self._warm_up()

    def advance(self, dt_s: float) -> None:
        """Advance by `dt_s` under the torques of the previous step."""
        torque = self._torque
        self._square += dt_s * torque * torque
        self._passed_s += dt_s
        if self._passed_s >= EVERY_S:
            self.load = self._square / self._passed_s
            self._slow_step(self.load, self._passed_s)
            self._square[:] = self._passed_s = 0.0
            self._read()
        if self._filtering:
            self._filter(dt_s)

    def skip(self, square: Vector, seconds: float) -> None:
        """Advance only the temperatures, under a mean squared torque (12,), (N m)^2."""
        while seconds > 0.0:
            step_s = min(1.0, seconds)
            self._slow_step(square, step_s)
            seconds -= step_s
        self._read()

    def force(self, axis: int, celsius: float | None) -> None:
        """Hold an axis's output stage at a temperature; None releases it."""
        if celsius is None:
            self._forced.pop(axis, None)
        else:
            self._forced[axis] = celsius
        self._filtering = True

    @property
    def derating(self) -> float:
        """Smallest fraction of an axis's current limit that remains after derating."""
        return float(self._control.derating.min())

    def numbers(self) -> tuple[float, ...]:
        """Return the temperatures, for `set_numbers`: windings, housings, output stages."""
        return tuple(np.concatenate((self.winding, self.housing, self.stage)).tolist())

    def set_numbers(self, numbers: tuple[float, ...]) -> None:
        """Restore the temperatures of `numbers`; if it is empty, change nothing."""
        if numbers:
            self.winding[:], self.housing[:], self.stage[:] = np.array(numbers).reshape(3, -1)
            self._read()

    def _slow_step(self, square: Vector, dt_s: float) -> None:
        """Advance the temperatures under a mean squared torque (12,), (N m)^2."""
        heat, winding, housing = self._heat, self.winding, self.housing
        amperes2 = square / self._settings.axis("motor.config.torque_constant") ** 2
        copper = 1.5 * heat.resistance * (1.0 + COPPER * (winding - REFERENCE)) * amperes2
        inwards = (winding - housing) / heat.winding_to_housing
        winding += dt_s / heat.winding_capacity * (copper - inwards)
        outwards = (housing - heat.ambient) / heat.housing_to_air
        housing += dt_s / heat.housing_capacity * (inwards - outwards)
        end = heat.ambient + heat.stage_per_square_ampere * amperes2
        self.stage += min(1.0, dt_s / heat.stage_s) * (end - self.stage)
        self._warm_up()

    def _warm_up(self) -> None:
        np.subtract(self.winding, REFERENCE, out=self._control.warmth)
        self._control.warmth *= COPPER
        self._control.warmth += 1.0

    def _raw(self) -> Vector:
        if not self._forced:
            return self.stage
        raw = self.stage.copy()
        for axis, celsius in self._forced.items():
            raw[axis] = celsius
        return raw

    def _read(self) -> None:
        """Read the thermistors; the filters' lag is negligible unless a temperature has jumped."""
        if self._heat.motor_thermistor:
            self.motor[:] = self.winding
        if not self._filtering:
            self.fet[:] = self._half[:] = self._raw()
        self._derate()

    def _filter(self, dt_s: float) -> None:
        raw, share = self._raw(), 1.0 - np.exp(-dt_s / FILTER_S)
        self._half += share * (raw - self._half)
        self.fet += share * (self._half - self.fet)
        self._filtering = bool(np.abs(raw - self.fet).max() > SETTLED)
        self._derate()

    def _derate(self) -> None:
        """Derate the current limits, and find the axes that disarm."""
        settings, derating = self._settings, self._control.derating
        derating[:] = 1.0
        self.hot.clear()
        for below, reading, is_motor in ((_FET, self.fet, False), (_MOTOR, self.motor, True)):
            enabled = settings.axis(below + "enabled") > 0.0
            low = settings.axis(below + "temp_limit_lower")
            high = settings.axis(below + "temp_limit_upper")
            if not (enabled & (reading > low)).any():
                continue
            for axis in np.flatnonzero(enabled):
                margin, span = high[axis] - reading[axis], high[axis] - low[axis]
                share = margin / span if span != 0.0 else 0.0
                derating[axis] = min(derating[axis], max(0.0, share))
                if margin <= -OVER_TEMP_MARGIN:
                    self.hot[int(axis)] = is_motor
