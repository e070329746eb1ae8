"""Whole-body law: Hybrid Open-Loop Closed-Loop Control (paper, docs/law.md).

One tick, in the paper's letters:

    p, J                 from the measured joints and the stance of the feet
    p_ref = S_perp p_C + S p
    q_ref = IK(p_ref)
    v_ref                J v_ref = S J v + S_perp pdot_C, C v_ref = 0
    F     = K_p (p_ref - p) + B_p (pdot_ref - pdot) + F_O
    F_O                  weight m g up, pitch moment of the load beyond the robot file, and the lift
                         and moment that hold a closed height or pitch
    T                    [J; C] T = [I; 0] at q_ref, so v_ref = T (S J v + S_perp pdot_C)
    K_q, B_q             at q_ref
    D, D_B               local gains of the joint services, from schedule and certificate
    K_c, B_c             the part of K_p and B_p that D and D_B lack
    tau_ff  = J^T F_O + J_harness^T (F_assist + F_load) up
    tau_coupled = low-pass { J^T [K_c (p_ref - p) + B_c (pdot_ref - pdot) + F_I] } + eased lead

Pure: no clock, bus or thread.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import msgspec
import numpy as np

from services.planner.law.assist import (
    AssistLaw,
    AssistState,
    EasingState,
    LeadEasing,
    force_up,
    is_still,
    wrench_in_world,
)
from services.planner.law.closed_reference import (
    HeightReference,
    HeightState,
    Released,
    ShiftReference,
    ShiftState,
    Toward,
)
from services.planner.law.coupling import CouplingState, LawAtReference, PushIntegral, Y, low_passed
from services.planner.law.feet import (
    FOLLOW_S,
    Levelling,
    LevellingState,
    Stance,
    StanceState,
    up_of,
)
from services.planner.law.kinematics import Measured
from services.planner.law.load import Load, LoadState
from services.planner.law.reference import Reference
from services.planner.law.split import GainLaw, GainSplit, LocalGains
from shared.arrays import Array, vector6
from shared.bus.messages import STRAIGHT, Pair, Vector3, Vector4, Vector6, Wrench
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULE_INDEX, N_JOINTS, SIDES

RECENTRED = np.array([True, True, False, True, False, True])
"""Rows of p whose closed-loop reference returns to zero: roll, yaw, and the COM's offset from the
vertical through the ankles. On a slope, the vertical differs from the floor's normal by height
times slope."""

_PERSON: Final = Toward.PERSON
KNEES = tuple(2 * MODULE_INDEX[f"knee_{side}"] + 1 for side in SIDES)
"""Indices of the knees' theta among the joints."""

KEPT = np.where(RECENTRED, 0.0, 1.0)
"""1 for the rows of p_C that keep their value, 0 for those that return to zero."""


class LawInputs(NamedTuple):
    """Inputs of one tick."""

    q: Array
    """Measured joint angles (12,), rad."""
    v: Array
    """Measured joint rates (12,), rad/s."""
    dt: float
    """Time since the last tick, s."""
    assist: float = 0.0
    """Requested assist, N. The law limits its rate, except in the first tick, because HOLD may
    already carry it."""
    shed_rate: float = 0.0
    """Maximum rate at which the assist falls, N/s, if above the law's own limit."""
    shift: Vector4 = STRAIGHT
    """Requested x, y (m), roll and yaw (rad) of the shift; limited by the law."""
    toward: Toward = Toward.PERSON
    """Direction in which the robot moves on its own (`services.planner.law.closed_reference`)."""
    released: Released = (False, False)
    """(height, pitch), each True to close it in place."""
    pitch_drive: float = 0.0
    """Pitch acceleration measured when the pitch was released, rad/s^2."""
    align: bool = False
    """True while the planner does not lead: p_C starts at the measured pose, so that engaging makes
    no step. It then returns to zero within `law.recentre_s`: COM over the ankles, no roll, no yaw;
    height and pitch stay. After an earlier lead, p_C starts at zero instead, because the measured
    pose is part of a sway. HOLD would keep that pose after another dropout, and a robot held 25 mm
    off centre fell at the second push. The modules' blend then avoids a step. The requested shift
    is kept."""
    wrench: Wrench | None = None
    """Operator's wrench on the torso; None if stale or invalid."""
    up_torso: Vector3 | None = None
    """Unit vector against gravity, torso axes; None if the attitude is unknown."""


