"""The centralised baseline: only latency separates it from the shipped control."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.simulator.physics.plant import IDEAL, PlantConfig
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Scenario
from tests.lockstep import runs
from tests.lockstep.runs import push, variant
from tests.robots import ROBOT
from tools import cli
from tools.sim.centralised import CONTROLS, SHIPPED, torques_only
from tools.sim.lockstep import Lockstep


def run(
    control: str, robot: RobotConfig, scenario: Scenario, plant: PlantConfig | None = None
) -> list[SimTruth]:
    """Run without delay; the shipped control begins standing on the realistic plant."""
    stands, fleet_type = control == SHIPPED and plant is None, CONTROLS[control]
    return runs.run(robot, scenario, 0.0, plant, stands=stands, fleet_type=fleet_type).rows


def test_without_delay_it_does_what_the_distributed_control_does() -> None:
    """The first of the squat's way down, with the hand's largest force, and a push.

    Joint services that have the law write torques only there as well.
    """
    beginning = variant("squat", duration=1.6, kill=(), push=(push(0.8, 30.0, 20.0, 0.0),))
    both = (
        run("centralised", ROBOT, beginning, IDEAL),
        run("distributed", torques_only(ROBOT), beginning, IDEAL),
    )
    assert len(both[0]) == len(both[1])
    for name, unit, far in (("com", 1e3, 1.0), ("torso", 1e3, 1.0), ("angles", 1.0, 0.002)):
        a, b = (unit * np.array([getattr(row, name) for row in rows]) for rows in both)
        assert np.abs(a - b).max() < far, name
    com = [1e3 * max(np.hypot(*row.com[:2]) for row in rows) for rows in both]
    hand = [max(abs(row.operator_force[2]) for row in rows) for rows in both]
    assert com[1] > 8.0, "the push is felt"
    assert com[0] == pytest.approx(com[1], abs=0.5)
    assert hand[1] > 12.0, "the hand leads"
    assert hand[0] == pytest.approx(hand[1], abs=1.0)


@pytest.mark.parametrize(("control", "falls"), [("centralised", True), ("distributed", False)])
def test_at_100_ms_only_the_shipped_stands(control: str, falls: bool) -> None:
    late = (Inject(link="all", at=0.05, delay_ms=100.0),)
    happens = {"kill": (), "inject": late, "push": (push(0.2, 40.0, 0.0, 0.0),)}
    rows = run(control, ROBOT, variant("squat", duration=2.5, **happens))
    assert rows[-1].fallen is falls


def test_a_run_of_it_is_marked_and_cannot_be_mistaken_for_the_services_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert CONTROLS[SHIPPED] is Lockstep
    flags = ("--duration", "0.2", "--kill", "planner@0.1", "--control", "centralised")
    flags += ("--plant", "ideal")
    assert cli.main(["sim", *flags, "--out", str(tmp_path)]) == 0
    log = str(tmp_path / "run.mcap")
    capsys.readouterr()
    assert cli.main(["log", "resim", log]) == 2
    assert cli.main(["log", "whatif", log, "--kill", "planner"]) == 2
