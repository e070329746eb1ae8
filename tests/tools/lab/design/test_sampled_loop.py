"""The linearised loop against two others: an independent one, and the simulated world itself."""

from __future__ import annotations

import math

import msgspec
import mujoco
import numpy as np
import pytest

from services.planner.law.coupling import pole_gain
from services.planner.law.model import BodyInertia
from services.planner.law.split import ScheduledGains
from services.planner.watch.park import FOLLOW_S, LIFTS
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from services.simulator.physics.world import World
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import still
from tests.tools.lab.design import loop_oracle
from tools.lab.design import dynamic_certificate
from tools.lab.design.dynamic_certificate import (
    BLIND,
    PARKED,
    Condition,
    Design,
    DynamicCertificate,
    StiffnessNode,
    nodes_of,
    stands_of,
)
from tools.lab.design.poses import Poses
from tools.lab.design.sampled_loop import (
    NO_HAND,
    DrivetrainModel,
    Feedback,
    Gains,
    HandModel,
    LoopTiming,
    SampledLoop,
    Stand,
    whole,
)
from tools.lab.design.split_program import design_of
from tools.sim.lockstep import Lockstep


@pytest.fixture(scope="module")
def nodes(robot: RobotConfig) -> list[StiffnessNode]:
    schedule = robot.gain_schedule
    assert schedule is not None
    heights = np.array([schedule.z[2], schedule.z[12], schedule.z[22]])
    return nodes_of(robot, ScheduledGains(schedule).at, heights, np.array([0.0, 1.2]))


@pytest.fixture(scope="module")
def certificate(robot: RobotConfig, nodes: list[StiffnessNode]) -> DynamicCertificate:
    return DynamicCertificate(robot, nodes)


@pytest.fixture(scope="module")
def design(robot: RobotConfig) -> Design:
    assert robot.gain_schedule is not None
    return design_of(robot.gain_schedule)


def led(node: StiffnessNode, half: int, stiffness: float, delay_s: float) -> Condition:
    """Return a condition in TRACK without a hand, nominal."""
    return Condition("TRACK", node, half, stiffness, delay_s, NO_HAND, Gains())


def whole_loop(
    certificate: DynamicCertificate, condition: Condition, design: Design
) -> tuple[SampledLoop, loop_oracle.Loop]:
    """Return both halves as one loop, and the same for the oracle."""
    hand = condition.hand
    loop = certificate.loop(condition, design)
    stand, feedback = condition.node.stand, loop.feedback
    if condition.mode in PARKED:
        stand = stand._replace(S=np.zeros(6))
    drive = certificate.drivetrain(condition.stiffness)
    timing = certificate.timing(condition.delay_s)
    gains = {name: value for name, value in feedback._asdict().items() if name != "seen"}
    oracle = loop_oracle.Loop(
        **stand._asdict(), **gains, **timing._asdict(), hand=tuple(hand), follow_s=FOLLOW_S,
        k=drive.stiffness, b=drive.damping, I=drive.rotor_inertia, d_motor=drive.motor_damping,
        d_joint=drive.joint_damping, lag_s=drive.lag_s, encoder_bandwidth=drive.encoder_bandwidth,
    )  # fmt: skip
    return SampledLoop(stand, whole(), feedback, drive, timing, hand), oracle


