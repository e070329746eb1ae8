"""The centralised baseline: only latency separates it from the shipped control."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from services.joint import pd_law
from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_manager import DriveAction, DriveCommand
from services.joint.drivers.base import DriveReading, DriveStatus
from services.planner.planner import Planner
from services.simulator.physics.plant import IDEAL, PlantConfig
from shared.bus.messages import JointState, Mode, Pair, PlannerMode, SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Scenario
from shared.robot.robot_model import stand_pose
from tests.joint.helpers import command
from tests.lockstep.runs import push, variant
from tests.planner.states import standing_torque
from tests.test_architecture import IMPORTS, Import, imports_in
from tools import cli
from tools.sim.centralised.control import CentralPlanner, PassThrough
from tools.sim.centralised.fleet import CONTROLS, SHIPPED, torques_only
from tools.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[2]
CYCLE_NS = 2 * NS_PER_MS
TAU: Pair = (3.0, -41.0)


def run(
    control: str,
    robot: RobotConfig,
    scenario: Scenario,
    delay_ms: float,
    plant: PlantConfig | None = None,
) -> list[SimTruth]:
    fleet = CONTROLS[control](robot, scenario, Impairment(delay_ms=delay_ms), plant=plant)
    rows = []
    for row in fleet.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
        if row.fallen:
            break
    return rows


@pytest.fixture(scope="module")
def beginning() -> Scenario:
    """The first of the squat's way down, with the hand's largest force, and a push."""
    return variant("squat", duration=1.6, kill=(), push=(push(0.8, 30.0, 20.0, 0.0),))


@pytest.fixture(scope="module")
def distributed(robot: RobotConfig, beginning: Scenario) -> list[SimTruth]:
    """Torques only there as well, from joint services that have the law."""
    return run("distributed", torques_only(robot), beginning, 0.0, IDEAL)


def test_without_delay_it_does_what_the_distributed_control_does(
    robot: RobotConfig, beginning: Scenario, distributed: list[SimTruth]
) -> None:
    centralised = run("centralised", robot, beginning, 0.0, IDEAL)
    assert len(centralised) == len(distributed)
    for name, unit, far in (("com", 1e3, 1.0), ("torso", 1e3, 1.0), ("angles", 1.0, 0.002)):
        a, b = (
            unit * np.array([getattr(r, name) for r in rows]) for rows in (centralised, distributed)
        )
        assert np.abs(a - b).max() < far, name
    com, hand = (
        [1e3 * max(np.hypot(*row.com[:2]) for row in rows) for rows in (centralised, distributed)],
        [max(abs(r.operator_force[2]) for r in rows) for rows in (centralised, distributed)],
    )
    assert com[1] > 8.0, "the push is felt"
    assert com[0] == pytest.approx(com[1], abs=0.5)
    assert hand[1] > 12.0, "the hand leads"
    assert hand[0] == pytest.approx(hand[1], abs=1.0)


@pytest.mark.parametrize(("control", "falls"), [("centralised", True), ("distributed", False)])
def test_at_100_ms_only_the_shipped_stands(robot: RobotConfig, control: str, falls: bool) -> None:
    late = Inject(link="all", at=0.05, delay_ms=100.0)
    pushed = variant(
        "squat", duration=2.5, kill=(), inject=(late,), push=(push(0.2, 40.0, 0.0, 0.0),)
    )
    assert run(control, robot, pushed, 0.0)[-1].fallen is falls


class Bench:
    """One module that passes torques on; the joint stays where it is."""

    def __init__(self, robot: RobotConfig) -> None:
        self.module = PassThrough(torques_only(robot), "knee_right")
        self.gear_ratio = robot.joint.gear_ratio
        self.now_ns = 1000 * NS_PER_S
        self.seq = 0
        self.status = DriveStatus.ARMED

    def cycle(
        self, tau: Pair | None = None, age_ns: int = 0, *, estop: bool = False
    ) -> DriveAction:
        """Run a cycle, with a command of this torque or with none."""
        self.now_ns += CYCLE_NS
        pos = motor_from_joint((0.02, -1.0), self.gear_ratio)
        reading = DriveReading(self.now_ns, pos, (0.0, 0.0), self.status, 0)
        sent = None
        if tau is not None:
            self.seq += 1
            sent = command(
                seq=self.seq,
                echo_t_ns=self.now_ns - age_ns,
                tau_ff=tau,
                k_p=pd_law.ZERO,
                k_d=pd_law.ZERO,
            )
        return self.module.step(self.now_ns, reading, sent, estop)

    def to_passing(self) -> None:
        """Arm, and let commands come until the blend into TRACK is over."""
        self.status = DriveStatus.IDLE
        self.cycle()
        self.status = DriveStatus.ARMED
        for _ in range(400):
            self.cycle(TAU)
        assert self.mode is Mode.TRACK

    @property
    def mode(self) -> Mode:
        return self.module.controller.failsafe.mode

    def torque_of(self, step: DriveAction) -> Pair:
        assert step.command is DriveCommand.TORQUE
        return joint_torque(step.torque, self.gear_ratio)


@pytest.fixture
def bench(robot: RobotConfig) -> Bench:
    one = Bench(robot)
    one.to_passing()
    return one


def test_a_torque_goes_to_the_drive_unchanged_until_the_next_however_long(bench: Bench) -> None:
    assert bench.torque_of(bench.cycle((5.0, -60.0))) == pytest.approx((5.0, -60.0))
    for _ in range(500):  # 1 s, where the shipped module holds after 50 ms
        step = bench.cycle()
        assert bench.torque_of(step) == pytest.approx((5.0, -60.0))
        assert step.event is None
    assert bench.mode is Mode.TRACK


def test_a_torque_made_from_an_old_state_is_taken(bench: Bench) -> None:
    step = bench.cycle((1.0, -2.0), age_ns=400 * NS_PER_MS)
    assert bench.torque_of(step) == pytest.approx((1.0, -2.0))
    assert bench.module.controller.state(bench.now_ns).age_ns == 400 * NS_PER_MS


@pytest.mark.parametrize(
    ("asked", "given"), [((0.0, -500.0), (0.0, -115.6)), ((80.0, 80.0), (57.8, 57.8))]
)
def test_of_the_gate_the_torque_diamond_is_left(bench: Bench, asked: Pair, given: Pair) -> None:
    """In one cycle: no limit on its step."""
    assert bench.torque_of(bench.cycle(asked)) == pytest.approx(given)


def test_what_is_no_number_is_not_passed_on(bench: Bench) -> None:
    bench.cycle((5.0, -60.0))
    step = bench.cycle((float("nan"), 0.0))
    assert bench.torque_of(step) == pytest.approx((5.0, -60.0))


def test_an_estop_and_a_lost_drive_are_as_shipped(robot: RobotConfig, bench: Bench) -> None:
    bench.cycle(estop=True)
    assert bench.mode is Mode.DAMP
    other = Bench(robot)
    other.to_passing()
    other.status = DriveStatus.LOST
    other.cycle(TAU)
    assert other.mode is Mode.FAULT
    assert other.cycle(TAU).command is not DriveCommand.TORQUE


def states(robot: RobotConfig, now_ns: int, seq: int) -> list[JointState]:
    """Return six states of a robot that stands on its feet, each joint moving."""
    q = stand_pose(robot, 1.1)
    tau = standing_torque(tuple(q))
    fleet = Lockstep(robot, variant("stand"))
    blank = [module.state(now_ns) for module in fleet.controllers]
    return [
        msgspec.structs.replace(
            state,
            t_ns=now_ns,
            seq=seq,
            q=(q[2 * i], q[2 * i + 1]),
            v=(0.01 * i, -0.03 * i),
            tau=(float(tau[2 * i]), float(tau[2 * i + 1])),
            mode=int(Mode.TRACK),
            ready=True,
            session=1,
            age_ns=2 * NS_PER_MS,
        )
        for i, state in enumerate(blank)
    ]


def test_a_command_is_all_of_the_shipped_one_as_a_torque(robot: RobotConfig) -> None:
    shipped, central = Planner(robot, 1), CentralPlanner(robot, 1)
    now = NS_PER_S
    for seq in range(1, 4):
        now += 4 * NS_PER_MS
        received = states(robot, now, seq)
        for index, state in enumerate(received):
            shipped.receive_state(index, state, now)
            central.receive_state(index, state, now)
        for state, whole, parts in zip(received, central.tick(now), shipped.tick(now), strict=True):
            wanted = pd_law.torque(pd_law.extrapolate(parts, 0.0), state.q, state.v)
            assert whole.tau_ff == pytest.approx(wanted, abs=1e-12)
            assert whole.k_p == whole.k_d == whole.tau_coupled == whole.dtau_ff == pd_law.ZERO
            assert whole.margin == whole.margin_onboard == 0.0
            assert max(map(abs, parts.tau_coupled)) > 0.0
            assert whole.echo_t_ns == parts.echo_t_ns


def test_once_it_leads_the_planner_leads_whatever_it_receives(robot: RobotConfig) -> None:
    planners = Planner(robot, 1), CentralPlanner(robot, 1)
    received = states(robot, NS_PER_S, 1)
    modes = []
    for planner in planners:
        for index, state in enumerate(received):
            planner.receive_state(index, state, NS_PER_S)
        for tick in range(3):
            planner.tick(NS_PER_S + tick * 4 * NS_PER_MS)
        assert planner.status(NS_PER_S, 0.0).mode == PlannerMode.LEADING
        planner.tick(2 * NS_PER_S)  # 1 s of silence
        modes.append(planner.status(2 * NS_PER_S, 0.0).mode)
    assert modes == [PlannerMode.WAITING, PlannerMode.LEADING]


def knows_it(imports: list[Import]) -> bool:
    return any(f"{one.full}.".startswith("tools.sim.centralised.") for one in imports)


@pytest.mark.parametrize(
    "source",
    [
        "from tools.sim.centralised.control import PassThrough",
        "from tools.sim.centralised import fleet",
        "from tools.sim import centralised",
        "import tools.sim.centralised",
        "def f():\n    import tools.sim.centralised.control as c",
    ],
)
def test_every_importer_is_seen_however_it_is_written(source: str) -> None:
    assert knows_it(imports_in(source))
    assert not knows_it(imports_in(source.replace("centralised", "centralised_else")))


def test_nothing_but_two_tools_knows_it_and_no_file_names_it() -> None:
    users = {file for file, imports in IMPORTS.items() if knows_it(imports)}
    assert users == {
        "tools/sim/recorded_lockstep.py",
        "tools/verbs/sim.py",
        "tools/lab/studies/sweeps/latency_trial.py",
        "tools/sim/centralised/fleet.py",
    }
    for file in (*(ROOT / "deploy").glob("*.toml"), *(ROOT / "deploy" / "scenarios").glob("*")):
        assert "centralised" not in file.read_text(encoding="utf-8")
    assert CONTROLS[SHIPPED] is Lockstep


def test_a_run_of_it_is_marked_and_cannot_be_mistaken_for_the_services_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ("--duration", "0.2", "--kill", "planner@0.1", "--control", "centralised")
    flags += ("--plant", "ideal")
    assert cli.main(["sim", *flags, "--out", str(tmp_path)]) == 0
    log = str(tmp_path / "run.mcap")
    capsys.readouterr()
    assert cli.main(["resim", log]) == 2
    assert cli.main(["whatif", log, "--kill", "planner"]) == 2
