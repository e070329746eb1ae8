"""One ODrive v3 over USB and the `odrive` package, unmodified (docs/drives.md).

Threads: unlike other drivers, this one has several. The package runs its own asyncio loop in a
thread (and libodrive a second one below it), and a transfer may take 0.5 s to fail. So every
transfer runs on the package's loop. The control thread only reads the newest sample and stores the
newest target. The threads share only references to frozen objects, each written by one side.

An exchange reads a sample, and at once writes the control thread's target for it: with a target one
period late, the robot shook. Every four endpoints cost a round trip, so only changes are written,
and the states are read less often. There are at most 200 exchanges a second, which suffices for the
drives' own loops; use CAN for 1 kHz.
"""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from math import isfinite
from typing import Final

import msgspec
from odrive.device_manager import DeviceManager, get_device_manager
from odrive.runtime_device import RuntimeDevice

from services.joint.drivers.base import HEAT_EVERY_NS, DriveReading, MotorTarget, is_target
from services.joint.drivers.odrive_v3 import AxesStatus, OdriveV3
from shared import log
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisState
from shared.clamp import clamp
from shared.clock import NS_PER_MS, machine_s, now_ns
from shared.config.sections import DriveConfig
from shared.exceptions import DriveError
from shared.extras import libusb_fix

EXCHANGE_HZ: Final = 200
"""Maximum rate of exchanges, Hz: a v3 board answers no faster over USB (docs/drives.md)."""
PATIENCE: Final = 1.5
"""Minimum wait of `read`, in exchange periods: with one period it would often miss the sample."""
FEED_MS: Final = 1000
"""Time after `arm` in which watchdogs are fed without a target, ms: one is sent only once ARMED."""
RETRY_S: Final = 0.2
"""Time between two attempts to connect, s."""
STATES_EVERY: Final = 4
"""Number of exchanges with an armed drive per read of its states: 20 ms."""
COUNTS_EVERY: Final = 20
"""Number of exchanges with a drive that is not armed per read of its counts: 100 ms."""
ANSWER_S: Final = 0.003
"""Maximum time for which an exchange waits for the control thread's target after its sample, s."""
REPORT_S: Final = 5.0
"""Time after which a missing drive is reported, s: the serial number may be wrong."""
TURNS_MAX: Final = 1 << 13
"""Largest position, turns: at 18 bits per turn, an axis's count has 31 bits and a sign."""
CLOSE_S: Final = 1.0
"""Maximum time for which `close` waits for a last request, s; not for the control path."""

_ZERO = (0.0, 0.0)


class _Request:
    """Request of the control thread; its identity distinguishes it from earlier requests."""

    def __init__(self, *, arm: bool = False, clear: bool = False) -> None:
        self.arm, self.clear = arm, clear


class _Wanted:
    """Newest target, request and position from the control thread for the package's loop."""

    def __init__(self) -> None:
        self.target: MotorTarget | None = None
        self.request: _Request | None = None
        self.position: Pair | None = None  # the loop clears it once it is written
        self.closing = False


class _Exchanged:
    """Progress of the package's loop with the drive; the control thread only reads it."""

    def __init__(self) -> None:
        self.request: _Request | None = None  # carried out last
        self.target: MotorTarget | None = None  # sent last
        self.axes = AxesStatus()
        self.status, self.errors = DriveStatus.LOST, 0
        self.count = 0  # of exchanges
        self.heat_at_ns = 0
        self.feed_until_ns = 0  # above 0: arm was requested, and idle not since


def device_manager() -> DeviceManager:
    """Return the package's manager, on a loop in its own thread; loads libusb-1.0.

    Raises:
        DriveError: libusb-1.0 is missing on this system.
    """
    try:
        return get_device_manager(force_background_thread=True)
    except OSError as error:
        raise DriveError(
            f"USB: {error}; the odrive package needs libusb-1.0; install it with {libusb_fix()}"
        ) from error


