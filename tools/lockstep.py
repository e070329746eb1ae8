"""Lockstep: the same objects as live, in one process under virtual time (design section 7).

World, twelve emulated axes, six joint controllers and the planner step in a fixed order;
messages between them pass a modelled network with a constant delay. No process, clock or
bus: bit-identical from run to run.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

from services.joint.controller import JointController
from services.joint.differential import motor_torque
from services.joint.drivers.base import DriveReading, DriveStatus
from services.planner.planner import Planner
from services.simulator.axis_bank import AxisBank
from services.simulator.world import World
from shared.cansimple import AxisState, ControlMode, InputMode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import RobotConfig
from shared.joints import MODULES, N_JOINTS
from shared.messages import JointCommand, JointEvent, JointState, Mode, SimTruth
from shared.scenario import Scenario

T = TypeVar("T")

SETTLE_NS = NS_PER_S
"""The scenario starts this long after all six modules track."""


class Link(Generic[T]):
    """One direction of a network link with a constant delay."""

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns = delay_ns
        self._queue: deque[tuple[int, T]] = deque()

    def put(self, now_ns: int, message: T) -> None:
        """Send."""
        self._queue.append((now_ns + self._delay_ns, message))

    def take(self, now_ns: int) -> T | None:
        """Return the newest message that has arrived, as a ring of depth 1 does."""
        newest = None
        while self._queue and self._queue[0][0] <= now_ns:
            newest = self._queue.popleft()[1]
        return newest


class Lockstep:
    """A whole fleet in virtual time."""

    def __init__(self, config: RobotConfig, scenario: Scenario, delay_ms: float = 1.0) -> None:
        self.config = config
        self.scenario = scenario
        self.world = World(config, scenario)
        self.controllers = [JointController(config, module) for module in MODULES]
        self.planner: Planner | None = Planner(config, session=1)
        self._sessions = 1
        delay_ns = round(delay_ms * NS_PER_MS)
        self._states: list[Link[JointState]] = [Link(delay_ns) for _ in MODULES]
        self._commands: list[Link[JointCommand]] = [Link(delay_ns) for _ in MODULES]
        self._cycle_ns = round(NS_PER_S / config.joint_service.rate_hz)
        self._state_ns = round(NS_PER_S / config.joint_service.state_rate_hz)
        self._step_ns = round(config.simulation.timestep * NS_PER_S)
        self._truth_ns = round(NS_PER_S / config.simulation.truth_rate_hz)
        self.now_ns = NS_PER_S
        self._tracked_since_ns = 0
        self.bank = AxisBank(
            config.drive, encoder_counts_per_turn=config.joint.encoder_counts_per_turn
        )
        self._torque = self.bank.torque
        for axis in range(N_JOINTS):
            self.bank.set_modes(axis, ControlMode.TORQUE, InputMode.PASSTHROUGH)
        self.events: list[tuple[str, JointEvent]] = []

    def run(self) -> Iterator[SimTruth]:
        """Run to the scenario's end; yield the truth at its rate from the start on."""
        kills = sorted(self.scenario.kill, key=lambda kill: kill.at)
        restarts = sorted(self.scenario.restart, key=lambda restart: restart.at)
        while self.world.scenario_s < self.scenario.duration:
            t = self.world.scenario_s
            while kills and t >= kills[0].at:
                if kills.pop(0).service == "planner":
                    self.planner = None
            while restarts and t >= restarts[0].at:
                if restarts.pop(0).service == "planner":
                    self._sessions += 1
                    self.planner = Planner(self.config, self._sessions)
            self.advance()
            if t >= 0.0 and self.now_ns % self._truth_ns == 0:
                yield self.world.truth(self.now_ns, 1.0, 0.0)

    def advance(self) -> None:
        """Move virtual time on by one step of the world."""
        now = self.now_ns
        if now % self._cycle_ns == 0:
            self._torque = self.bank.step(self.world.time, *self.world.motor_turns())
            self._cycle_joints(now)
        if self.planner is not None:
            self._advance_planner(self.planner, now)
        self._begin_when_tracking(now)
        self.world.step(self._torque)
        if self.now_ns == NS_PER_S:
            for axis in range(N_JOINTS):
                self.bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
        self.now_ns += self._step_ns

    def _cycle_joints(self, now: int) -> None:
        bank = self.bank
        pos, vel = bank.pos_estimate.tolist(), bank.vel_estimate.tolist()
        for index, controller in enumerate(self.controllers):
            a, b = 2 * index, 2 * index + 1
            armed = bank.state[a] == bank.state[b] == AxisState.CLOSED_LOOP_CONTROL
            status = DriveStatus.ARMED if armed else DriveStatus.IDLE
            reading = DriveReading(now, (pos[a], pos[b]), (vel[a], vel[b]), status, 0)
            command = self._commands[index].take(now)
            result = controller.step(now, reading, command, estop=False)
            if result.event is not None:
                self.events.append((MODULES[index], result.event))
            bank.input_torque[a : b + 1] = motor_torque(result.tau, self.config.joint.gear_ratio)
            bank.feed(a)
            bank.feed(b)
            if now % self._state_ns == 0:
                self._states[index].put(now, controller.state(now))

    def _advance_planner(self, planner: Planner, now: int) -> None:
        """Hand over what has arrived, and tick as the live loop does."""
        for index, link in enumerate(self._states):
            state = link.take(now)
            if state is not None:
                planner.hear_state(index, state, now)
        if planner.is_due(now):
            planner.hear_assist(self.world.lead().assist)
            for index, command in enumerate(planner.tick(now)):
                self._commands[index].put(now, command)

    def _begin_when_tracking(self, now: int) -> None:
        if self.world.scenario_s >= 0.0:
            return
        modes = [controller.failsafe.mode for controller in self.controllers]
        if Mode.DISARMED not in modes:
            self.world.release_hoist()
        if self.world.hoist > 0.0 or any(mode is not Mode.TRACK for mode in modes):
            self._tracked_since_ns = now
        elif now - self._tracked_since_ns >= SETTLE_NS:
            self.world.start()
