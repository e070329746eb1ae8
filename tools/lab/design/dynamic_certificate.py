"""Dynamic certificate: the sampled-data loop is stable on flexible joints. Offline and pure.

The static certificate (`services.planner.law.certificate`) requires stiffness. This one requires
that no motion of the loop in `tools.lab.design.sampled_loop` grows, except a slow drift along the
led directions. It covers thirteen heights of the schedule, upright and pitched by 1.2 rad, and
every drivetrain (`robustness.stiffness`), hand and delay of the robot file:

- with every feedback torque, and with tau_coupled alone, scaled by `gain_margin`;
- with the delay scaled by `delay_margin`, also while F_I is at its limit;
- in HOLD with the services, and with the drives alone;
- on request, parked: as in TRACK, but height and pitch are closed, and nothing may drift.

A drive reports a blind encoder only after `BLIND_S`. Until then a motion may grow by a factor of
at most `BLIND_GROWTH_MAX`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from services.planner.law.certificate import motor_mean
from services.planner.law.coupling import PushIntegral, UncoupledGains, Y
from services.planner.law.model import BodyInertia
from services.planner.law.split import CouplingGains, GainLaw
from services.planner.watch.park import LIFTS
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_JOINTS, N_LEG
from tools.lab.design.poses import PoseNode, Poses, geometric_stiffness
from tools.lab.design.sampled_loop import (
    NO_HAND,
    NOMINAL,
    DrivetrainModel,
    Feedback,
    Gains,
    Growth,
    HandModel,
    LoopTiming,
    SampledLoop,
    Stand,
    halves,
    whole,
)

DELAY_MIN_S: Final = 2e-3
"""Delay from a sample to the first use of its command, over a bus without delay, s."""
DRIVE_STEP_S: Final = 1e-3
"""Period of the modelled drive loop, s, as in the simulator; the firmware's 8 kHz is less
critical."""
DRIFT_HZ: Final = 0.05
"""A slower motion is a drift, not an oscillation: the leading operator closes that loop."""
HALF_NAMES: Final = ("fore and aft", "sideways", "all directions")
TRACK: Final = ("TRACK",)
PARKED: Final = ("parked",)
HELD: Final = ("HOLD", "drives alone")
"""Modes: with the services, and with the drives alone."""
BLIND: Final = tuple(
    f"HOLD, {MODULES[i // 3]} with {('no encoder', 'one encoder', 'the other encoder')[i % 3]}"
    for i in range(3 * N_LEG // 2)
)
"""Modes: HOLD, with both axes or either axis of one module of a leg blind."""
BLIND_S: Final = 0.051
"""Time for which an axis stays armed and blind, s (docs/drives.md)."""
BLIND_GROWTH_MAX: Final = 1.5
"""Factor by which a motion may grow within `BLIND_S`."""
SEEN: Final = (
    np.zeros((2, 2)),
    0.5 * np.array([[1.0, 1.0], [1.0, 1.0]]),
    0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]]),
)
"""Matrices from true to measured (phi, theta) of a module, with both motors blind and with either
one blind: docs/law.md (3)."""


class Design(NamedTuple):
    """Gains chosen with this certificate, one set for all poses."""

    D_B: tuple[float, ...]
    """(6,) local damping of a leg, N m s/rad."""
    coupling: CouplingGains


class StiffnessNode(NamedTuple):
    """A pose of the schedule with its local stiffness."""

    z: float
    pitch: float
    stand: Stand
    D: Array
    """(12,) N m/rad"""


class Condition(NamedTuple):
    """One case that the certificate covers."""

    mode: str
    """One of `TRACK`, `PARKED`, `HELD` or `BLIND`."""
    node: StiffnessNode
    half: int
    stiffness: float
    delay_s: float
    hand: HandModel
    gains: Gains
    integral: bool = True
    """False if F_I is at its limit and stays there."""

    def words(self) -> str:
        """Return a description of the case."""
        parts = [
            f"{self.mode}, COM {self.node.z:.2f} m, pitch {self.node.pitch:.1f} rad",
            f"k = {self.stiffness:g} N m/rad",
            f"{1e3 * self.delay_s:g} ms",
        ]
        if self.hand != NO_HAND:
            parts.append(f"hand {self.hand.k_z:g} N/m")
        if not self.integral:
            parts.append("F_I at its limit")
        if self.gains.coupling != 1.0:
            parts.append(f"tau_coupled x{self.gains.coupling:g}")
        if self.gains.torque != 1.0:
            parts.append(f"all feedback x{self.gains.torque:g}")
        return f"{HALF_NAMES[self.half]}: " + ", ".join(parts)


class _DynamicVerdict(NamedTuple):
    """The worst case found."""

    growth: Growth
    condition: Condition
    excess: float
    """Growth rate minus the rate allowed for a drift, 1/s."""

    @property
    def stable(self) -> bool:
        """True if the motion decays, or is a slow drift in directions that the operator leads."""
        return self.excess < 0.0

    def words(self) -> str:
        """Return a description of the case and its growth."""
        g = self.growth
        what = "grows" if g.rate > 0.0 else "decays"
        return f"{self.condition.words()}: {what} by {abs(g.rate):.2f}/s at {g.frequency_hz:.1f} Hz"


def nodes_of(
    config: RobotConfig, D_at: Callable[[float, float], Array], heights: Array, pitches: Array
) -> list[StiffnessNode]:
    """Return the reachable poses, linearised, without and with the full assist.

    `D_at` returns the local stiffness (12,), N m/rad, at a COM height, m, and a pitch, rad.
    """
    poses, inertia = Poses(config), BodyInertia(config)
    nodes = []
    for z, pitch in itertools.product(heights.tolist(), pitches.tolist()):
        node = poses.node(z, pitch)
        if node is None:
            continue
        M, D = inertia.at(poses.q, node.T), D_at(z, pitch)
        nodes += [StiffnessNode(z, pitch, stand, D) for stand in stands_of(config, poses, node, M)]
    return nodes


def stands_of(config: RobotConfig, poses: Poses, node: PoseNode, M: Array) -> list[Stand]:
    """Return a node, the pose last solved by `poses`, linearised without and with the full assist.

    M (6, 6) is the node's inertia along p (`services.planner.law.model.BodyInertia`).
    """
    J, J_harness = poses.kinematics.J.copy(), poses.kinematics.J_harness.copy()
    S = np.array(config.law.S, float)
    return [
        Stand(M, geometric_stiffness(node.T, H), node.T, J, J_harness, H, S) for H in node.hessians
    ]


class DynamicCertificate:
    """The conditions of a robot, and the loop in each condition."""

    def __init__(self, config: RobotConfig, nodes: list[StiffnessNode]) -> None:
        self._config = config
        self._nodes = nodes
        self._wanted = config.robustness
        self._body = GainLaw(config)
        self._integral_gain = PushIntegral(config.law).gain
        self._hands = [HandModel(*hand) for hand in config.robustness.hands]
        self._halves = (*halves(), whole())
        hold = np.array([config.hold_gains(module) for module in MODULES])
        self._hold = hold[:, 0].ravel(), hold[:, 1].ravel()
        """Minimum (k_p, k_d) of the joints in HOLD, (12,) each."""

    def feedback(self, node: StiffnessNode, design: Design) -> Feedback:
        """Return the feedback of services and planner in TRACK at a pose."""
        T, J = node.stand.T, node.stand.J
        D_B, body = np.tile(design.D_B, 2), self._body
        uncoupled = UncoupledGains(body.K_p, body.B_p, body.S, design.coupling.damping)
        K_fail = T.T @ (node.D[:, np.newaxis] * T) + node.stand.K_geo
        K_c, B_c = uncoupled.at(K_fail, (T.T * D_B) @ T)
        # tau_coupled = C_q e_q + C_v e_v, with J e_q = p_ref - p in the closed rows
        return Feedback(
            node.D,
            D_B,
            J.T @ K_c @ J,
            J.T @ B_c @ J,
            design.coupling.bandwidth_hz,
            self._config.law.lead_easing,
            self._config.harness.low_pass_hz,
            J[Y],
            self._integral_gain,
        )

    def held(self, node: StiffnessNode, design: Design, *, onboard: bool) -> Feedback:
        """Return the feedback in HOLD, from the services or from the drives alone (`onboard`)."""
        k_p, k_d = self._hold
        D, D_B = np.maximum(node.D, k_p), np.maximum(np.tile(design.D_B, 2), k_d)
        if onboard:
            D, D_B = motor_mean(D), motor_mean(D_B)
        zero_coupling = np.zeros((len(D), len(D)))
        return Feedback(D, D_B, zero_coupling, zero_coupling, 1.0)

    def loop(self, condition: Condition, design: Design) -> SampledLoop:
        """Return the loop of a condition."""
        c = condition
        stand, half = c.node.stand, self._halves[c.half]
        if c.mode in TRACK + PARKED:
            feedback = self.feedback(c.node, design)
            if c.mode in PARKED:
                stand, feedback = stand._replace(S=np.zeros(6)), feedback._replace(lifts=LIFTS)
            if not c.integral:
                feedback = feedback._replace(integral_gain=0.0)
        else:
            feedback = self.held(c.node, design, onboard=c.mode == "drives alone")
            stand = stand._replace(S=np.zeros(6))
            if c.mode in BLIND:
                feedback = feedback._replace(seen=_seen(BLIND.index(c.mode)))
        drivetrain, timing = self.drivetrain(c.stiffness), self.timing(c.delay_s)
        return SampledLoop(stand, half, feedback, drivetrain, timing, c.hand)

    def conditions(self, modes: Sequence[str] = TRACK + HELD + BLIND) -> Iterator[Condition]:
        """Yield every condition."""
        for cases_of, own in (
            (self._in_track, TRACK), (self._in_park, PARKED), (self._in_hold, HELD),
        ):  # fmt: skip
            if not set(own) <= set(modes):
                continue
            for case in itertools.product(self._nodes, self._wanted.stiffness, (0, 1)):
                yield from cases_of(*case)
        if set(BLIND) <= set(modes):
            for node, k, mode in itertools.product(self._nodes, self._wanted.stiffness, BLIND):
                yield Condition(mode, node, 2, k, DELAY_MIN_S, NO_HAND, NOMINAL)

    def worst(
        self,
        design: Design,
        modes: Sequence[str] = TRACK + HELD + BLIND,
        *,
        stop_above: float = np.inf,
    ) -> _DynamicVerdict:
        """Return the verdict with the largest excess, or the first above `stop_above`, 1/s."""
        worst: _DynamicVerdict | None = None
        for condition in self.conditions(modes):
            verdict = self.judge(condition, design)
            if worst is None or verdict.excess > worst.excess:
                worst = verdict
                if verdict.excess > stop_above:
                    break
        assert worst is not None  # noqa: S101 - there is always a pose
        return worst

    def led(self, stiffness: float) -> Iterator[Condition]:
        """Yield upright TRACK conditions without a hand, at the minimum and the designed delay."""
        for node in self._nodes:
            if node.pitch == 0.0:
                for delay in (DELAY_MIN_S, self._wanted.delay_ms / 1e3):
                    yield Condition("TRACK", node, 0, stiffness, delay, NO_HAND, NOMINAL)

    def sway(self, design: Design) -> float:
        """Return the growth rate of the worst oscillation in TRACK, 1/s; negative if it decays."""
        cases = (c for c in self.conditions(TRACK) if c.gains == NOMINAL and c.integral
                 and c.delay_s <= self._wanted.delay_ms / 1e3)  # fmt: skip
        return max(self.loop(c, design).growth(c.gains, DRIFT_HZ).rate for c in cases)

    def judge(self, condition: Condition, design: Design) -> _DynamicVerdict:
        """Return the growth of the loop in a condition, and its excess."""
        growth = self.loop(condition, design).growth(condition.gains)
        drifts = condition.half == 0 and growth.frequency_hz < DRIFT_HZ
        allowed = self._wanted.drift_max if drifts and condition.mode == "TRACK" else 0.0
        if condition.mode in BLIND:
            allowed = math.log(BLIND_GROWTH_MAX) / BLIND_S
        return _DynamicVerdict(growth, condition, growth.rate - allowed)

    def _in_track(self, node: StiffnessNode, stiffness: float, half: int) -> Iterator[Condition]:
        wanted = self._wanted
        delay = wanted.delay_ms / 1e3
        hands = self._hands if half == 0 else self._hands[:1]
        for hand in hands:
            case = Condition("TRACK", node, half, stiffness, DELAY_MIN_S, hand, NOMINAL)
            yield case
            yield case._replace(delay_s=delay)
            yield case._replace(delay_s=wanted.delay_margin * delay)
            if half == 1:
                yield case._replace(delay_s=wanted.delay_margin * delay, integral=False)
            yield case._replace(delay_s=delay, gains=Gains(coupling=wanted.gain_margin))
            yield case._replace(gains=Gains(torque=wanted.gain_margin))
            yield case._replace(delay_s=delay, gains=Gains(torque=wanted.gain_margin))

    def _in_park(self, node: StiffnessNode, stiffness: float, half: int) -> Iterator[Condition]:
        for case in self._in_track(node, stiffness, half):
            yield case._replace(mode=PARKED[0])

    def _in_hold(self, node: StiffnessNode, stiffness: float, half: int) -> Iterator[Condition]:
        for mode in HELD:
            case = Condition(mode, node, half, stiffness, DELAY_MIN_S, NO_HAND, NOMINAL)
            yield case
            yield case._replace(gains=Gains(torque=self._wanted.gain_margin))

    def drivetrain(self, stiffness: float) -> DrivetrainModel:
        """Return the drivetrain with a stiffness, N m/rad."""
        joint, wanted = self._config.joint, self._wanted
        return DrivetrainModel(
            stiffness,
            wanted.damping_s * stiffness,
            joint.armature,
            lag_s=wanted.torque_lag_ms / 1e3,
            encoder_bandwidth=self._config.drive.encoder_bandwidth,
        )

    def timing(self, delay_s: float) -> LoopTiming:
        """Return the loop's periods, with a delay from sample to use."""
        service = self._config.joint_service
        return LoopTiming(
            1.0 / service.rate_hz, 1.0 / self._config.planner.rate_hz, delay_s, DRIVE_STEP_S
        )


def _seen(mode: int) -> Array:
    """Return the joints' measurements (12,) per joint angle in a mode of `BLIND`, by its index."""
    seen, first = np.eye(N_JOINTS), 2 * (mode // len(SEEN))
    seen[first : first + 2, first : first + 2] = SEEN[mode % len(SEEN)]
    return seen
