"""One test case of the dynamic certificate: drawn gains replace those of a standing robot.

The robot stands up and is led to a pose with the shipped gains. Then the planner continues with
drawn ones (damping, bandwidth and damping of tau_coupled) and the robot is tapped. The joints'
motion after the tap is compared with that some seconds later. The certificate is evaluated for this
pose, stiffness, drivetrain, delay and hand.

The plant is that of the linear model: no play, dry friction, cogging or noise, a hard floor, a hand
that follows its path. But the encoders count, and their rounding can sustain a motion that hardly
decays.
"""

from __future__ import annotations

import math
import random
from typing import Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.planner.planner import Planner
from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from shared.bus.messages import Mode
from shared.config.gain_schedule import believing
from shared.config.gain_table import GainSchedule
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.joints import N_LEG
from tools.lab.design.dynamic_certificate import Condition, DynamicCertificate, nodes_of
from tools.lab.design.sampled_loop import NOMINAL, HandModel
from tools.lab.design.split_program import design_of
from tools.lab.studies.sweeps.figures import scalars
from tools.sim.lockstep import Lockstep

HEIGHTS: Final = (0.95, 1.188)
"""m, of the torso."""
PITCHES: Final = (0.0, 0.6)
"""rad"""
STIFFNESS: Final = (2e3, 1e5)
"""N m/rad, log-uniform."""
DELAY_MAX_MS: Final = 12
"""Each way."""
DAMPING: Final = (0.1, 6.0)
"""Factor on each joint's D_B, log-uniform, the legs alike."""
BANDWIDTH_HZ: Final = (1.0, 20.0)
"""Bandwidth of tau_coupled, log-uniform."""
COUPLING: Final = (0.3, 6.0)
"""What tau_coupled fills the damping up to, in shares of B_p, log-uniform."""

REACHED_S: Final = 1.2
TAKEN_OVER_S: Final = 1.8
"""Scenario time at which the drawn gains take over."""
TAP_S: Final = 1.9
TAP_LASTS_S: Final = 0.05
TAP_N: Final = 20.0
"""In x and in y."""
WINDOW_S: Final = 0.5
DURATION_S: Final = 4.5
GREW: Final = 1.3
"""Motion late over motion early."""
STILL_RAD_S: Final = 0.02
"""rad/s; the encoders' counts alone cause this much at rest."""
SHAKES_RAD_S: Final = 0.1
"""More than this, long after the tap, has grown at once and is held by the torque limits."""


class DynamicsTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A drawn case."""

    number: int
    seed: int
    height: float
    pitch: float
    stiffness: float
    delay_ms: int
    """Each way."""
    damping: tuple[float, ...]
    """(6,) factors on D_B of a leg."""
    bandwidth_hz: float
    coupling: float


class DynamicsResult(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction and result."""

    rate: float
    """1/s, of the motion that the certificate calls the slowest to fade, less a drift's share."""
    frequency_hz: float
    mode: str
    """fore and aft, or sideways; empty: not evaluated."""
    early_rad_s: float
    """Root mean square of the joints' rates after the tap."""
    late_rad_s: float
    ended: Literal["tracked", "left", "fell", "unready"]
    """tracked, left (a module left TRACK), fell, or unready: with the shipped gains it did not
    stand and track in a pose for which the certificate can be evaluated, and nothing was tried.
    """
    said_stable: bool
    """The certificate says that every motion fades."""
    grew: bool
    """The motion grew (`has_grown`)."""


def has_grown(early_rad_s: float, late_rad_s: float, ended: str) -> bool:
    """Return True for motion that rises, stays large, or ends the lead."""
    least = min(SHAKES_RAD_S, max(GREW * early_rad_s, STILL_RAD_S))
    return late_rad_s > least or ended in ("left", "fell")


def draw(seed: int, number: int) -> DynamicsTrial:
    """Return one trial; no other has to be drawn for it."""
    dice = random.Random(f"dynamics {seed} {number}")
    return DynamicsTrial(
        number=number,
        seed=seed,
        height=round(dice.uniform(*HEIGHTS), 3),
        pitch=round(dice.uniform(*PITCHES), 3),
        stiffness=round(_log(dice, *STIFFNESS), 1),
        delay_ms=dice.randint(0, DELAY_MAX_MS),
        damping=tuple(round(_log(dice, *DAMPING), 3) for _ in range(N_LEG)),
        bandwidth_hz=round(_log(dice, *BANDWIDTH_HZ), 3),
        coupling=round(_log(dice, *COUPLING), 3),
    )


def row_of(trial: DynamicsTrial) -> dict[str, object]:
    """Return a trial's draws by column."""
    factors = {f"damping_{joint}": factor for joint, factor in enumerate(trial.damping)}
    return scalars(trial) | factors


def _log(dice: random.Random, low: float, high: float) -> float:
    return math.exp(dice.uniform(math.log(low), math.log(high)))


def plant_of(robot: RobotConfig, trial: DynamicsTrial) -> PlantConfig:
    """Return the linear model's plant."""
    return changed(
        IDEAL,
        {
            "drivetrain.stiffness": trial.stiffness,
            "drivetrain.damping_s": robot.robustness.damping_s,
            "drivetrain.rotor_inertia": robot.joint.armature,
            "drivetrain.motor_friction": 0.0,
            "drivetrain.joint_friction": 0.0,
            "drive.lag_s": 1e-3 * robot.robustness.torque_lag_ms,
            "floor.contact_time": 0.004,
        },
    )


