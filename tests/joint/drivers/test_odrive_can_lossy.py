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

from services.joint.drivers.base import MotorTarget
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState, ControlMode
from shared.can.unix_can import Frame
from tests.joint.drivers.rig import AXES, DRIVE, TARGET, Line, Shed

ARMED = [AxisState.CLOSED_LOOP_CONTROL] * 2
ASK_EVERY_MS = 500
"""How often a joint service repeats a request that has shown no effect."""


class LossyHub(UnixCanHub):
    """A bus on which every frame to a drive, and every packet of the drives, may be lost."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.dice = random.Random(0)
        self.lost = 0

    def poll(self) -> list[Frame]:
        return [frame for frame in super().poll() if not self._loses()]

    def broadcast_packet(self, packet: bytes) -> None:
        for at in range(0, len(packet), 16):
            if not self._loses():
                super().broadcast_packet(packet[at : at + 16])

    def _loses(self) -> bool:
        loses = self.dice.random() < 0.3
        self.lost += loses
        return loses


@pytest.fixture(params=itertools.product(range(3), ["0.5", "0.6"]))
def line(request: pytest.FixtureRequest, shed: Shed) -> Iterator[Line]:
    seed, dialect = request.param
    line = Line(shed, LossyHub, dialect=dialect)
    line.hub.dice.seed(seed)
    yield line
    assert line.hub.lost > 10


def until_armed(line: Line, *, onboard: bool) -> None:
    """Ask until the drive is armed, as a joint service does."""
    for _ in range(20):
        line.driver.arm(onboard=onboard)
        for _ in range(ASK_EVERY_MS // 2):
            line.cycle()
            if not onboard:
                line.driver.write_torque((0.0, 0.0))
            if line.status is DriveStatus.ARMED:
                return


@pytest.mark.parametrize("onboard", [True, False])
def test_modes_limits_gains_and_targets_arrive(line: Line, onboard: bool) -> None:
    bank, axes = line.rig.bank, list(AXES)
    bank.control_mode[:] = ControlMode.POSITION
    line.run(100)
    until_armed(line, onboard=onboard)
    for _ in range(600):
        line.cycle()
        line.driver.write(TARGET) if onboard else line.driver.write_torque((0.25, -0.5))
    assert (line.rig.states, line.status) == (ARMED, DriveStatus.ARMED)
    mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
    assert list(bank.control_mode[axes]) == [mode] * 2
    arrived = [(bank.vel_limit, DRIVE.vel_limit), (bank.current_lim, DRIVE.current_lim)]
    if onboard:
        arrived += [(bank.pos_gain, TARGET.pos_gain), (bank.vel_gain, TARGET.vel_gain)]
        arrived += [(bank.input_pos, TARGET.pos_turns), (bank.input_vel, TARGET.vel_turns)]
        arrived += [(bank.input_torque, TARGET.torque), (bank.vel_integrator_gain, (0.0, 0.0))]
    else:
        arrived += [(bank.input_torque, (0.25, -0.5))]
    for found, wanted in arrived:
        np.testing.assert_allclose(found[axes], wanted, rtol=1e-6)


def test_an_axis_that_disarms_shows_and_a_drive_that_is_idled_until_it_is_idle_ends_idle(
    line: Line,
) -> None:
    line.run(100)
    until_armed(line, onboard=True)
    line.run(300, TARGET)
    line.rig.bank.inject("hip_right.axis1", "DISARM")
    line.run(100, TARGET)
    assert line.status is DriveStatus.ERROR
    until_armed(line, onboard=True)
    assert line.rig.states == ARMED
    for _ in range(12):
        line.driver.idle()
        line.run(100)
    assert line.rig.states == [AxisState.IDLE] * 2


def test_the_dialect_is_found_and_never_the_wrong_one(line: Line) -> None:
    truth = "0.6" if line.rig.front._dialect.sdo is not None else "0.5"
    for _ in range(400):
        line.cycle()
        assert line.driver.dialect in ("", truth)
        assert line.status is not DriveStatus.ERROR or line.driver.dialect == ""
    assert line.driver.dialect == truth


# ---- each frame lost, one after the other

HERE = (0.1, -0.2)
HOLD = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.2, -0.1), (60.0, 40.0), (0.2, 0.3))
SPRING = np.array([60.0 * 0.2 * 0.05, 40.0 * 0.3 * 0.05])
HELD = np.array(HOLD.torque) + SPRING
DAMP = MotorTarget((0.15, -0.15), (0.0, 0.0), (0.8, 0.5), (0.0, 0.0), (0.4, 0.4))
"""With HOLD's spring, at this position, as torque."""
HOLD_MS, DAMP_MS, LISTEN_MS, CYCLE_MS = 40, 40, 20, 2
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
        line = self.line = Line(shed, DroppingHub)
        line.rig.pos[list(AXES)] = HERE
        line.run(LISTEN_MS)
        line.torques.clear()
        line.rig.front.receive()  # where it is, which was asked before: no frame of an order
        line.hub.lost, line.hub.count = frozenset(lost), 0
        line.driver.arm(onboard=True)
        for _ in range(200):
            if line.status is DriveStatus.ARMED:
                break
            line.cycle()
        else:
            line.driver.arm(onboard=True)  # as the joint service does, 500 ms later
            line.run(LISTEN_MS)
        self.held_ms = len(line.torques)
        line.run(HOLD_MS, HOLD)
        line.run(DAMP_MS, DAMP)
        self.frames, self.torques = line.hub.count, np.array(line.torques)
        line.driver.close()
        line.hub.close()

    @property
    def excess(self) -> float:
        """By how much motors pull beyond HOLD's torque, the largest that is ever asked for."""
        return float((np.maximum(0.0, np.abs(self.torques) - np.abs(HELD)) / SPRING).max())


