"""External forces on the simulated torso: the hand, the person's weight, pushes and the hoist."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import msgspec
import numpy as np

from services.simulator.physics.body import Body
from services.simulator.physics.operator import (
    NO_ACT,
    HandForce,
    LedHand,
    Operator,
    Wearer,
    acting,
)
from shared.arrays import Array
from shared.bus.messages import Vector3, Vector4
from shared.config.scenarios import Lead, Scenario, lead, push_at

HOIST_STIFFNESS: Final = (2e4, 2e3)
"""Stiffness of the hoist while it holds the torso, N/m and N m/rad."""
HOIST_DAMPING: Final = (2e3, 2e2)
"""Damping of the hoist, N s/m and N m s/rad."""
HOIST_WEIGHT_SHARE: Final = 0.75
"""Fraction of the weight that the hoist carries; the soles stay on the floor."""


class Torso(NamedTuple):
    """Views of the torso in MuJoCo's memory, because querying an array costs a microsecond."""

    position: Array
    """(3,) m, world."""
    rotation: Array
    """(9,), row by row; rotates torso axes to world axes."""
    rates: Array
    """(6,) velocity in world axes and angular velocity in torso axes."""
    wrench: Array
    """(6,) N and N m, world, at the centre of mass; `OutsideForces` writes it."""
    com: list[float]
    """Centre of mass (3,), m, torso axes; a plant may move it."""


class _Hoist(msgspec.Struct):
    """Spring-damper on the torso that also carries weight, and fades out on release."""

    weight: float
    """Weight of the robot, N."""
    release_s: float
    """Duration of the release, s."""
    position: Array
    """Position at which the torso is held (3,), m, world."""
    share: float = 1.0
    """Fraction of the support: 1 hanging, 0 free."""
    releasing: bool = False

    def advance(self, torso: Torso, dt: float) -> Array:
        """Advance the release; return force and moment on the torso (6,), N and N m, world."""
        if self.releasing:
            self.share = max(0.0, self.share - dt / self.release_s)
        k_lin, k_ang = HOIST_STIFFNESS
        b_lin, b_ang = HOIST_DAMPING
        rotation = torso.rotation.reshape(3, 3)
        turn = 0.5 * np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        wrench = np.concatenate(
            (
                k_lin * (self.position - torso.position) - b_lin * torso.rates[:3],
                -k_ang * turn - b_ang * (rotation @ torso.rates[3:]),
            )
        )
        wrench[2] += HOIST_WEIGHT_SHARE * self.weight
        wrench = np.asarray(self.share * wrench, float)
        wrench[3:] -= np.cross(rotation @ torso.com, wrench[:3])
        return wrench


