"""Whole-body law: Hybrid Open-Loop Closed-Loop Control (paper, docs/law.md).

One tick, in the paper's letters:

    p, J                 from the measured joints and the stance of the feet
    p_ref = S_perp p_C + S p
    q_ref = IK(p_ref)
    v_ref                J v_ref = S J v + S_perp pdot_C, C v_ref = 0
    F     = K_p (p_ref - p) + B_p (pdot_ref - pdot) + F_O
    T                    [J; C] T = [I; 0] at q_ref, so v_ref = T (S J v + S_perp pdot_C)
    K_q, B_q             at q_ref
    D, D_B               local gains that the joint services hold: schedule and certificate
    K_c, B_c             the part of K_p and B_p that D and D_B lack
    tau_ff  = J^T (m g up) + J_harness^T (F_assist + F_load) up
    tau_coupled = low-pass { J^T [K_c (p_ref - p) + B_c (pdot_ref - pdot) + F_I] }

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
from services.planner.law.coupling import CoupledTorque, PushIntegral, Y
from services.planner.law.gains import GainLaw
from services.planner.law.height import HeightReference, HeightState, Released, Toward
from services.planner.law.kinematics import Measured
from services.planner.law.law_terms import LawAtReference
from services.planner.law.levelling import Levelling
from services.planner.law.load import Load, LoadState
from services.planner.law.reference import Reference
from services.planner.law.shift import ShiftReference, ShiftState
from services.planner.law.split import GainSplit, LocalGains
from services.planner.law.stance import FOLLOW_S, Stance
from shared.arrays import Array
from shared.bus.messages import AS_CONFIGURED, STRAIGHT, Pair, Vector3, Vector4, Vector6, Wrench
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULE_INDEX, N_JOINTS, SIDES
from shared.state import copied

RECENTRED = np.array([True, True, False, True, False, True])
"""Rows of p whose closed-loop reference returns to zero: no roll or yaw, and the COM above the
ankles along gravity. Along the floor's normal the COM is off them by its height times the floor's
slope."""

_PERSON: Final = Toward.PERSON
KNEES = tuple(2 * MODULE_INDEX[f"knee_{side}"] + 1 for side in SIDES)
"""Indices of the knees' theta among the joints."""

KEPT = np.where(RECENTRED, 0.0, 1.0)
"""1 for the rows of p_C that stay."""


class LawOutput(NamedTuple):
    """Outputs of one tick for the twelve joints, (12,) where no other shape is given."""

    q_ref: Array
    v_ref: Array
    tau_ff: Array
    dtau_ff: Array
    tau_coupled: Array
    tau_unfiltered: Array
    """J^T [K_c e + B_c e' + F_I], `tau_coupled` before its low-pass."""
    local: LocalGains
    """D and D_B, certified."""
    p: Array
    """Measured pose (6,)."""
    pdot: Array
    p_ref: Array
    closure: Array
    assist: float
    """N"""
    slope: Pair
    """Rise of the floor along x and y, rad."""
    stance: Array
    """The right foot relative to the left (6,), as deviation from the robot file, m and rad."""
    ik_iterations: int
    ik_residual: float


class LawState(msgspec.Struct):
    """State of `Hocca`."""

    p_C0: tuple[float, ...] = (0.0,) * 6
    since_align_s: float = 0.0
    aligned: bool = False
    q: tuple[float, ...] = (0.0,) * N_JOINTS
    """Start of the inverse kinematics, rad."""
    assist: AssistState = msgspec.field(default_factory=AssistState)
    easing: EasingState = msgspec.field(default_factory=EasingState)
    has_led: bool = False
    coupling: tuple[float, ...] = (0.0,) * (2 * N_JOINTS + 1)
    """State of `CoupledTorque`, N m and N."""
    levelling: tuple[bool, float, float] = (False, 0.0, 0.0)
    """State of `Levelling`: True if a slope is known, and the slope, rad."""
    shift: ShiftState = msgspec.field(default_factory=ShiftState)
    stance: tuple[Vector6, bool] = (AS_CONFIGURED, False)
    """State of `Stance`: the adopted stance, m and rad, and True if it is refused."""
    load: LoadState = msgspec.field(default_factory=LoadState)
    height: HeightState = msgspec.field(default_factory=HeightState)


