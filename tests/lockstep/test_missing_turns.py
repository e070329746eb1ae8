"""A zero with turns missing is not kept: drawn motions, gaps, zeros and phases of heartbeats.

No physics: the motors move as the test draws it, and the drives and modules are the real ones.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from services.joint.differential import motor_from_joint
from services.joint.drive_manager import DriveCommand, DriveManager
from services.joint.drivers.base import DriveReading
from services.joint.drivers.wired_drive import MotorFrame, WiredDrive
from services.joint.rearm_guard import LastState
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_encoders import Words
from shared.bus.messages import DriveStatus
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES, kind_of
from tests.robots import ROBOT
from tools.sim.virtual_drive import VirtualDrive

PERIOD_NS = 2 * NS_PER_MS
BEAT_NS = 100 * NS_PER_MS
CYCLES = 700
FIRST, LAST = 150, 300
"""Cycles in which an encoder begins to be wrong, and after which it is right."""


class PhasedDrive(VirtualDrive):
    """A drive whose state and errors are seen with its heartbeats."""

    phase_ns = 0
    seen: tuple[DriveStatus, int] = (DriveStatus.IDLE, 0)

    def read(self, timeout_s: float) -> DriveReading | None:
        reading = super().read(timeout_s)
        if reading is None:
            return None
        if (reading.t_ns - self.phase_ns) % BEAT_NS < PERIOD_NS:
            self.seen = reading.status, reading.error
        return msgspec.structs.replace(reading, status=self.seen[0], error=self.seen[1])


def motion(dice: np.random.Generator, *, held: bool) -> NDArray[np.float64]:
    """Return an axis's way, turns, in each cycle: at rest, drawn, and at rest again."""
    most, fastest = (150.0, 15.0) if held else (300.0, 25.0)
    wanted = np.zeros(CYCLES)
    cycle = 60
    while cycle < LAST + 50:
        lasts = int(dice.integers(5, 80))
        wanted[cycle : cycle + lasts] = dice.uniform(-fastest, fastest)
        cycle += lasts
    speed, way, at = 0.0, np.zeros(CYCLES), 0.0
    for k in range(CYCLES):
        goal = float(wanted[k]) - 2.0 * at  # it stays about where it is
        speed += float(np.clip(goal - speed, -most * 2e-3, most * 2e-3))
        at += speed * 2e-3
        way[k] = at
    return way


def words(dice: np.random.Generator) -> list[Words]:
    """Return what an encoder's words are in each cycle."""
    found = [Words.TRUE] * CYCLES
    cycle = int(dice.integers(FIRST, LAST - 30))
    kind = dice.choice(["gaps", "zeros", "fails"], p=[0.6, 0.3, 0.1])
    for _ in range(int(dice.integers(1, 4)) if kind == "gaps" else 1):
        longest = {"gaps": 26, "zeros": 150, "fails": 150}[kind]
        lasts = int(dice.integers(1, longest))
        end = min(cycle + lasts, LAST)
        found[cycle:end] = [Words.ZERO if kind == "zeros" else Words.NONE] * (end - cycle)
        cycle = end + int(dice.integers(1, 30))
    return found


def draw(seed: int) -> list[tuple[bool, bool, bool]]:
    """Run six modules through motions with wrong words.

    Returns:
        for each whether it lacks turns, is zeroed, and is armed.
    """
    dice = np.random.default_rng(seed)
    counts, mark = ROBOT.joint.encoder_counts_per_turn, ROBOT.drive.zero_mark_turns
    bank = AxisBank(ROBOT.drive, encoder_counts_per_turn=counts, watchdog=False)
    now_ns = NS_PER_S
    held = [bool(dice.random() < 0.6) for _ in MODULES]
    drives, modules, true, wrong = [], [], np.zeros((CYCLES, 12)), []
    for i, name in enumerate(MODULES):
        drive = PhasedDrive(bank, i, ROBOT.drive, lambda: now_ns, counts_per_turn=counts)
        drive.phase_ns = int(dice.integers(0, BEAT_NS))
        drives.append(WiredDrive(drive, MotorFrame(mark)))
        last = LastState.NOTHING if held[i] else LastState.HELD
        modules.append(DriveManager(ROBOT, name, last))
        limit = getattr(ROBOT.limits, kind_of(name))
        q = (sum(limit.phi) / 2, sum(limit.theta) / 2)
        start = motor_from_joint(q, ROBOT.joint.gear_ratio)
        for axis in (0, 1):
            true[:, 2 * i + axis] = start[axis] + motion(dice, held=held[i])
        wrong.append((2 * i + int(dice.integers(0, 2)), words(dice)))
    vel = np.gradient(true, 2e-3, axis=0)
    for axis in range(12):
        bank.step(now_ns / NS_PER_S, true[0], np.zeros(12))
        bank.set_count(axis, (true[0, axis] + mark) * counts)
    for k in range(CYCLES):
        now_ns += PERIOD_NS
        for axis, said in wrong:
            if said[k] is not said[k - 1]:
                bank.conditions.read_encoder(axis, said[k])
        bank.step(now_ns / NS_PER_S, true[k], vel[k])
        for drive, module in zip(drives, modules, strict=True):
            act = module.step(now_ns, drive.read(0.0), None, estop=False)
            if act.target is not None:
                drive.write(act.target)
            elif act.command is DriveCommand.ARM:
                drive.arm(onboard=True)
            elif act.command is DriveCommand.CLEAR_ERRORS:
                drive.clear_errors()
            elif act.command is DriveCommand.IDLE:
                drive.idle()
            elif act.command is DriveCommand.CLEAR_ZERO:
                drive.set_position((-mark, -mark))
    zeroed = np.abs(bank.encoder_turns - mark).reshape(6, 2).max(axis=1) < 0.5 * mark
    off = np.abs(bank.encoder_turns - true[-1] - mark).reshape(6, 2).max(axis=1) > 0.5
    armed = [module.state.controller.estimate.status is DriveStatus.ARMED for module in modules]
    return list(zip(off | ~zeroed, zeroed, armed, strict=True))


@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 170), marks=pytest.mark.wide)], ids=["60", "960"]
)
def test_no_module_keeps_a_zero_with_turns_missing(seeds: range) -> None:
    missing, zeroed, armed = np.array([row for seed in seeds for row in draw(seed)]).T
    assert not (zeroed & missing).any()
    assert (~zeroed).mean() > 0.05
    assert armed.mean() > 0.05