def drawn(robot: RobotConfig, trial: DynamicsTrial) -> RobotConfig:
    """Return the robot with the trial's gains in its schedule."""
    schedule = robot.gain_schedule
    assert schedule is not None  # noqa: S101 - `load_robot` has seen to it
    most = robot.joint_service.k_d_max
    D_B = [min(most, f * d) for f, d in zip(trial.damping, schedule.D_B, strict=True)]
    new: GainSchedule = msgspec.structs.replace(
        schedule,
        D_B=tuple(D_B),
        coupling_bandwidth_hz=trial.bandwidth_hz,
        coupling_damping=trial.coupling,
    )
    return msgspec.structs.replace(robot, gain_schedule=new)


def delay_s(robot: RobotConfig, trial: DynamicsTrial) -> float:
    """Return the time from a sample to the first use of its command, s.

    A planner on the spot answers within the millisecond, for the next joint cycle.
    """
    cycle = 1.0 / robot.joint_service.rate_hz
    return cycle * max(1, math.ceil(2e-3 * trial.delay_ms / cycle - 1e-9))


def scenario_of(robot: RobotConfig, trial: DynamicsTrial) -> Scenario:
    """Return what happens."""
    tap = {"at": TAP_S, "duration": TAP_LASTS_S}
    return Scenario(
        name=f"dynamics-{trial.seed}-{trial.number}",
        about=f"case {trial.number} of `xrl study dynamics --seed {trial.seed}`",
        duration=DURATION_S,
        keyframe=(
            Keyframe(at=0.0, height=robot.simulation.stand_height),
            Keyframe(at=REACHED_S, height=trial.height, pitch=trial.pitch),
        ),
        push=(Push(force=(TAP_N, TAP_N, 0.0), **tap),),
    )


UNREADY: Final = DynamicsResult(
    rate=0.0, frequency_hz=0.0, mode="", early_rad_s=0.0, late_rad_s=0.0, ended="unready",
    said_stable=False, grew=False,
)  # fmt: skip


def run_trial(trial: DynamicsTrial, robot: RobotConfig) -> DynamicsResult:
    """Run a trial; its joint services believe gains that the law would never send."""
    fleet = Lockstep(
        believing(robot),
        scenario_of(robot, trial),
        Impairment(delay_ms=float(trial.delay_ms)),
        plant=plant_of(robot, trial),
    )
    other = drawn(robot, trial)
    rates: list[float] = []
    times: list[float] = []
    predicted: DynamicsResult | None = None
    ended: Literal["tracked", "left", "fell"] = "tracked"
    for row in fleet.run():
        if row.fallen or any(c.failsafe.mode is not Mode.TRACK for c in fleet.controllers):
            if row.scenario_s >= TAKEN_OVER_S:
                ended = "fell" if row.fallen else "left"
                break
            if row.fallen:
                return UNREADY
        if predicted is None and row.scenario_s >= TAKEN_OVER_S:
            predicted = _predicted(fleet, other, trial)
            if predicted is None:
                return UNREADY
            _take_over(fleet, other)
        if row.scenario_s >= TAP_S + TAP_LASTS_S:
            rates.append(float(np.mean([np.square(c.samples.v) for c in fleet.controllers])))
            times.append(row.scenario_s)
    if predicted is None:
        return UNREADY
    t, squares = np.array(times), np.array(rates)
    begin = TAP_S + TAP_LASTS_S
    early = _root(squares[t < begin + WINDOW_S])
    late = _root(squares[t > DURATION_S - WINDOW_S] if ended == "tracked" else squares[-5:])
    return msgspec.structs.replace(
        predicted,
        early_rad_s=early,
        late_rad_s=late,
        ended=ended,
        grew=has_grown(early, late, ended),
    )


def _root(squares: NDArray[np.float64]) -> float:
    return math.sqrt(float(squares.mean())) if len(squares) else 0.0


def _take_over(fleet: Lockstep, robot: RobotConfig) -> None:
    """Have a planner with other gains go on from where this one is."""
    before = fleet.planner
    assert before is not None  # noqa: S101 - nobody kills it
    fleet.planner = Planner(robot, before.session)
    fleet.planner.state = before.state


def _predicted(fleet: Lockstep, robot: RobotConfig, trial: DynamicsTrial) -> DynamicsResult | None:
    """Ask the certificate about where the robot is now; None: no level stand is near."""
    assert fleet.planner is not None  # noqa: S101 - nobody kills it
    schedule = robot.gain_schedule
    assert schedule is not None  # noqa: S101 - `load_robot` has seen to it
    status = fleet.planner.status(fleet.now_ns, 0.0)
    z, pitch = status.p[2], status.p[4]
    commands = [controller.failsafe.command for controller in fleet.controllers]
    D = np.ravel([command.k_p for command in commands if command is not None])
    nodes = nodes_of(robot, lambda _z, _pitch: D, np.array([z]), np.array([pitch]))
    if not nodes:
        return None
    node = nodes[0]
    hand = robot.simulation.operator
    certificate = DynamicCertificate(robot, [node])
    verdicts = [
        certificate.judge(
            Condition(
                "TRACK",
                node,
                half,
                trial.stiffness,
                delay_s(robot, trial),
                HandModel(hand.k_z, hand.b_z, hand.k_pitch, hand.b_pitch),
                NOMINAL,
            ),
            design_of(schedule),
        )
        for half in (0, 1)
    ]
    worst = max(verdicts, key=lambda verdict: verdict.excess)
    return msgspec.structs.replace(
        UNREADY,
        rate=worst.excess,
        frequency_hz=worst.growth.frequency_hz,
        mode=worst.condition.words().partition(":")[0],
        said_stable=worst.excess < 0.0,
    )
