"""Emulated ODrives on a CAN bus over sockets, and their drivers, in the test's own time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.joint.drivers import can_link, odrive_can
from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.drivers.frame_times import ARM_GRACE_MS
from services.joint.drivers.odrive_can import OdriveCan
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.cansimple_dialects import DialectName
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState
from shared.can.unix_can import UnixCanBus
from shared.clock import NS_PER_MS
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
        shed: Shed,
        *,
        watchdog: bool = False,
        dialect: DialectName = "0.5",
        hub: type[UnixCanHub] = UnixCanHub,
        nodes: Sequence[int] = NODES,
    ) -> None:
        """Put the drive's axes on nodes of the same numbers."""
        self.shed = shed
        self.hub = hub(shed.path)
        self.bank = AxisBank(DRIVE, encoder_counts_per_turn=16384, watchdog=watchdog)
        axes = [{node: node for node in nodes}]
        self.front = CanSimpleFront(
            self.bank, [self.hub], axes, heartbeat_period_ms=1, dialect=dialect
        )
        self.pos = np.zeros(12)
        self.vel = np.zeros(12)

    def as_shipped(self) -> None:
        """Give the drive the limits and gains that it is sold with."""
        bank = self.bank
        bank.vel_limit[:], bank.current_lim[:] = 2.0, 10.0
        bank.pos_gain[:], bank.vel_gain[:], bank.vel_integrator_gain[:] = 20.0, 1 / 6, 1 / 3

    @property
    def states(self) -> list[AxisState]:
        """States of both axes."""
        return [self.bank.state[axis] for axis in AXES]

    def step(self) -> np.ndarray:
        now_s = self.shed.now_s
        self.front.receive()
        torque = self.bank.step(now_s, self.pos, self.vel)
        self.front.send_encoders()
        self.front.send_heartbeats(now_s)
        self.shed.wait(MS)
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


class Shed:
    """Makes emulated drives and drivers of one socket, and closes them in the end.

    Their time is the shed's: a rig's steps and every wait, a driver's for frames too, make it pass.
    """

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = path
        self.now_s = 0.0
        self.rigs: list[Rig] = []
        self.drivers: list[OdriveCan] = []
        receive = UnixCanBus.recv_packet

        def recv_packet(bus: UnixCanBus, timeout: float) -> bytes:
            packet = receive(bus, 0.0)
            if not packet:
                self.wait(timeout)
            return packet

        monkeypatch.setattr(UnixCanBus, "recv_packet", recv_packet)
        monkeypatch.setattr(time, "sleep", self.wait)
        for module in (odrive_can, can_link):
            monkeypatch.setattr(module, "now_ns", self.now_ns)

    def now_ns(self) -> int:
        return NS_PER_MS + round(self.now_s * 1e9)

    def wait(self, seconds: float) -> None:
        self.now_s += seconds

    def rig(self, **how: Any) -> Rig:
        self.rigs.append(Rig(self, **how))
        return self.rigs[-1]

    def driver(
        self, nodes: tuple[int, int] = NODES, counts_per_turn: int | None = 16384
    ) -> OdriveCan:
        """Return a driver of the bus, which need not be there."""
        config = CanConfig(interface="xrl_unix", channel=str(self.path))
        driver = OdriveCan(config, nodes, DRIVE, encoder_counts_per_turn=counts_per_turn)
        self.drivers.append(driver)
        return driver

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


class Line:
    """An emulated drive as it is sold, its driver as a service uses it, and the bus between."""

    def __init__(self, shed: Shed, hub: type[Any], dialect: DialectName = "0.5") -> None:
        self.shed = shed
        self.rig = shed.rig(hub=hub, dialect=dialect)
        self.rig.as_shipped()
        self.hub: Any = self.rig.hub
        self.driver = shed.driver()
        self.status = DriveStatus.LOST
        self.torques: list[np.ndarray] = []
        """Of both motors, in each millisecond."""

    def cycle(self, target: MotorTarget | None = None, ms: int = 2) -> None:
        """Let some milliseconds pass, read, and write a target if there is one."""
        for _ in range(ms):
            self.torques.append(self.rig.step()[list(AXES)].copy())
        reading = self.driver.read(0.0)
        if reading is not None:
            self.status = reading.status
        if target is not None:
            self.driver.write(target)

    def run(self, ms: int, target: MotorTarget | None = None) -> None:
        for _ in range(ms // 2):
            self.cycle(target)


def arm(rig: Rig, driver: OdriveCan, *, onboard: bool = False) -> None:
    """Arm and wait out the time in which heartbeats are not believed."""
    driver.arm(onboard=onboard)
    time.sleep((ARM_GRACE_MS + 5) * MS)
    reading = rig.cycle(driver)
    assert (reading.status, reading.error) == (DriveStatus.ARMED, 0)
