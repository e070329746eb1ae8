"""A second planner by accident: the first leads on, and when either ends the other leads."""

from __future__ import annotations

from typing import Any

import pytest

from services.planner.planner import Planner
from shared.bus import topics
from shared.bus.messages import JointState, Message, Mode, PlannerMode
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Kill
from shared.joints import MODULE_INDEX, MODULES
from tests.lockstep.runs import kill, led_to, modes_of, restart
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep, begin_standing

SECOND = 99


def lost(link: str, seconds: float) -> dict[str, Any]:
    return {"inject": (Inject(link=link, at=1.0, duration=seconds, partition=True),)}


def held_up(to_s: float) -> dict[str, Any]:
    """Return what stops the first planner from 1 s on."""
    stopped = (Kill(service="planner", at=1.0, signal="STOP"),)
    return {"kill": stopped, "restart": restart(to_s)}


class TwoPlanners(Lockstep):
    """A second planner hears the same states and sends on the same keys, for a part of the run."""

    def __init__(
        self, robot: RobotConfig, duration: float, begin_s: float, end_s: float, **happens: Any
    ) -> None:
        """Squat; the second planner lives from `begin_s` to `end_s`."""
        squat = led_to((2.0, 1.0), (4.0, 1.188), (6.0, 1.0), duration=duration, **happens)
        super().__init__(robot, squat, record=self._hear)
        self.second: Planner | None = None
        self.begin_s, self.end_s = begin_s, end_s
        self.sent = self.announced = 0
        """Commands of the second planner that a module might use, and those that none can."""
        self.accepted: list[tuple[float, tuple[int, ...]]] = []
        """Scenario time and each module's session, whenever one changes."""

    def advance(self) -> None:
        """Go on by one step of the world."""
        super().advance()
        at_s = self.world.scenario_s
        if not self.begin_s <= at_s < self.end_s:
            self.second = None
        elif self.second is None:
            self.second = Planner(self.config, SECOND)
        if self.second is not None and self.second.is_due(self.now_ns):
            for name, command in zip(MODULES, self.second.tick(self.now_ns), strict=False):
                self.network.links[f"planner->{name}"].put(self.now_ns, command)
                age_ms = (self.now_ns - command.echo_t_ns) / NS_PER_MS
                usable = age_ms <= self.config.joint_service.max_command_age_ms
                self.sent += usable
                self.announced += not usable
        sessions = tuple(controller.failsafe.session for controller in self.controllers)
        if not self.accepted or self.accepted[-1][1] != sessions:
            self.accepted.append((at_s, sessions))

    def _hear(self, topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_STATE and self.second is not None:
            assert isinstance(message, JointState)
            self.second.receive_state(MODULE_INDEX[module], message, self.now_ns)

    def to_the_end(self, *, stands: bool = True) -> list[tuple[int, ...]]:
        """Run, and end with all six in TRACK; return the modules' sessions after the begin."""
        assert not stands or begin_standing(self)
        for row in self.run():
            assert not row.fallen, f"{row.scenario_s:.2f} s"
        assert row.scenario_s > self.scenario.duration - 0.1
        assert set(modes_of(self)) == {Mode.TRACK}
        return [sessions for at_s, sessions in self.accepted if at_s > 0.1]


@pytest.mark.parametrize(
    ("link", "seconds", "begin_s"),
    [("planner->knee_left", 0.06, 0.5), ("planner->joints", 0.06, 0.5),
     ("planner->joints", 0.3, 1.1)],
    ids=["of one knee", "of all", "it starts in a gap"],
)  # fmt: skip
def test_60_ms_of_loss_give_the_second_planner_no_module(
    link: str, seconds: float, begin_s: float
) -> None:
    """It took one knee for good, while the others followed the first.

    In a gap it caught some modules, and neither led any more: it waits.
    """
    fleet = TwoPlanners(ROBOT, 3.5, begin_s, 3.0, **lost(link, seconds))
    followed = fleet.to_the_end()
    assert fleet.sent == 0
    if begin_s < 1.0:
        assert followed == []
        assert 0 < fleet.announced <= 6 * 5 * 2.6, "it makes itself known five times a second"


def test_when_the_first_ends_the_second_leads() -> None:
    fleet = TwoPlanners(ROBOT, 5.0, 0.5, 9.0, kill=kill(1.5))
    followed = fleet.to_the_end()
    assert fleet.second is not None
    assert fleet.second.status(fleet.now_ns, 0.0).mode == PlannerMode.LEADING
    assert set(followed[-1]) == {fleet.second.session}


@pytest.mark.parametrize(
    ("until_s", "other_ends_s", "seconds"),
    [(3.5, 5.0, 7.5), (4.0, 3.5, 6.0)],
    ids=["it sees the other", "it never sees it"],
)
def test_one_that_was_held_up_leads_again_when_the_other_has_ended(
    until_s: float, other_ends_s: float, seconds: float
) -> None:
    """Its session was retired, and all stayed in HOLD: they refused it for good."""
    fleet = TwoPlanners(ROBOT, seconds, 0.5, other_ends_s, **held_up(until_s))
    led = [sessions for sessions in fleet.to_the_end() if len(set(sessions)) == 1]
    assert fleet.sent > 0
    assert led[-2][0] >= SECOND, "the second led while the first was held up"
    assert fleet.planner is not None
    assert led[-1] == fleet.accepted[-1][1] == (fleet.planner.session,) * 6


def test_two_that_start_at_once_agree_on_one() -> None:
    fleet = TwoPlanners(ROBOT, 1.5, -100.0, 9.0)
    assert fleet.to_the_end(stands=False) == []
    assert len(set(fleet.accepted[-1][1])) == 1
