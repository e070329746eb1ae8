"""One case of the certificate's test: the sign of K_fail against a simulated fall or stand.

A case is a random posture, payload, assist and set of local gains. The robot starts in the
posture, on free feet, with the law that remains without a planner (docs/law.md#certificate):

    tau = D (q_ref - q) - D_B v + tau_ff

sampled as the joint services do, through their torque limiter. It is nudged, and then stands or
falls. A margin above zero predicts that it stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from services.joint import differential
from services.joint.differential import limit_torque, limits_of
from services.joint.pd_law import ZERO, Setpoint, torque
from services.planner.law.certificate import Certificate, Weakest
from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from services.simulator.physics.world import World
from shared.arrays import Array
from shared.bus.messages import Pair
from shared.bus.traces import SimTruth
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.exceptions import RunError
from shared.joints import MODULES, N_JOINTS, N_LEG
from shared.robot.robot_model import stand_pose
from tools.lab.studies.sweeps.figures import sole_tilt_max_rad, with_payload

HEIGHTS: Final = (0.79, 1.25)
"""m; the torso's in a level stand: from the crawl to nearly straight legs."""
PITCHES: Final = (-0.2, 1.2)
"""rad"""
PAYLOADS: Final = (0.0, 6.8, 13.6, 20.4)
"""kg"""
FACTORS: Final = (0.15, 5.0)
"""Factors on diag(K_q): each joint its own, log-uniform, the legs alike. About half do not
stand."""
DAMPING_S: Final = 0.04
"""s; D_B over D, as in the stand gains, up to the largest of theirs."""
DAMPING_MAX: Final = 60.0
"""N m s/rad"""
NUDGES: Final = (3.0, 10.0)
"""N"""
NUDGE_AT: Final = 0.5
"""s; until then the soles sink into the floor's elastic skin, 0.2 to 0.5 mm."""
NUDGE_S: Final = 0.2
OFF_AXIS: Final = (0.35, 1.22)
"""rad off the x axis: a nudge moves the sagittal and the lateral plane, which hardly couple."""
DURATION_S: Final = 12.0
SAMPLE_EVERY: Final = 10
"""Ticks of the joint services."""
LIMIT_MARGIN: Final = 0.1
"""rad inside the joint limits: a soft stop would support gains that are too soft."""
TORQUE_SHARE_MAX: Final = 0.8
"""Fraction of a module's torque that a posture may need to carry itself."""
DRAWS_MAX: Final = 100
RIGID_STEPS: Final = 4
"""Time constant of a rigid floor's skin (MuJoCo's is 20 ms), in time steps; 2 is its least."""

COM_BOUND: Final = 0.15
"""m; farther from the posture than this, or than the next two, is not standing."""
ANGLE_BOUND: Final = 0.3
"""rad, of the torso."""
TILT_BOUND: Final = 0.05
"""rad, of a sole."""
GROWTH_BOUND: Final = 1.2
"""Farthest in the last third of a run over farthest before: beyond, it drifts away."""
STILL: Final = 0.02
"""Fraction of the bounds; slower motion is no drift."""


class Posture(NamedTuple):
    """A stand with the COM over the ankles, and what carries it."""

    height: float
    """m, of the torso in a level stand with its COM as high."""
    pitch: float
    """rad"""
    payload: float
    """kg"""
    assist: float
    """N, rested on the harness and carried by tau_ff."""
    q: Array
    """(12,) rad"""
    tau_ff: Array
    """(12,) N m"""


class CertificateCase(NamedTuple):
    """A posture with local gains and a nudge."""

    number: int
    posture: Posture
    D: Array
    """(12,) N m/rad"""
    D_B: Array
    """(12,) N m s/rad"""
    nudge: tuple[float, float]
    """N along x and y, for `NUDGE_S`."""
    weakest: Weakest
    """With tier 2's margin (`services.planner.law.certificate`)."""


class CertificateResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the simulation."""

    stood: bool
    """False for a fall, and for a drift away."""
    com_mm: float
    """The COM's farthest from the posture."""
    angle_rad: float
    """The torso's farthest, about any axis."""
    growth: float
    """As for `GROWTH_BOUND`."""
    ended_s: float


FRICTIONLESS: Final = changed(
    IDEAL, {"drivetrain.motor_friction": 0.0, "drivetrain.joint_friction": 0.0}
)
"""Falls predicted, stood: dry friction holds a robot that is slightly too soft."""


