"""A second planner by accident: the first leads on, and when either ends the other leads."""

from __future__ import annotations

import pytest

from services.planner.planner import Planner
from shared.bus import topics
from shared.bus.messages import JointState, Message, Mode, PlannerMode, SimTruth
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Kill, Restart, Scenario
from shared.joints import MODULE_INDEX
from tests.lockstep.runs import kill, variant
from tools.sim.lockstep import Lockstep
from tools.sim.standing_start import begin_standing

SECOND = 99
SQUAT = (
    Keyframe(at=0.0, height=1.188),
    Keyframe(at=2.0, height=1.0),
    Keyframe(at=4.0, height=1.188),
    Keyframe(at=6.0, height=1.0),
)


def squat(duration: float, **changes: object) -> Scenario:
    return variant(
        "stand", **{"duration": duration, "keyframe": SQUAT, "kill": (), "push": ()} | changes
    )


def held_up(from_s: float, to_s: float) -> dict[str, object]:
    """Return what stops the first planner for a while."""
    return {
        "kill": (Kill(service="planner", at=from_s, signal="STOP"),),
        "restart": (Restart(service="planner", at=to_s),),
    }


class TwoPlanners(Lockstep):
    """A second planner hears the same states and sends on the same keys, for a part of the run."""

    def __init__(
        self, robot: RobotConfig, scenario: Scenario, begin_s: float, end_s: float
    ) -> None:
        """Begin as `Lockstep` does; the second planner lives from `begin_s` to `end_s`."""
        super().__init__(robot, scenario, record=self._hear)
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
        lives = self.begin_s <= at_s < self.end_s
        if not lives:
            self.second = None
        elif self.second is None:
            self.second = Planner(self.config, SECOND)
        if self.second is not None and self.second.is_due(self.now_ns):
            for index, command in enumerate(self.second.tick(self.now_ns)):
                self.network.commands()[index].put(self.now_ns, command)
                age_ms = (self.now_ns - command.echo_t_ns) / NS_PER_MS
                usable = age_ms <= self.config.joint_service.max_command_age_ms
                self.sent += usable
                self.announced += not usable
        sessions = tuple(controller._state.failsafe.session for controller in self.controllers)
        if not self.accepted or self.accepted[-1][1] != sessions:
            self.accepted.append((at_s, sessions))

    def _hear(self, topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_STATE and self.second is not None:
            assert isinstance(message, JointState)
            self.second.receive_state(MODULE_INDEX[module], message, self.now_ns)

    @property
    def modes(self) -> set[Mode]:
        return {controller.failsafe.mode for controller in self.controllers}


def run(fleet: TwoPlanners) -> list[SimTruth]:
    assert begin_standing(fleet)
    rows = []
    for row in fleet.run():
        assert not row.fallen, f"{row.scenario_s:.2f} s"
        rows.append(row)
    assert rows[-1].scenario_s > fleet.scenario.duration - 0.1
    return rows


def changes_after(fleet: TwoPlanners, at_s: float) -> list[tuple[float, tuple[int, ...]]]:
    return [row for row in fleet.accepted if row[0] > at_s]


@pytest.mark.parametrize("link", ["planner->knee_left", "planner->joints"])
def test_60_ms_of_loss_give_the_second_planner_no_module(robot: RobotConfig, link: str) -> None:
    """It took one knee for good, while the others followed the first."""
    lost = (Inject(link=link, at=1.0, duration=0.06, partition=True),)
    scenario = squat(5.0, inject=lost)
    fleet = TwoPlanners(robot, scenario, 0.5, 4.0)
    run(fleet)
    assert fleet.sent == 0
    assert 0 < fleet.announced <= 6 * 5 * 3.6, "it makes itself known five times a second"
    assert changes_after(fleet, 0.1) == []
    assert fleet.modes == {Mode.TRACK}


def test_when_the_first_ends_the_second_leads(robot: RobotConfig) -> None:
    scenario = squat(5.0, kill=kill(1.5))
    fleet = TwoPlanners(robot, scenario, 0.5, 9.0)
    run(fleet)
    assert fleet.modes == {Mode.TRACK}
    assert fleet.second is not None
    assert fleet.second.status(fleet.now_ns, 0.0).mode == PlannerMode.LEADING
    ((_, sessions),) = changes_after(fleet, 0.1)[-1:]
    assert set(sessions) == {fleet.second.session}


def test_one_that_was_held_up_lets_the_other_lead_and_leads_when_that_ends(
    robot: RobotConfig,
) -> None:
    """Its session was retired, and all stayed in HOLD."""
    scenario = squat(7.5, **held_up(1.0, 3.5))
    fleet = TwoPlanners(robot, scenario, 0.5, 5.0)
    run(fleet)
    led = [sessions for _, sessions in changes_after(fleet, 0.1) if len(set(sessions)) == 1]
    assert led[-2][0] >= SECOND, "the second led while the first was held up, and after"
    assert fleet.planner is not None
    assert led[-1] == (fleet.planner.session,) * 6
    assert fleet.modes == {Mode.TRACK}


def test_one_that_was_held_up_past_the_others_end_leads_again(robot: RobotConfig) -> None:
    """It never saw the other, for which all six had retired it: they refused it for good."""
    scenario = squat(6.0, **held_up(1.0, 4.0))
    fleet = TwoPlanners(robot, scenario, 0.5, 3.5)
    run(fleet)
    assert fleet.sent > 0
    assert fleet.planner is not None
    assert fleet.accepted[-1][1] == (fleet.planner.session,) * 6
    assert fleet.modes == {Mode.TRACK}


def test_a_second_one_that_starts_while_the_first_is_held_up_for_a_moment_waits(
    robot: RobotConfig,
) -> None:
    """It caught some modules in the gap, and neither led any more."""
    lost = (Inject(link="planner->joints", at=1.0, duration=0.3, partition=True),)
    scenario = squat(4.0, inject=lost)
    fleet = TwoPlanners(robot, scenario, 1.1, 9.0)
    run(fleet)
    assert fleet.sent == 0
    assert fleet.modes == {Mode.TRACK}


def test_two_that_start_at_once_agree_on_one(robot: RobotConfig) -> None:
    scenario = squat(3.0)
    fleet = TwoPlanners(robot, scenario, -100.0, 9.0)
    for row in fleet.run():
        assert not row.fallen
    assert fleet.world.scenario_s > 2.9
    assert fleet.modes == {Mode.TRACK}
    assert len(set(fleet.accepted[-1][1])) == 1
    assert changes_after(fleet, 0.1) == []
