"""The joint service's loop, clocked by the drive's encoder frames."""

from __future__ import annotations

import msgspec

from services.joint.controller import JointController
from services.joint.differential import motor_torque
from services.joint.drivers.base import Drive, DriveStatus
from shared.bus import Latest, Publisher
from shared.clock import NS_PER_MS, now_ns
from shared.config import RobotConfig
from shared.messages import Estop, JointCommand, JointEvent, JointState, Mode
from shared.process import StopFlag

READ_TIMEOUT_S = 0.005
"""A cycle without an encoder sample runs all the same: ages and the failsafe go on."""

ESTOP_EVERY = 8
"""Cycles between two looks for an emergency stop: 16 ms at 500 Hz, against a sink of 5 s."""
ARM_EVERY_NS = 500 * NS_PER_MS
"""Arming is asked for again after this long, while DISARMED."""


class Ports(msgspec.Struct, frozen=True):
    """The bus ends of one joint service."""

    commands: Latest[JointCommand]
    estops: Latest[Estop]
    states: Publisher[JointState]
    events: Publisher[JointEvent]


class JointLoop:
    """Read, age, decide, compute, gate, write, publish: once for each encoder sample."""

    def __init__(
        self, config: RobotConfig, controller: JointController, drive: Drive, ports: Ports
    ) -> None:
        service = config.joint_service
        self._controller = controller
        self._drive = drive
        self._ports = ports
        self._gear_ratio = config.joint.gear_ratio
        self._state_every = round(service.rate_hz / service.state_rate_hz)
        self._arm_at_ns = 0
        self._estop = False

    def run(self, stop: StopFlag) -> None:
        """Run until told to stop; then leave the drive idle."""
        while not stop:
            self.cycle()
        self._drive.idle()

    def cycle(self) -> None:
        """Run one cycle."""
        drive, ports, controller = self._drive, self._ports, self._controller
        reading = drive.read(READ_TIMEOUT_S)
        now = now_ns()
        if controller.cycle % ESTOP_EVERY == 0:
            estop = ports.estops.take()
            if estop is not None:
                self._estop = self._estop or estop.engaged  # released by a restart only
        result = controller.step(now, reading, ports.commands.take(), self._estop)
        drive.write_torque(motor_torque(result.tau, self._gear_ratio))
        if controller.cycle % self._state_every == 0:
            ports.states.put(controller.state(now))
        if result.event is not None:
            ports.events.put(result.event)
            if result.event.mode_after == Mode.FAULT:
                drive.idle()  # one axis that disarms leaves its sibling's torque on
        mode = controller.failsafe.mode
        if mode is Mode.DISARMED and reading is not None and reading.status is DriveStatus.IDLE:
            self._arm(now)

    def _arm(self, now: int) -> None:
        if now >= self._arm_at_ns:
            self._arm_at_ns = now + ARM_EVERY_NS
            self._drive.arm()