class OutsideForces:
    """Forces of the operator, pushes and the hoist on the torso.

    Attributes:
        operator: the hand's spring-damper; may be replaced.
        asked: assist, N, and shift that another operator requests instead of the scenario.
        led_hand: the hand that an operator leads instead of the scenario.
        holds: True if the operator's hand is on the harness.
        hand: the hand's present force.
        hand_side: the hand's force along world y, N.
        hand_ahead: the person's force along world x, N.
        push: the present push, N, world.
        harness_force: the operator's force on the torso at the harness point, N, torso axes.
        harness_moment: the operator's moment on the torso, N m, torso axes.
    """

    def __init__(self, body: Body, scenario: Scenario, torso: Torso) -> None:
        """Hang the torso on the hoist at its present position."""
        self.scenario = scenario
        self._torso = torso
        self._harness_point = body.harness_point
        self.operator = Operator(body.hand, body.harness_point)
        self.wearer = Wearer(body.plant.person)
        self.hoist = _Hoist(body.weight, body.hoist_s, torso.position.copy())
        self.asked: tuple[float, Vector4] | None = None
        self.led_hand: LedHand | None = None
        self.holds = scenario.hand
        self.hand = HandForce(0.0, 0.0)
        self.hand_side = self.hand_ahead = 0.0
        self.push: Vector3 = (0.0, 0.0, 0.0)
        self.harness_force: Vector3 = (0.0, 0.0, 0.0)
        self.harness_moment: Vector3 = (0.0, 0.0, 0.0)

    def lead(self, scenario_s: float) -> Lead:
        """Return the operator's present request."""
        wanted = lead(self.scenario, scenario_s)
        if self.led_hand is not None:
            wanted = self.led_hand.over(wanted)
        if self.asked is not None:
            wanted = wanted._replace(assist=self.asked[0], shift=self.asked[1])
        return wanted

    def apply(self, scenario_s: float, dt: float) -> None:
        """Advance by `dt`, s, and set the wrench on the torso.

        It uses plain floats, because it runs at every step and NumPy's calls on three numbers
        would cost more than the physics.
        """
        torso, led_hand = self._torso, self.led_hand
        if led_hand is not None:
            led_hand.advance(dt)
        wanted = self.lead(scenario_s)
        r = torso.rotation.tolist()  # row by row
        x, y, z = self._harness_point
        arm_x = r[0] * x + r[1] * y + r[2] * z
        arm_y = r[3] * x + r[4] * y + r[5] * z
        arm_z = r[6] * x + r[7] * y + r[8] * z
        # MuJoCo applies external forces at the body's centre of mass, which a plant may move
        com_x, com_y, com_z = torso.com
        off_x = r[0] * com_x + r[1] * com_y + r[2] * com_z
        off_y = r[3] * com_x + r[4] * com_y + r[5] * com_z
        off_z = r[6] * com_x + r[7] * com_y + r[8] * com_z
        self.hand, side = HandForce(0.0, 0.0), 0.0
        acts = self.scenario.act
        now = acting(acts, scenario_s) if acts else NO_ACT
        if now.grip == 0.0:
            self.wearer.holds = False
        elif self.holds and self.hoist.share == 0.0:
            height = float(torso.position[2]) + arm_z
            _, v_y, v_z, w_x, w_y, w_z = torso.rates.tolist()  # omega in torso axes
            omega_x = r[0] * w_x + r[1] * w_y + r[2] * w_z
            omega_y = r[3] * w_x + r[4] * w_y + r[5] * w_z
            rate = v_z + omega_x * arm_y - omega_y * arm_x
            self.wearer.grip(height - wanted.height - z)
            above, rising = self.wearer.motion()
            height, rate = height - above, rate - rising
            self.hand = self.operator.force(wanted, height, rate, math.atan2(-r[6], r[8]), w_y)
            if acts:
                force_z, moment = self.hand
                self.hand = HandForce(now.grip * force_z, now.grip * moment)
            if wanted.side is not None:
                omega_z = r[6] * w_x + r[7] * w_y + r[8] * w_z
                across = v_y + omega_z * arm_x - omega_x * arm_z
                at = float(torso.position[1]) + arm_y
                side = self.operator.force_side(wanted, at, across)
        if acts:
            self.hand = HandForce(self.hand.force_z + now.up, self.hand.moment_pitch)
        self.wearer.step(dt, self.hand.force_z, wanted.assist, now.load)
        self.push = push_at(self.scenario, scenario_s) if scenario_s >= 0.0 else (0.0, 0.0, 0.0)
        if led_hand is not None:
            self.push = led_hand.push or self.push
        f, m = self.hand.force_z - self.wearer.load_n, self.hand.moment_pitch
        ahead = now.ahead
        self.hand_side, self.hand_ahead = side, ahead
        # in torso axes, as the sensor measures it, and m about torso y
        self.harness_force = (
            r[0] * ahead + r[3] * side + r[6] * f,
            r[1] * ahead + r[4] * side + r[7] * f,
            r[2] * ahead + r[5] * side + r[8] * f,
        )
        self.harness_moment = (0.0, m, 0.0)
        torso.wrench[:] = (
            self.push[0] + ahead,
            self.push[1] + side,
            self.push[2] + f,
            r[1] * m + (arm_y - off_y) * f - (arm_z - off_z) * side,
            r[4] * m - (arm_x - off_x) * f + (arm_z - off_z) * ahead,
            r[7] * m + (arm_x - off_x) * side - (arm_y - off_y) * ahead,
        )
        if self.hoist.share > 0.0:
            torso.wrench[:] += self.hoist.advance(torso, dt)
