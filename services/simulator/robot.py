"""The simulated robot, shared by the simulator's process and by lockstep. Pure.

It consists of the world, twelve emulated axes, load cells, an IMU, and the faults that a scenario
injects into the drives. Process and lockstep differ only in clock, bus and network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_encoders import Words
from services.simulator.drives.axis_faults import AXIS_NAMES
from services.simulator.drives.axis_heat import OVER_TEMP_MARGIN
from services.simulator.drives.dc_bus import SUPPLY_VOLTAGE
from services.simulator.fronts.sensor_fronts import FrameHub, HarnessFront, ImuFront
from services.simulator.physics.body import body_of
from services.simulator.physics.operator import LedHand
from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.world import World
from shared.bus.topics import SIM_STATE
from shared.bus.traces import SimState
from shared.can.cansimple import AxisState
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Scenario
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX, N_JOINTS

INTENT_RATE_HZ: Final = 50.0
_COLUMNS: Final = ("input_pos", "input_vel", "input_torque", "pos_gain", "vel_gain", "counts_from")
"""Arrays of the bank that `SimState` stores under the same names."""


class Periods(NamedTuple):
    """Periods in whole steps of the world, ns."""

    step: int
    encoders: int
    harness: int
    imu: int
    truth: int
    intent: int
    state: int

    @classmethod
    def from_config(cls, config: RobotConfig) -> Periods:
        """Return the periods for the rates in the robot file."""
        simulation = config.simulation
        step_ns = round(simulation.timestep * NS_PER_S)
        rates_hz = (
            simulation.encoder_rate_hz, config.harness.rate_hz, config.imu.rate_hz,
            simulation.truth_rate_hz, INTENT_RATE_HZ, SIM_STATE.rate_hz,
        )  # fmt: skip
        steps = (max(1, round(NS_PER_S / (rate_hz * step_ns))) for rate_hz in rates_hz)
        return cls(step_ns, *(step_ns * each for each in steps))


def axes_by_bus(config: RobotConfig) -> dict[str, dict[int, int]]:
    """Return, for each bus with drives, the axis (0..11) of each CAN node on it."""
    buses: dict[str, dict[int, int]] = {}
    for module in config.module:
        nodes = buses.setdefault(module.bus, {})
        for side, node in enumerate(module.node_ids):
            nodes[node] = 2 * MODULE_INDEX[module.name] + side
    return buses


class SimulatedRobot:
    """World, drives and sensors; the drives step before the world.

    Attributes:
        harness: the load cells.
        imu: the IMU; None if none is fitted.
        every: periods of the periodic exchanges.
    """

    def __init__(
        self,
        config: RobotConfig,
        plant: PlantConfig,
        scenario: Scenario,
        *,
        cells: FrameHub,
        imu: FrameHub | None,
        seed: int,
        lifted: float = 0.0,
    ) -> None:
        """Put the robot on the hoist, drives idle.

        Args:
            config: the robot file.
            plant: how the true robot differs from it.
            scenario: course of the run, including drive faults.
            cells: CAN bus of the load cells.
            imu: CAN bus of the IMU; None if no IMU is fitted.
            seed: seed of the sensors' noise.
            lifted: height of the soles above the floor, m.
        """
        self.world = World(body_of(config, plant), scenario, lifted)
        self.bank = AxisBank(
            config.drive,
            encoder_counts_per_turn=config.joint.encoder_counts_per_turn,
            motor_signs=config.motor_signs(),
            heat=plant.heat,
        )
        self.harness = HarnessFront(config, cells, seed)
        self.imu = None if imu is None else ImuFront(config.imu, plant.imu, imu, seed)
        self.every = Periods.from_config(config)
        self._faults = FaultInjector(scenario.fault, self.bank)
        self._torque = self.bank.torque

    def begin_faults(self) -> list[Fault]:
        """Start and end the faults that are due; return those that started."""
        return self._faults.advance(self.world.scenario_s)

    def step_drives(self) -> None:
        """Step the axes; call it per encoder sample, and per step of the world if they regulate."""
        self._torque = self.bank.step(self.world.time, *self.world.motor_turns())

    def step_world(self) -> None:
        """Advance the world by one step under the drives' torques."""
        self.world.step(self._torque)

    def feel(self) -> None:
        """Send a sample of the load cells."""
        outside = self.world.outside
        self.harness.send(outside.harness_force, outside.harness_moment)

    def read_state(self, t_ns: int, seq: int) -> SimState:
        """Return the state between two steps, from which a run can continue."""
        world, data = self.world, self.world.data
        return SimState(
            t_ns=t_ns,
            seq=seq,
            scenario_s=world.scenario_s,
            qpos=tuple(data.qpos.tolist()),
            qvel=tuple(data.qvel.tolist()),
            warmstart=tuple(data.qacc_warmstart.tolist()),
            hoist=world.hoist,
            armed=tuple(int(state == AxisState.CLOSED_LOOP_CONTROL) for state in self.bank.state),
            hidden=world.hidden(),
            hand=(world.outside.led_hand or LedHand()).numbers(),
            heat=self.bank.heat.numbers(),
            **{name: tuple(getattr(self.bank, name).tolist()) for name in _COLUMNS},
        )

    def write_state(self, state: SimState) -> None:
        """Continue from a state of the same robot and scenario; this robot must be new.

        The state contains no errors or conditions of drives, so an axis that is not armed is idle.
        """
        world, bank = self.world, self.bank
        world.resume(state)
        bank.heat.set_numbers(state.heat)
        bank.counts_from[:] = state.counts_from
        bank.step(world.time, *world.motor_turns())
        for axis in range(N_JOINTS):
            if state.armed[axis]:
                bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
        for name in _COLUMNS:
            getattr(bank, name)[:] = getattr(state, name)


