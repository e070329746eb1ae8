"""The assembled robot: every fault on every axis, and the loop that steps drives and world."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import msgspec
import numpy as np
import pytest

from services.simulator import loop as simulator_loop
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_faults import AXIS_NAMES, BOOT_S, TALKS_S
from services.simulator.drives.axis_faults import AxisErrors as Registers
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.loop import SimulatorLoop, SimulatorPorts
from services.simulator.physics.plant import IDEAL
from services.simulator.physics.world import World
from services.simulator.robot import FaultInjector, SimulatedRobot
from shared.can.cansimple import (
    AxisError,
    AxisState,
    ControllerError,
    ControlMode,
    EncoderError,
    MotorError,
    OdriveError,
)
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import FAULT_KINDS, Fault, Keyframe, Scenario
from shared.joints import MODULES
from tests.simulator.banks import DT, ZERO, close_loop, make_bank

FAILED = AxisError.MOTOR_FAILED
NO_COMMAND = MotorError.UNKNOWN_TORQUE | MotorError.UNKNOWN_VOLTAGE_COMMAND
"""Errors that a real board leaves on a motor whose controller has failed (ODrive issue 700)."""
OVERSPEED = Registers(
    FAILED | AxisError.CONTROLLER_FAILED, NO_COMMAND, controller=ControllerError.OVERSPEED
)


class Outcome(NamedTuple):
    """What a kind leaves behind `after_s` after it began."""

    state: AxisState
    registers: Registers
    sibling: AxisState = AxisState.CLOSED_LOOP_CONTROL
    is_responding: bool = True
    after_s: float = 0.02


OUTCOMES = {
    "over_temperature": Outcome(
        AxisState.IDLE, Registers(FAILED, MotorError.FET_THERMISTOR_OVER_TEMP), after_s=0.5
    ),
    "over_voltage": Outcome(
        AxisState.IDLE,
        Registers(FAILED, MotorError.SYSTEM_LEVEL, odrive=OdriveError.DC_BUS_OVER_VOLTAGE),
        sibling=AxisState.IDLE,
    ),
    "encoder": Outcome(
        AxisState.IDLE,
        Registers(
            FAILED | AxisError.ENCODER_FAILED | AxisError.CONTROLLER_FAILED,
            NO_COMMAND,
            EncoderError.ABS_SPI_COM_FAIL,
            ControllerError.INVALID_ESTIMATE,
        ),
        after_s=0.06,
    ),
    "watchdog": Outcome(AxisState.IDLE, Registers(AxisError.WATCHDOG_TIMER_EXPIRED)),
    "link_lost": Outcome(AxisState.CLOSED_LOOP_CONTROL, Registers(), is_responding=False),
    "disarmed": Outcome(AxisState.IDLE, Registers()),
    "overspeed": Outcome(AxisState.IDLE, OVERSPEED),
    "encoder_zero": Outcome(AxisState.IDLE, OVERSPEED),
    "encoder_gap": Outcome(AxisState.CLOSED_LOOP_CONTROL, Registers(), after_s=0.0),
    "no_ack": Outcome(AxisState.CLOSED_LOOP_CONTROL, Registers()),
    "bus_full": Outcome(AxisState.CLOSED_LOOP_CONTROL, Registers()),
    "bus_flap": Outcome(AxisState.CLOSED_LOOP_CONTROL, Registers(), is_responding=False),
    "brown_out": Outcome(
        AxisState.UNDEFINED, Registers(), sibling=AxisState.UNDEFINED, is_responding=False
    ),
}


class Scene:
    """A bank with a fault to come; `run` steps it, feeding what hears."""

    def __init__(self, fault: Fault, *, watchdog: bool = True) -> None:
        self.bank: AxisBank = make_bank(watchdog=watchdog, turns=0.5)
        self.bank.input_torque[:] = 1.0
        self.bank.encoder_mount[:] = 0.0  # half a turn from where encoders read 0
        self.injector = FaultInjector((fault,), self.bank)
        self.steps = 0
        self.torque = ZERO

    def run(self, until_s: float) -> None:
        while self.steps < round(until_s / DT):
            self.steps += 1
            for axis in range(12):
                if self.bank.is_responding(axis):
                    self.bank.feed(axis)
            self.injector.advance(self.steps * DT)
            self.torque = self.bank.step(self.steps * DT, np.full(12, 0.5), ZERO).copy()


def make_fault(kind: str, axis: int, duration: float | None = None) -> Fault:
    row = {"module": MODULES[axis // 2], "kind": kind, "at": 0.01, "duration": duration}
    if not FAULT_KINDS[kind].whole:
        row["axis"] = axis % 2
    return Fault(**row)  # type: ignore[arg-type]


def test_every_kind_of_a_scenario_has_its_outcome_here() -> None:
    assert set(OUTCOMES) == set(FAULT_KINDS)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("axis", range(12), ids=AXIS_NAMES)
@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_fault_leaves_these_registers_this_state_and_this_sibling(kind: str, axis: int) -> None:
    scene, outcome = Scene(make_fault(kind, axis)), OUTCOMES[kind]
    scene.run(0.009)
    assert scene.bank.state == [AxisState.CLOSED_LOOP_CONTROL] * 12, "not before its time"
    scene.run(0.01 + outcome.after_s)
    bank, sibling = scene.bank, axis ^ 1
    assert bank.state[axis] == outcome.state
    assert bank.faults[axis] == outcome.registers
    assert bank.is_responding(axis) == outcome.is_responding
    assert bank.state[sibling] == outcome.sibling
    assert (bank.faults[sibling] == outcome.registers) == (
        FAULT_KINDS[kind].whole or outcome.registers == Registers()
    )
    closed = [state == AxisState.CLOSED_LOOP_CONTROL for state in bank.state]
    assert scene.torque == pytest.approx(np.array(closed, float)), "what is not armed floats"
    others = [each for each in range(12) if each // 2 != axis // 2]
    assert all(closed[each] and bank.is_responding(each) for each in others)


@pytest.mark.parametrize("kind", ["over_temperature", "over_voltage"])
def test_errors_cleared_while_the_fault_lasts_are_back_at_once(kind: str) -> None:
    lasts = 0.1 + OUTCOMES[kind].after_s
    scene = Scene(make_fault(kind, 4, duration=lasts + 0.1))
    scene.run(lasts)
    scene.bank.clear_errors(4)
    scene.bank.request_state(4, AxisState.CLOSED_LOOP_CONTROL)
    scene.run(lasts + 0.002)
    assert scene.bank.state[4] == AxisState.IDLE
    assert scene.bank.faults[4] == OUTCOMES[kind].registers


@pytest.mark.parametrize("kind", [k for k in FAULT_KINDS if k != "brown_out"])
def test_after_it_an_axis_stays_as_it_is_until_it_is_cleared_and_asked_to_arm(kind: str) -> None:
    lasts = None if FAULT_KINDS[kind].duration is None else 0.05 + OUTCOMES[kind].after_s
    scene = Scene(make_fault(kind, 7, duration=lasts))
    scene.run(1.5)
    assert scene.bank.state[7] == OUTCOMES[kind].state, "it does not recover by itself"
    scene.bank.clear_errors(7)
    scene.bank.request_state(7, AxisState.CLOSED_LOOP_CONTROL)
    scene.run(1.52)
    assert scene.bank.state[7] == AxisState.CLOSED_LOOP_CONTROL
    assert scene.bank.faults[7] == Registers()
    assert scene.torque[7] == 1.0, "the trap: the input torque of before is in force again"


def test_a_brown_out_ends_in_a_restart_in_idle_with_no_error_and_nothing_remembered() -> None:
    scene = Scene(make_fault("brown_out", 2, duration=0.1), watchdog=False)
    scene.bank.vel_limit[2] = 3.0  # written, and never saved
    scene.run(0.11 + TALKS_S - 0.01)
    assert not scene.bank.is_responding(3)
    scene.bank.request_state(2, AxisState.CLOSED_LOOP_CONTROL)
    scene.run(0.11 + BOOT_S + 0.01)
    bank = scene.bank
    assert bank.state[2:4] == [AxisState.IDLE] * 2, "it did not hear"
    assert bank.is_responding(2)
    assert bank.faults[2] == bank.faults[3] == Registers()
    assert bank.input_torque[2] == bank.input_torque[3] == 0.0
    assert bank.vel_limit[2] == 60.0


def test_after_power_a_drive_talks_then_runs_its_last_request_and_shows_early_errors() -> None:
    scene = Scene(make_fault("brown_out", 2, duration=0.1), watchdog=False)
    bank = scene.bank
    scene.run(0.11 + TALKS_S + 0.01)
    assert bank.is_responding(2)
    assert bank.is_responding(3)
    assert [bank.heartbeat(2)[:2], bank.heartbeat(3)[:2]] == [(0, AxisState.UNDEFINED)] * 2
    bank.request_state(2, AxisState.IDLE)
    bank.request_state(2, AxisState.CLOSED_LOOP_CONTROL)
    scene.run(0.11 + BOOT_S - 0.01)
    assert bank.state[2:4] == [AxisState.UNDEFINED] * 2
    scene.run(0.11 + BOOT_S + 0.01)
    assert bank.state[2:4] == [AxisState.CLOSED_LOOP_CONTROL, AxisState.IDLE], "armed by itself"
    scene = Scene(make_fault("brown_out", 2, duration=0.1), watchdog=False)
    scene = Scene(make_fault("brown_out", 2, duration=0.1), watchdog=False)
    scene.run(0.2)
    scene.bank.estop(2)
    assert scene.bank.heartbeat(2)[:2] == (AxisError.ESTOP_REQUESTED, AxisState.UNDEFINED)


@pytest.mark.parametrize(("kind", "share"), [("bus_full", 0.4), ("bus_flap", 0.4), ("no_ack", 1.0)])
def test_a_buss_fault_comes_and_goes_and_is_over_at_its_end(kind: str, share: float) -> None:
    scene, axis = Scene(make_fault(kind, 6, duration=3.0), watchdog=False), 6
    conditions = scene.bank.conditions
    struck = []
    while scene.steps * DT < 3.01:
        scene.run(scene.steps * DT + 0.01)
        hit = (conditions.silent, conditions.deaf, conditions.choked)
        struck.append(any(axis in axes for axes in hit))
    assert sum(struck) / 300 == pytest.approx(share, abs=0.05)
    scene.run(3.05)
    assert not conditions.silent | conditions.deaf | conditions.choked


class Silent:
    """Every end of the bus, and the load cells' own: takes anything, has nothing."""

    def put(self, *_: object) -> None: ...

    def poll(self) -> None: ...

    def broadcast(self, *_: object) -> None: ...

    def take(self) -> None:
        return None