@pytest.mark.parametrize("seed", range(6))
def test_its_eigenvalues_are_those_of_an_independent_implementation(
    nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design, seed: int
) -> None:
    """Another formulation (all joints, queues, events) and another integrator (RK4), to 1 %."""
    dice = np.random.default_rng(seed)
    design = design._replace(
        D_B=tuple(dice.uniform(3.0, 60.0, 6)),
        coupling=design.coupling._replace(bandwidth_hz=float(dice.uniform(2.0, 8.0))),
    )
    node = nodes[int(dice.integers(len(nodes)))]
    hand = HandModel(1500.0, 150.0, 200.0, 20.0) if seed % 2 else NO_HAND
    delay = float(dice.choice([0.002, 0.01, 0.016]))
    condition = led(node, 0, float(dice.choice([2000.0, 5000.0, 15000.0])), delay)
    if seed > 3:
        condition = condition._replace(mode=PARKED[0])
    own, oracle = whole_loop(certificate, condition._replace(hand=hand), design)
    gains = Gains(coupling=float(dice.uniform(0.5, 2.0)), torque=float(dice.uniform(0.7, 1.5)))
    mine = own.eigenvalues(gains)
    theirs = np.linalg.eigvals(loop_oracle.monodromy(oracle, gains.coupling, gains.torque))
    period = certificate.timing(delay).planner_period
    poles = (1.0 - pole_gain(design.coupling.bandwidth_hz, period), 1.0 - period / FOLLOW_S)
    mine, theirs = (  # the oracle also filters what no torque ever has: the bare poles, often
        sorted((v for v in values if min(abs(v - pole) for pole in poles) > 1e-4), key=abs)[:-21:-1]
        for values in (mine, theirs)
    )
    np.testing.assert_allclose(np.abs(mine), np.abs(theirs), rtol=1e-3)
    for value in mine:
        assert min(abs(value - other) for other in theirs) < 0.01 * abs(value)


def test_the_two_halves_together_are_the_whole(
    nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design
) -> None:
    cases = [led(nodes[0], half, 5000.0, 0.01) for half in (0, 1)]
    halves = [certificate.loop(case, design).eigenvalues() for case in cases]
    loop, _ = whole_loop(certificate, cases[0], design)
    together = np.sort(np.abs(np.concatenate(halves)))[::-1][:30]
    np.testing.assert_allclose(together, np.sort(np.abs(loop.eigenvalues()))[::-1][:30], rtol=1e-6)


def test_the_plant_has_the_simulated_world_s_modes(robot: RobotConfig) -> None:
    """Frequencies and damping by finite differences of the MuJoCo world on its soft floor."""
    plant = changed(
        PlantConfig(),
        {
            "drivetrain.stiffness": 5000.0, "drivetrain.play": 0.0, "drivetrain.cogging": 0.0,
            "drivetrain.motor_friction": 0.0, "drivetrain.joint_friction": 0.0,
            "encoder.noise_counts": 0.0, "person.mass": 0.0, "steps": 16,
        },
    )  # fmt: skip
    fleet = Lockstep(robot, still(3.0, hand=False), plant=plant)
    fleet.planner = None
    for _ in range(2000):
        fleet.advance()
    world = fleet.world
    simulated = modes(
        simulated_transition(world, fleet._robot._torque.copy()), world.model.opt.timestep
    )
    stand = linearised(robot, world.actuation.flexible.theta)
    nothing = np.zeros((12, 12))
    drivetrain = DrivetrainModel(5000.0, 10.0, 0.15)
    loop = SampledLoop(
        stand, whole(), Feedback(np.zeros(12), np.zeros(12), nothing, nothing, 1.0),
        drivetrain, LoopTiming(2e-3, 4e-3, 2e-3),
    )  # fmt: skip
    mechanical = np.r_[0:36]  # p, p', rotors: neither torques nor estimates
    modelled = modes_of(np.linalg.eigvals(loop.A[np.ix_(mechanical, mechanical)]))
    # the feet's own modes on the soft floor are below 5 Hz and hardly a vibration
    simulated = simulated[simulated[:, 0] > 10.0]
    assert len(simulated) == len(modelled) == 12
    np.testing.assert_allclose(simulated[:, 0], modelled[:, 0], rtol=0.035)
    np.testing.assert_allclose(simulated[:, 1], modelled[:, 1], atol=0.03)


def linearised(robot: RobotConfig, q: np.ndarray) -> Stand:
    """Return the stand at joint angles (12,), rad, without assist."""
    poses = Poses(robot)
    node = poses.node_at(q)
    return stands_of(robot, poses, node, BodyInertia(robot).at(q, node.T))[0]


