"""The emergency stop that needs no bus, in the joint service's loop."""

from __future__ import annotations

import getpass
from pathlib import Path

import pytest

from services.joint.rearm_guard import (
    PENDANT,
    SOURCE_MAX,
    Pendant,
    RearmGuard,
    clear,
    request_stop,
    stop_source,
)
from shared.bus.messages import Estop, Mode
from shared.config.robot_config import RobotConfig
from tests.joint.test_loop import Rig
from tools.fleet import emergency_stop

MODULE = "knee_right"


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


def test_the_first_named_source_of_a_stop_is_kept_until_a_person_asks_for_the_module(
    tmp_path: Path,
) -> None:
    guard = RearmGuard(tmp_path, MODULE)
    assert stop_source(tmp_path, MODULE) == ""
    guard.note_stop("")
    request_stop(tmp_path, MODULE, "xrl estop by anna")
    guard.note_stop("somebody else")
    assert stop_source(tmp_path, MODULE) == "xrl estop by anna"
    clear(tmp_path, MODULE)
    guard.note_stop("é" * SOURCE_MAX)
    assert stop_source(tmp_path, MODULE) == "é" * (SOURCE_MAX // 2)
    assert not guard.stop_requested, "a long name reaches nothing else"
    assert guard.beats == 0


@pytest.mark.parametrize("name", [KeyError("uid not found: 12345"), "l\udce9a"])
def test_a_user_without_a_name_or_with_a_broken_one_stops_the_robot_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: KeyError | str
) -> None:
    def who() -> str:
        if isinstance(name, KeyError):
            raise name
        return name

    monkeypatch.setattr(getpass, "getuser", who)
    guard = RearmGuard(tmp_path, MODULE)
    assert emergency_stop.request_here(tmp_path) == ([MODULE], [])
    assert guard.stop_requested
    assert stop_source(tmp_path, MODULE).startswith("xrl estop by ")


def test_the_source_of_a_stop_that_nobody_made_is_empty(tmp_path: Path) -> None:
    assert stop_source(tmp_path, MODULE) == ""


def test_a_stop_over_the_bus_is_told_by_its_sender_and_a_silent_pendant_by_itself(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rig = Rig(robot, monkeypatch, RearmGuard(tmp_path, MODULE))
    rig.run(20)
    rig.estops.waiting.append(Estop(t_ns=0, seq=1, source="anna"))
    rig.run(1)
    assert rig.mode is Mode.DAMP
    assert stop_source(tmp_path, MODULE) == "anna"
    clear(tmp_path, MODULE)
    held = Rig(robot, monkeypatch, RearmGuard(tmp_path, MODULE))
    Pendant(tmp_path, [MODULE]).beat()
    held.run(1000)
    assert held.mode is Mode.DAMP
    assert stop_source(tmp_path, MODULE) == PENDANT