class LawOutput(NamedTuple):
    """Outputs of one tick: (12,) for the joints, and (6,) from `p` to `closure`."""

    q_ref: Array
    v_ref: Array
    tau_ff: Array
    dtau_ff: Array
    tau_coupled: Array
    tau_unfiltered: Array
    """J^T [K_c e + B_c e' + F_I]: `tau_coupled` before its low-pass, without the eased lead."""
    local: LocalGains
    """D and D_B, with their margins."""
    p: Array
    """Measured pose."""
    pdot: Array
    p_ref: Array
    closure: Array
    assist: float
    """Assist plus F_lift, N."""
    slope: Pair
    """Rise of the floor along x and y, rad."""
    stance: Vector6
    """Right foot relative to the left, as a deviation from the robot file, m and rad."""
    ik_iterations: int
    ik_residual: float


class LawState(msgspec.Struct):
    """State of `Hocca` between two ticks."""

    p_C0: Vector6 = (0.0,) * 6
    """Pose from which p_C returns to zero, m and rad."""
    since_align_s: float = 0.0
    aligned: bool = False
    has_led: bool = False
    q: tuple[float, ...] = (0.0,) * N_JOINTS
    """Joint angles from which the inverse kinematics starts, rad."""
    stance: StanceState = msgspec.field(default_factory=StanceState)
    levelling: LevellingState = msgspec.field(default_factory=LevellingState)
    shift: ShiftState = msgspec.field(default_factory=ShiftState)
    height: HeightState = msgspec.field(default_factory=HeightState)
    assist: AssistState = msgspec.field(default_factory=AssistState)
    easing: EasingState = msgspec.field(default_factory=EasingState)
    load: LoadState = msgspec.field(default_factory=LoadState)
    coupling: CouplingState = msgspec.field(default_factory=CouplingState)