def make_loop(robot: RobotConfig, *faults: Fault) -> tuple[SimulatorLoop, World, AxisBank]:
    stand = Scenario(
        name="stand",
        about="",
        duration=5.0,
        keyframe=(Keyframe(at=0.0, height=robot.simulation.stand_height),),
        fault=faults,
    )
    silent: Any = Silent()
    made = SimulatedRobot(robot, IDEAL, stand, cells=silent, imu=None, seed=0)
    made.bank.settings.fill("config.enable_watchdog", value=False)
    ports = msgspec.defstruct("Fake", list(SimulatorPorts.__struct_fields__))(
        *[silent] * len(SimulatorPorts.__struct_fields__)
    )
    front = CanSimpleFront(made.bank, [], [])
    loop = SimulatorLoop(robot, made, front, [], cast("SimulatorPorts", ports))
    return loop, made.world, made.bank


def count_steps(loop: SimulatorLoop, bank: AxisBank, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return how often the drives step in 100 steps of the world."""
    times = []
    real = bank.step
    monkeypatch.setattr(bank, "step", lambda *given: (times.append(given[0]), real(*given))[1])
    for _ in range(100):
        loop.step()
    assert times == sorted(set(times))
    return len(times)


@pytest.mark.parametrize(
    ("mode", "every"), [(ControlMode.TORQUE, False), (ControlMode.POSITION, True)]
)
def test_the_drives_step_with_the_world_only_where_they_have_their_own_loop(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, mode: ControlMode, every: bool
) -> None:
    loop, _, bank = make_loop(robot)
    loop.step()
    close_loop(bank, mode)
    steps = count_steps(loop, bank, monkeypatch)
    rates = robot.simulation.encoder_rate_hz * robot.simulation.timestep
    assert steps == (100 if every else pytest.approx(100 * rates, abs=1))


@pytest.mark.parametrize(
    ("harness_hz", "wanted"), [(250.0, [2, 4, 6, 8, 10, 12]), (200.0, [2, 4, 5, 6, 8, 10])]
)
def test_the_loop_wakes_up_only_for_steps_that_receive_or_send(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, harness_hz: float, wanted: list[int]
) -> None:
    """Encoder frames are due every 2 ms; cells at 200 Hz need a wake-up of their own."""
    harness = msgspec.structs.replace(robot.harness, rate_hz=harness_hz)
    loop, _, _ = make_loop(msgspec.structs.replace(robot, harness=harness))
    woken_ms: list[int] = []
    monkeypatch.setattr(simulator_loop, "now_ns", lambda: 0)
    monkeypatch.setattr(
        simulator_loop, "sleep_until", lambda due: woken_ms.append(due // NS_PER_MS)
    )
    stop: Any = type("Stop", (), {"__bool__": lambda _: len(woken_ms) == 6})()
    loop.run(stop)
    assert woken_ms == wanted


def test_a_fault_comes_at_its_time_in_the_scenario_and_not_before_that_begins(
    robot: RobotConfig,
) -> None:
    loop, world, bank = make_loop(robot, Fault(module="knee_left", kind="over_voltage", at=0.1))
    for _ in range(300):
        loop.step()
    for axis in range(12):
        bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
    world.start()
    began = world.time
    while bank.state[8] == AxisState.CLOSED_LOOP_CONTROL:
        loop.step()
        assert world.time < began + 0.2
    assert world.time - began == pytest.approx(0.1, abs=0.005)
    assert np.flatnonzero([s == AxisState.IDLE for s in bank.state]).tolist() == [8, 9]
