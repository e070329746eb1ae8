"""Interface of a controller of your own, in the place of the shipped law (docs/own-controller.md).

It runs inside the planner: in lockstep, live and from the log. Everything around it stays as it is:
stance, load, assist, engagement and trips of the planner; certificate of the local gains
(`services.planner.watch.controller_guard`); age rule, envelope and torque limits of the joint
services. Joints are in the order of `shared.joints`, the pose is p = [COM x y z; torso roll
pitch yaw].
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from services.planner.intents import OperatorRequest
from services.planner.law.hocca import LawOutput
from shared.arrays import Array
from shared.bus.messages import Wrench


class Action(NamedTuple):
    """What the joint services are told: arrays (12,).

    A joint's torque is D (q_ref - q) + D_B (v_ref - v) + tau_ff + tau_coupled; q_ref and tau_ff are
    extrapolated by the command's age. HOLD keeps q_ref, tau_ff and D, and drops tau_coupled.
    """

    q_ref: Array
    """rad"""
    v_ref: Array
    """rad/s; the rate of q_ref. A joint service refuses a q_ref that goes another way."""
    tau_ff: Array
    """N m; what holds the body up without anybody's reaction."""
    dtau_ff: Array
    """Rate of tau_ff, N m/s."""
    tau_coupled: Array
    """N m; all that is fed back over the body. Low-pass it: the joints flex."""
    D: Array
    """Local stiffness, N m/rad. It must stand alone; the local damping D_B is the schedule's."""

    @classmethod
    def of(cls, law: LawOutput) -> Action:
        """Return what the shipped law does at this tick."""
        return cls(law.q_ref, law.v_ref, law.tau_ff, law.dtau_ff, law.tau_coupled, law.local.D)


class Observation(NamedTuple):
    """What a controller is given at a tick."""

    time_s: float
    """Since it was last reset."""
    dt: float
    """Since the last tick, s."""
    q: Array
    """Joint angles (12,), rad."""
    v: Array
    """Joint rates (12,), rad/s."""
    tau: Array
    """Joint torques (12,), N m."""
    p: Array
    """Measured pose (6,), m and rad."""
    pdot: Array
    """Its rate (6,)."""
    J: Array
    """dp/dq (6, 12)."""
    T: Array
    """Joint rates per unit of p with closed legs (12, 6), at the law's reference pose."""
    wrench: Wrench | None
    """Wrench of the person on the torso, at the harness, torso axes; None if unknown."""
    request: OperatorRequest
    """Assist and shift that the operator requests."""
    law: LawOutput
    """What the shipped law does at this tick."""


class Controller(Protocol):
    """A controller; each planner makes its own."""

    def reset(self, seen: Observation) -> None:
        """Begin at a pose; called at every tick in which the planner does not lead."""

    def step(self, seen: Observation) -> Action:
        """Return what to do at a tick in which the planner leads. A period is 4 ms."""
