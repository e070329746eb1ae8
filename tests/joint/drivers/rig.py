"""An emulated ODrive on a CAN bus over sockets, with time made by the test on its side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.joint.drivers.frame_times import ARM_GRACE_MS
from services.joint.drivers.odrive_can import OdriveCan
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.cansimple_dialects import DialectName
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.config.sections import CanConfig, DriveConfig

DRIVE = DriveConfig(
    torque_constant=0.0827,
    current_lim=60.0,
    vel_limit=60.0,
    dc_max_negative_current=-30.0,
    watchdog_timeout=0.1,
    encoder_period_ms=1,
    heartbeat_period_ms=1,  # so that a state is known one step later
    zero_mark_turns=0.0,
)
NODES = (4, 5)
AXES = (4, 5)
MS = 1e-3


TARGET = MotorTarget((0.25, -0.5), (1.0, -2.0), (0.5, -0.25), (30.0, 40.0), (0.05, 0.06))


class Rig:
    """An emulated ODrive, hip_right of the bank, on a hub; `step` is one millisecond of it."""

    def __init__(
        self,
        path: Path,
        *,
        watchdog: bool = False,
        dialect: DialectName = "0.5",
        hub: type[UnixCanHub] = UnixCanHub,
        nodes: Sequence[int] = NODES,
    ) -> None:
        """Put the drive's axes on nodes of the same numbers."""
        self.hub = hub(path)
        self.bank = AxisBank(DRIVE, encoder_counts_per_turn=16384, watchdog=watchdog)
        axes = [{node: node for node in nodes}]
        self.front = CanSimpleFront(
            self.bank, [self.hub], axes, heartbeat_period_ms=1, dialect=dialect
        )
        self.pos = np.zeros(12)
        self.vel = np.zeros(12)
        self.now_s = 0.0

    def step(self) -> np.ndarray:
        self.front.receive()
        torque = self.bank.step(self.now_s, self.pos, self.vel)
        self.front.send_encoders()
        self.front.send_heartbeats(self.now_s)
        self.now_s += MS
        return torque

    def cycle(self, driver: OdriveCan) -> DriveReading:
        """Step, read twice what the step sent, so that its heartbeats are in, and return it."""
        self.step()
        read(driver)
        self.step()
        return read(driver)


def read(driver: OdriveCan, timeout_s: float = 0.5) -> DriveReading:
    """Return the reading that is there for sure."""
    reading = driver.read(timeout_s)
    assert reading is not None
    return reading


def make_driver(path: Path) -> OdriveCan:
    """Return a driver of the bus at a socket, which need not be there."""
    config = CanConfig(interface="xrl_unix", channel=str(path))
    return OdriveCan(config, NODES, DRIVE, encoder_counts_per_turn=16384)


class Shed:
    """Makes emulated drives and drivers of one socket, and closes them in the end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rigs: list[Rig] = []
        self.drivers: list[OdriveCan] = []

    def rig(self, **how: Any) -> Rig:
        self.rigs.append(Rig(self.path, **how))
        return self.rigs[-1]

    def driver(self) -> OdriveCan:
        self.drivers.append(make_driver(self.path))
        return self.drivers[-1]

    def connected(self, rig: Rig) -> OdriveCan:
        """Return a driver that has found the drive."""
        driver = self.driver()
        assert rig.cycle(driver).status == DriveStatus.IDLE
        return driver

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        for rig in self.rigs:
            rig.hub.close()


def arm(rig: Rig, driver: OdriveCan, *, onboard: bool = False) -> None:
    """Arm and wait out the time in which heartbeats are not believed."""
    driver.arm(onboard=onboard)
    time.sleep((ARM_GRACE_MS + 5) * MS)
    reading = rig.cycle(driver)
    assert reading.status == DriveStatus.ARMED
    assert reading.error == 0
