"""The limits of a jog are taken back."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path

import can
import msgspec
import pytest

from shared.can import cansimple
from shared.can.cansimple import Command
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted
from tools.bringup import drive_limits
from tools.bringup.boards import FoundBoards

MODULE = "knee_left"
SERIAL = "3A0000000005"
SMALL = {"axis0.controller.config.vel_limit": 3.0, "axis1.motor.config.current_lim": 3.5}


class Link:
    """A CAN link that keeps what it is given."""

    def __init__(self, *_: object) -> None:
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
    monkeypatch.setattr(drive_limits, "CanLink", lambda *_: link)
    return link


def test_over_can_both_axes_get_the_robot_files_limits_more_than_once(
    robot: RobotConfig, link: Link
) -> None:
    drive_limits.give_back(robot, MODULE, Path("/nowhere"))
    wanted = (robot.drive.vel_limit, robot.drive.current_lim)
    for node in robot.module_named(MODULE).node_ids:
        found = [
            cansimple.unpack_two_floats(bytes(message.data))
            for message in link.sent
            if message.arbitration_id == cansimple.arbitration_id(node, Command.SET_LIMITS)
        ]
        assert found == [pytest.approx(wanted)] * drive_limits.TIMES
    assert len(link.sent) == 2 * drive_limits.TIMES, "and nothing else"
    assert not link.open


def test_a_bus_that_is_gone_is_reported(robot: RobotConfig, link: Link) -> None:
    link.open = False
    with pytest.raises(DriveError, match="takes no frames"):
        drive_limits.give_back(robot, MODULE, Path("/nowhere"))


@pytest.fixture
def on_usb(robot: RobotConfig, monkeypatch: pytest.MonkeyPatch) -> tuple[RobotConfig, FoundBoards]:
    found = FoundBoards({SERIAL: BoardInMemory(as_wanted() | SMALL)}, {}, ())

    @contextmanager
    def boards(*_: object):  # type: ignore[no-untyped-def]
        yield found

    monkeypatch.setattr(drive_limits, "boards_on_usb", boards)
    service = msgspec.structs.replace(robot.joint_service, driver="odrive_usb")
    return msgspec.structs.replace(robot, joint_service=service), found


def test_over_usb_they_are_written_and_read_back(on_usb: tuple[RobotConfig, FoundBoards]) -> None:
    robot, found = on_usb
    board = found.boards[SERIAL]
    assert isinstance(board, BoardInMemory)
    drive_limits.give_back(robot, MODULE, Path("/nowhere"))
    assert board.now == as_wanted()
    assert board.saves == 0, "a board that saves restarts, and has lost its zero"
    board.now |= SMALL
    board.deaf.add("axis0.controller.config.vel_limit")
    with pytest.raises(DriveError, match="did not keep"):
        drive_limits.give_back(robot, MODULE, Path("/nowhere"))


def test_a_board_that_has_gone_is_reported(on_usb: tuple[RobotConfig, FoundBoards]) -> None:
    robot, found = on_usb
    found.boards.clear()
    with pytest.raises(DriveError, match=f"{SERIAL}: not there"):
        drive_limits.give_back(robot, MODULE, Path("/nowhere"))