class CertificateCases:
    """Draws cases of a robot; each number is its own, whatever was drawn before."""

    def __init__(self, robot: RobotConfig) -> None:
        """Build the kinematics, one for each payload."""
        self._robots = [with_payload(robot, payload) for payload in PAYLOADS]
        self._kinematics = [Kinematics(loaded) for loaded in self._robots]
        self._limits: Array = np.array(robot.joint_limits())

    def draw(self, seed: int, number: int) -> CertificateCase:
        """Return a case; raise `RunError` if the robot can hardly stand in any posture."""
        rng, (low, high) = np.random.default_rng((seed, number)), FACTORS
        for _ in range(DRAWS_MAX):
            load = int(rng.integers(len(PAYLOADS)))
            robot, kinematics = self._robots[load], self._kinematics[load]
            F_O = np.array([0.0, 0.0, robot.total_mass * GRAVITY, 0.0, 0.0, 0.0])
            F_assist = np.array([0.0, 0.0, rng.choice((0.0, robot.assist.force_max))])
            posture = self._posture(rng, load, F_O, F_assist)
            if posture is None:
                continue
            hessian_O = kinematics.hessian_times(F_O, F_assist)
            K_q = GainLaw(robot).gains(kinematics, hessian_O).K_q
            factors = np.tile(low * (high / low) ** rng.uniform(size=N_LEG), 2)
            D = np.clip(factors * np.diagonal(K_q), 0.0, robot.joint_service.k_p_max)
            chain = np.vstack((kinematics.J, kinematics.C))
            certificate = Certificate(robot)
            T = np.asarray(np.linalg.solve(chain, np.eye(N_JOINTS)[:, :6]), float)
            certificate.at(T, hessian_O)
            D_B = np.minimum(DAMPING_S * D, DAMPING_MAX)
            return CertificateCase(number, posture, D, D_B, _nudge(rng), certificate.weakest(D))
        raise RunError(
            f"case {number}: of {DRAWS_MAX} postures none can be reached and carried; "
            "see limits, geometry and mass in the robot file"
        )

    def _posture(
        self, rng: np.random.Generator, load: int, F_O: Array, F_assist: Array
    ) -> Posture | None:
        """Draw a posture and move the kinematics there; None if no robot can stand in it."""
        robot, kinematics = self._robots[load], self._kinematics[load]
        height, pitch = float(rng.uniform(*HEIGHTS)), float(rng.uniform(*PITCHES))
        ik = InverseKinematics(kinematics, self._limits)
        ik.q[:] = stand_pose(robot, height)
        kinematics.update(ik.q)
        p_ref = np.array([0.0, 0.0, kinematics.p[2], 0.0, pitch, 0.0])
        reached = ik.solve(p_ref, iterations_max=60).converged
        kinematics.update(ik.q)
        inside = np.minimum(ik.q - self._limits[:, 0], self._limits[:, 1] - ik.q).min()
        tau_ff = F_O @ kinematics.J + F_assist @ kinematics.J_harness
        module = np.abs(tau_ff).reshape(-1, 2).sum(axis=1).max()
        carried = module < TORQUE_SHARE_MAX * robot.joint.tau_module_max
        if not (reached and inside > LIMIT_MARGIN and carried):
            return None
        return Posture(height, pitch, PAYLOADS[load], float(F_assist[2]), ik.q, tau_ff)


def _nudge(rng: np.random.Generator) -> tuple[float, float]:
    force, off_axis = rng.uniform(*NUDGES), rng.uniform(*OFF_AXIS)
    x, y = rng.choice((-force, force), 2)
    return float(x * math.cos(off_axis)), float(y * math.sin(off_axis))


class _Module:
    """A joint service that holds: its law frozen, its torque limiter and its differential."""

    def __init__(self, robot: RobotConfig, case: CertificateCase, index: int) -> None:
        def pair(values: Array) -> Pair:
            return float(values[2 * index]), float(values[2 * index + 1])

        q_ref, tau_ff = pair(case.posture.q), pair(case.posture.tau_ff)
        self._setpoint = Setpoint(q_ref, ZERO, tau_ff, ZERO, pair(case.D), pair(case.D_B))
        self._limits = limits_of(robot, MODULES[index])
        self._tau = self._setpoint.tau_ff
        self._gear_ratio = robot.joint.gear_ratio

    def motor_torque(self, turns: Pair, turns_per_s: Pair) -> Pair:
        q = differential.joint_from_motor(turns, self._gear_ratio)
        v = differential.joint_from_motor(turns_per_s, self._gear_ratio)
        self._tau = limit_torque(torque(self._setpoint, q, v), q, self._tau, self._limits)
        return differential.motor_torque(self._tau, self._gear_ratio)


