"""The certificates against the simulation: what they let stand stands, what they refuse falls."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
import pytest

from services.joint import differential
from services.joint.differential import limit_torque, limits_of
from services.joint.pd_law import ZERO, Setpoint, torque
from services.planner.law.certificate import Certificate
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw
from services.planner.planner import Planner
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from services.simulator.physics.world import World
from shared.arrays import Array
from shared.bus.messages import Mode
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.joints import MODULES, N_JOINTS
from shared.robot.robot_model import stand_pose
from tests.lockstep.runs import modes_of, variant
from tools.lab.design.dynamic_certificate import Condition, Design, DynamicCertificate
from tools.lab.design.poses import Poses
from tools.lab.design.sampled_loop import NOMINAL, HandModel
from tools.lab.design.split_program import design_of, dynamic_nodes
from tools.sim.lockstep import Lockstep
from tools.sim.network import BASE

FRICTIONLESS: Final = changed(
    IDEAL, {"drivetrain.motor_friction": 0.0, "drivetrain.joint_friction": 0.0}
)
"""Dry friction holds a robot that is slightly too soft."""
CLEAR: Final = 0.05
"""Fraction of K_required."""
RIGID_STEPS: Final = 4
"""Time constant of a rigid floor's skin, in time steps; MuJoCo's own floor is elastic (20 ms)."""
LASTS_S: Final = 10.0
DAMPING_S, DAMPING_MAX = 0.04, 60.0
"""D_B over D as in the stand gains, s, and its maximum, N m s/rad."""
NUDGE: Final = Push(at=0.5, duration=0.2, force=(5.0, 5.0, 0.0))


def held_alone(robot: RobotConfig, q: Array, D: Array, tau_ff: Array, height: float) -> bool:
    """Return True if local gains alone hold a nudged stand, on free feet."""
    scenario = Scenario(
        name="certificate", about="", duration=LASTS_S, hand=False, push=(NUDGE,),
        keyframe=(Keyframe(at=0.0, height=height),),
    )  # fmt: skip
    world = World(body_of(robot, FRICTIONLESS), scenario)
    world.model.pair_solref[:, 0] = RIGID_STEPS * world.timestep
    world.stand_at(q)
    world.start()
    damping = np.minimum(DAMPING_S * D, DAMPING_MAX)
    laws, ratio = [], robot.joint.gear_ratio
    for index, module in enumerate(MODULES):
        both = slice(2 * index, 2 * index + 2)
        q_ref, tau, k_p, k_d = (tuple(row[both].tolist()) for row in (q, tau_ff, D, damping))
        laws.append((Setpoint(q_ref, ZERO, tau, ZERO, k_p, k_d), limits_of(robot, module)))
    taus = [setpoint.tau_ff for setpoint, _ in laws]
    motor = np.zeros(N_JOINTS)
    for _ in range(round(LASTS_S * robot.joint_service.rate_hz)):
        turns, rates = (values.tolist() for values in world.motor_turns())
        for index, (setpoint, limits) in enumerate(laws):
            a, b = 2 * index, 2 * index + 1
            at = differential.joint_from_motor((turns[a], turns[b]), ratio)
            v = differential.joint_from_motor((rates[a], rates[b]), ratio)
            taus[index] = limit_torque(torque(setpoint, at, v), at, taus[index], limits)
            motor[a], motor[b] = differential.motor_torque(taus[index], ratio)
        for _ in range(round(1.0 / (robot.joint_service.rate_hz * world.timestep))):
            world.step(motor)
        truth = world.truth(0, 1.0, 0.0)
        if truth.fallen or max(truth.foot_right_tilt, truth.foot_left_tilt) > 0.05:
            return False
    return math.hypot(*truth.over) < 0.1


@pytest.mark.sampled(2)
@pytest.mark.parametrize("height", [0.85, 0.95, 1.07, 1.188])
def test_what_the_certificate_lets_stand_stands_and_what_it_refuses_falls(
    robot: RobotConfig, height: float
) -> None:
    """Local gains in one ratio, just above and just below what the certificate requires."""
    poses, certificate = Poses(robot), Certificate(robot)
    kinematics = poses.kinematics
    kinematics.update(np.array(stand_pose(robot, height)))
    node = poses.node(kinematics.p[2], 0.0)
    assert node is not None
    hessian = node.hessians[0]
    certificate.at(node.T, hessian)
    K_q = np.diagonal(GainLaw(robot).gains(kinematics, hessian).K_q)
    tau_ff = poses.F_O @ kinematics.J
    margins = {
        scale: certificate.weakest(np.clip(scale * K_q, 0.0, robot.joint_service.k_p_max)).margin
        for scale in np.geomspace(0.02, 3.0, 120).tolist()
    }
    stands = min(scale for scale, margin in margins.items() if margin > CLEAR)
    falls = max(scale for scale, margin in margins.items() if margin < -CLEAR)
    assert falls < stands
    for scale, stood in ((stands, True), (falls, False)):
        D = np.clip(scale * K_q, 0.0, robot.joint_service.k_p_max)
        assert held_alone(robot, poses.q, D, tau_ff, height) is stood, scale


def grows(robot: RobotConfig, design: Design, stiffness: float, delay_ms: float) -> bool:
    """Return True if the joints of a tapped robot, led with a design, still shake after 2 s."""
    plant = linear_plant(robot, stiffness)
    tapped = variant("stand", duration=4.0, push=(Push(1.5, 0.05, (20.0, 20.0, 0.0)),))
    impairment = msgspec.structs.replace(BASE, delay_ms=delay_ms)
    fleet = Lockstep(believing(robot), tapped, impairment, plant=plant)
    taken_over, squares = False, list[float]()
    for row in fleet.run():
        if row.scenario_s >= 1.4 and not taken_over:
            taken_over = True
            assert fleet.planner is not None
            other = Planner(with_design(robot, design), fleet.planner.session)
            other.state = fleet.planner.state
            fleet.planner = other
        if row.fallen or (taken_over and set(modes_of(fleet)) != {Mode.TRACK}):
            return True
        if row.scenario_s > 3.5:
            squares.append(float(np.mean([np.square(c.estimate.v) for c in fleet.controllers])))
    return math.sqrt(np.mean(squares)) > 0.1


def with_design(robot: RobotConfig, design: Design) -> RobotConfig:
    schedule = msgspec.structs.replace(
        robot.gain_schedule,  # type: ignore[type-var]
        D_B=design.D_B,
        coupling_bandwidth_hz=design.coupling.bandwidth_hz,
        coupling_damping=design.coupling.damping,
    )
    return msgspec.structs.replace(robot, gain_schedule=schedule)


def linear_plant(robot: RobotConfig, stiffness: float) -> PlantConfig:
    """Return the plant of the linear model: no play, dry friction or noise, a hard floor."""
    wanted = robot.robustness
    return changed(
        FRICTIONLESS,
        {
            "drivetrain.stiffness": stiffness,
            "drivetrain.damping_s": wanted.damping_s,
            "drivetrain.rotor_inertia": robot.joint.armature,
            "drive.lag_s": 1e-3 * wanted.torque_lag_ms,
            "floor.contact_time": 0.004,
        },
    )


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("stiffness", "delay_ms", "bandwidth", "damping", "stable"),
    [
        (8000.0, 1.0, 1.0, 1.0, True),
        (2000.0, 5.0, 1.0, 1.0, True),
        (8000.0, 8.0, 7.0, 3.0, False),
        (3000.0, 8.0, 7.0, 3.0, False),
    ],
)
def test_a_motion_that_the_dynamic_certificate_lets_decay_decays_and_one_it_refuses_grows(
    robot: RobotConfig,
    stiffness: float,
    delay_ms: float,
    bandwidth: float,
    damping: float,
    stable: bool,
) -> None:
    """The shipped design, and one with a coupling that is far too fast."""
    assert robot.gain_schedule is not None
    shipped = design_of(robot.gain_schedule)
    coupling = shipped.coupling._replace(
        bandwidth_hz=bandwidth * shipped.coupling.bandwidth_hz,
        damping=damping * shipped.coupling.damping,
    )
    design = shipped._replace(coupling=coupling)
    nodes = dynamic_nodes(robot, robot.gain_schedule)
    kinematics = Kinematics(robot)
    kinematics.update(np.array(stand_pose(robot, robot.simulation.stand_height)))
    upright = [node for node in nodes if node.pitch == 0.0]
    node = min(upright, key=lambda one: abs(one.z - kinematics.p[2]))
    hand = robot.simulation.operator
    model = HandModel(hand.k_z, hand.b_z, hand.k_pitch, hand.b_pitch)
    certificate = DynamicCertificate(robot, [node])
    said = [
        certificate.judge(
            Condition("TRACK", node, half, stiffness, 2e-3 * max(1.0, delay_ms), model, NOMINAL),
            design,
        ).stable
        for half in (0, 1)
    ]
    assert all(said) is stable
    assert grows(robot, design, stiffness, delay_ms) is not stable
