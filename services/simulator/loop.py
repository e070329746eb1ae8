"""The simulator's loop: drives, world and sensors in real time; it waits for nobody."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fault_injector import FaultInjector
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.fibre_port import FibreHub
from services.simulator.fronts.harness_front import HarnessFront
from services.simulator.fronts.imu_front import ImuFront
from services.simulator.physics.world import World
from services.simulator.state import taken
from shared.bus.messages import HandLead, OperatorIntent, SimControl, SimTruth, Vector4
from shared.bus.session import Latest, Publisher
from shared.bus.topics import SIM_STATE
from shared.bus.traces import SimState
from shared.can.cansimple import AxisState
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S, now_ns, sleep_until
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.process import StopFlag

INTENT_RATE_HZ = 50.0
SILENT_INTENTS = 250
"""Intents of the scenario left out after somebody else's last: until his has faded out."""
STATE_RATE_HZ = SIM_STATE.rate_hz


class SimulatorPorts(msgspec.Struct, frozen=True):
    """The simulator's bus ends."""

    truth: Publisher[SimTruth]
    intent: Publisher[OperatorIntent]
    control: Latest[SimControl]
    state: Publisher[SimState]
    asked: Latest[OperatorIntent]
    hand: Latest[HandLead]


def granted(asked: OperatorIntent, assist_max: float, shift_max: Vector4) -> tuple[float, Vector4]:
    """Return the assist, N, and the shift that the planner would grant: the person rests no more.

    Asked for 1e9 N, the simulated person rested 1e9 N on the robot.
    """
    x, y, roll, yaw = (
        clamp(part, -most, most) for part, most in zip(asked.shift, shift_max, strict=True)
    )
    return clamp(asked.assist_n, 0.0, assist_max), (x, y, roll, yaw)


class SimulatorLoop:
    """Steps twelve emulated axes and the world, and paces them by the clock.

    The drives receive and send at the rate of their encoder frames. In torque mode they hold their
    torque between frames; with a loop of their own they step with the world.
    """

    def __init__(
        self,
        config: RobotConfig,
        world: World,
        bank: AxisBank,
        front: CanSimpleFront,
        usb: Sequence[FibreHub],
        sensors: tuple[HarnessFront, ImuFront | None],
        ports: SimulatorPorts,
    ) -> None:
        self._world, self._bank, self._front = world, bank, front
        (self._harness, self._imu), self._ports = sensors, ports
        self._usb = usb
        self._faults = FaultInjector(world.scenario.fault, bank)
        simulation = config.simulation
        rate = 1.0 / simulation.timestep
        self._step_ns = round(simulation.timestep * NS_PER_S)
        self._encoder_every = max(1, round(rate / simulation.encoder_rate_hz))
        self._harness_every = max(1, round(rate / config.harness.rate_hz))
        self._imu_every = max(1, round(rate / config.imu.rate_hz))
        self._truth_every = max(1, round(rate / simulation.truth_rate_hz))
        self._intent_every = max(1, round(rate / INTENT_RATE_HZ))
        self._state_every = max(1, round(rate / STATE_RATE_HZ))
        self._assist_max, self._shift_max = config.assist.force_max, config.law.shift_max
        self._states = 0
        self._slip_ns = round(simulation.late_slip_ms * NS_PER_MS)
        self.autostart_s: float | None = None
        """Start the scenario by itself, so long after the hoist is down."""
        self._hoisted_step = 0
        self._torque = bank.torque
        self._steps = 0
        self._intents = 0
        self._unasked = 0
        self._lost_ns = 0
        self._start_ns = 0
        self._start_step = 0
        self._lost_at_start_ns = 0

    def run(self, stop: StopFlag) -> None:
        """Run until stopped.

        A late step is followed at once by the next. Time further behind than `late_slip_ms` is
        skipped and counted, because the services must not receive a burst.
        """
        due = now_ns()
        while not stop:
            self.step()
            due += self._step_ns
            behind = now_ns() - due
            if behind > self._slip_ns:
                self._lost_ns += behind
                due += behind
            sleep_until(due)

    def step(self) -> None:
        """Take the drives' frames, advance the world by one step, send what is due."""
        world, front, ports = self._world, self._front, self._ports
        if self._steps % self._encoder_every == 0:
            self._faults.advance(world.scenario_s)
            front.receive()
            self._torque = self._bank.step(world.time, *world.motor_turns())
            front.send_encoders()
            front.send_heartbeats(world.time)
        elif self._bank.regulates:
            self._torque = self._bank.step(world.time, *world.motor_turns())
        for hub in self._usb:
            hub.poll()
        world.step(self._torque)
        self._steps += 1
        steps = self._steps
        if steps % self._harness_every == 0:
            self._harness.send(world.harness_force, world.harness_moment)
        if self._imu is not None and steps % self._imu_every == 0:
            self._imu.send(world)
        if steps % self._truth_every == 0:
            self._publish_truth()
        if steps % self._state_every == 0:
            self._states += 1
            ports.state.put(taken(world, self._bank, now_ns(), self._states))
        if steps % self._intent_every == 0:
            self._ask()

    def _ask(self) -> None:
        """Publish the scenario's request; if another operator publishes one, rest that much."""
        world, other = self._world, self._ports.asked.take()
        if other is not None and other.source != SCENARIO:
            self._unasked = 0
            world.asked = granted(other, self._assist_max, self._shift_max)
            return
        self._unasked += 1
        if world.asked is not None and self._unasked < SILENT_INTENTS:
            return
        world.asked = None
        self._intents += 1
        wanted = world.lead()
        intent = OperatorIntent(
            t_ns=now_ns(),
            seq=self._intents,
            assist_n=wanted.assist,
            shift=wanted.shift,
            source=SCENARIO,
        )
        self._ports.intent.put(intent)

    def _publish_truth(self) -> None:
        """Publish the truth, and look at what needs no more than its rate."""
        world, now = self._world, now_ns()
        control, hand = self._ports.control.take(), self._ports.hand.take()
        if hand is not None:
            world.take_hand(hand)
        if world.hoist > 0.0:
            self._hoisted_step = self._steps
        down_s = (self._steps - self._hoisted_step) * world.timestep
        by_itself = self.autostart_s is not None and down_s > self.autostart_s
        requested = control is not None and control.start
        if (requested or by_itself) and world.scenario_s < 0.0:
            world.start()
            self._start_ns, self._start_step = now, self._steps
            self._lost_at_start_ns = self._lost_ns
        if all(state == AxisState.CLOSED_LOOP_CONTROL for state in self._bank.state):
            world.release_hoist()
        wall_ns = now - self._start_ns
        simulated_ns = (self._steps - self._start_step) * self._step_ns
        factor = simulated_ns / wall_ns if self._start_ns and wall_ns > 0 else 1.0
        late_s = (self._lost_ns - self._lost_at_start_ns) / NS_PER_S
        self._ports.truth.put(world.truth(now, factor, late_s))
