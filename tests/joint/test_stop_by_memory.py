"""The emergency stop that needs no bus, in the joint service's loop."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.joint.rearm_guard import RearmGuard, clear, request_stop
from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from tests.joint.test_loop import Rig


def test_a_stop_by_shared_memory_acts_in_the_next_cycle_of_a_service_without_a_bus(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rig = Rig(robot, monkeypatch, RearmGuard(tmp_path, "knee_right"))
    rig.run(20)
    assert rig.controller.failsafe.mode is Mode.HOLD
    request_stop(tmp_path, "knee_right")
    rig.run(1)
    assert rig.controller.failsafe.mode is Mode.DAMP
    crashed = Rig(robot, monkeypatch, RearmGuard(tmp_path, "knee_right"))
    crashed.run(20)
    assert crashed.controller.failsafe.mode in (Mode.DAMP, Mode.FAULT)
    assert crashed.drive.armed == 0, "nobody has asked for it"
    clear(tmp_path, "knee_right")
    asked_for = Rig(robot, monkeypatch, RearmGuard(tmp_path, "knee_right"))
    asked_for.run(20)
    assert asked_for.controller.failsafe.mode is Mode.HOLD