class Hocca:
    """The whole-body law. Everything that changes between ticks is in `LawState`.

    Attributes:
        measured: kinematics at the measured joints of the last tick.
        reference: the law's quantities at the last tick's reference pose.
        split: split of the gains, with their certificate.
        load: estimate of the load beyond the robot file.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.measured = Measured(config)
        self.reference = Reference(config)
        gains = GainLaw(config)
        self.split = GainSplit(config)
        self._S = gains.S
        self._S_perp = 1.0 - self._S
        self._terms = LawAtReference(gains, self.split)
        self._push = PushIntegral(config.law)
        self._stance = Stance(config.law.stance_max)
        self._levelling = Levelling(config.imu.levelling_s)
        self._shift = ShiftReference(config.law.shift_max)
        low, high = config.joint_service.damp_knee_stop, config.limits.knee.theta[1]
        self._height = HeightReference((low, high))
        self._weight = config.total_mass * GRAVITY
        size = config.geometry.torso_size
        inertia = config.torso_mass * (size[0] ** 2 + size[2] ** 2) / 12.0
        # the paper's split is for comparison only, so it gets no load correction
        certified = config.law.split == "certified"
        correction_max = config.law.load_correction if certified else (0.0, 0.0)
        self.load = Load(correction_max, self._weight, config.torso_mass, inertia)
        self._assist = AssistLaw(config.assist)
        self._easing = LeadEasing(config.law.lead_easing)
        self._recentre_s = config.law.recentre_s

    def tick(self, s: LawState, inputs: LawInputs) -> LawOutput:
        """Run the law once: docs/law.md (6), (12) and (17).

        Args:
            s: the law's state; updated in place.
            inputs: inputs of this tick.
        """
        measured, reference, dt = self.measured, self.reference, inputs.dt
        up = self._measure(s, inputs)
        p_C, pdot_C = self._closed_loop_reference(s, inputs, up)
        p_ref = self._S_perp * p_C + self._S * measured.p
        pdot_ref = self._S_perp * pdot_C + self._S * measured.pdot
        force, moment_pitch, assist_rate = self._hand(s, inputs)
        assist = s.assist.assist
        F_O = self._body_wrench(s, inputs, up, p_ref, pdot_ref)
        F_harness = (assist + self.load.force(s.load)) * up
        reference.load(pdot_ref, F_O, F_harness, assist_rate * up, measured.D_left)
        result = reference.solve(np.array(s.q), p_ref)
        terms = self._terms.evaluate(reference, p_ref - measured.p, pdot_ref - measured.pdot)
        tau_unfiltered, tau_coupled = self._coupled_torque(s, terms.coupled, p_ref, pdot_ref, dt)
        # the eased lead goes into tau_coupled, which HOLD drops; in tau_ff it would outlast the
        # hand. The harness filter is enough for it, because it depends on a force, not on joint
        # rates
        ease_z, ease_pitch = self._easing.ease(s.easing, force, moment_pitch, assist, dt)
        tau_coupled += ease_z * reference.J_harness[2] + ease_pitch * reference.J[4]
        s.q = tuple(reference.expected(dt).tolist())
        s.height.T_z = float(np.abs(reference.T[:, 2]).max())
        return LawOutput(
            q_ref=reference.q.copy(),
            v_ref=reference.v.copy(),
            tau_ff=reference.gravity + reference.assist,
            dtau_ff=reference.dtau_ff.copy(),
            tau_coupled=tau_coupled,
            tau_unfiltered=tau_unfiltered,
            local=terms.local,
            p=measured.p.copy(),
            pdot=measured.pdot.copy(),
            p_ref=p_ref,
            closure=measured.closure.copy(),
            assist=assist + s.height.force,
            slope=s.levelling.slope,
            stance=s.stance.taken,
            ik_iterations=result.iterations,
            ik_residual=result.residual,
        )

    def _measure(self, s: LawState, inputs: LawInputs) -> Array:
        """Evaluate p, J and pdot in the adopted stance; return the up direction (3,)."""
        measured, aligns = self.measured, inputs.align or not s.aligned
        if aligns:
            fraction = min(1.0, inputs.dt / FOLLOW_S) if s.has_led else 1.0
            self._stance.advance(s.stance, measured.stance_at(inputs.q), fraction)
        measured.stance[:] = self.reference.inputs.stance[:] = s.stance.taken
        measured.update(inputs.q, inputs.v)
        self._levelling.advance(
            s.levelling, inputs.up_torso, measured.p[3:], inputs.dt, jump=aligns
        )
        return np.array(up_of(s.levelling.slope))

    def _closed_loop_reference(
        self, s: LawState, inputs: LawInputs, up: Array
    ) -> tuple[Array, Array]:
        """Return p_C and its rate (6,): the return to zero, the shift and the floor's slope."""
        p, pdot = self.measured.p, self.measured.pdot
        lean = up[:2] / up[2]
        if inputs.align or not s.aligned:
            s.aligned, s.since_align_s = True, 0.0
            p_C0 = p.copy()
            p_C0[:2] -= lean * p[2]
            p_C0 *= np.where(RECENTRED & s.has_led, 0.0, self._S_perp)
            s.p_C0, s.q, s.coupling = vector6(p_C0), tuple(inputs.q.tolist()), CouplingState()
            s.shift.stop()
            s.height.reset()
        else:
            s.has_led = True
            self._shift.advance(s.shift, inputs.shift, inputs.dt)
        s.since_align_s += inputs.dt
        p_C, pdot_C = _recentred(np.array(s.p_C0), s.since_align_s, self._recentre_s)
        s.shift.add_to(p_C, pdot_C)
        p_C[:2] += lean * p[2]
        pdot_C[:2] += lean * pdot[2]
        return p_C, pdot_C

    def _hand(self, s: LawState, inputs: LawInputs) -> tuple[float | None, float, float]:
        """Advance the assist; return the hand's lead and the assist's rate.

        Returns:
            The operator's upward force, N, world; None if unknown or if the height is closed. The
            pitch moment, N m; 0 if unknown or if pitch is closed in place. The assist's rate, N/s.
        """
        p, pdot, wrench = self.measured.p, self.measured.pdot, inputs.wrench
        held_z, held_pitch = s.height.hold
        goes = inputs.toward is not _PERSON
        force, moment_pitch = None, 0.0
        if wrench is not None:
            if not goes and held_z == 0.0:  # force on a closed height is no assist error
                force = force_up(wrench.force, p[3], p[4])
            if goes or held_pitch == 0.0:
                moment_pitch = wrench.moment[1]
        still = not inputs.align and is_still(pdot[2], pdot[4])
        assist_measured = None if force is None else -force
        rate = self._assist.advance(
            s.assist, inputs.assist, assist_measured, inputs.dt,
            still=still, shed_rate=inputs.shed_rate,
        )  # fmt: skip
        return force, moment_pitch, rate

    def _body_wrench(
        self, s: LawState, inputs: LawInputs, up: Array, p_ref: Array, pdot_ref: Array
    ) -> Array:
        """Return F_O (6,), N and N m; close height and pitch if no hand leads them."""
        measured, height = self.measured, s.height
        F_O: Array = np.zeros(6)
        F_O[:3] = self._weight * up
        F_O[4] = self.load.moment(s.load, float(measured.p[4]))
        goes = inputs.toward is not _PERSON
        if not inputs.align and (goes or any(inputs.released) or height.is_active):
            right, left = KNEES
            lift_n, moment = self._height.advance(
                height,
                inputs.toward,
                inputs.released,
                self.load.inertia * inputs.pitch_drive,
                measured.p,
                measured.pdot,
                (float(inputs.q[right]), float(inputs.q[left])),
                inputs.dt,
            )
            height.apply(p_ref, pdot_ref)
            F_O[:3] += lift_n * up
            F_O[4] += moment
        return F_O

    def _coupled_torque(
        self, s: LawState, coupled: Array, p_ref: Array, pdot_ref: Array, dt: float
    ) -> tuple[Array, Array]:
        """Return J^T [K_c e + B_c e' + F_I] (12,), N m, and its low-pass, tau_coupled."""
        e_y = float(p_ref[Y] - self.measured.p[Y])
        rate = float(pdot_ref[Y] - self.measured.pdot[Y])
        s.coupling.push = self._push.after(s.coupling.push, e_y, rate, dt)
        tau_unfiltered = coupled + s.coupling.push * self.reference.J[Y]
        bandwidth_hz = self.split.coupling.bandwidth_hz
        return tau_unfiltered, low_passed(s.coupling, tau_unfiltered, bandwidth_hz, dt)

    def rest_from_here(self, D: Array, torque: Array) -> Array:
        """Return the displacement of p (6,) at which local gains alone balance a torque, m and rad.

        Args:
            D: local stiffness (12,), N m/rad, certified at this tick.
            torque: torque beyond the one that balances the body here (12,), N m.
        """
        K_fail = self.split.certificate.failsafe_stiffness(D)
        return np.asarray(np.linalg.solve(K_fail, self.reference.T.T @ torque), float)

    def weigh(
        self, s: LoadState, tau: Array, v: Array, wrench: Wrench | None, dt: float, *, led: bool
    ) -> None:
        """Update the estimate of the load beyond the robot file, at the last tick's pose.

        Args:
            s: state of the estimate; updated in place.
            tau: measured joint torques (12,), N m.
            v: joint rates (12,), rad/s.
            wrench: operator's wrench on the torso; None if unknown.
            dt: time since the last tick, s.
            led: True while the planner is engaged.
        """
        if not self.load.enabled:
            return
        if wrench is None:
            F_z = float(tau @ self.reference.T[:, 2])
            self.load.advance_without_harness(s, F_z, dt, led=led)
            return
        at_ref, p = self.reference, self.measured.p
        force, moment = wrench_in_world(wrench, float(p[3]), float(p[4]))
        tau_held = tau + force @ at_ref.J_harness + moment * at_ref.J[4]
        T, rates = at_ref.T, (self.harness_rate(v), float(self.measured.pdot[4]))
        n = at_ref.J_harness[2] @ T
        self.load.advance(s, tau_held @ T, n, float(p[4]), rates, dt, led=led)

    def harness_rate(self, v: Array) -> float:
        """Return the vertical rate of the harness point at the last tick's pose, m/s, world.

        Args:
            v: joint rates (12,), rad/s.
        """
        return float(self.measured.J_harness[2] @ v)


def _recentred(p_C0: Array, since_s: float, recentre_s: float) -> tuple[Array, Array]:
    """Return p_C and its rate (6,): a minimum-jerk path from p_C0 to zero.

    Closed height and pitch keep their initial values, because no robot stands at height zero.

    Args:
        p_C0: initial pose (6,), m and rad.
        since_s: time since the start of the path, s.
        recentre_s: duration of the path, s.
    """
    if since_s >= recentre_s:
        return p_C0 * KEPT, np.zeros(6)
    s = since_s / recentre_s
    remaining = 1.0 - s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
    rate = -30.0 * s * s * (1.0 - s) * (1.0 - s) / recentre_s
    return p_C0 * np.where(RECENTRED, remaining, 1.0), p_C0 * np.where(RECENTRED, rate, 0.0)