_AT_ONCE: Final = {"watchdog": "WATCHDOG", "disarmed": "DISARM", "overspeed": "OVERSPEED"}
"""Momentary fault kinds, each with its name in `FAULTS` of the drives."""
_PULSED: Final = {"bus_full": (0.04, 0.1), "bus_flap": (0.06, 0.15)}
"""Lasting fault kinds that pulse: duration and period of a pulse, s."""
_ABOVE: Final = 5.0
"""Excess of an injected voltage or temperature over its limit, V or C."""


class FaultInjector:
    """Starts and ends the faults of a run."""

    def __init__(self, faults: Sequence[Fault], bank: AxisBank) -> None:
        """Prepare the faults, which may be in any order."""
        self._bank = bank
        self._coming = sorted(faults, key=lambda fault: fault.at)
        self._lasting: list[Fault] = []

    def advance(self, scenario_s: float) -> list[Fault]:
        """Start and end the faults due at a scenario time; return those that started."""
        if not self._coming and not self._lasting:
            return []
        for fault in [row for row in self._lasting if scenario_s >= row.at + row.lasts_s]:
            self._lasting.remove(fault)
            self._act(fault, begins=False)
        begun = [fault for fault in self._coming if fault.at <= scenario_s]
        for fault in begun:
            self._coming.remove(fault)
            if fault.kind in _AT_ONCE:
                self._bank.inject(AXIS_NAMES[_axis_of(fault)], _AT_ONCE[fault.kind])
            else:
                self._lasting.append(fault)
                self._act(fault, begins=True)
        for fault in self._lasting:
            if fault.kind in _PULSED:
                lasts_s, period_s = _PULSED[fault.kind]
                self._act(fault, begins=(scenario_s - fault.at) % period_s < lasts_s)
        return begun

    def _act(self, fault: Fault, *, begins: bool) -> None:
        bank, axis = self._bank, _axis_of(fault)
        drive = axis >> 1
        match fault.kind:
            case "over_temperature":
                limit = bank.settings.axis("motor.fet_thermistor.config.temp_limit_upper")[axis]
                hot = float(limit) + OVER_TEMP_MARGIN + _ABOVE
                bank.heat.force(axis, hot if begins else None)
            case "encoder" | "encoder_gap" | "encoder_zero":
                wrong = Words.ZERO if fault.kind == "encoder_zero" else Words.NONE
                bank.conditions.read_encoder(axis, wrong if begins else Words.TRUE)
            case "link_lost" | "bus_flap":
                bank.conditions.link(drive, up=not begins)
            case "no_ack":
                bank.conditions.deafen(drive, deaf=begins)
            case "bus_full":
                bank.conditions.choke(drive, full=begins)
            case "over_voltage":
                limit = bank.settings.drive("config.dc_bus_overvoltage_trip_level")[drive]
                bank.supply(drive, float(limit) + _ABOVE if begins else SUPPLY_VOLTAGE)
            case "brown_out":
                bank.supply(drive, 0.0 if begins else SUPPLY_VOLTAGE)
            case _:
                raise DriveError(f"{fault.kind}: not a lasting fault of the emulated drives")


def _axis_of(fault: Fault) -> int:
    """Return a fault's axis (0 .. 11); the first axis if the whole ODrive is faulty."""
    return 2 * MODULE_INDEX[fault.module] + (fault.axis or 0)
