"""The end of an emergency stop: all six modules together, or none of them."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from services.joint.rearm_guard import LastState, RearmGuard, path_of
from shared.bus.messages import DriveStatus, JointState, Mode
from shared.exceptions import FleetError
from shared.joints import MODULES
from tests.messages import sample
from tools.fleet import procfs
from tools.fleet.rearming import hindrance
from tools.fleet.supervise import SupervisedFleet

HERE = {*MODULES, "planner"}


def states(**others: tuple[Mode, DriveStatus]) -> dict[str, JointState]:
    """Return six modules in DAMP with armed drives, but for some."""
    found = dict.fromkeys(MODULES, (Mode.DAMP, DriveStatus.ARMED)) | others
    return {
        module: sample(JointState, mode=int(mode), drive=int(drive))
        for module, (mode, drive) in found.items()
    }


@pytest.mark.parametrize(
    "other", [(Mode.DAMP, DriveStatus.ARMED), (Mode.HOLD, DriveStatus.ARMED),
              (Mode.TRACK, DriveStatus.ARMED), (Mode.DISARMED, DriveStatus.HOLDING)],
)  # fmt: skip
def test_a_stop_ends_where_all_six_bear_their_load(other: tuple[Mode, DriveStatus]) -> None:
    assert hindrance(states(knee_left=other), [], HERE, planner=True) == ""


@pytest.mark.parametrize(
    ("mode", "drive"),
    [(Mode.FAULT, DriveStatus.IDLE), (Mode.FAULT, DriveStatus.LOST), (Mode.DAMP, DriveStatus.IDLE),
     (Mode.DISARMED, DriveStatus.UNZEROED)],
)  # fmt: skip
def test_beside_a_module_without_torque_none_is_rearmed(mode: Mode, drive: DriveStatus) -> None:
    why = hindrance(states(knee_left=(mode, drive)), [], HERE, planner=True)
    assert why.startswith(f"knee_left is in {mode.name}, its drive is {drive.name}; hang the robot")


def test_none_is_rearmed_while_it_moves_or_is_pulled_or_one_is_missing() -> None:
    six = states()
    five = {module: state for module, state in six.items() if module != "hip_left"}
    tracking = states(**dict.fromkeys(MODULES, (Mode.TRACK, DriveStatus.ARMED)))
    assert "no state from hip_left" in hindrance(five, [], HERE, planner=True)
    assert "knee_left still moving" in hindrance(six, ["knee_left"], HERE, planner=True)
    assert "no service of hip_left" in hindrance(six, [], HERE - {"hip_left"}, planner=True)
    assert "150 N on the harness" in hindrance(six, [], HERE, 150.0, planner=True)
    assert hindrance(six, [], HERE, 39.0, planner=True) == ""
    assert "needs a planner" in hindrance(six, [], HERE, planner=False)
    assert "no module is in DAMP" in hindrance(tracking, [], HERE, planner=True)


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SupervisedFleet:
    for module in MODULES:
        RearmGuard(tmp_path, module).write(LastState.DAMP)
    found = SupervisedFleet(tmp_path)
    monkeypatch.setattr(found, "supervision_fault", lambda: "")
    monkeypatch.setattr(found, "pids", lambda: {m: at for at, m in enumerate(MODULES, 1000)})
    return found


def last_states(fleet: SupervisedFleet) -> list[LastState]:
    return [RearmGuard(fleet.run.path, module).read() for module in MODULES]


def test_all_six_are_ended_at_once_and_forget_the_stop(
    fleet: SupervisedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[int], int]] = []
    monkeypatch.setattr(procfs, "signal_all", lambda pids, number: asked.append((pids, number)))
    fleet.restart_together(MODULES)
    assert asked == [(list(range(1000, 1006)), signal.SIGKILL)]
    assert last_states(fleet) == [LastState.NOTHING] * 6


@pytest.mark.parametrize("why", ["no supervisor", "one without a process", "a file unwritable"])
def test_if_one_cannot_be_restarted_none_is(
    why: str, fleet: SupervisedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(procfs, "signal_all", lambda *_: pytest.fail("signalled"))
    left = list(MODULES)
    if why == "no supervisor":
        monkeypatch.setattr(fleet, "supervision_fault", lambda: "the supervisor is gone")
    elif why == "one without a process":
        monkeypatch.setattr(fleet, "pids", lambda: dict.fromkeys(MODULES[:5], 1000))
    else:
        last = path_of(fleet.run.path, left.pop())
        last.unlink()
        last.mkdir()
    with pytest.raises((FleetError, IsADirectoryError)):
        fleet.restart_together(MODULES)
    assert {RearmGuard(fleet.run.path, module).read() for module in left} == {LastState.DAMP}
