"""Fits the standing robot's masses, zeros and torque scale to quasi-static moments. Pure.

Maximum a posteriori: the balance of the torso and the place of the feet (`body_statics`) at every
moment, and for each parameter what is plausible before anything is measured (`PRIORS`). With errors
x, what a motor's encoder and its drive report becomes what the joint has:

    tau  = (1 + s) tau_asked - c tanh(v / v_0) - d v
    q    = q_reported - zero - tau / k - (play / 2) tanh(tau / tau_0)

A sole on its floor gives way to the ankle's torque like a spring in series: ankles have a k of
their own. Without it a shift of the COM by 30 mm looked like a torque scale of 0.95.

The noise of both sets of equations is taken from their own residuals. Residuals of one moment and
the next are alike (friction, play), so the covariance is of blocks of moments (sandwich estimator);
a parameter that the record does not show keeps its prior's width, and is said to be unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import AXES, JOINTS, N_JOINTS, SIDES
from tools.bringup.identify.body_statics import BodyStatics
from tools.bringup.identify.quasi_static import SLOT_S, Moments


class Prior(NamedTuple):
    """What is plausible for a parameter before anything is measured: normal."""

    name: str
    unit: str
    mean: float
    sd: float
    """Standard deviation."""


SCALE: Final = "torque scale"
MASS: Final = "payload"
COM: Final = tuple(f"payload COM {axis}" for axis in "xyz")
HARNESS: Final = tuple(f"harness point {axis}" for axis in "xyz")
ZEROS: Final = tuple(f"zero {joint}" for joint in JOINTS)
COMPLIANCE: Final = "compliance"
SOLES: Final = ("sole's compliance, roll", "sole's compliance, pitch")
PLAY: Final = "half play"
FRICTION: Final = tuple(f"friction {joint}" for joint in JOINTS)
VISCOUS: Final = tuple(f"viscous friction {joint}" for joint in JOINTS)

PRIORS: Final = (
    Prior(SCALE, "1", 0.0, 0.1),
    Prior(MASS, "kg", 0.0, 10.0),
    *(Prior(name, "kg m", 0.0, 1.0) for name in COM),
    *(Prior(name, "m", 0.0, 0.05) for name in HARNESS),
    *(Prior(name, "rad", 0.0, 0.02) for name in ZEROS),
    Prior(COMPLIANCE, "rad/(N m)", 1.5e-4, 1.5e-4),
    *(Prior(name, "rad/(N m)", 1e-4, 3e-4) for name in SOLES),
    Prior(PLAY, "rad", 1e-3, 1e-3),
    *(Prior(name, "N m", 0.3, 0.3) for name in FRICTION),
    *(Prior(name, "N m s/rad", 0.5, 1.0) for name in VISCOUS),
)
"""Errors against the robot file, where it has a figure. COM: first moment of all that the torso
carries beyond the file, kg m. `docs/identify.md` says where each width comes from."""

FEET_SD: Final = (0.003, 0.003, 0.5, 0.5, 0.5, 0.003)
"""Prior of the left foot's place against the file's, seen from the right one: soles flat on one
floor within 3 mrad and 3 mm; yaw (rad), x and y (m) wherever they stand."""
ADDED_COM_SD: Final = 0.3
"""m; where an added weight hangs, about the torso's origin."""

TORQUE_SD: Final = 0.2
"""N m of a joint that moves, to begin with."""
STUCK_SD: Final = 0.3
"""N m more of one that does not: its dry friction has no known sign."""
FEET_NOISE: Final = (5e-4, 5e-4, 5e-4, 1e-3, 1e-3, 1e-3)
"""rad and m, to begin with."""
V_0: Final = 0.002
"""rad/s; at this speed a joint's dry friction is nearly whole."""
TAU_0: Final = 2.0
"""N m; from this torque on the play is taken up to one side."""
BLOCK: Final = round(4.0 / SLOT_S)
"""Moments in a block."""
MODEL_ERROR: Final = 2.0
"""Factor on all standard deviations: what the equations leave out is alike for longer than a block.
In 10 plants with every error drawn, true values lay 0.8 to 2.5 of the residuals' own standard
deviations away (root mean square, by parameter)."""
ROUNDS: Final = 6
HUBER: Final = 3.0
"""Standard deviations beyond which a moment counts less."""
MOMENTS_MIN: Final = 50
"""Fewer are refused: ten seconds of quasi-static motion."""
_ANKLES: Final = [JOINTS.index(f"ankle_{side}_{axis}") for side in SIDES for axis in AXES]
_STEP: Final = 1e-3
"""Step of the numerical derivative, in widths of the prior."""


