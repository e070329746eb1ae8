"""A policy's numbers: what it sees and does, as vectors. Pure.

`PolicyController` puts a policy in the planner's place: in the environment, in `xrl sim` and live
it is the same code, behind the same certificate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from services.planner.controller import Action, Observation
from shared.arrays import Array
from shared.joints import N_JOINTS

Policy = Callable[[Array], Array]
"""Returns an action (36,) in -1 .. 1 for an observation (56,)."""

TORQUE_SCALE: Final = 100.0
"""N m; torques are seen in units of it, and forces in as many N."""
RATE_SCALE: Final = 5.0
"""rad/s and m/s; rates are seen in units of it."""
OFFSET: Final = 0.05
"""rad; an action of 1 moves a joint's reference so far."""
TORQUE: Final = 20.0
"""N m; an action of 1 adds so much to a joint's coupled torque."""
OCTAVE: Final = 2.0
"""An action of 1 takes so many times a joint's local stiffness, one of -1 as much less."""
LARGEST: Final = 50.0
OBSERVED: Final = 4 * N_JOINTS + 8
ACTIONS: Final = 3 * N_JOINTS


def observed(seen: Observation) -> Array:
    """Return what a policy sees (56,).

    Joint angles, rates and torques (36), pose and its rate (12), the person's wrench (6; zeros if
    it is not known), 1 if it is known, and the assist that is requested; each within +-LARGEST.
    """
    wrench = (0.0,) * 6 if seen.wrench is None else (*seen.wrench.force, *seen.wrench.moment)
    known = float(seen.wrench is not None)
    parts = (
        seen.q, seen.v / RATE_SCALE, seen.tau / TORQUE_SCALE, seen.p, seen.pdot / RATE_SCALE,
        np.array(wrench) / TORQUE_SCALE, (known, seen.request.assist_n / TORQUE_SCALE),
    )  # fmt: skip
    return np.clip(np.concatenate(parts), -LARGEST, LARGEST)


def acted(action: Array, seen: Observation) -> Action:
    """Return what a policy's action (36,) asks for; zero is the shipped law."""
    law = Action.of(seen.law)
    reference, torque, stiffness = np.clip(np.asarray(action, float), -1.0, 1.0).reshape(3, -1)
    return law._replace(
        q_ref=law.q_ref + OFFSET * reference,
        tau_coupled=law.tau_coupled + TORQUE * torque,
        D=law.D * OCTAVE**stiffness,
    )


class PolicyController:
    """A policy in the planner's place: `Controller = lambda robot: PolicyController(policy)`."""

    def __init__(self, policy: Policy) -> None:
        """Take the policy."""
        self._policy = policy

    def reset(self, seen: Observation) -> None:
        """A policy has no state here."""

    def step(self, seen: Observation) -> Action:
        """Ask the policy."""
        return acted(self._policy(observed(seen)), seen)
