"""Loop of the simulator: steps drives, world and sensors in real time, and waits for no service."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.fibre_port import FibreHub
from services.simulator.robot import SimulatedRobot
from shared.bus.messages import HandLead, OperatorIntent, SimControl, Vector4
from shared.bus.pubsub import Latest, Publisher
from shared.bus.traces import SimState, SimTruth
from shared.can.cansimple import AxisState
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S, now_ns, sleep_until
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.process import StopFlag

SILENT_INTENTS: Final = 250
"""Number of scenario intents skipped after another operator's last intent, until it has faded."""


class SimulatorPorts(msgspec.Struct, frozen=True):
    """Publishers and subscriptions of the simulator."""

    truth: Publisher[SimTruth]
    intent: Publisher[OperatorIntent]
    control: Latest[SimControl]
    state: Publisher[SimState]
    asked: Latest[OperatorIntent]
    hand: Latest[HandLead]


class Pace(msgspec.Struct):
    """Skipped time, and the clock, step and skipped time at the start of the scenario."""

    lost_ns: int = 0
    start_ns: int = 0
    """0 before the start."""
    start_step: int = 0
    lost_at_start_ns: int = 0


def granted(asked: OperatorIntent, assist_max: float, shift_max: Vector4) -> tuple[float, Vector4]:
    """Return the assist, N, and the shift, clamped to what the planner would grant.

    Without the clamp, the simulated person would load the robot with 1e9 N on request.
    """
    x, y, roll, yaw = (
        clamp(part, -most, most) for part, most in zip(asked.shift, shift_max, strict=True)
    )
    return clamp(asked.assist_n, 0.0, assist_max), (x, y, roll, yaw)


class SimulatorLoop:
    """Loop that steps twelve emulated axes and the world in real time.

    The drives receive and send at the rate of their encoder frames. In torque mode they hold their
    torque between frames; in position or velocity mode they step with the world.

    Attributes:
        autostart_s: delay from hoist down to the start of the scenario, s; None if a message
            starts it.
    """

    def __init__(
        self,
        config: RobotConfig,
        robot: SimulatedRobot,
        front: CanSimpleFront,
        usb: Sequence[FibreHub],
        ports: SimulatorPorts,
    ) -> None:
        self._config, self._robot = config, robot
        self._world, self._bank, self._every = robot.world, robot.bank, robot.every
        self._front, self._usb, self._ports = front, usb, ports
        every = self._every
        self._exchanges = {
            every.encoders,
            every.harness,
            every.truth,
            every.state,
            every.intent,
            every.imu if robot.imu is not None else every.encoders,
        }
        self._slip_ns = round(config.simulation.late_slip_ms * NS_PER_MS)
        self.autostart_s: float | None = None
        self._steps = 0
        self._hoisted_step = 0
        self._intents = 0
        self._unasked = 0
        self._pace = Pace()

    def run(self, stop: StopFlag) -> None:
        """Run until stopped.

        A step without an exchange runs in the same wake-up as the previous one. After a late step,
        the next follows at once. A delay beyond `late_slip_ms` is skipped and counted, so that the
        services do not receive a burst.
        """
        due = now_ns()
        while not stop:
            self.step()
            due += self._every.step
            while self._exchanges_nothing():
                self.step()
                due += self._every.step
            behind = now_ns() - due
            if behind > self._slip_ns:
                self._pace.lost_ns += behind
                due += behind
            sleep_until(due)

    def step(self) -> None:
        """Exchange the drives' frames, advance the world by one step, and send the due messages."""
        robot, front, every = self._robot, self._front, self._every
        begins_ns = self._steps * every.step
        if begins_ns % every.encoders == 0:
            robot.begin_faults()
            front.receive()
            robot.step_drives()
            front.send_encoders()
            front.send_heartbeats(self._world.time)
        elif self._bank.regulates:
            robot.step_drives()
        for hub in self._usb:
            hub.poll()
        robot.step_world()
        self._steps += 1
        if begins_ns % every.harness == 0:
            robot.feel()
        if robot.imu is not None and begins_ns % every.imu == 0:
            robot.imu.send(self._world)
        if begins_ns % every.truth == 0:
            self._publish_truth()
        if begins_ns % every.state == 0:
            self._ports.state.put(robot.read_state(now_ns(), 1 + begins_ns // every.state))
        if begins_ns % every.intent == 0:
            self._ask()

    def _exchanges_nothing(self) -> bool:
        """Return True if the next step neither receives from the services nor sends to them."""
        begins_ns = self._steps * self._every.step
        exchanged = (begins_ns % period_ns == 0 for period_ns in self._exchanges)
        return not any(exchanged) and not any(hub.clients for hub in self._usb)

    def _ask(self) -> None:
        """Publish the scenario's request, or adopt the request of another operator."""
        world, other = self._world, self._ports.asked.take()
        if other is not None and other.source != SCENARIO:
            self._unasked = 0
            most = self._config.assist.force_max, self._config.law.shift_max
            world.outside.asked = granted(other, *most)
            world.outside.holds = world.scenario.hand and not other.sit
            return
        self._unasked += 1
        if world.outside.asked is not None and self._unasked < SILENT_INTENTS:
            return
        if world.outside.asked is not None:
            world.outside.asked = None
            world.outside.holds = world.scenario.hand
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
        """Publish the true state; at this rate, also handle requests, scenario start and hoist."""
        world, pace, now = self._world, self._pace, now_ns()
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
            pace.start_ns, pace.start_step, pace.lost_at_start_ns = now, self._steps, pace.lost_ns
        if all(state == AxisState.CLOSED_LOOP_CONTROL for state in self._bank.state):
            world.release_hoist()
        wall_ns = now - pace.start_ns
        simulated_ns = (self._steps - pace.start_step) * self._every.step
        factor = simulated_ns / wall_ns if pace.start_ns and wall_ns > 0 else 1.0
        late_s = (pace.lost_ns - pace.lost_at_start_ns) / NS_PER_S
        self._ports.truth.put(world.truth(now, factor, late_s))
