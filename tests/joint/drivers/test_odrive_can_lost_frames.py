"""Each frame to a drive lost, one after the other: what its motors then do beyond what they should.

A drive is armed, holds, and is put into DAMP's law: every spring is gone at once, and its torque
comes as feedforward. The joint stands still, so that each difference is the lost frame's.
"""

from __future__ import annotations

import itertools
import random
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from services.joint.drivers import can_link, odrive_can
from services.joint.drivers.base import DriveStatus, MotorTarget
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can.cansimple import AxisState
from shared.can.unix_can import Frame
from shared.clock import NS_PER_MS
from tests.joint.drivers.rig import AXES, Rig, make_driver

HERE = (0.1, -0.2)
HOLD = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.2, -0.1), (60.0, 40.0), (0.2, 0.3))
SPRING = np.array([60.0 * 0.2 * 0.05, 40.0 * 0.3 * 0.05])
DAMP = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.8, 0.5), (0.0, 0.0), (0.4, 0.4))
"""With HOLD's spring, at this position, as torque."""
HOLD_MS, DAMP_MS = 40, 40
CYCLE_MS = 2
LISTEN_MS = 20
EXCESS_MAX = 1.02 * 0.4 / 0.2
"""Of the spring: HOLD's pos_gain, if it is DAMP's that was lost, with DAMP's vel_gain."""
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


class Clock:
    """The time of the rig that runs."""

    rig: Rig | None = None

    def now_ns(self) -> int:
        return NS_PER_MS + (round(self.rig.now_s * 1e9) if self.rig is not None else 0)


class Run:
    """One run with some frames lost, in its own time.

    Attributes:
        torques: of both motors, in each millisecond since arming was asked for.
        frames: how many went to the drive.
        held_ms: when HOLD was first written.
    """

    def __init__(self, folder: Path, lost: Iterable[int], clock: Clock) -> None:
        path = folder / "can.sock"
        self.rig = clock.rig = Rig(path, hub=DroppingHub)
        hub = self.rig.hub
        assert isinstance(hub, DroppingHub)
        bank = self.rig.bank
        bank.vel_limit[:], bank.current_lim[:] = 2.0, 10.0  # as shipped
        bank.pos_gain[:], bank.vel_gain[:], bank.vel_integrator_gain[:] = 20.0, 1 / 6, 1 / 3
        self.rig.pos[list(AXES)] = HERE
        self.torques: list[np.ndarray] = []
        self.status = DriveStatus.LOST
        self.held_ms = 0
        self.driver = make_driver(path)
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
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Runner]:
    """Return how to make a run in which frames are lost."""
    clock = Clock()
    for module in (odrive_can, can_link):
        monkeypatch.setattr(module, "now_ns", clock.now_ns)
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    yield lambda lost: Run(folder, lost, clock)
    shutil.rmtree(folder)


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
        assert [each.rig.bank.state[axis] for axis in AXES] == [AxisState.CLOSED_LOOP_CONTROL] * 2
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
