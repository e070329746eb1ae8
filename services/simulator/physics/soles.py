"""Measures what the floor does to the simulated robot's soles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from services.simulator.physics.posture import as_vector
from shared.bus.messages import Pair, Vector3
from shared.extras import late

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")

LEAST_N: Final = 1e-3
"""A sole that bears less has no centre of pressure."""


class SoleLoad(NamedTuple):
    """What the floor does to one sole."""

    force: Vector3
    """N, world."""
    cop: Pair
    """Centre of pressure, x and y, m, world; (0, 0) if it bears nothing."""


def sole_loads(model: Any, data: Any, feet: Sequence[int]) -> list[SoleLoad]:
    """Return each foot's load, from the contacts of the last step.

    Args:
        model: MuJoCo's.
        data: MuJoCo's, after a step.
        feet: ids of the bodies, by side.
    """
    count = data.ncon
    contact, local = data.contact, np.zeros(6)
    forces = np.zeros((count, 3))
    for index in range(count):
        mujoco.mj_contactForce(model, data, index, local)
        forces[index] = local[:3] @ contact.frame[index].reshape(3, 3)  # of geom1 on geom2
    bodies = model.geom_bodyid[contact.geom] if count else np.zeros((0, 2), int)
    loads = []
    for foot in feet:
        on = forces * ((bodies[:, 1] == foot) * 1.0 - (bodies[:, 0] == foot))[:, None]
        force = on.sum(axis=0)
        bears = abs(force[2]) > LEAST_N
        x, y = (on[:, 2] @ contact.pos[:, :2] / force[2]).tolist() if bears else (0.0, 0.0)
        loads.append(SoleLoad(as_vector(force), (x, y)))
    return loads
