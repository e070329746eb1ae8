"""The joint service's loop, clocked by the drive's encoder frames."""

from __future__ import annotations

import msgspec

from services.joint.controller import JointController
from services.joint.differential import motor_torque
from services.joint.drivers.base import Drive, DriveReading, DriveStatus
from services.joint.onboard import OnboardLaw
from shared import log
from shared.bus import Latest, Publisher
from shared.clock import NS_PER_MS, now_ns
from shared.config import RobotConfig
from shared.messages import Cause, Estop, JointCommand, JointEvent, JointState, Mode, Pair
from shared.process import StopFlag

READ_TIMEOUT_S = 0.005
"""A cycle without an encoder sample runs all the same: ages and the failsafe go on."""

ARM_EVERY_NS = 500 * NS_PER_MS
"""Arming is asked for again after this long, while DISARMED."""

IDLE_EVERY_NS = 500 * NS_PER_MS
"""A drive one of whose axes has disarmed is told to go idle this often: its sibling goes on."""

ARM_TRIES = 10
"""A drive that has not armed by then needs a person."""


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
        self._onboard = (
            OnboardLaw(config.joint.gear_ratio, config.drive.vel_limit)
            if service.loop == "onboard"
            else None
        )
        self._motors: tuple[Pair, Pair] = ((0.0, 0.0), (0.0, 0.0))
        self._idle_at_ns = 0
        self._state_every = round(service.rate_hz / service.state_rate_hz)
        self._arm_at_ns = 0
        self._tries = 0
        self._estop = False

    def run(self, stop: StopFlag) -> None:
        """Run until told to stop.

        Told alone (SIGTERM), the service leaves a drive that holds by its own loop holding:
        the robot stands on it, and the next service takes it over. When the fleet goes down
        (SIGINT) the drive is left idle.
        """
        while not stop:
            self.cycle()
        holding = self._controller.failsafe.mode in (Mode.HOLD, Mode.TRACK)
        if stop.interrupted or self._onboard is None or not holding:
            self._drive.idle()

    def cycle(self) -> None:
        """Run one cycle."""
        drive, ports, controller = self._drive, self._ports, self._controller
        reading = drive.read(READ_TIMEOUT_S)
        now = now_ns()
        self._estop = self._estop or ports.estops.take() is not None
        if self._tries == 0 and reading is not None and reading.status is DriveStatus.ARMED:
            reading = self._found_armed(now, reading)
        result = controller.step(now, reading, ports.commands.take(), self._estop)
        if reading is not None:
            self._motors = (reading.pos_turns, reading.vel_turns)
        self._write(now, result.tau)
        if controller.cycle % self._state_every == 0:
            ports.states.put(controller.state(now))
        if result.event is not None:
            ports.events.put(result.event)
            if result.event.mode_after == Mode.FAULT:
                log.get("xrl").error(  # nothing is controlled any more: a line does no harm
                    "FAULT: %s, drive error 0x%x; restart this service to leave it",
                    Cause(result.event.cause).name,
                    controller.drive_error,
                )
        if controller.failsafe.mode is Mode.DISARMED and now >= self._arm_at_ns:
            self._arm(now, reading)

    def _write(self, now: int, tau: Pair) -> None:
        """Send what the mode asks for.

        A lost drive that holds by its own loop is left alone: should the link come back,
        it holds still.
        """
        drive, controller = self._drive, self._controller
        mode = controller.failsafe.mode
        if mode is Mode.FAULT:
            if controller.cause is Cause.DRIVE_LOST and self._onboard is not None:
                return
            if now >= self._idle_at_ns:
                self._idle_at_ns = now + IDLE_EVERY_NS
                drive.idle()
        elif self._onboard is None:
            drive.write_torque(motor_torque(tau, self._gear_ratio))
        elif mode is not Mode.DISARMED:
            drive.write(self._onboard.target(controller.setpoint, tau, *self._motors))

    def _found_armed(self, now: int, reading: DriveReading) -> DriveReading:
        """Return the reading of a drive that somebody else has armed.

        One that holds the robot by its own loop, after the service before this one died, is
        taken over as it is, once it has told its torques. Any other is not armed by us.
        """
        if self._onboard is None:
            return msgspec.structs.replace(reading, status=DriveStatus.IDLE)
        if reading.torque is None:
            self._arm_at_ns = now + ARM_EVERY_NS  # and it is not armed anew meanwhile
            return msgspec.structs.replace(reading, status=DriveStatus.IDLE)
        self._tries = 1
        return reading

    def _arm(self, now: int, reading: DriveReading | None) -> None:
        """Ask the drive to arm, with its errors cleared, if the joint is where it may be."""
        if reading is None or reading.status is DriveStatus.LOST:
            return
        self._arm_at_ns = now + ARM_EVERY_NS
        if not self._controller.inside_limits():
            log.get("xrl").error(
                "not armed: the joint is at phi %.3f, theta %.3f rad, outside its limits; "
                "bring it inside, or correct the joint's zero",
                *self._controller.q,
            )
        elif self._tries < ARM_TRIES:
            self._tries += 1
            self._drive.arm(onboard=self._onboard is not None)
        elif self._tries == ARM_TRIES:
            self._tries += 1
            log.get("xrl").error(
                "not armed after %d tries: drive error 0x%x", ARM_TRIES, reading.error
            )
