"""A bus that loses frames both ways: the drive ends up as it was told to be, and jerks for none.

Then each frame is lost, one after the other: what motors do beyond what they should. A drive is
armed, holds, and is put into DAMP's law: every spring is gone at once, and its torque comes as
feedforward. The joint stands still, so that each difference is the lost frame's.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.simulator.fronts.cansimple_dialects import DialectName
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can.cansimple import AxisState, ControlMode
from shared.can.unix_can import Frame
from tests.joint.drivers.rig import AXES, DRIVE, MS, TARGET, Shed

LOSS = 0.3

STEP_MS = 4

ASK_EVERY_MS = 500
"""How often a joint service repeats a request that has shown no effect."""


class LossyHub(UnixCanHub):
    """A bus on which every frame to a drive, and every packet of the drives, may be lost."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.dice = random.Random(0)
        self.loss = LOSS
        self.lost = 0

    def poll(self) -> list[Frame]:
        return [frame for frame in super().poll() if not self._loses()]

    def broadcast_packet(self, packet: bytes) -> None:
        for at in range(0, len(packet), 16):
            if not self._loses():
                super().broadcast_packet(packet[at : at + 16])

    def _loses(self) -> bool:
        loses = self.dice.random() < self.loss
        self.lost += loses
        return loses


class Bench:
    """A drive on a lossy bus, in its own time, and what a joint service does about it."""

    def __init__(self, shed: Shed, seed: int, dialect: DialectName) -> None:
        self.shed = shed
        self.rig = shed.rig(dialect=dialect, hub=LossyHub)
        assert isinstance(self.rig.hub, LossyHub)
        self.hub = self.rig.hub
        self.hub.dice.seed(seed)
        self.driver = shed.driver()
        self.status = DriveStatus.LOST

    def cycle(self) -> DriveReading | None:
        self.rig.step()
        self.shed.wait((STEP_MS - 1) * MS)
        reading = self.driver.read(0.0)
        if reading is not None:
            self.status = reading.status
        return reading

    def run(self, ms: int, target: MotorTarget | None = None) -> None:
        for _ in range(ms // STEP_MS):
            self.cycle()
            if target is not None:
                self.driver.write(target)

    def until_armed(self, *, onboard: bool) -> int:
        """Ask until the drive is armed; return how often it was asked."""
        for asked in range(1, 20):
            self.driver.arm(onboard=onboard)
            for _ in range(ASK_EVERY_MS // STEP_MS):
                self.cycle()
                if not onboard:
                    self.driver.write_torque((0.0, 0.0))
                if self.status is DriveStatus.ARMED:
                    return asked
        return 0


@pytest.fixture(params=range(3))
def seed(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(params=["0.5", "0.6"])
def bench(request: pytest.FixtureRequest, shed: Shed, seed: int) -> Iterator[Bench]:
    bench = Bench(shed, seed, request.param)
    bench.rig.as_shipped()
    yield bench
    assert bench.hub.lost > 10


@pytest.mark.parametrize("onboard", [True, False])
def test_modes_limits_gains_and_targets_arrive(bench: Bench, onboard: bool) -> None:
    bank, axes = bench.rig.bank, list(AXES)
    bank.control_mode[:] = ControlMode.POSITION
    bench.run(100)
    assert bench.until_armed(onboard=onboard)
    for _ in range(1200 // STEP_MS):
        bench.cycle()
        bench.driver.write(TARGET) if onboard else bench.driver.write_torque((0.25, -0.5))
    assert bench.rig.states == [AxisState.CLOSED_LOOP_CONTROL] * 2
    mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
    assert list(bank.control_mode[axes]) == [mode] * 2
    np.testing.assert_allclose(bank.vel_limit[axes], DRIVE.vel_limit)
    np.testing.assert_allclose(bank.current_lim[axes], DRIVE.current_lim)
    if onboard:
        np.testing.assert_allclose(bank.pos_gain[axes], TARGET.pos_gain, rtol=1e-6)
        np.testing.assert_allclose(bank.vel_gain[axes], TARGET.vel_gain, rtol=1e-6)
        assert not bank.vel_integrator_gain[axes].any()
        np.testing.assert_allclose(bank.input_pos[axes], TARGET.pos_turns)
        np.testing.assert_allclose(bank.input_vel[axes], TARGET.vel_turns)
        np.testing.assert_allclose(bank.input_torque[axes], TARGET.torque)
    else:
        assert list(bank.input_torque[axes]) == [0.25, -0.5]
    assert bench.status is DriveStatus.ARMED


def test_a_drive_that_is_idled_until_it_is_idle_ends_idle(bench: Bench) -> None:
    bench.run(100)
    bench.until_armed(onboard=True)
    bench.run(300, TARGET)
    for _ in range(12):
        bench.driver.idle()
        bench.run(100)
    assert bench.rig.states == [AxisState.IDLE] * 2


def test_the_dialect_is_found_and_never_the_wrong_one(bench: Bench) -> None:
    truth = "0.6" if bench.rig.front._dialect.sdo is not None else "0.5"
    for _ in range(200):
        bench.cycle()
        assert bench.driver.dialect in ("", truth)
        assert bench.status is not DriveStatus.ERROR or bench.driver.dialect == ""
    assert bench.driver.dialect == truth


def test_an_axis_that_disarms_shows_though_heartbeats_are_lost(bench: Bench) -> None:
    bench.run(100)
    bench.until_armed(onboard=True)
    bench.rig.bank.inject("hip_right.axis1", "DISARM")
    bench.run(100, TARGET)
    assert bench.status is DriveStatus.ERROR


# ---- each frame lost, one after the other

HERE = (0.1, -0.2)

HOLD = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.2, -0.1), (60.0, 40.0), (0.2, 0.3))

SPRING = np.array([60.0 * 0.2 * 0.05, 40.0 * 0.3 * 0.05])

DAMP = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.8, 0.5), (0.0, 0.0), (0.4, 0.4))
"""With HOLD's spring, at this position, as torque."""

