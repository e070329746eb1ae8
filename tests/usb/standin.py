"""A USB bus for tests: the stand-in libusb, built here, and drives that are plugged into it."""

from __future__ import annotations

import math
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from services.joint.drivers.base import Drive, MotorTarget
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.fibre_front import EmulatedBoard, FibreFront
from services.simulator.fronts.fibre_port import FibreHub, FibrePort
from services.simulator.fronts.usb_standin import build, load
from shared.bus.messages import DriveStatus
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_JOINTS
from tests.waiting import comes_true as eventually

__all__ = ["Control", "UsbRobot", "build", "eventually", "load"]

MODULE = 2
"""The module that the driver under test is for."""
FIRST_SERIAL = 0x365A335A3430
READ_TIMEOUT_S = 0.005
INERTIA = 1e-3
"""kg m^2 of a motor that carries nothing."""
STEP_MAX_S = 0.005
"""A machine that stalled makes no longer step: a drive's loop would not survive it."""


def serial_number(module: int) -> str:
    """Return a module's serial number as USB shows it."""
    return f"{FIRST_SERIAL + module:012X}"


class UsbRobot:
    """Emulated drives with free motors on the bus, run by a thread at about 1 kHz.

    Hold `lock` to look into or change `bank` and `ports`.
    """

    def __init__(self, robot: RobotConfig, folder: Path) -> None:
        counts = robot.joint.encoder_counts_per_turn
        self.bank = AxisBank(robot.drive, encoder_counts_per_turn=counts)
        self.ports = [
            FibrePort(
                FibreFront(EmulatedBoard(self.bank, module, FIRST_SERIAL + module)),
                folder / serial_number(module),
            )
            for module in range(len(MODULES))
        ]
        self.hub = FibreHub(self.ports)
        self.lock = threading.Lock()
        self.pos = np.zeros(N_JOINTS)
        self.vel = np.zeros(N_JOINTS)
        self._stop = threading.Event()
        self.stalled = threading.Event()
        """While set, the drives answer nothing, as a board that hangs."""
        self._thread = threading.Thread(target=self._run)

    @contextmanager
    def running(self) -> Iterator[UsbRobot]:
        """Run the thread within a with block."""
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join()
            self.hub.close()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._stop.is_set():
            stalled = self.stalled.is_set()
            select.select([] if stalled else [self.hub], [], [], 1e-3)
            with self.lock:
                if not stalled:
                    self.hub.poll()
                now = time.monotonic()
                passed_s = min(now - before, STEP_MAX_S)
                torque = self.bank.step(now, self.pos, self.vel)
                self.vel += torque / (2 * np.pi * INERTIA) * passed_s
                self.pos += self.vel * passed_s
                before = now


def axis_name(axis: int) -> str:
    """Return an axis's name as `AxisBank.inject` takes it."""
    return f"{MODULES[axis // 2]}.axis{axis % 2}"


class Control:
    """A control loop on a drive, as the joint service runs it: read, then write the target."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.target: MotorTarget | tuple[float, float] | None = (0.0, 0.0)
        self.status = DriveStatus.LOST
        self.error = 0
        self.pos = (math.nan, math.nan)
        self.torque: tuple[float, float] | None = None
        self.samples = 0
        self.raised: BaseException | None = None
        self.longest_s = 0.0
        """Longest time that one cycle took beyond its wait."""
        self.hang = threading.Event()
        """While set, the loop does nothing."""
        self._asked: list[Callable[[], None]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def arm(self) -> None:
        """Have the loop ask for arming."""
        self._asked.append(lambda: self.drive.arm(onboard=True))

    def idle(self) -> None:
        """Have the loop ask for idle."""
        self._asked.append(self.drive.idle)

    def stop(self) -> None:
        """End the loop."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    @contextmanager
    def running(self) -> Iterator[Control]:
        """Run the thread within a with block."""
        self._thread.start()
        try:
            yield self
        finally:
            self.stop()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                if self.hang.is_set():
                    time.sleep(1e-3)
                else:
                    self._cycle()
        except Exception as error:  # the claim is that there is none
            self.raised = error
            raise

    def _cycle(self) -> None:
        before = time.monotonic()
        reading = self.drive.read(READ_TIMEOUT_S)
        if reading is not None:
            self.samples += reading.status is not DriveStatus.LOST
            self.status, self.error, self.pos = reading.status, reading.error, reading.pos_turns
            self.torque = reading.torque
        while self._asked:
            self._asked.pop(0)()
        if isinstance(self.target, MotorTarget):
            self.drive.write(self.target)
        elif self.target is not None:
            self.drive.write_torque(self.target)
        self.longest_s = max(self.longest_s, time.monotonic() - before - READ_TIMEOUT_S)
