"""The simulator's loop: how often the drives step, and a scenario's faults."""

from __future__ import annotations

from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.loop import SimulatorLoop, SimulatorPorts, granted
from services.simulator.physics.plant import IDEAL
from services.simulator.physics.world import World
from services.simulator.robot import SimulatedRobot
from shared.bus.messages import OperatorIntent, Vector4
from shared.can.cansimple import AxisState, ControlMode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Keyframe, Scenario
from tests.simulator.banks import close_loop


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


ANY = st.floats(-1e300, 1e300)


@given(ANY, st.tuples(ANY, ANY, ANY, ANY))
def test_the_person_rests_no_more_than_a_planner_grants(assist: float, shift: Vector4) -> None:
    assist_max, shift_max = 200.0, (0.02, 0.03, 0.1, 0.2)
    asked = OperatorIntent(t_ns=1, seq=1, assist_n=assist, shift=shift)
    force, parts = granted(asked, assist_max, shift_max)
    assert 0.0 <= force <= assist_max
    assert force == assist or not 0.0 <= assist <= assist_max
    assert all(abs(part) <= most for part, most in zip(parts, shift_max, strict=True))