class Record(NamedTuple):
    """One stand of the same robot: the feet stay where they are."""

    moments: Moments
    added_kg: float = 0.0
    """Mass that hangs on the torso in this record, known by a scale."""


class BodyFit(NamedTuple):
    """Result."""

    names: tuple[str, ...]
    priors: tuple[Prior, ...]
    x: Array
    """Errors (m,) against the robot file, in the order of `names`."""
    covariance: Array
    """(m, m)"""
    residuals: Array
    """Torso's imbalance (n, 6), N and N m, torso axes, with x applied."""
    residuals_before: Array
    """The same with the robot file as it is."""
    feet: Array
    """Motion of the feet against each other (n, 6), rad and m, with x applied."""
    feet_before: Array

    def of(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation."""
        i = self.names.index(name)
        return float(self.x[i]), float(np.sqrt(self.covariance[i, i]))

    def covariance_of(self, a: str, b: str) -> float:
        """Return the covariance of two parameters."""
        return float(self.covariance[self.names.index(a), self.names.index(b)])

    def known(self, name: str) -> float:
        """Return what share of the usual prior's variance is gone, 0 to 1.

        By the record, or before it: a weighed payload is known.
        """
        i = self.names.index(name)
        usual = next((row.sd for row in PRIORS if row.name == name), self.priors[i].sd)
        return 1.0 - float(self.covariance[i, i]) / usual**2


def fit(
    robot: RobotConfig,
    records: Sequence[Record],
    *,
    level_sd: float,
    payload_sd: float | None = None,
) -> BodyFit:
    """Fit the errors of a robot file to at least one record.

    Args:
        robot: the robot file.
        records: of one robot.
        level_sd: standard deviation of the floor's slope about level, rad.
        payload_sd: kg by which the file's payload may be wrong, where it was weighed.
    """
    count = sum(len(record.moments.t_s) for record in records)
    if count < MOMENTS_MIN:
        raise RunError(
            f"{count} quasi-static moments of {SLOT_S:g} s: {MOMENTS_MIN} or more are right, with "
            "all six modules in TRACK and the harness valid; lead the robot slowly "
            "(`xrl sim --scenario identify` shows how)"
        )
    return _Problem(robot, records, _priors(records, level_sd, payload_sd)).solve()


def _priors(
    records: Sequence[Record], level_sd: float, payload_sd: float | None
) -> tuple[Prior, ...]:
    rows = [
        row._replace(sd=payload_sd) if row.name == MASS and payload_sd is not None else row
        for row in PRIORS
    ]
    for number, record in enumerate(records):
        rows += [Prior(f"feet {number} {k}", "", 0.0, sd) for k, sd in enumerate(FEET_SD)]
        rows += [Prior(f"slope {number} {axis}", "rad", 0.0, level_sd) for axis in "xy"]
        sd = ADDED_COM_SD * record.added_kg
        if sd:
            rows += [Prior(f"added {number} {axis}", "kg m", 0.0, sd) for axis in "xyz"]
    return tuple(rows)


class _Problem:
    def __init__(
        self, robot: RobotConfig, records: Sequence[Record], priors: tuple[Prior, ...]
    ) -> None:
        self._body = BodyStatics(robot)
        self._records, self._priors = records, priors
        self._index = {row.name: i for i, row in enumerate(priors)}
        self._mean = np.array([row.mean for row in priors])
        self._sd = np.array([row.sd for row in priors])
        self._r_harness = np.array(robot.geometry.harness_point)
        self._torso_moment = robot.torso_mass * np.array(robot.torso_com)
        self._apart = np.array([0.0, 0.0, 0.0, 0.0, robot.geometry.w_base, 0.0])

    def solve(self) -> BodyFit:
        z: Array = np.zeros(len(self._priors))  # in widths of the priors
        noise: Array = np.array([TORQUE_SD, *FEET_NOISE])
        for _ in range(ROUNDS):
            rows, A = self._linear(z, noise)
            weight = self._weights(rows)
            H = A.T @ (weight[:, None] * A) + np.eye(len(z))
            z -= np.linalg.solve(H, A.T @ (weight * rows) + z)
            noise = self._noise(z, noise)
        rows, A = self._linear(z, noise)
        weight = self._weights(rows)
        H = np.asarray(np.linalg.inv(A.T @ (weight[:, None] * A) + np.eye(len(z))), float)
        starts = np.arange(0, len(rows), 12 * BLOCK)
        scores = np.asarray(np.add.reduceat(A * (weight * rows)[:, None], starts, axis=0))
        sandwich = H @ (scores.T @ scores + np.eye(len(z))) @ H
        wider = MODEL_ERROR * np.sqrt(np.maximum(1.0, np.diag(sandwich) / np.diag(H)))
        covariance = H * np.outer(wider, wider)
        widths = np.minimum(1.0, 1.0 / np.sqrt(np.diag(covariance)))
        covariance = covariance * np.outer(widths, widths)
        x = self._mean + self._sd * z
        before = np.where([row.name.startswith("feet") for row in self._priors], x, 0.0)
        wrench, feet, _ = self._residuals(x)
        wrench_before, feet_before, _ = self._residuals(before)
        return BodyFit(
            names=tuple(self._index), priors=self._priors, x=x,
            covariance=covariance * np.outer(self._sd, self._sd),
            residuals=wrench, residuals_before=wrench_before, feet=feet, feet_before=feet_before,
        )  # fmt: skip

    def _of(self, x: Array, names: Iterable[str]) -> Array:
        return x[[self._index[name] for name in names]]

    def _residuals(self, x: Array) -> tuple[Array, Array, list[Array]]:
        """Return wrench (n, 6), feet (n, 6), and each record's d wrench / d torque (n_i, 6, 12)."""
        wrenches, feet, maps = [], [], []
        scale, mass = 1.0 + x[self._index[SCALE]], x[self._index[MASS]]
        play, viscous = x[self._index[PLAY]], self._of(x, VISCOUS)
        compliance = np.full(N_JOINTS, x[self._index[COMPLIANCE]])
        compliance[_ANKLES] += np.tile(self._of(x, SOLES), 2)
        zeros, friction = self._of(x, ZEROS), self._of(x, FRICTION)
        arm = self._r_harness + self._of(x, HARNESS)
        for number, (m, added_kg) in enumerate(self._records):
            tau = scale * m.tau - friction * np.tanh(m.v / V_0) - viscous * m.v
            q = m.q - zeros - compliance * tau - play * np.tanh(tau / TAU_0)
            moment = self._torso_moment + self._of(x, COM)
            if added_kg:
                moment = moment + self._of(x, [f"added {number} {axis}" for axis in "xyz"])
            slope = self._of(x, [f"slope {number} {axis}" for axis in "xy"])
            up = np.array([slope[0], slope[1], 1.0])
            found = self._body.balance(
                q, tau, up / np.linalg.norm(up), mass=self._body.torso_mass + mass + added_kg,
                moment=moment, force=m.force, force_moment=m.moment + np.cross(arm, m.force),
            )  # fmt: skip
            place = self._of(x, [f"feet {number} {k}" for k in range(6)])
            wrenches.append(found.wrench)
            feet.append(found.feet - self._apart - place)
            maps.append(found.by_torque)
        return np.vstack(wrenches), np.vstack(feet), maps

    def _whitened(self, x: Array, noise: Array) -> Array:
        """Return all equations in units of their noise (12 n,), moment by moment."""
        wrench, feet, maps = self._residuals(x)
        by_torque = np.concatenate(maps)
        v = np.vstack([record.moments.v for record in self._records])
        stuck = 1.0 - np.tanh(v / V_0) ** 2
        # the noise is the asked torques': a fit that could shrink it would find too small a scale
        scale = 1.0 + x[self._index[SCALE]]
        variance = scale**2 * (noise[0] ** 2 + STUCK_SD**2 * stuck)
        covariance = np.einsum("nij,nj,nkj->nik", by_torque, variance, by_torque)
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, wrench[:, :, None])[:, :, 0]
        return np.hstack([white, feet / noise[1:]]).ravel()

    def _linear(self, z: Array, noise: Array) -> tuple[Array, Array]:
        rows = self._whitened(self._mean + self._sd * z, noise)
        A = np.empty((len(rows), len(z)))
        for i in range(len(z)):
            moved = z.copy()
            moved[i] += _STEP
            A[:, i] = (self._whitened(self._mean + self._sd * moved, noise) - rows) / _STEP
        return rows, A

    @staticmethod
    def _weights(rows: Array) -> Array:
        size = np.sqrt(np.mean(rows.reshape(-1, 12) ** 2, axis=1))
        return np.repeat(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)), 12)

    def _noise(self, z: Array, noise: Array) -> Array:
        """Return the noise that the residuals have: of torques, and of each row of the feet."""
        x = self._mean + self._sd * z
        white = self._whitened(x, noise).reshape(-1, 12)
        torque = noise[0] * float(np.sqrt(np.mean(np.minimum(white[:, :6], HUBER) ** 2)))
        _, feet, _ = self._residuals(x)
        spread = np.sqrt(np.mean(feet**2, axis=0))
        return np.array([max(torque, 0.02), *np.maximum(spread, 1e-5)])