class Hocca:
    """The law and its state, such as the closed-loop reference p_C and the assist.

    Attributes:
        measured: at the measured joints of the last tick.
        reference: at the last tick's reference pose.
        split: of the gains, with their certificate.
        stance: of the feet.
        load: beyond the robot file.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Build the law; the first tick starts from the measured pose."""
        self.measured = Measured(config)
        self.reference = Reference(config)
        gains = GainLaw(config)
        self.split = GainSplit(config)
        self._S = gains.S
        self._terms = LawAtReference(gains, self.split)
        self._coupling = CoupledTorque(self.split.coupling.bandwidth_hz, PushIntegral(config.law))
        self._S_perp = 1.0 - self._S
        self._levelling = Levelling(config.imu.levelling_s)
        self._shift = ShiftReference(config.law.shift_max)
        low, high = config.joint_service.damp_knee_stop, config.limits.knee.theta[1]
        self._height = HeightReference((low, high))
        self.stance = Stance(config.law.stance_max)
        self._weight = config.total_mass * GRAVITY
        self._F_O: Array = np.zeros(6)
        size = config.geometry.torso_size
        inertia = config.torso_mass * (size[0] ** 2 + size[2] ** 2) / 12.0
        # the paper's split serves for comparison only: no load correction is added to it
        certified = config.law.split == "certified"
        correction_max = config.law.load_correction if certified else (0.0, 0.0)
        self.load = Load(correction_max, self._weight, config.torso_mass, inertia)
        self._assist = AssistLaw(config.assist)
        self._easing = LeadEasing(config.law.lead_easing)
        self._recentre_s = config.law.recentre_s
        self._p_C0: Array = np.zeros(6)
        self._state = LawState(
            assist=self._assist.state,
            easing=self._easing.state,
            shift=self._shift.state,
            load=self.load.state,
            height=self._height.state,
        )

    def tick(
        self,
        q: Array,
        v: Array,
        assist_wanted: float,
        dt: float,
        *,
        shift_requested: Vector4 = STRAIGHT,
        toward: Toward = Toward.PERSON,
        released: Released = (False, False),
        pitch_drive: float = 0.0,
        align: bool = False,
        wrench: Wrench | None = None,
        up_torso: Vector3 | None = None,
    ) -> LawOutput:
        """Run the law once: docs/law.md (6), (12) and (17).

        Args:
            q: measured joint angles (12,), rad.
            v: measured joint rates (12,), rad/s.
            assist_wanted: assist force that the operator requests, N. Its rate is limited here,
                except in the first tick, which takes over the assist that HOLD carries.
            dt: time since the last tick, s.
            shift_requested: requested x, y (m), roll and yaw (rad) of the shift; limited here.
            toward: where to go without a hand (`services.planner.law.height`).
            released: nobody leads the height, the pitch.
            pitch_drive: acceleration of a pitch that nobody leads, rad/s^2.
            align: start from the measured pose, so that engaging makes no step. p_C starts at the
                measured pose and returns to zero (COM over the ankles, no roll, no yaw; height and
                pitch stay) during `law.recentre_s` of ticks without `align`. A planner that was
                engaged before starts from p_C = 0 instead. The pose it finds is then part of a
                sway, and after another drop-out HOLD would stay at that pose. A robot held off
                centre by 25 mm fell at the second push. The modules' blend avoids a step in this
                case. The requested shift (`shift_requested`) is kept.
            wrench: of the operator on the torso, if it is fresh and valid.
            up_torso: unit vector against gravity, torso axes, if the IMU knows it now.
        """
        measured, reference = self.measured, self.reference
        if align or not self._state.aligned:
            fraction = min(1.0, dt / FOLLOW_S) if self._state.has_led else 1.0
            self.stance.take(measured.stance_at(q), fraction)
            self._apply_stance()
        measured.update(q, v)
        self._levelling.advance(up_torso, measured.p[3:], dt, jump=align or not self._state.aligned)
        up = self._levelling.up
        self._F_O[:3] = self._weight * up
        self._F_O[4] = self.load.moment(float(measured.p[4]))
        if align or not self._state.aligned:
            self._align(q)
            self._shift.rest()
            self._height.reset()
        else:
            self._state.has_led = True
            self._shift.advance(shift_requested, dt)
        pdot = measured.pdot
        p_C, pdot_C = self._closed_loop_reference(dt)
        self._shift.add_to(p_C, pdot_C)
        lean = up[:2] / up[2]
        p_C[:2] += lean * measured.p[2]
        pdot_C[:2] += lean * pdot[2]
        p_ref = self._S_perp * p_C + self._S * measured.p
        pdot_ref = self._S_perp * pdot_C + self._S * pdot
        force, moment_pitch = None, 0.0
        if wrench is not None:
            force = force_up(wrench.force, measured.p[3], measured.p[4])
            moment_pitch = wrench.moment[1]
        still = not align and is_still(pdot[2], pdot[4])
        height = self._height
        held_z, held_pitch = height.state.hold
        if toward is not _PERSON or held_z > 0.0:
            force = None  # the hand leads no height now, and its force is no error of the assist
        if held_pitch > 0.0 and toward is _PERSON:
            moment_pitch = 0.0
        measured_assist = None if force is None else -force
        assist_rate = self._assist.advance(assist_wanted, measured_assist, dt, still=still)
        assist, F_O = self._assist.assist, self._F_O
        if not align and (toward is not _PERSON or any(released) or height.is_active):
            T_z, knees = reference.T[:, 2], (float(q[KNEES[0]]), float(q[KNEES[1]]))
            drive = self.load.inertia * pitch_drive
            lift_n, moment = height.advance(
                toward, released, drive, measured.p, pdot, T_z, knees, dt
            )
            height.apply(p_ref, pdot_ref)
            F_O = F_O.copy()
            F_O[:3] += lift_n * up
            F_O[4] += moment
        ease_z, ease_pitch = self._easing.ease(force, moment_pitch, assist, dt)

        reference.load(
            pdot_ref,
            F_O,
            (assist + self.load.force()) * up,
            assist_rate * up,
            measured.D_left,
        )
        result = reference.solve(p_ref)
        e_p, e_pdot = p_ref - measured.p, pdot_ref - pdot
        terms = self._terms.evaluate(reference, e_p, e_pdot)
        integral = self._coupling.integral
        integral.advance(float(e_p[Y]), float(e_pdot[Y]), dt)
        tau_unfiltered = terms.coupled + integral.force * reference.J[Y]
        tau_coupled = self._coupling.advance(tau_unfiltered, dt)
        # the eased lead goes into tau_coupled, which HOLD drops; in tau_ff it would outlive the
        # hand. It is a force fed forward, not fed-back joint rates, so the harness filter is enough
        tau_coupled += ease_z * reference.J_harness[2] + ease_pitch * reference.J[4]
        reference.expect(dt)
        return LawOutput(
            q_ref=reference.q.copy(),
            v_ref=reference.v.copy(),
            tau_ff=reference.gravity + reference.assist,
            dtau_ff=reference.dtau_ff.copy(),
            tau_coupled=tau_coupled,
            tau_unfiltered=tau_unfiltered,
            local=terms.local,
            p=measured.p.copy(),
            pdot=pdot.copy(),
            p_ref=p_ref,
            closure=measured.closure.copy(),
            assist=assist + height.state.force,
            slope=self._levelling.slope,
            stance=self.stance.taken,
            ik_iterations=result.iterations,
            ik_residual=result.residual,
        )

    def rest_from_here(self, D: Array, torque: Array) -> Array:
        """Return how far p (6,) goes until local gains alone balance a torque, m and rad.

        Args:
            D: local stiffness (12,), N m/rad, certified at this tick.
            torque: beyond what balances the body here (12,), N m.
        """
        K_fail = self.split.certificate.failsafe_stiffness(D)
        return np.asarray(np.linalg.solve(K_fail, self.reference.T.T @ torque), float)

    def weigh(self, tau: Array, v: Array, wrench: Wrench | None, dt: float, *, led: bool) -> None:
        """Update the estimate of the load beyond the robot file, at the last tick's pose.

        Args:
            tau: measured joint torques (12,), N m.
            v: joint rates (12,), rad/s.
            wrench: of the operator on the torso; None if it is not known.
            dt: time since the last tick, s.
            led: the planner is engaged.
        """
        if not self.load.enabled:
            return
        if wrench is None:
            F_z = float(tau @ self.reference.T[:, 2])
            self.load.advance_without_harness(F_z, dt, led=led)
            return
        at_ref, p = self.reference, self.measured.p
        force, moment = wrench_in_world(wrench, float(p[3]), float(p[4]))
        tau_held = tau + force @ at_ref.J_harness + moment * at_ref.J[4]
        T, rates = at_ref.T, (self.harness_rate(v), float(self.measured.pdot[4]))
        self.load.advance(tau_held @ T, at_ref.J_harness[2] @ T, float(p[4]), rates, dt, led=led)

    def harness_rate(self, v: Array) -> float:
        """Return the vertical rate of the harness point at the last tick's pose, m/s, world.

        Args:
            v: joint rates (12,), rad/s.
        """
        return float(self.measured.J_harness[2] @ v)

    def snapshot(self) -> LawState:
        """Return a copy of the state; `restore` continues from it."""
        state = msgspec.structs.replace(
            self._state,
            p_C0=tuple(self._p_C0.tolist()),
            q=tuple(self.reference.start.tolist()),
            coupling=self._coupling.snapshot(),
            levelling=self._levelling.snapshot(),
            stance=self.stance.snapshot(),
        )
        return copied(state)

    def restore(self, state: LawState) -> None:
        """Continue from a copy of a state."""
        self._state = own = copied(state)
        self._assist.state, self._easing.state, self._shift.state = (
            own.assist,
            own.easing,
            own.shift,
        )
        self.load.state, self._height.state = own.load, own.height
        self._p_C0 = np.array(own.p_C0)
        self.reference.start[:] = own.q
        self._coupling.restore(own.coupling)
        self._levelling.restore(own.levelling)
        self.stance.restore(own.stance)
        self._apply_stance()

    def _apply_stance(self) -> None:
        for stance in (self.measured.stance, self.reference.inputs.stance):
            stance[:] = self.stance.taken

    def _align(self, q: Array) -> None:
        self._state.aligned = True
        self._coupling.reset()
        kept_rows = np.where(RECENTRED & self._state.has_led, 0.0, self._S_perp)
        p = self.measured.p.copy()
        p[:2] -= self._levelling.up[:2] / self._levelling.up[2] * p[2]
        self._p_C0 = p * kept_rows
        self._state.since_align_s = 0.0
        self.reference.start[:] = q

    def _closed_loop_reference(self, dt: float) -> tuple[Array, Array]:
        """Return p_C and its rate: a minimum-jerk path from the pose found by `align` to zero.

        Height and pitch stay where they were found, if they are closed: at zero nothing stands.
        """
        self._state.since_align_s += dt
        if self._state.since_align_s >= self._recentre_s:
            return self._p_C0 * KEPT, np.zeros(6)
        s = self._state.since_align_s / self._recentre_s
        remaining = 1.0 - s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = -30.0 * s * s * (1.0 - s) * (1.0 - s) / self._recentre_s
        return self._p_C0 * np.where(RECENTRED, remaining, 1.0), self._p_C0 * np.where(
            RECENTRED, rate, 0.0
        )