HOLD_MS, DAMP_MS = 40, 40

CYCLE_MS = 2

LISTEN_MS = 20

EXCESS_MAX = 1.02 * 0.4 / 0.2
"""As a ratio of the spring's torque: without DAMP's pos_gain, HOLD's acts with DAMP's vel_gain."""

ENTERING = 14
"""Frames of the order to arm."""


class DroppingHub(UnixCanHub):
    """A bus that loses chosen frames to the drive, by their number since `start`."""

    lost: frozenset[int] = frozenset()
    count = -(1 << 30)

    def poll(self) -> list[Frame]:
        kept = []
        for frame in super().poll():
            if self.count not in self.lost:
                kept.append(frame)
            self.count += 1
        return kept


class Run:
    """One run with some frames lost, in its own time.

    Attributes:
        torques: of both motors, in each millisecond since arming was asked for.
        frames: how many went to the drive.
        held_ms: when HOLD was first written.
    """

    def __init__(self, shed: Shed, lost: Iterable[int]) -> None:
        shed.now_s = 0.0
        self.rig = shed.rig(hub=DroppingHub)
        hub = self.rig.hub
        assert isinstance(hub, DroppingHub)
        self.rig.as_shipped()
        self.rig.pos[list(AXES)] = HERE
        self.torques: list[np.ndarray] = []
        self.status = DriveStatus.LOST
        self.held_ms = 0
        self.driver = shed.driver()
        self._cycle(None, LISTEN_MS)
        self.torques.clear()
        self.rig.front.receive()  # where it is, which was asked before: no frame of an order
        hub.lost, hub.count = frozenset(lost), 0
        self.driver.arm(onboard=True)
        for _ in range(200):
            if self.status is DriveStatus.ARMED:
                break
            self._cycle(None, CYCLE_MS)
        else:
            self.driver.arm(onboard=True)  # as the joint service does, 500 ms later
            self._cycle(None, LISTEN_MS)
        self.held_ms = len(self.torques)
        self._cycle(HOLD, HOLD_MS)
        self._cycle(DAMP, DAMP_MS)
        self.frames = hub.count
        self.driver.close()
        hub.close()

    def _cycle(self, target: MotorTarget | None, ms: int) -> None:
        for _ in range(ms // CYCLE_MS):
            for _ in range(CYCLE_MS):
                self.torques.append(self.rig.step()[list(AXES)].copy())
            reading = self.driver.read(0.0)
            if reading is not None:
                self.status = reading.status
            if target is not None:
                self.driver.write(target)


Runner = Callable[[Iterable[int]], Run]


@pytest.fixture
def run(shed: Shed) -> Runner:
    """Return how to make a run in which frames are lost."""
    return lambda lost: Run(shed, lost)


def excess(torques: list[np.ndarray]) -> np.ndarray:
    """Return by how much motors pull beyond HOLD's torque, the largest that is ever asked for."""
    wanted = np.array(HOLD.torque) + SPRING
    return np.maximum(0.0, np.abs(np.array(torques)) - np.abs(wanted)) / SPRING


def test_without_loss_the_drive_does_what_is_commanded(run: Runner) -> None:
    whole = run(())
    assert excess(whole.torques).max() < 1e-3
    wanted = np.array(HOLD.torque) + SPRING
    np.testing.assert_allclose(whole.torques[-1], wanted, atol=2e-3)
    np.testing.assert_allclose(whole.torques[-DAMP_MS - 10], wanted, atol=2e-3)
    assert not np.array(whole.torques[: whole.held_ms]).any()


def test_no_single_lost_frame_is_felt_for_longer_than_three_cycles(run: Runner) -> None:
    whole = run(())
    for lost in range(ENTERING, whole.frames):
        torques = run((lost,)).torques
        differs = np.abs(np.array(torques) - np.array(whole.torques)).max(axis=1) > 2e-3
        assert np.count_nonzero(differs) <= 3 * CYCLE_MS, f"frame {lost}"
        assert excess(torques).max() < EXCESS_MAX, f"frame {lost}"
        assert not differs[-1], f"frame {lost}"


def test_no_lost_frame_of_arming_gives_a_torque_before_a_target(run: Runner) -> None:
    for lost in range(ENTERING):
        each = run((lost,))
        before = np.array(each.torques[: each.held_ms])
        assert np.abs(before).max() < 1e-3, f"frame {lost}"
        assert each.status is DriveStatus.ARMED, f"frame {lost}"
        assert each.rig.states == [AxisState.CLOSED_LOOP_CONTROL] * 2
        np.testing.assert_allclose(each.torques[-1], np.array(HOLD.torque) + SPRING, atol=2e-3)


def test_no_pair_of_lost_frames_adds_more_or_lasts(run: Runner) -> None:
    frames = run(()).frames
    pairs = list(itertools.combinations(range(min(frames, 60)), 2))
    pairs += list(itertools.combinations(range(frames - 55, frames - 25), 2))
    for lost in random.Random(0).sample(pairs, 40):
        each = run(lost)
        assert excess(each.torques).max() < EXCESS_MAX, f"frames {lost}"
        np.testing.assert_allclose(
            each.torques[-1], np.array(HOLD.torque) + SPRING, atol=2e-3, err_msg=f"frames {lost}"
        )
