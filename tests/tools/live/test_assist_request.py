"""A request for assist against a planner that the test plays."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from rich.text import Text

from shared.bus.messages import STRAIGHT, OperatorIntent, PlannerMode, PlannerStatus, Vector4
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from tests.messages import planner_status
from tools.live import assist_request as assist

WISH = OperatorIntent(t_ns=1, seq=0, assist_n=80.0, shift=(0.02, 0.0, 0.0, 0.0), source="me")


class FakePlanner:
    """Says what `answer` makes of the intents so far."""

    def __init__(self, answer: Callable[[list[OperatorIntent]], PlannerStatus | None]) -> None:
        self.heard: list[OperatorIntent] = []
        self.lines: list[str] = []
        self._answer = answer

    def put(self, message: OperatorIntent) -> bool:
        self.heard.append(message)
        return True

    def take(self) -> PlannerStatus | None:
        return self._answer(self.heard)

    def update(self, renderable: Text) -> None:
        self.lines.append(renderable.plain)


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let time pass while the verb sleeps, and no more: no machine stalls here."""
    now_s = [1000.0]
    clock = SimpleNamespace(
        monotonic=lambda: now_s[0], sleep=lambda s: now_s.__setitem__(0, now_s[0] + s)
    )
    monkeypatch.setattr(assist, "time", clock)


def status(requested_by: str, given: float = 0.0) -> PlannerStatus:
    return planner_status(requested_by=requested_by, assist_n=given)


def test_it_asks_until_it_is_stopped_and_reports_what_is_given() -> None:
    def answer(heard: list[OperatorIntent]) -> PlannerStatus:
        return status("me", 80.0) if len(heard) > 2 else status(SCENARIO)

    planner = FakePlanner(answer)
    given = assist.ask(planner, planner, WISH, lambda: len(planner.heard) > 20, planner)
    assert given == 80.0
    assert {(each.assist_n, each.shift, each.source) for each in planner.heard} == {
        (80.0, WISH.shift, "me")
    }
    numbers = [each.seq for each in planner.heard]
    assert numbers == sorted(set(numbers))
    assert "requested 80 N, given 80 N, shift x 0.02 m" in planner.lines[-1]


def test_it_ends_by_itself_after_the_time_it_was_given() -> None:
    planner = FakePlanner(lambda heard: status("me" if heard else "", 80.0))
    assert assist.ask(planner, planner, WISH, lambda: False, planner, for_s=0.02) == 80.0


@pytest.mark.parametrize(
    ("follows", "said"),
    [
        ("xrl lead by ada (7)", r"xrl lead by ada \(7\) asks already"),
        (SCENARIO, "does not take what is asked; it follows the scenario"),
        (None, "the planner is silent"),
    ],
)
def test_a_request_that_is_not_followed_ends_in_words(follows: str | None, said: str) -> None:
    planner = FakePlanner(lambda _: None if follows is None else status(follows))
    with pytest.raises(FleetError, match=said):
        assist.ask(planner, planner, WISH, lambda: False, planner)
    assert bool(planner.heard) is (follows == SCENARIO), "one who asks already goes on"


def test_why_it_is_not_given_is_shown() -> None:
    mode = int(PlannerMode.TRIPPED)
    holds = planner_status(requested_by="me", mode=mode, why="the torso turns fast")
    assert "TRIPPED: the torso turns fast" in assist.describe(WISH, holds)


@pytest.mark.parametrize(
    ("force", "shift", "said"),
    [
        (-1.0, STRAIGHT, "0 to 200 N"),
        (201.0, STRAIGHT, "0 to 200 N"),
        (float("nan"), STRAIGHT, "0 to 200 N"),
        (0.0, (0.031, 0.0, 0.0, 0.0), "x 0.031 m: -0.03 to 0.03 m"),
        (0.0, (0.0, 0.0, 0.0, -0.2), "yaw -0.2 rad"),
    ],
)
def test_what_the_planner_would_not_give_is_refused(
    robot: RobotConfig, force: float, shift: Vector4, said: str
) -> None:
    with pytest.raises(FleetError, match=said):
        assist.refuse_beyond_limits(robot, force, shift)


def test_the_limits_themselves_can_be_asked_for(robot: RobotConfig) -> None:
    x, y, roll, yaw = robot.law.shift_max
    assist.refuse_beyond_limits(robot, robot.assist.force_max, (x, -y, roll, -yaw))
