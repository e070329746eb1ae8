"""One ODrive over CANSimple and python-can (design section 5).

The same code on the robot (socketcan) and in the demo (`xrl_unix`): only the configured
interface and channel differ.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from math import isfinite
from typing import Final

import can

from services.joint.drivers import odrive_frames
from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.joint.drivers.can_link import (
    Receive,
    Send,
    drop,
    message,
    nothing,
    receiver,
    request_of,
    sender,
)
from shared import cansimple
from shared.cansimple import AxisError, AxisState, Command, ControlMode
from shared.clock import NS_PER_MS, NS_PER_S, now_ns
from shared.config_sections import CanConfig, DriveConfig
from shared.exceptions import DriveError
from shared.messages import Pair

REBOOT_MS: Final = 500
"""After so long a silence the drive may have been switched off and on: what its
heartbeats said before is forgotten."""
RETRY_MS: Final = 200
"""Between two attempts to open the bus: on socketcan an attempt may cost a millisecond."""
ARM_GRACE_MS: Final = 10
"""Heartbeats this soon after `arm` may have been sent before it; they are not believed."""
FEED_MS: Final = 1000
"""So long after `arm` reading feeds the watchdogs until the drive is ARMED: that shows
only in the next heartbeat, and a watchdog may run out before it."""

GAINS_MS: Final = 100
"""Gains go to the drive when they change and this often: a frame may have been lost."""
LOST_MS: Final = 100
"""Silence of a drive without a watchdog after which it counts as lost."""

_NMT_COMMAND = 0x000  # the firmware takes it as food for the watchdog and does nothing else
_BOTH = 0b11
_unpack_estimates = struct.Struct("<ff").unpack_from
_unpack_iq = struct.Struct("<ff").unpack_from
_pack_torque = struct.Struct("<f").pack


class OdriveCan:
    """Both axes of one ODrive; implements `services.joint.drivers.base.Drive`.

    The bus need not be there yet: until it is, and whenever it goes away, the status is
    LOST and reading retries by itself; it stays LOST until both axes have sent a
    heartbeat, for only that tells their state. What is lost on the way to the drive is counted,
    not raised.

    Attributes:
        write_failures: torque pairs that could not be handed to the bus.
        connections: how often the bus was opened.
    """

    def __init__(
        self,
        can_config: CanConfig,
        node_ids: tuple[int, int],
        drive: DriveConfig,
    ) -> None:
        """Take the channel with `{run}` already expanded; open the bus if it is there.

        Raises:
            DriveError: python-can does not know the interface.
        """
        self.write_failures = 0
        self.connections = 0
        self._can_config = can_config
        self._drive = drive
        self._node_ids = node_ids
        self._torque_max = drive.current_lim * drive.torque_constant
        # Not before its own watchdog has fired: until then a silent drive holds its last
        # torque and comes back as if nothing had been, while a FAULT is for good.
        lost_s = drive.watchdog_timeout or LOST_MS * 1e-3
        self._lost_after_ns = round(lost_s * NS_PER_S)
        self._torque_messages = [message(n, Command.SET_INPUT_TORQUE, bytes(4)) for n in node_ids]
        first, second = (message(n, Command.SET_INPUT_POS, bytes(8)) for n in node_ids)
        self._input_messages = (first, second)
        self._food = [message(n, _NMT_COMMAND, b"") for n in node_ids]
        self._encoder_axis = {
            cansimple.arbitration_id(n, Command.GET_ENCODER_ESTIMATES): i
            for i, n in enumerate(node_ids)
        }
        self._heartbeat_axis = {
            cansimple.arbitration_id(n, Command.HEARTBEAT): i for i, n in enumerate(node_ids)
        }
        self._iq_axis = {
            cansimple.arbitration_id(n, Command.GET_IQ): i for i, n in enumerate(node_ids)
        }
        self._ask_iq = [request_of(n, Command.GET_IQ) for n in node_ids]
        self._found: list[float | None] = [None, None]  # torques of a drive that was found armed
        self._gains_sent: tuple[Pair, Pair] | None = None
        self._gains_at_ns = 0
        self._bus: can.BusABC | None = None
        self._receive: Receive = nothing
        self._send: Send = drop
        self._retry_at_ns = 0
        self._believe_from_ns = 0
        self._feed_until_ns = 0  # later than 0: arm was asked for, and no idle since
        self._estimates: list[Pair] = [(0.0, 0.0), (0.0, 0.0)]
        self._fresh = 0  # bit i: axis i has a frame since the last sample
        self._sample_ns = now_ns()
        self._has_sample = False
        self._states = [int(AxisState.UNDEFINED)] * 2
        self._errors = [0, 0]
        self._was_armed = [False, False]
        self._status = DriveStatus.LOST
        self._connect()

    def read(self, timeout_s: float) -> DriveReading | None:
        """Wait for the next encoder sample of both axes; see `Drive.read`.

        All frames that wait are read and the newest of each axis wins. A reading with
        status LOST repeats the last sample and its time.
        """
        now = now_ns()
        deadline = now + int(timeout_s * NS_PER_S)
        if self._bus is None and not self._connect():
            time.sleep(max(0.0, timeout_s))
            return self._silence(now_ns())
        while True:
            self._pump((deadline - now) / NS_PER_S)
            now = now_ns()
            if self._fresh == _BOTH:
                self._fresh = 0
                self._sample_ns = now
                self._has_sample = True
                if self._status != DriveStatus.ARMED and now < self._feed_until_ns:
                    self._transmit(self._food)
                return self._reading(self._status)
            if now >= deadline or self._bus is None:
                break
        return self._silence(now)

    def _silence(self, now: int) -> DriveReading | None:
        """Return None while the drive may yet come back as it was, then LOST.

        A link that failed counts as silence too: an interface that restarts is not a lost
        drive.
        """
        silent_ns = now - self._sample_ns
        if self._has_sample and silent_ns <= self._lost_after_ns:
            return None
        if silent_ns > REBOOT_MS * NS_PER_MS:
            self._forget()
        return self._reading(DriveStatus.LOST)

    def write_torque(self, torque: Pair) -> None:
        """Send both motor torques, N m, at most `current_lim`'s worth; not a number is zero."""
        messages = self._torque_messages
        limit = self._torque_max
        for frame, value in zip(messages, torque, strict=True):
            if not -limit <= value <= limit:
                value = limit if value > limit else -limit if value < -limit else 0.0  # noqa: PLW2901
            frame.data[:] = _pack_torque(value)
        if not self._transmit(messages):
            self.write_failures += 1

    def write(self, target: MotorTarget) -> None:
        """Send what both motors' own loops are to do; gains before what they act on.

        Over CAN velocity and torque travel in thousandths: 0.035 N m at the joint.
        """
        now = now_ns()
        nodes = self._node_ids
        messages: list[can.Message] = []
        gains = (target.pos_gain, target.vel_gain)
        if gains != self._gains_sent or now >= self._gains_at_ns:
            if self._gains_sent is None:  # the first since connecting: taken over as it stands
                messages += odrive_frames.modes(nodes, ControlMode.POSITION)
            self._gains_sent, self._gains_at_ns = gains, now + GAINS_MS * NS_PER_MS
            messages += odrive_frames.gains(nodes, target)
        odrive_frames.fill_inputs(self._input_messages, target)
        messages += self._input_messages
        if not self._transmit(messages):
            self._gains_sent = None if self._bus is None else self._gains_sent
            self._gains_at_ns = 0
            self.write_failures += 1

    def arm(self, *, onboard: bool) -> None:
        """Ask for closed loop control on both axes; see `Drive.arm`.

        Errors are cleared, and `input_torque` and the gains zeroed first: re-arming would
        otherwise bring back the torque of before, and the gains the drive ships with have
        an integrator. `status` is IDLE until heartbeats tell more.
        """
        self._request(*odrive_frames.arming(self._drive, onboard=onboard))
        self._gains_sent = ((0.0, 0.0), (0.0, 0.0))
        self._feed_until_ns = now_ns() + FEED_MS * NS_PER_MS

    def idle(self) -> None:
        """Ask both axes to go idle, with their input torque zeroed."""
        self._request(*odrive_frames.IDLING)

    def close(self) -> None:
        """Release the bus and stay away from it."""
        self._disconnect()
        self._retry_at_ns = 1 << 63

    def _request(self, *commands: tuple[Command, bytes]) -> None:
        """Send commands to both axes and forget what the axes reported before."""
        self._states = [int(AxisState.UNDEFINED)] * 2
        self._errors = [0, 0]
        self._was_armed = [False, False]
        self._status = DriveStatus.IDLE
        self._feed_until_ns = 0
        self._found = [None, None]
        self._believe_from_ns = now_ns() + ARM_GRACE_MS * NS_PER_MS
        self._transmit(
            [message(node, command, data) for command, data in commands for node in self._node_ids]
        )

    def _pump(self, timeout_s: float) -> None:
        """Take in the frames of one wait; a link that fails is closed."""
        try:
            frames = self._receive(max(0.0, timeout_s))
        except (can.CanError, OSError):
            self._disconnect()
            return
        encoder_axis = self._encoder_axis
        for can_id, data in frames:
            axis = encoder_axis.get(can_id)
            if axis is not None and len(data) == 8:
                pos, vel = estimates = _unpack_estimates(data)
                if isfinite(pos) and isfinite(vel):  # what is no number is no sample
                    self._estimates[axis] = estimates
                    self._fresh |= 1 << axis
            elif (axis := self._heartbeat_axis.get(can_id)) is not None and len(data) == 8:
                self._hear(axis, data)
            elif (axis := self._iq_axis.get(can_id)) is not None and len(data) == 8:
                self._found[axis] = _unpack_iq(data)[0] * self._drive.torque_constant

    def _hear(self, axis: int, data: bytes) -> None:
        """Take in a heartbeat and work out the status."""
        if now_ns() < self._believe_from_ns:
            return
        heartbeat = cansimple.unpack_heartbeat(data)
        closed_loop = heartbeat.axis_state == AxisState.CLOSED_LOOP_CONTROL
        errors = int(heartbeat.errors)
        if not closed_loop and self._feed_until_ns == 0:
            # The watchdog also runs in IDLE: there it only says that nobody has written yet.
            errors &= ~AxisError.WATCHDOG_TIMER_EXPIRED
        self._states[axis] = heartbeat.axis_state
        self._errors[axis] = errors
        self._was_armed[axis] |= closed_loop
        self._status = self._judge()
        if self._status == DriveStatus.ARMED and self._gains_sent is None and None in self._found:
            self._transmit(self._ask_iq)  # found armed: whoever takes it over asks for its torques

    def _judge(self) -> DriveStatus:
        """Return the status by the last heartbeats; axis_error 0 does not mean armed."""
        closed = [state == AxisState.CLOSED_LOOP_CONTROL for state in self._states]
        left = any(
            was and state not in (AxisState.CLOSED_LOOP_CONTROL, AxisState.UNDEFINED)
            for was, state in zip(self._was_armed, self._states, strict=True)
        )
        if left or any(self._errors):
            return DriveStatus.ERROR
        if AxisState.UNDEFINED in self._states:
            return self._status  # LOST after connecting, IDLE after a request
        return DriveStatus.ARMED if all(closed) else DriveStatus.IDLE

    def _forget(self) -> None:
        """Believe nothing of the axes' states until both have sent a heartbeat."""
        self._states = [int(AxisState.UNDEFINED)] * 2
        self._status = DriveStatus.LOST

    def _reading(self, status: DriveStatus) -> DriveReading:
        """Return the newest estimates with a status."""
        (pos_0, vel_0), (pos_1, vel_1) = self._estimates
        return DriveReading(
            self._sample_ns,
            (pos_0, pos_1),
            (vel_0, vel_1),
            status,
            self._errors[0] | self._errors[1],
            self._found_torque(),
        )

    def _found_torque(self) -> Pair | None:
        a, b = self._found
        return (a, b) if a is not None and b is not None and self._gains_sent is None else None

    def _transmit(self, messages: Sequence[can.Message]) -> bool:
        """Hand messages to the bus; False if it did not take them all."""
        try:
            self._send(messages)
        except (can.CanError, OSError):
            # A full queue of socketcan comes here too. A dead link shows in reading.
            return False
        return self._bus is not None

    def _connect(self) -> bool:
        """Open the bus, not more often than every `RETRY_MS`."""
        now = now_ns()
        if now < self._retry_at_ns:
            return False
        self._retry_at_ns = now + RETRY_MS * NS_PER_MS
        try:
            bus = can.Bus(
                interface=self._can_config.interface,
                channel=self._can_config.channel,
                ignore_config=True,  # python-can would read its own files at every attempt
            )
        except NotImplementedError as error:
            raise DriveError(
                f"CAN interface {self._can_config.interface!r}: {error}; "
                "use one that python-can knows, such as socketcan or xrl_unix"
            ) from error
        except (can.CanError, OSError):
            return False
        self._bus = bus
        self.connections += 1
        self._fresh = 0
        self._gains_sent = None
        self._found = [None, None]
        if not self._has_sample or now - self._sample_ns > self._lost_after_ns:
            self._forget()
        self._receive = receiver(bus)
        self._send = sender(bus)
        return True

    def _disconnect(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.shutdown()
        self._bus = None
        self._receive = nothing
        self._send = drop
