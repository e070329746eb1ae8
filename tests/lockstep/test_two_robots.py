"""Two robots in one process, twelve joint services and two planners: neither knows of the other."""

from __future__ import annotations

from shared.bus.messages import SimTruth
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from tests.lockstep.runs import kill, restart, still
from tools.sim.lockstep import Lockstep
from tools.sim.standing_start import begin_standing

CALM = still(1.5, height=1.1)
HARD = still(1.5, height=1.0, kill=kill(0.4), restart=restart(0.9))


def fleet(robot: RobotConfig, scenario: Scenario, seed: int) -> Lockstep:
    network = Impairment(delay_ms=2.0, jitter_ms=1.0, loss=0.01)
    made = Lockstep(robot, scenario, network, seed=seed)
    assert begin_standing(made)
    return made


def test_two_robots_side_by_side_run_as_each_alone_to_the_last_bit(robot: RobotConfig) -> None:
    alone = [list(fleet(robot, CALM, 1).run()), list(fleet(robot, HARD, 2).run())]
    runs = [fleet(robot, CALM, 1).run(), fleet(robot, HARD, 2).run()]
    together: list[list[SimTruth]] = [[], []]
    going = [0, 1]
    while going:
        for index in tuple(going):
            row = next(runs[index], None)
            if row is None:
                going.remove(index)
            else:
                together[index].append(row)
    assert together == alone
    assert all(rows[-1].scenario_s > 1.4 and not rows[-1].fallen for rows in together)
    assert together[0][-1].com != together[1][-1].com
