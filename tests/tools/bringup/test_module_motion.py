"""The limits of a motion are taken back."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import can
import pytest

from shared.can import cansimple
from shared.can.cansimple import Command
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted, with_driver
from tools.bringup import motion_runner
from tools.bringup.boards import FoundBoards

MODULE = "knee_left"
SERIAL = "3A0000000005"
NOWHERE = Path("/nowhere")
SMALL = {"axis0.controller.config.vel_limit": 3.0, "axis1.motor.config.current_lim": 3.5}


class Link:
    """A CAN link that keeps what it is given."""

    def __init__(self) -> None:
        self.open = True
        self.sent: list[can.Message] = []

    def connect(self) -> bool:
        return self.open

    def send(self, messages: Sequence[can.Message]) -> bool:
        self.sent += messages
        return True

    def receive(self, _timeout_s: float) -> tuple[()]:
        return ()

    def close(self) -> None:
        self.open = False


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Link:
    link = Link()
    monkeypatch.setattr(motion_runner, "CanLink", lambda *_: link)
    return link


def test_over_can_both_axes_get_the_robot_files_limits_more_than_once(
    robot: RobotConfig, link: Link
) -> None:
    motion_runner.give_back(robot, MODULE, NOWHERE)
    wanted = (robot.drive.vel_limit, robot.drive.current_lim)
    sent = [(m.arbitration_id, cansimple.unpack_two_floats(bytes(m.data))) for m in link.sent]
    ids = [
        cansimple.arbitration_id(node, Command.SET_LIMITS)
        for node in robot.module_named(MODULE).node_ids
    ]
    assert sorted(can_id for can_id, _ in sent) == sorted(ids * motion_runner.LIMITS_TIMES), (
        "nothing else"
    )
    assert all(limits == pytest.approx(wanted) for _, limits in sent)
    assert not link.open


def test_a_bus_that_is_gone_is_reported(robot: RobotConfig, link: Link) -> None:
    link.open = False
    with pytest.raises(DriveError, match="takes no frames"):
        motion_runner.give_back(robot, MODULE, NOWHERE)


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> FoundBoards:
    found = FoundBoards({SERIAL: BoardInMemory(as_wanted() | SMALL)}, {}, ())
    monkeypatch.setattr(motion_runner, "boards_on_usb", lambda *_: nullcontext(found))
    return found


@pytest.fixture
def on_usb(robot: RobotConfig) -> RobotConfig:
    return with_driver(robot, "odrive_usb")


def test_over_usb_they_are_written_and_read_back(on_usb: RobotConfig, found: FoundBoards) -> None:
    board = found.boards[SERIAL]
    assert isinstance(board, BoardInMemory)
    motion_runner.give_back(on_usb, MODULE, NOWHERE)
    assert board.now == as_wanted()
    assert board.saves == 0, "a board that saves restarts, and has lost its zero"
    board.now |= SMALL
    board.deaf.add("axis0.controller.config.vel_limit")
    with pytest.raises(DriveError, match="did not keep"):
        motion_runner.give_back(on_usb, MODULE, NOWHERE)


def test_a_board_that_has_gone_is_reported(on_usb: RobotConfig, found: FoundBoards) -> None:
    found.boards.clear()
    with pytest.raises(DriveError, match=f"{SERIAL}: not there"):
        motion_runner.give_back(on_usb, MODULE, NOWHERE)