def simulated_transition(world: World, torque: np.ndarray) -> np.ndarray:
    """Return d state+ / d state (60, 60) of one step: body and rotors, torque held."""
    model, data, rotors = world.model, world.data, world.actuation.flexible
    assert rotors is not None
    world._steps = 1
    tau, warm = world.actuation._tau.copy(), data.qacc_warmstart.copy()
    qpos, theta = data.qpos.copy(), rotors.theta.copy()

    def step(dx: np.ndarray) -> np.ndarray:
        moved = qpos.copy()
        mujoco.mj_integratePos(model, moved, dx[:18], 1.0)
        data.qpos[:], data.qvel[:] = moved, dx[18:36]
        rotors.theta[:], rotors.rate[:] = theta + dx[36:48], dx[48:]
        data.qacc_warmstart[:] = warm
        world.actuation._tau[:] = tau
        world.step(torque)
        dq = np.zeros(18)
        mujoco.mj_differentiatePos(model, dq, 1.0, qpos, data.qpos)
        return np.concatenate([dq, data.qvel, rotors.theta - theta, rotors.rate])

    h = 1e-6
    columns = [(step(h * e) - step(-h * e)) / (2.0 * h) for e in np.eye(60)]
    return np.array(columns).T


def modes(transition: np.ndarray, dt: float) -> np.ndarray:
    return modes_of(np.log(np.linalg.eigvals(transition).astype(complex)) / dt)


def modes_of(values: np.ndarray) -> np.ndarray:
    """Return (frequency in Hz, damping ratio) of each oscillation, fastest first."""
    oscillating = [v for v in values if v.imag > 1.0]
    pairs = [(v.imag / (2.0 * math.pi), -v.real / abs(v)) for v in oscillating]
    return np.array(sorted(pairs, reverse=True))


def test_inertia_along_p_is_that_of_the_simulated_body(robot: RobotConfig) -> None:
    """Kinetic energy of a motion with both feet still, by MuJoCo's own mass matrix."""
    world = World(body_of(robot, changed(IDEAL, {"drivetrain.rotor_inertia": 0.01})), still(1.0))
    q = world.data.qpos[world.joints.q_index].copy()
    stand = linearised(robot, q)
    M = np.zeros((18, 18))
    mujoco.mj_fullM(world.model, world.data, M)
    M[world.joints.v_index, world.joints.v_index] -= 0.01  # the rotors
    rates = np.zeros((18, 6))
    rates[world.joints.v_index] = stand.T
    foot = np.zeros((6, 18))
    mujoco.mj_jacBody(world.model, world.data, foot[:3], foot[3:], world.placement.feet[0])
    rates[:6] = -np.linalg.solve(foot[:, :6], foot[:, 6:] @ rates[6:])
    np.testing.assert_allclose(rates.T @ M @ rates, stand.M, rtol=2e-3, atol=2e-2)


def test_a_hand_that_moves_it_feels_little_more_than_its_mass(
    nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design
) -> None:
    node = next(node for node in nodes if node.pitch == 0.0 and node.z > 0.75)
    loop = certificate.loop(led(node, 0, 20000.0, 2e-3), design)
    w = 2.0 * math.pi * 1.0
    given = np.ix_([2, 4], [2, 4])  # height and pitch give way, the rest hardly does
    mass = (node.stand.M + 0.15 * node.stand.T.T @ node.stand.T)[given]
    up = (node.stand.J_harness[2] @ node.stand.T)[[2, 4]]
    felt = 1.0 / (up @ np.linalg.solve(mass, up))
    assert abs(loop.impedance_z(w)) == pytest.approx(felt * w, rel=0.4)


