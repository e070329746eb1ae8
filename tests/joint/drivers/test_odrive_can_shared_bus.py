"""Several modules on one CAN bus: each driver hears and moves its own drive only."""

from __future__ import annotations

import time

import numpy as np
import pytest

from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.drivers.frame_times import ARM_GRACE_MS
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState, Command, arbitration_id, pack_two_floats
from tests.joint.drivers.rig import DRIVE, MS, Rig, Shed, read

MODULES = 3

NODES = [(0, 1), (2, 3), (4, 5)]


class Leg(Rig):
    """Three emulated drives on one bus, and a driver of each."""

    def __init__(self, shed: Shed) -> None:
        super().__init__(shed, nodes=range(2 * MODULES))
        shed.rigs.append(self)
        self.pos = np.arange(12.0)
        self.drivers = [shed.driver(pair) for pair in NODES]

    def cycles(self) -> list[DriveReading]:
        """Step twice, and return what each driver then reads."""
        for _ in range(2):
            self.step()
            readings = [read(driver) for driver in self.drivers]
        return readings

    def arm(self, *which: int) -> list[DriveStatus]:
        for index in which:
            self.drivers[index].arm(onboard=True)
        time.sleep((ARM_GRACE_MS + 5) * MS)
        return [reading.status for reading in self.cycles()]


@pytest.fixture
def leg(shed: Shed) -> Leg:
    return Leg(shed)


def test_each_driver_reads_its_own_two_axes(leg: Leg) -> None:
    leg.bank.connected[:] = 1.0  # as after a first closed loop: before it 0.5.6 says zeros
    leg.vel = -0.5 * leg.pos
    leg.step()
    readings = [read(driver) for driver in leg.drivers]
    assert [reading.pos_turns for reading in readings] == [(0.0, 1.0), (2.0, 3.0), (4.0, 5.0)]
    vels = np.ravel([reading.vel_turns for reading in readings])
    assert vels == pytest.approx(leg.vel[: 2 * MODULES])
    assert [reading.status for reading in leg.cycles()] == [DriveStatus.IDLE] * MODULES


def test_arming_and_a_fault_of_one_module_leave_its_neighbours_alone(leg: Leg) -> None:
    leg.cycles()
    idle, armed = DriveStatus.IDLE, DriveStatus.ARMED
    assert leg.arm(1) == [idle, armed, idle]
    closed = [state == AxisState.CLOSED_LOOP_CONTROL for state in leg.bank.state[:6]]
    assert closed == [False, False, True, True, False, False]
    assert leg.arm(0, 2) == [armed] * 3
    leg.bank.inject("knee_right.axis0", "OVERSPEED")
    statuses = [reading.status for reading in leg.cycles()]
    assert statuses == [armed, DriveStatus.ERROR, armed]


def test_each_module_does_what_its_own_driver_writes(leg: Leg) -> None:
    leg.cycles()
    assert set(leg.arm(0, 1, 2)) == {DriveStatus.ARMED}
    for index, driver in enumerate(leg.drivers):
        at = float(index)
        driver.write(MotorTarget((at, -at), (0.0, 0.0), (0.0, 0.0), (1.0 + at,) * 2, (0.1,) * 2))
    leg.step()
    assert list(leg.bank.input_pos[:6]) == [0.0, 0.0, 1.0, -1.0, 2.0, -2.0]
    np.testing.assert_allclose(leg.bank.pos_gain[:6], [1.0, 1.0, 2.0, 2.0, 3.0, 3.0])


def test_a_silent_module_is_lost_though_its_neighbours_go_on(leg: Leg) -> None:
    leg.cycles()
    leg.bank.conditions.link(1, up=False)
    status = DriveStatus.IDLE
    for _ in range(round(2.0 * DRIVE.watchdog_timeout / MS)):
        leg.step()
        reading = leg.drivers[1].read(0.0)
        status = status if reading is None else reading.status
    assert status is DriveStatus.LOST


def test_frames_of_other_modules_make_no_sample_and_do_not_prolong_the_wait(leg: Leg) -> None:
    leg.cycles()
    driver = leg.drivers[0]
    while driver.read(0.0) is not None:
        pass
    others = [
        (arbitration_id(node, Command.GET_ENCODER_ESTIMATES), pack_two_floats(9.0, 9.0))
        for node in (2, 3, 4, 5, 33, 63)
    ]
    for _ in range(20):
        leg.hub.broadcast(others)
    before = leg.shed.now_s
    assert driver.read(0.01) is None
    assert leg.shed.now_s - before == pytest.approx(0.01)