Runner = Callable[[Iterable[int]], Run]


@pytest.fixture
def run(shed: Shed) -> Runner:
    """Return how to make a run in which frames are lost."""
    return lambda lost: Run(shed, lost)


def test_no_single_lost_frame_is_felt_for_longer_than_three_cycles(run: Runner) -> None:
    whole = run(())
    assert whole.excess < 1e-3, "without loss the drive does what is commanded"
    for ms in (-1, -DAMP_MS - 10):
        np.testing.assert_allclose(whole.torques[ms], HELD, atol=2e-3)
    assert not whole.torques[: whole.held_ms].any()
    for lost in range(ENTERING, whole.frames):
        each = run((lost,))
        differs = np.abs(each.torques - whole.torques).max(axis=1) > 2e-3
        assert np.count_nonzero(differs) <= 3 * CYCLE_MS, f"frame {lost}"
        assert each.excess < EXCESS_MAX, f"frame {lost}"
        assert not differs[-1], f"frame {lost}"


def test_no_lost_frame_of_arming_gives_a_torque_before_a_target(run: Runner) -> None:
    for lost in range(ENTERING):
        each = run((lost,))
        assert np.abs(each.torques[: each.held_ms]).max() < 1e-3, f"frame {lost}"
        assert each.line.status is DriveStatus.ARMED, f"frame {lost}"
        assert each.line.rig.states == ARMED
        np.testing.assert_allclose(each.torques[-1], HELD, atol=2e-3)


def test_no_pair_of_lost_frames_adds_more_or_lasts(run: Runner) -> None:
    frames = run(()).frames
    pairs = list(itertools.combinations(range(min(frames, 60)), 2))
    pairs += list(itertools.combinations(range(frames - 55, frames - 25), 2))
    for lost in random.Random(0).sample(pairs, 40):
        each = run(lost)
        assert each.excess < EXCESS_MAX, f"frames {lost}"
        np.testing.assert_allclose(each.torques[-1], HELD, atol=2e-3, err_msg=f"frames {lost}")