def world_of(
    robot: RobotConfig, case: CertificateCase, *, rigid: bool, plant: PlantConfig = FRICTIONLESS
) -> World:
    """Return the world with the robot in the case's posture, the nudge to come.

    The payload is the case's. `rigid`: the floor is hard, as the certificate has it.
    """
    posture = case.posture
    scenario = Scenario(
        name="certificate",
        about="a posture held by local gains alone, and a nudge",
        duration=DURATION_S,
        keyframe=(Keyframe(at=0.0, height=posture.height, assist=posture.assist),),
        hand=False,
        push=(Push(at=NUDGE_AT, duration=NUDGE_S, force=(*case.nudge, 0.0)),),
    )
    world = World(body_of(with_payload(robot, posture.payload), plant), scenario)
    if rigid:
        world.model.pair_solref[:, 0] = RIGID_STEPS * world.timestep
    world.stand_at(posture.q)
    world.start()
    return world


def row_of(case: CertificateCase) -> dict[str, object]:
    """Return a case by column: what is predicted of it, and how it begins."""
    row = {
        "number": case.number,
        "margin": case.weakest.margin,
        "weakest": case.weakest.direction,
        "stiffness": case.weakest.stiffness,
        "height_m": case.posture.height,
        "pitch_rad": case.posture.pitch,
        "payload_kg": case.posture.payload,
        "assist_n": case.posture.assist,
        "nudge_x_n": case.nudge[0],
        "nudge_y_n": case.nudge[1],
    }
    return row | {f"D{joint}": float(value) for joint, value in enumerate(case.D[:6])}


def run_case(
    case: CertificateCase,
    robot: RobotConfig,
    *,
    rigid: bool = False,
    plant: PlantConfig = FRICTIONLESS,
) -> CertificateResult:
    """Simulate a case; arguments as for `world_of`."""
    world = world_of(robot, case, rigid=rigid, plant=plant)
    modules = [_Module(robot, case, index) for index in range(len(MODULES))]
    steps = round(1.0 / (robot.joint_service.rate_hz * world.timestep))
    motor = np.zeros(N_JOINTS)
    rows: list[SimTruth] = []
    for tick in range(round(DURATION_S / (steps * world.timestep))):
        turns, rates = (values.tolist() for values in world.motor_turns())
        for index, module in enumerate(modules):
            a, b = 2 * index, 2 * index + 1
            motor[a], motor[b] = module.motor_torque((turns[a], turns[b]), (rates[a], rates[b]))
        for _ in range(steps):
            world.step(motor)
        if world.time > 0.9 * NUDGE_AT and tick % SAMPLE_EVERY == 0:
            rows.append(world.truth(0, 1.0, 0.0))
            if rows[-1].fallen:
                break
    return judge(rows)


def judge(rows: Sequence[SimTruth]) -> CertificateResult:
    """Return the outcome of a run, whose first row is from before the nudge."""
    com = np.array([row.com for row in rows])
    angles = np.array([row.angles for row in rows])
    com_m = np.linalg.norm(com - com[0], axis=1)
    angle_rad = np.abs(angles - angles[0]).max(axis=1)
    tilt = sole_tilt_max_rad(rows)
    departure = np.maximum(com_m / COM_BOUND, angle_rad / ANGLE_BOUND)
    late = 2 * len(rows) // 3
    growth = float(departure[late:].max(initial=0.0) / departure[:late].max(initial=STILL))
    stays = departure.max() < 1.0 and tilt < TILT_BOUND and growth < GROWTH_BOUND
    return CertificateResult(
        stood=bool(stays and not rows[-1].fallen),
        com_mm=1e3 * float(com_m.max()),
        angle_rad=float(angle_rad.max()),
        growth=growth,
        ended_s=rows[-1].scenario_s,
    )
