"""Pose p, its Jacobian and the Hessian term, evaluated as numbers (paper section IV).

p = [COM x y z; torso roll pitch yaw]. The load-sharing matrices D mix the two legs' estimates of
the torso: J_torso = [D_R^T J_R, D_L^T J_L]. J^T F then requests from each foot a wrench that its
sole can bear. Each knee's mass enters through its own leg. `services.planner.law.symbolic` contains
the equations.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from services.planner.law import symbolic
from services.planner.law.model import leg_geometry
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.config.sections import GeometryConfig, LawConfig, MassConfig
from shared.joints import N_LEG
from shared.robot.compiled_graph import CompiledGraph

_GRAPHS: Final[dict[tuple[MassConfig, GeometryConfig, LawConfig], symbolic.Graphs]] = {}
"""Graphs per robot. A process builds each once, because that takes a tenth of a second."""
_GRAPHS_KEPT: Final = 16
DETERMINANT_MIN: Final = 0.05
"""m^3; minimum determinant of a leg's Jacobian. For straighter or more folded legs (hip to ankle
outside 0.79 to 1.28 m) the force is unknown: 1 N m of friction would count as more than 10 N."""


class Kinematics:
    """p, J and the closure of the two legs at one joint configuration.

    `update(q)` writes these arrays, and the next call overwrites them:

    - `p` (6,): m and rad; `J` (6, 12): dp/dq.
    - `closure` (6,): left minus right estimate of the torso, m and rad; `C` (6, 12): d closure/dq.
    - `J_harness` (3, 12): harness point's velocity per joint rate, m/rad, world.
    - `r_torso` (3,), `r_harness` (3,): m, world.
    - `D_left` (6, 6): the left leg's share of a torso wrench; the right's is I - D_left.

    The caller writes:

    - `stance` (6,): pose of the right foot relative to the left, as a deviation from the robot
      file: x, y, z in m and a rotation vector in rad, world axes. The origin is midway between the
      feet.
    """

    def __init__(self, config: RobotConfig) -> None:
        graphs = graphs_of(config)
        self._sharing = CompiledGraph(graphs.sharing)
        self._pose = CompiledGraph(graphs.pose)
        self._hessian = CompiledGraph(graphs.hessian)
        self.stance: Array = np.zeros(6)
        self.D_left = self._sharing.results[0]
        (
            self.p,
            self.closure,
            self.J,
            self.C,
            self.J_harness,
            self.r_torso,
            self.r_harness,
        ) = self._pose.results

    def update(self, q: Array, D_left: Array | None = None) -> None:
        """Compute all outputs at joint angles q (12,), rad.

        Args:
            q: joint angles.
            D_left: load sharing (6, 6) to use; None computes it at q. A tick uses the sharing of
                the measured pose throughout.
        """
        if D_left is None:
            self._sharing.arguments[0][:] = q
            self._sharing.arguments[1][:] = self.stance
            self._sharing()
        else:
            self.D_left[:] = D_left
        self._pose.arguments[0][:] = q
        self._pose.arguments[1][:] = self.stance
        self._pose.arguments[2][:] = self.D_left
        self._pose()

    def hessian_times(self, F: Array, F_harness: Array) -> Array:
        """Return sum_i H_i F_i (12, 12), plus the harness point's term for its force, N m/rad.

        It is d(J^T F + J_harness^T F_harness)/dq at the last `update`, with each leg's share of the
        wrench constant. It is symmetric, and exact along the closed chain. The next call overwrites
        it.

        Args:
            F: wrench along p (6,): N, and N m along roll, pitch, yaw.
            F_harness: force at the harness point (3,), N, world.
        """
        q, stance, D_left, force, at_harness = self._hessian.arguments
        q[:], stance[:] = self._pose.arguments[0], self._pose.arguments[1]
        D_left[:] = self.D_left
        force[:] = F
        at_harness[:] = F_harness
        self._hessian()
        return self._hessian.results[0]


class Measured:
    """Kinematics of a tick at the measured joints.

    `update` writes these arrays, and the next call overwrites them: `D_left`, `p`, `closure`, `J`,
    `C` and `J_harness` as in `Kinematics`, and `pdot` (6,): J v, m/s and rad/s.

    The caller writes `stance` (6,), as in `Kinematics`.
    """

    def __init__(self, config: RobotConfig) -> None:
        graphs = graphs_of(config)
        self._graph, self._stance = CompiledGraph(graphs.measured), CompiledGraph(graphs.stance)
        self._q, self._v, self.stance = self._graph.arguments
        (
            self.D_left, self.p, self.closure, self.J, self.C, self.J_harness, self.pdot,
            self._upward, self._determinants,
        ) = self._graph.results  # fmt: skip

    def update(self, q: Array, v: Array) -> None:
        """Compute all outputs.

        Args:
            q: joint angles (12,), rad.
            v: joint rates (12,), rad/s.
        """
        self._q[:], self._v[:] = q, v
        self._graph()

    def stance_at(self, q: Array) -> Array:
        """Return the stance (6,) in which the legs agree at q; overwritten by the next call."""
        self._stance.arguments[0][:] = q
        self._stance()
        return self._stance.results[0]

    def leg_loads(self, tau: Array) -> tuple[float, float]:
        """Return the upward force of right and left leg on the torso, N; NaN if unknown.

        It is unknown for straight and folded legs (`DETERMINANT_MIN`). The joint torques also carry
        part of the leg's own weight, which is not subtracted.

        Args:
            tau: joint torques (12,), N m.
        """
        rows, (right, left) = self._upward, self._determinants.tolist()
        return (
            float(rows[0] @ tau[:N_LEG]) if right > DETERMINANT_MIN else math.nan,
            float(rows[1] @ tau[N_LEG:]) if left > DETERMINANT_MIN else math.nan,
        )


def graphs_of(config: RobotConfig) -> symbolic.Graphs:
    """Return the graphs of a robot."""
    key = (config.mass, config.geometry, config.law)
    if key not in _GRAPHS:
        if len(_GRAPHS) == _GRAPHS_KEPT:
            del _GRAPHS[next(iter(_GRAPHS))]
        _GRAPHS[key] = symbolic.build(config, leg_geometry(config))
    return _GRAPHS[key]
