"""What a page may do to a live fleet, and what it may not."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from shared.bus.topics import VIEWER
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tests.certified import certified, install_all
from tools.fleet import process_table
from tools.verbs import view
from tools.view.frame import Order
from tools.view.live import LiveOrders, LiveSource

REAL = ("planner", "knee_left", "recorder")
SIMULATED = ("simulator", *REAL)


class Fleet:
    """A fleet that writes down what is asked of it."""

    def __init__(self, services: tuple[str, ...]) -> None:
        self.manifest = SimpleNamespace(services=services)
        self.run = SimpleNamespace(path=Path("/tmp/nowhere"))
        self.asked: list[tuple[str, ...]] = []

    def kill(self, service: str, number: int) -> None:
        process_table.check_known([service], self.manifest.services)
        if service == "recorder":
            raise ProcessLookupError(3, "No such process")
        self.asked.append(("kill", service, str(int(number))))

    def forget(self, service: str) -> str:
        self.asked.append(("forget", service))
        return ""

    def crash_loop(self, _service: str) -> str:
        return ""

    def start_service(self, service: str) -> None:
        self.asked.append(("start", service))


def orders_of(robot: RobotConfig, fleet: Any) -> LiveOrders:
    return LiveOrders(robot, fleet, lambda: 1.0)


def test_hand_and_push_are_for_a_simulator_and_cuts_for_a_network_proxy(robot: RobotConfig) -> None:
    assert set(orders_of(robot, Fleet(REAL)).orders) == {"estop", "kill", "freeze", "start"}
    simulated = orders_of(robot, Fleet((*SIMULATED, "network_proxy")))
    assert {"hand", "push", "cut"} <= set(simulated.orders)
    said = orders_of(robot, Fleet(REAL)).carry_out(Order(order="hand", height=1.0))
    assert "'hand' is not an order here; must be one of estop" in said


def test_a_joint_service_is_killed_so_that_its_next_process_may_arm(robot: RobotConfig) -> None:
    fleet = Fleet(REAL)
    orders = orders_of(robot, fleet)
    for order, service in (("kill", "knee_left"), ("freeze", "planner"), ("start", "planner")):
        assert orders.carry_out(Order(order=order, service=service)) == ""
    assert fleet.asked == [
        ("forget", "knee_left"), ("kill", "knee_left", "9"), ("kill", "planner", "19"),
        ("start", "planner"),
    ]  # fmt: skip


def test_what_cannot_be_done_is_said_in_words(robot: RobotConfig) -> None:
    orders = orders_of(robot, Fleet(SIMULATED))
    assert "no service 'cook'" in orders.carry_out(Order(order="kill", service="cook"))
    assert "No such process" in orders.carry_out(Order(order="kill", service="recorder"))
    assert "no link" in orders.carry_out(Order(order="hand", height=1.0))
    assert "through shared memory only" in orders.carry_out(Order(order="estop"))
    cutter = orders_of(robot, Fleet((*SIMULATED, "network_proxy")))
    assert "one of left leg" in cutter.carry_out(Order(order="cut", service="cable"))


def test_without_leave_a_page_only_looks(robot: RobotConfig) -> None:
    fleet: Any = Fleet(SIMULATED)
    source = LiveSource(robot, fleet)
    assert source.orders == ()
    for order in ("estop", "kill", "hand"):
        said = source.carry_out(Order(order=order, service="planner", height=1.0))
        assert "this page cannot act" in said
    assert fleet.asked == []


def test_a_viewers_key_may_not_act(robot: RobotConfig, tmp_path: Path) -> None:
    secured, made = certified(robot, tmp_path)
    install_all(made, tmp_path / "keys", VIEWER)
    with pytest.raises(FleetError, match="key of a viewer"):
        orders_of(secured, Fleet(REAL))
    assert LiveSource(secured, Fleet(REAL)).orders == (), "but look"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("terminal", "typed", "refusal"),
    [
        (True, "{name}", ""),
        (True, "yes", "not the name of this robot"),
        (True, "", "not the name of this robot"),
        (False, "{name}", "only after a person types"),
    ],
)
def test_a_real_robots_name_has_to_be_typed_in_a_terminal(
    robot: RobotConfig, terminal: bool, typed: str, refusal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr(view.Console, "input", lambda *_: typed.format(name=robot.name))
    refused = pytest.raises(FleetError, match=refusal)
    with refused if refusal else contextlib.nullcontext():
        view.confirm(robot)