def test_a_push_from_the_side_that_lasts_leaves_no_error_that_an_encoder_sees(
    nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design
) -> None:
    """The drivetrain still gives way: its encoders are at the motors."""
    node, seen_mm = nodes[0], []
    with_integral = certificate.feedback(node, design)
    for feedback in (with_integral, with_integral._replace(integral_gain=0.0)):
        drive, timing = certificate.drivetrain(8000.0), certificate.timing(2e-3)
        stand = node.stand._replace(S=np.zeros(6))  # led, the robot does not keep its height
        loop = SampledLoop(stand, whole(), feedback, drive, timing)
        Phi, Gamma = loop.period_map()
        X = np.linalg.solve(np.eye(len(Phi)) - Phi, Gamma @ np.array([0, 60.0, 0, 0, 0, 0]))
        seen_mm.append(1e3 * float(node.stand.J[1] @ X[12:24]))
    assert abs(seen_mm[0]) < 1e-6
    assert seen_mm[1] > 5.0


@pytest.mark.parametrize("stiffness", [2000.0, 8000.0, 20000.0])
def test_yesterday_s_coupling_is_called_unstable(
    nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design, stiffness: float
) -> None:
    """Hardly filtered, with little damping at the joints: it fell below 20 000 N m/rad."""
    soft = design._replace(
        D_B=(3.4, 21.0, 0.6, 2.5, 1.4, 0.7),
        coupling=design.coupling._replace(bandwidth_hz=100.0, damping=1.0),
    )
    growth = certificate.loop(led(nodes[0], 1, stiffness, 2e-3), soft).growth()
    assert growth.rate > 10.0
    assert growth.frequency_hz > 5.0


def test_a_motion_that_hardly_grows_is_a_drift_only_where_the_person_leads(
    robot: RobotConfig, nodes: list[StiffnessNode], certificate: DynamicCertificate, design: Design
) -> None:
    robust = msgspec.structs.replace(robot.robustness, drift_max=0.0)
    strict = DynamicCertificate(msgspec.structs.replace(robot, robustness=robust), nodes)
    condition = led(nodes[0], 0, 2000.0, 2e-3)
    drifting = strict.judge(condition, design)
    assert drifting.growth.rate > 0.0
    assert not drifting.stable
    assert certificate.judge(condition, design).stable


def test_a_blind_module_adds_its_stiffness_along_the_axis_that_still_sees(
    certificate: DynamicCertificate, nodes: list[StiffnessNode], design: Design
) -> None:
    knee = [mode for mode in BLIND if "knee" in mode]
    cases = {c.mode: c for c in certificate.conditions(BLIND) if c.node is nodes[0]}
    seen = [certificate.loop(cases[mode], design).feedback.seen[2:4, 2:4] for mode in knee]
    first, second = np.array([1.0, 1.0]), np.array([-1.0, 1.0])  # of phi, theta for one motor each
    np.testing.assert_array_equal(seen[0], 0.0)
    for one, moved, rests in ((seen[1], first, second), (seen[2], second, first)):
        np.testing.assert_allclose(one @ moved, moved)
        np.testing.assert_allclose(one @ rests, 0.0)


def test_until_its_drive_says_so_a_blind_encoder_lets_motions_grow_by_half_at_most(
    nodes: list[StiffnessNode], design: Design, robot: RobotConfig
) -> None:
    """All poses of the schedule are in `test_split_program.py`, as shipped."""
    heavy = [n._replace(stand=n.stand._replace(K_geo=8.0 * n.stand.K_geo)) for n in nodes[:1]]
    verdict = DynamicCertificate(robot, heavy).worst(design, BLIND)
    assert not verdict.stable
    assert verdict.condition.mode in BLIND


def test_parked_with_height_and_pitch_closed_every_motion_decays(
    certificate: DynamicCertificate, design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the margins that are required of a led robot, and with no drift allowed.

    The assist that follows the hand is part of the loop: three times as fast a lift is refused.
    """
    assert certificate.worst(design, PARKED).stable
    monkeypatch.setattr(dynamic_certificate, "LIFTS", 3.0 * LIFTS)
    assert not certificate.worst(design, PARKED).stable
