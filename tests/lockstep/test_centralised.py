"""The centralised baseline: only latency separates it from the shipped control."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from services.joint import pd_law
from services.joint.differential import joint_torque
from services.joint.drive_manager import DriveAction, DriveCommand
from services.planner.planner import Planner
from services.simulator.physics.plant import IDEAL, PlantConfig
from shared.bus.messages import DriveStatus, JointState, Mode, Pair, PlannerMode
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Scenario
from shared.joints import N_MODULES
from shared.robot.robot_model import stand_pose
from tests.joint.helpers import ModuleBench, command
from tests.lockstep import runs
from tests.lockstep.runs import push, variant
from tests.planner.states import state
from tests.robots import ROBOT
from tools import cli
from tools.sim.centralised import CONTROLS, SHIPPED, CentralPlanner, PassThrough, torques_only
from tools.sim.lockstep import Lockstep

TAU: Pair = (3.0, -41.0)


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


class Bench(ModuleBench):
    """One module that passes torques on; the joint stays where it is."""

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(torques_only(robot), "service")
        self.module = PassThrough(self.robot, "knee_right")
        self.cycle()
        for _ in range(400):  # until the blend into TRACK is over
            self.passes(TAU)
        assert self.mode is Mode.TRACK

    def passes(self, tau: Pair, age_ns: int = 0) -> DriveAction:
        """Run a cycle with a command of this torque."""
        self.seq += 1
        now_ns = self.now_ns + self.cycle_ns - age_ns
        law = {"tau_ff": tau, "k_p": pd_law.ZERO, "k_d": pd_law.ZERO}
        return self.cycle(command(seq=self.seq, echo_t_ns=now_ns, **law))

    def torque_of(self, step: DriveAction) -> Pair:
        assert step.command is DriveCommand.TORQUE
        return joint_torque(step.torque, self.gear_ratio)


@pytest.fixture
def bench() -> Bench:
    return Bench(ROBOT)


def test_a_torque_goes_to_the_drive_unchanged_until_the_next_however_long(bench: Bench) -> None:
    """Also one made from an old state. Of the gate the torque diamond is left, in one cycle."""
    assert bench.torque_of(bench.passes((5.0, -60.0))) == pytest.approx((5.0, -60.0))
    for _ in range(500):  # 1 s, where the shipped module holds after 50 ms
        step = bench.cycle()
        assert bench.torque_of(step) == pytest.approx((5.0, -60.0))
        assert step.event is None
    assert bench.mode is Mode.TRACK
    step = bench.passes((math.nan, 0.0))
    assert bench.torque_of(step) == pytest.approx((5.0, -60.0)), "NaN is not passed on"
    step = bench.passes((1.0, -2.0), age_ns=400 * NS_PER_MS)
    assert bench.torque_of(step) == pytest.approx((1.0, -2.0))
    assert (
        bench.module.controller.state(bench.module.state.controller, bench.now_ns).age_ns
        == 400 * NS_PER_MS
    )
    for asked, given in (((0.0, -500.0), (0.0, -115.6)), ((80.0, 80.0), (57.8, 57.8))):
        assert bench.torque_of(bench.passes(asked)) == pytest.approx(given)


def test_an_estop_and_a_lost_drive_are_as_shipped(bench: Bench) -> None:
    bench.cycle(estop=True)
    assert bench.mode is Mode.DAMP
    bench.status = DriveStatus.LOST
    bench.passes(TAU)
    assert bench.mode is Mode.FAULT
    assert bench.passes(TAU).command is not DriveCommand.TORQUE


def receive(now_ns: int, seq: int, *planners: Planner) -> list[JointState]:
    """Have planners receive six states of a robot that stands on its feet, each joint moving."""
    q = np.array(stand_pose(ROBOT, 1.1))
    own = {"t_ns": now_ns, "session": 1, "age_ns": 2 * NS_PER_MS}
    states = [state(i, q, seq, v=(0.01 * i, -0.03 * i), **own) for i in range(N_MODULES)]
    for planner, (index, each) in itertools.product(planners, enumerate(states)):
        planner.receive_state(index, each, now_ns)
    return states


def test_a_command_is_all_of_the_shipped_one_as_a_torque() -> None:
    shipped, central = Planner(ROBOT, 1), CentralPlanner(ROBOT, 1)
    now = NS_PER_S
    for seq in range(1, 4):
        now += 4 * NS_PER_MS
        received = receive(now, seq, shipped, central)
        for seen, whole, parts in zip(received, central.tick(now), shipped.tick(now), strict=True):
            wanted = pd_law.torque(pd_law.extrapolate(parts, 0.0), seen.q, seen.v)
            assert whole.tau_ff == pytest.approx(wanted, abs=1e-12)
            assert whole.k_p == whole.k_d == whole.tau_coupled == whole.dtau_ff == pd_law.ZERO
            assert whole.margin == whole.margin_onboard == 0.0
            assert max(map(abs, parts.tau_coupled)) > 0.0
            assert whole.echo_t_ns == parts.echo_t_ns


def test_once_it_leads_the_planner_leads_whatever_it_receives() -> None:
    modes = []
    for planner in (Planner(ROBOT, 1), CentralPlanner(ROBOT, 1)):
        receive(NS_PER_S, 1, planner)
        for tick in range(3):
            planner.tick(NS_PER_S + tick * 4 * NS_PER_MS)
        assert planner.status(NS_PER_S, 0.0).mode == PlannerMode.LEADING
        planner.tick(2 * NS_PER_S)  # 1 s of silence
        modes.append(planner.status(2 * NS_PER_S, 0.0).mode)
    assert modes == [PlannerMode.WAITING, PlannerMode.LEADING]


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