class OdriveUsb:
    """Both axes of one ODrive; implements `services.joint.drivers.base.Drive`.

    The drive is found by its serial number whenever it is plugged in; while it is unplugged, the
    status is LOST. It is armed in position mode with zero gains, so there is no torque without a
    target; `write_torque` sends a target with zero gains.

    Enabled watchdogs are fed with each new target, so they expire if the control loop hangs.

    Attributes:
        write_failures: invalid targets, and targets without a connected drive.
        connections: number of times that the drive was connected.
        trouble: why the last connection failed, ended or was not made; "" at first.
    """

    def __init__(self, serial_number: str, drive: DriveConfig) -> None:
        """Start to search for a drive by its serial number, 12 hexadecimal digits.

        Raises:
            DriveError: libusb-1.0 is missing on this system.
        """
        self.write_failures = 0
        self.connections = 0
        self.trouble = ""
        self._drive = drive
        self._serial_number = serial_number.upper()
        self._period_s = max(1.0 / EXCHANGE_HZ, drive.encoder_period_ms * 1e-3)
        self._torque_max = drive.current_lim * drive.torque_constant
        self._lost_after_s = drive.lost_after_s
        self._wanted = _Wanted()
        self._silent_s = 0.0  # time waited without a sample, without pauses of the process
        # Written by the package's loop:
        self._sample = DriveReading(now_ns(), _ZERO, _ZERO, DriveStatus.LOST, 0)
        self._fresh = threading.Event()
        self._connected = False
        self._done = _Exchanged()
        # Made by the package's loop, and resolved there once the control thread has written:
        self._awaited: asyncio.Future[None] | None = None
        self._manager = device_manager()
        self._task: Future[None] = asyncio.run_coroutine_threadsafe(
            self._run(self._manager), self._manager.loop
        )

    # The control thread's side: nothing here waits for a transfer.

    def read(self, timeout_s: float) -> DriveReading | None:
        """Wait for the next sample of both axes; see `Drive.read`.

        A reading with status LOST repeats the last sample and its time.
        """
        wait_s = max(timeout_s, PATIENCE * self._period_s) if timeout_s > 0.0 else 0.0
        if self._fresh.wait(machine_s(wait_s)):
            self._fresh.clear()
            self._silent_s = 0.0
            sample = self._sample
            if self._wanted.request is not self._done.request:  # it predates the request
                return msgspec.structs.replace(sample, status=DriveStatus.IDLE, error=0)
            return sample
        sample = self._sample
        self._silent_s += wait_s
        if sample.status is not DriveStatus.LOST and self._silent_s <= self._lost_after_s:
            return None
        return msgspec.structs.replace(sample, status=DriveStatus.LOST, error=0)

    def write_torque(self, torque: Pair) -> None:
        """Store both motor torques, N m, for the next exchange, with zero gains."""
        self.write(MotorTarget(self._sample.pos_turns, _ZERO, torque, _ZERO, _ZERO))

    def write(self, target: MotorTarget) -> None:
        """Store a target for the next exchange; the newest wins.

        The feedforward is clipped to `current_lim`. As over CAN, an invalid target is not sent, and
        the drive keeps the last one. Packing it would fail and end the connection.
        """
        if not self._connected or not is_target(target):
            self.write_failures += 1
            return
        limit = self._torque_max
        if max(map(abs, target.torque)) > limit:
            first, second = (clamp(value, -limit, limit) for value in target.torque)
            target = msgspec.structs.replace(target, torque=(first, second))
        self._wanted.target = target
        awaited = self._awaited
        if awaited is not None:
            self._awaited = None
            self._manager.loop.call_soon_threadsafe(_resolve, awaited)

    def arm(self, *, onboard: bool) -> None:  # noqa: ARG002 - see below
        """Request closed loop on both axes; errors are cleared and the gains zeroed first.

        Position mode also serves plain torques: with zero gains it gives the requested torque,
        whereas torque mode would limit it by the present vel_gain. Like `idle`, the request is
        dropped if the drive is lost first; the caller repeats it.
        """
        self._wanted.request = _Request(arm=True)

    def clear_errors(self) -> None:
        """See `Drive.clear_errors`."""
        self._wanted.request = _Request(clear=True)

    def idle(self) -> None:
        """Command both axes to go idle, with their input torque zeroed; see `arm`."""
        self._wanted.request = _Request(arm=False)

    def set_position(self, turns: Pair) -> None:
        """Request writing both encoders' positions, turns; dropped if the drive is lost first.

        Raises:
            DriveError: the drive is lost now, or its count cannot hold the position.
        """
        if not self._connected:
            raise DriveError(
                f"ODrive {self._serial_number}: not connected, so its position cannot be written; "
                "check its power and its USB cable"
            )
        if not all(abs(turn) < TURNS_MAX for turn in turns):
            raise DriveError(
                f"ODrive {self._serial_number}: {turns[0]:g} and {turns[1]:g} turns are not valid "
                f"positions; give less than {TURNS_MAX} turns"
            )
        self._wanted.position = turns

    def close(self) -> None:
        """Carry out the last request if the drive is there, and release it."""
        self._wanted.closing = True
        try:
            self._task.result(CLOSE_S)
        except TimeoutError:
            self._task.cancel()
        except CancelledError:
            return  # closed before

    # The package's side: everything below runs on its loop.

    async def _run(self, manager: DeviceManager) -> None:
        """Connect, exchange, and start over when the drive is gone; never raises."""
        while not self._wanted.closing:
            device: RuntimeDevice | None = None
            try:
                device = await self._find(manager)
                if device is not None:
                    board = OdriveV3(device)
                    await board.read_settings()
                    # Requests for an absent drive do not apply to this one: it may hold the robot
                    # with its own loop, and an old target would be wrong.
                    self._done.request, self._wanted.position = self._wanted.request, None
                    self._done.target = self._wanted.target
                    self._done.status = DriveStatus.LOST
                    self._connected = True
                    self.connections += 1
                    await self._stay(board)
            except Exception as error:  # noqa: BLE001 - the package raises bare Exceptions
                self._report(f"{type(error).__name__}: {error}")
                await asyncio.sleep(RETRY_S)
            finally:
                self._connected = False
                if device is not None:
                    with suppress(Exception):  # it may be gone already
                        manager.release_connection(device)

    async def _find(self, manager: DeviceManager) -> RuntimeDevice | None:
        """Return the drive once it is plugged in and connected; None when closing."""
        search = asyncio.ensure_future(
            manager.wait_for(serial_number=self._serial_number, return_type=RuntimeDevice)
        )
        loop = asyncio.get_running_loop()
        report_at = loop.time() + REPORT_S
        try:
            while not self._wanted.closing:
                await asyncio.wait((search,), timeout=RETRY_S)
                if search.done():
                    return search.result()
                if loop.time() > report_at:
                    self._report("not on USB; `xrl doctor` lists the connected serial numbers")
        finally:
            search.cancel()
        return None

    def _report(self, trouble: str) -> None:
        """Log why the drive is absent, unless that was the last report."""
        if trouble != self.trouble:
            self.trouble = trouble
            log.get("xrl").warning("ODrive %s: %s", self._serial_number, trouble)

    async def _stay(self, board: OdriveV3) -> None:
        """Exchange periodically, until closing or until a transfer fails."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while not (self._wanted.closing and self._is_carried_out()):
            await self._exchange(board)
            due = max(due + machine_s(self._period_s), loop.time())
            await asyncio.sleep(due - loop.time())

    def _is_carried_out(self) -> bool:
        return self._wanted.request is self._done.request and self._wanted.position is None

    async def _exchange(self, board: OdriveV3) -> None:
        """Carry out a request if there is one; then take a sample and send the target."""
        wanted, done = self._wanted, self._done
        request, position = wanted.request, wanted.position
        new = request if request is not done.request else None
        if position is not None and (new is None or new.arm):
            # Never while armed, or the drive jumps by as many turns. So arming waits for the next
            # exchange, and so does the position if it comes with a request to go idle.
            await board.set_position(position)
            if wanted.position is position:  # there is no newer one
                wanted.position = None
            request = done.request
        elif new is not None:
            await self._carry_out(board, new)
        await self._take_sample(board)
        done.request = request  # only with a sample taken after it
        await self._answer()
        target, sent = wanted.target, done.target
        done.target = target
        if target is not None and target is not sent:
            await board.target.write(target)
        if board.hungry and (target is not sent or now_ns() < done.feed_until_ns):
            await board.feed()

    async def _answer(self) -> None:
        """Wait until the control thread has written, for at most `ANSWER_S`."""
        awaited = self._awaited
        if awaited is not None:
            timer = asyncio.get_running_loop().call_later(ANSWER_S, _resolve, awaited)
            await awaited
            timer.cancel()
            self._awaited = None

    async def _take_sample(self, board: OdriveV3) -> None:
        """Take a sample of both axes, for the control thread."""
        wanted, done = self._wanted, self._done
        done.count += 1
        torque = zero = None
        found = wanted.request is None and wanted.target is None
        if done.status is DriveStatus.ARMED and not found and done.count % STATES_EVERY:
            values = await board.sample.read()
            t_ns = now_ns()
        else:
            values = await board.sample_and_state.read()
            t_ns = now_ns()
            await self._judge(board, values[4:])
            if found and done.status is DriveStatus.ARMED:
                torque = await board.torques(self._drive.torque_constant)
            if done.status is not DriveStatus.ARMED and done.count % COUNTS_EVERY == 1:
                zero = await board.encoder_zero()
        fet = motor = None
        if t_ns >= done.heat_at_ns:
            done.heat_at_ns = t_ns + HEAT_EVERY_NS
            fet, motor = await board.heat()
        if all(map(isfinite, values)):  # otherwise it is not a sample
            pos, vel = (values[0], values[1]), (values[2], values[3])
            self._sample = DriveReading(
                t_ns, pos, vel, done.status, done.errors, torque, zero, fet, motor
            )
            if wanted.target is not None:
                self._awaited = asyncio.get_running_loop().create_future()
            self._fresh.set()

    async def _judge(self, board: OdriveV3, states: tuple[int, ...]) -> None:
        """Derive the status from both axes' states."""
        done = self._done
        done.errors = 0
        if any(state != AxisState.CLOSED_LOOP_CONTROL for state in states):
            done.errors = done.axes.errors(
                await board.errors.read(), wanted_armed=done.feed_until_ns != 0
            )
        done.status = done.axes.judge(states, done.errors)

    async def _carry_out(self, board: OdriveV3, request: _Request) -> None:
        """Arm or idle both axes, or clear errors; their earlier reports are forgotten."""
        done = self._done
        if request.clear:
            await board.clear_errors()
        elif request.arm:
            await board.arm(self._drive.vel_limit, self._drive.current_lim)
            done.feed_until_ns = now_ns() + FEED_MS * NS_PER_MS
            done.target = self._wanted.target  # it is from before arming
        else:
            await board.idle()
            done.feed_until_ns = 0
        board.target.forget()
        done.axes = AxesStatus()
        done.status = DriveStatus.LOST  # until its states are read


def _resolve(future: asyncio.Future[None]) -> None:
    """End the wait for a future, if it has not ended."""
    if not future.done():
        future.set_result(None)
