"""Joint services that began to count at different times send their states in the same period."""

from __future__ import annotations

import pytest

from services.planner.state_phases import COMPARED_TICKS
from shared.bus import topics
from shared.bus.messages import JointState, Message
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Restart
from shared.joints import MODULES
from tests.lockstep.runs import variant
from tools.sim.lockstep import Lockstep


class Sent:
    """When each module sent its last states."""

    def __init__(self) -> None:
        self.at: dict[str, list[int]] = {name: [] for name in MODULES}

    def __call__(self, topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_STATE and isinstance(message, JointState):
            self.at[module].append(message.t_ns)

    def spread_ns(self) -> int:
        last = [times[-1] for times in self.at.values()]
        return max(last) - min(last)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("skewed", [(1,), (0, 2, 4), (1, 2, 3, 4, 5)])
def test_after_one_comparison_all_six_are_in_step_and_stay_so_with_the_next_planner(
    robot: RobotConfig, skewed: tuple[int, ...]
) -> None:
    sent = Sent()
    scenario = variant(
        "stand",
        duration=4.0,
        kill=(Kill(service="planner", at=1.0),),
        restart=(Restart(service="planner", at=2.0),),
        push=(),
    )
    fleet = Lockstep(robot, scenario, record=sent)
    for index, joint in enumerate(fleet.joints):
        clock = joint.manager.controller._state.clock
        clock.count, clock.at_ns = 2 - (index in skewed), fleet.now_ns - 2_000_000
    begin_ns, spreads = fleet.now_ns, {}
    for row in fleet.run():
        assert not row.fallen
        if all(sent.at.values()):
            spreads[fleet.now_ns - begin_ns] = sent.spread_ns()
    compared_ns = (COMPARED_TICKS + 10) * NS_PER_S // 250
    assert max(spreads.values()) == 2_000_000, "they began out of step"
    assert {spread for at_ns, spread in spreads.items() if at_ns > compared_ns} == {0}
