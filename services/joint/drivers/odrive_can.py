"""One ODrive over CANSimple and python-can (docs/drives.md).

The same code runs on the robot (socketcan) and in the demo (`xrl_unix`); only the configured
interface and channel differ. It supports firmware 0.5 and 0.6 (`services.joint.drivers.firmware`).
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from math import isfinite
from typing import Final

import msgspec

from services.joint.drivers import odrive_frames
from services.joint.drivers.base import (
    HEAT_EVERY_NS,
    SUPPLY_EVERY_NS,
    DriveReading,
    MotorTarget,
    is_target,
)
from services.joint.drivers.can_link import CanLink, packed
from services.joint.drivers.firmware import (
    HEARTBEAT_BYTES,
    VERSION_BYTES,
    AxesReport,
    Dialect,
)
from services.joint.drivers.frame_times import EncoderPair, FrameTimes, OrderWindows
from services.joint.drivers.odrive_frames import Rows
from services.joint.drivers.replies import NOTHING, Replies
from services.joint.drivers.resend_policy import GainRow, ResendPolicy
from shared.bus.messages import DriveStatus, Pair
from shared.can import cansimple
from shared.can.cansimple import AxisState, Command
from shared.can.cansimple_06 import Command06
from shared.can.unix_can import ERROR_FLAG, unpack_frames
from shared.clock import NS_PER_MS, NS_PER_S, machine_s, now_ns
from shared.config.sections import CanConfig, DriveConfig
from shared.exceptions import DriveError

FRESH_S: Final = 0.05
"""Maximum time for which `set_position` waits for a silent drive, s; it never writes to one."""
CLOSE_MS: Final = 20
"""Maximum time for which an unsent command may delay `close`, ms."""

# Compared in each cycle: docs/contributing.md, The control path.
_LOST, _ARMED = DriveStatus.LOST, DriveStatus.ARMED
_unpack_two_floats = struct.Struct("<ff").unpack_from
_PAIR: Final = struct.Struct("<IB3xffIB3xff")
"""Packet with the estimates of both axes, which most cycles receive."""
_unpack_pair = _PAIR.unpack
_PAIR_BYTES: Final = 8


class OdriveCan:
    """Both axes of one ODrive; implements `services.joint.drivers.base.Drive`.

    While the bus is absent, the status is LOST and `read` retries to open it. The status stays LOST
    until both axes have sent a heartbeat, because only that shows their state. Torques and targets
    that the bus does not accept are counted, and raise no error.

    `DriveReading.error` holds `AxisError` bits for either firmware. An error of 0.6 maps to the bit
    of the same meaning, or to `OTHER_ERROR` if there is none.

    Attributes:
        write_failures: torque pairs and targets that the bus did not accept.
    """

    def __init__(
        self,
        can_config: CanConfig,
        node_ids: tuple[int, int],
        drive: DriveConfig,
        *,
        encoder_counts_per_turn: int | None = None,
    ) -> None:
        """Open the bus if it is there; `{run}` in its channel must already be expanded.

        Args:
            can_config: the bus; other modules may be on it too.
            node_ids: CAN nodes of axis0 and axis1.
            drive: limits and timing.
            encoder_counts_per_turn: for `set_position` on firmware 0.5, which takes counts.

        Raises:
            DriveError: python-can does not know the interface.
        """
        self.write_failures = 0
        self._node_ids = node_ids
        self._drive = drive
        self._counts_per_turn = encoder_counts_per_turn
        self._rows = Rows(node_ids, drive)
        # Feeds the firmware's watchdog; firmware 0.6 also answers with its version.
        self._food = b"".join(packed(n, Command06.GET_VERSION, b"") for n in node_ids)
        self._pair_ids = tuple(
            cansimple.arbitration_id(n, Command.GET_ENCODER_ESTIMATES) for n in node_ids
        )
        self._answers = Replies(node_ids, drive.torque_constant, encoder_counts_per_turn)
        take: dict[int, Callable[[int, bytes], None]] = {
            Command.GET_ENCODER_ESTIMATES: self._take_estimates,
            Command.GET_ENCODER_COUNT: self._answers.take_count,
            Command.HEARTBEAT: self._take_heartbeat,
            Command.GET_IQ: self._answers.take_current,
            Command06.GET_VERSION: self._take_version,
            Command06.GET_TEMPERATURE: self._answers.take_heat,
            Command.GET_VBUS: self._answers.take_supply,
        }
        self._takers = {
            cansimple.arbitration_id(node, command): (axis, taker)
            for axis, node in enumerate(node_ids)
            for command, taker in take.items()
        }
        self._link = CanLink(can_config, node_ids)
        self._report = AxesReport()
        self._due = ResendPolicy()
        self._first = 0  # the axis that is written first
        self._windows = OrderWindows()
        self._heat_at_ns = 0
        self._supply_at_ns = now_ns() + SUPPLY_EVERY_NS
        self._encoders = EncoderPair()
        self._times = FrameTimes(round(drive.lost_after_s * NS_PER_S), now_ns())
        self._connect()

    @property
    def dialect(self) -> Dialect:
        """The firmware's generation, "0.5" or "0.6"; "" while it is not known."""
        return self._report.dialect

    def read(self, timeout_s: float) -> DriveReading | None:
        """Wait for the next encoder sample of both axes; see `Drive.read`.

        All waiting frames are read, and the newest of each axis wins. A reading with status LOST
        repeats the last sample and its time.
        """
        link = self._link
        now = now_ns()
        deadline = now + int(timeout_s * NS_PER_S)
        if not link.is_open and not self._connect():
            time.sleep(max(0.0, machine_s(timeout_s)))
            return self._silence(now_ns())
        while True:
            now = self._pump(machine_s((deadline - now) / NS_PER_S))
            if self._encoders.complete():
                return self._sampled(now)
            if now >= deadline or not link.is_open:
                return self._silence(now)

    def _sampled(self, now: int) -> DriveReading:
        """Return the reading of a new sample; send the requests that are due."""
        link, answers = self._link, self._answers
        unheard = self._times.sampled(now)
        status = self._report.status
        if unheard and status is not _LOST:
            self._forget()
            status = _LOST
        if link.watch.carries_nothing(now):
            status = DriveStatus.UNACKNOWLEDGED
        elif status is not _ARMED and now < self._windows.feed_until_ns:
            link.send(self._food, awaited=1)
        if now >= self._heat_at_ns and self._report.dialect == "0.6":
            self._heat_at_ns = now + HEAT_EVERY_NS
            link.send(answers.ask_heat)
        if now >= self._supply_at_ns:
            self._supply_at_ns = now + SUPPLY_EVERY_NS
            link.send(answers.ask_supply)
        return self._reading(status)

    def write_torque(self, torque: Pair) -> None:
        """Send both motor torques, N m, clipped to `current_lim`; NaN is sent as zero."""
        settles = self._due.with_torques(now_ns())
        if not self._link.send(self._rows.torques(torque, settles=settles), awaited=1):
            self.write_failures += 1
            if settles:
                self._due.cut_off(GainRow.ALL)

    def write(self, target: MotorTarget) -> None:
        """Send the target of both motors' own loops; gains before the values they act on.

        An invalid target is not sent, so the drive keeps the last one. CAN carries velocity and
        torque in thousandths: torque steps are 0.035 N m at the joint.
        """
        if not self._link.is_open or not is_target(target):
            self.write_failures += 1
            return
        row = self._due.with_target((target.pos_gain, target.vel_gain), now_ns())
        if not self._link.send(self._rows.target(row, target, self._first), awaited=1):
            self.write_failures += 1
            self._first ^= 1  # a full queue would next cut off the other axis
            self._due.cut_off(row)

    def arm(self, *, onboard: bool) -> None:
        """Request closed loop control on both axes; see `Drive.arm`.

        Errors are cleared and `input_torque` is zeroed first, and with `onboard` also the gains:
        re-arming would otherwise bring back the earlier torque, and the factory gains have an
        integrator. `status` is IDLE until heartbeats show another state.
        """
        self._send(odrive_frames.arming(self._drive, onboard=onboard), armed=True, proven=True)
        now = now_ns()
        self._due.armed(now)
        self._windows.armed(now)

    def idle(self) -> None:
        """Command both axes to go idle, with their input torque zeroed."""
        self._send(odrive_frames.IDLING, armed=False)
        self._windows.idle(now_ns())
        self._due.idle()

    def clear_errors(self) -> None:
        """See `Drive.clear_errors`."""
        self._link.send(odrive_frames.packet_of(self._node_ids, odrive_frames.CLEARING))

    def set_position(self, turns: Pair) -> None:
        """Write both motors' positions, turns; see `Drive.set_position`.

        Raises:
            DriveError: the firmware is unknown, the counts per turn are missing, the position is
                invalid, the drive is silent, or the bus is full.
        """
        frames = odrive_frames.positions(self._node_ids, turns, self.dialect, self._counts_per_turn)
        if not self._link.watch.is_heard(now_ns()):  # the caller may have waited for a person
            self._pump(0.0)
            self._pump(FRESH_S)
        if not self._link.send(frames):
            first, second = self._node_ids
            raise DriveError(
                f"CAN nodes {first} and {second}: the drive is silent, or the bus did not accept "
                "the command; check the drive's power, the wiring, and whether the interface is up"
            )

    def close(self) -> None:
        """Release the bus for good; a waiting command has `CLOSE_MS` to be sent."""
        deadline = now_ns() + CLOSE_MS * NS_PER_MS
        while not self._link.send(b"") and self._link.is_open and now_ns() < deadline:
            time.sleep(1e-3)
        self._link.close()

    def _send(
        self,
        commands: tuple[odrive_frames.CanCommand, ...],
        *,
        armed: bool,
        proven: bool = False,
    ) -> None:
        """Send commands to both axes and forget their earlier reports."""
        self._report.requested(armed=armed)
        self._answers.forget_torques()
        self._windows.ordered(now_ns())
        self._link.order(odrive_frames.packet_of(self._node_ids, commands), proven=proven)

    def _pump(self, timeout_s: float) -> int:
        """Process the frames of one wait; on a shared bus most belong to other modules.

        Returns:
            time at which they were received, ns.
        """
        link, takers = self._link, self._takers
        packet = link.receive_packet(max(0.0, timeout_s))
        self._times.now_ns = now = now_ns()
        if len(packet) == _PAIR.size and self._take_pair(packet, now):
            link.hear_drive(now)
            return now
        frames = unpack_frames(packet)
        link.take_in(frames, now)
        for can_id, data in frames:
            found = takers.get(can_id)
            if found is not None:
                axis, take = found
                take(axis, data)
            elif can_id & ERROR_FLAG:
                link.error_frame(can_id)
        return now

    def _take_pair(self, packet: bytes, now: int) -> bool:
        """Store the estimates of both axes; return False if the packet holds anything else."""
        id_0, bytes_0, pos_0, vel_0, id_1, bytes_1, pos_1, vel_1 = _unpack_pair(packet)
        if (id_0, id_1) != self._pair_ids or bytes_0 != _PAIR_BYTES or bytes_1 != _PAIR_BYTES:
            return False
        first, second = (pos_0, vel_0), (pos_1, vel_1)
        if first == NOTHING or second == NOTHING or not isfinite(pos_0 + vel_0 + pos_1 + vel_1):
            return False
        counted = self._answers.counted
        counted[0] = counted[1] = None
        self._encoders.store_both(first, second, now)
        return True

    def _take_estimates(self, axis: int, data: bytes) -> None:
        if len(data) == 8:
            estimate = _unpack_two_floats(data)
            answers = self._answers
            if estimate == NOTHING and self.dialect != "0.6":
                self._link.send(answers.ask_count[axis])
                estimate = answers.counted[axis] or estimate
            else:
                answers.counted[axis] = None
            self._encoders.store(axis, estimate, self._times.now_ns)

    def _take_heartbeat(self, axis: int, data: bytes) -> None:
        times, windows = self._times, self._windows
        now = times.now_ns
        if len(data) != HEARTBEAT_BYTES or now < windows.believe_from_ns:
            return
        times.heard_ns[axis] = now
        if now < windows.insist_until_ns and data[4] == AxisState.CLOSED_LOOP_CONTROL:
            self._send(odrive_frames.IDLING, armed=False)  # the idle command was lost
            return
        report = self._report
        report.receive(axis, bytes(data))
        if report.dialect == "":
            self._link.send(self._answers.ask_version)
        if report.status is not DriveStatus.ARMED and report.dialect == "0.5":
            self._link.send(self._answers.ask_count[axis])
        found_armed = report.status is DriveStatus.ARMED and self._due.gains is None
        if found_armed and self._answers.torques is None:
            self._link.send(self._answers.ask_currents)  # a take-over needs them

    def _take_version(self, _axis: int, data: bytes) -> None:
        if len(data) == VERSION_BYTES:  # a request, from here or elsewhere, has no data
            self._report.receive_version()

    def _silence(self, now: int) -> DriveReading | None:
        """Return None during a short silence, then a reading that reports the drive as lost.

        A failed link counts as silence too, because an interface that restarts is not a lost drive.
        """
        if self._times.has_recent_sample(now):
            return None
        if self._times.may_have_restarted(now):
            self._forget()
        dead = self._link.watch.unacknowledged
        return self._reading(DriveStatus.UNACKNOWLEDGED if dead else DriveStatus.LOST)

    def _forget(self) -> None:
        """Forget the drive's reports: it may have been power-cycled."""
        self._report.forget()
        self._answers.forget_counts()
        self._answers.supply_v = 0.0

    def _reading(self, status: DriveStatus) -> DriveReading:
        """Return the newest estimates with a status."""
        answers = self._answers
        (pos_0, vel_0), (pos_1, vel_1) = self._encoders.estimates
        reading = DriveReading(
            self._times.sample_ns,
            (pos_0, pos_1),
            (vel_0, vel_1),
            status,
            self._report.errors,
            answers.torques if self._due.gains is None else None,
            supply_v=answers.supply_v,
        )
        if not answers.has_news:
            return reading
        answers.has_news = False
        fet, motor = answers.heat()
        return msgspec.structs.replace(
            reading,
            encoder_zero=answers.encoder_zero(),
            fet_celsius=fet,
            motor_celsius=motor,
        )

    def _connect(self) -> bool:
        """Open the bus if an attempt is due; request the firmware's version."""
        if not self._link.connect():
            return False
        self._encoders.forget()
        self._due.connected()
        self._answers.forget_torques()
        self._answers.forget_counts()
        if not self._times.has_recent_sample(now_ns()):
            self._report.forget()
        version = self._answers.ask_version if self._report.dialect == "" else b""
        self._link.greet(version + b"".join(self._answers.ask_count))
        return True
