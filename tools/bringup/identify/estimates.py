"""What a fit means for the robot file: each value, its interval, and the line to write. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.bringup.identify.body_fit import COM, COMPLIANCE, HARNESS, MASS, SCALE, ZEROS, BodyFit
from tools.bringup.identify.sines import MASS_SD, YIELDS, JointFit

HALF_WIDTH: Final = 1.96
"""Standard deviations on either side: 95 %."""
KNOWN_MIN: Final = 0.75
"""Share of the prior's variance that a record must take away: the interval is half as wide then."""

LIGHT: Final = 1.0
"""kg; nothing is known of the place of a load that is hardly there."""

Value = float | tuple[float, float, float]


class Verdict(Enum):
    """What to do about a value."""

    CHANGE = "change"
    """The file's value lies outside the interval."""
    AGREES = "agrees"
    """The file's value lies inside."""
    MEASURED = "measured"
    """The file has no such value."""
    UNKNOWN = "not shown"
    """The interval is hardly narrower than what was plausible before."""


class ParameterEstimate(NamedTuple):
    """One number of the robot."""

    key: str
    """Key in the robot file; "" if it has none."""
    what: str
    unit: str
    file: float | None
    """The robot file's value, in `unit`; None: it has none."""
    value: float
    half_width: float
    """Half the width of the 95 % interval."""
    verdict: Verdict

    @property
    def digits(self) -> int:
        """Decimals worth printing: a tenth of the interval; more would say what nobody knows."""
        return max(0, 1 - math.floor(math.log10(max(self.half_width, 1e-9))))

    def describes(self, truth: float) -> bool:
        """Return True if a value lies within the interval."""
        return abs(truth - self.value) <= self.half_width


def estimate(
    key: str, what: str, unit: str, *, file: float | None, value: float, sd: float, known: bool
) -> ParameterEstimate:
    """Return an estimate with its verdict; `sd` is the value's standard deviation."""
    half_width = HALF_WIDTH * sd
    verdict = Verdict.UNKNOWN
    if known and file is None:
        verdict = Verdict.MEASURED
    elif known and file is not None:
        verdict = Verdict.AGREES if abs(value - file) <= half_width else Verdict.CHANGE
    return ParameterEstimate(
        key=key, what=what, unit=unit, file=file, value=value, half_width=half_width,
        verdict=verdict,
    )  # fmt: skip


def of_body(fit: BodyFit, robot: RobotConfig) -> list[ParameterEstimate]:
    """Return what a standing record says of the body, by a fit against the robot file."""

    def row(
        key: str, what: str, unit: str, name: str, file: float, by: float = 1.0
    ) -> ParameterEstimate:
        error, sd = fit.of(name)
        known = fit.known(name) >= KNOWN_MIN
        return estimate(
            key, what, unit, file=file, value=file + by * error, sd=by * sd, known=known
        )

    mass = row("mass.payload", "payload", "kg", MASS, robot.mass.payload)
    constant = robot.drive.torque_constant
    points = zip(HARNESS, robot.geometry.harness_point, strict=True)
    return [
        mass,
        *_centre(fit, robot, mass),
        *(row("geometry.harness_point", name, "m", name, at) for name, at in points),
        row("drive.torque_constant", "torque constant", "N m/A", SCALE, constant, constant),
        *_stiffness(fit),
        *(row("", name, "rad", name, 0.0) for name in ZEROS),
    ]


def _centre(fit: BodyFit, robot: RobotConfig, mass: ParameterEstimate) -> list[ParameterEstimate]:
    """Return the payload's centre: a moment is what is measured.

    Its place goes with the payload that the file will have.
    """
    is_new = _is_written(mass, robot)
    payload = max(mass.value if is_new else robot.mass.payload, LIGHT)
    _, mass_sd = fit.of(MASS)
    rows = []
    for name, at_file in zip(COM, robot.mass.payload_com, strict=True):
        moment, moment_sd = fit.of(name)
        place = (robot.mass.payload * at_file + moment) / payload
        variance = moment_sd**2
        if is_new:
            variance += place * (place * mass_sd**2 - 2.0 * fit.covariance_of(name, MASS))
        rows.append(estimate(
            "mass.payload_com", f"payload's centre {name[-1]}", "m",
            file=at_file, value=place, sd=math.sqrt(max(0.0, variance)) / payload,
            known=fit.known(name) >= KNOWN_MIN and payload > LIGHT,
        ))  # fmt: skip
    return rows


def _is_written(mass: ParameterEstimate, robot: RobotConfig) -> bool:
    return mass.verdict is Verdict.CHANGE and 0.0 <= mass.value <= robot.mass.payload_max


def _stiffness(fit: BodyFit) -> list[ParameterEstimate]:
    compliance, sd = fit.of(COMPLIANCE)
    if compliance <= 2.0 * HALF_WIDTH * sd:
        return []
    k = 1.0 / compliance
    return [
        estimate(
            "", "drivetrain's stiffness", "N m/rad", file=None, value=k, sd=sd * k * k, known=True
        )
    ]


class JointResult(NamedTuple):
    """What the sines of one joint showed."""

    joint: str
    fit: JointFit
    leg_inertia: float
    """Inertia of what hangs on it by the robot file, without its rotor, kg m^2."""

    @property
    def rotor(self) -> tuple[float, float]:
        """Reflected inertia of the rotors and its standard deviation, kg m^2."""
        total, sd = self.fit.inertia
        return total - self.leg_inertia, math.hypot(sd, MASS_SD * self.leg_inertia)


def of_joints(results: Sequence[JointResult], robot: RobotConfig) -> list[ParameterEstimate]:
    """Return what small sines say of joints; the rotors' inertia is one for all of them."""

    def row(
        what: str, unit: str, of: tuple[float, float], file: float | None = None
    ) -> ParameterEstimate:
        return estimate("", what, unit, file=file, value=of[0], sd=of[1], known=True)

    armature, rows = robot.joint.armature, []
    for joint, fit, leg_inertia in results:
        inertia = fit.inertia[0], math.hypot(fit.inertia[1], MASS_SD * leg_inertia)
        rows += [
            row(f"dry friction {joint}", "N m", fit.dry),
            row(f"viscous friction {joint}", "N m s/rad", fit.viscous),
            row(f"inertia {joint}", "kg m^2", inertia, leg_inertia + armature),
        ]
    rotors = [result.rotor for result in results]
    weight = sum(1.0 / sd**2 for _, sd in rotors)
    mean = sum(value / sd**2 for value, sd in rotors) / weight
    sd = max(weight**-0.5, YIELDS * armature)
    rows.append(estimate(
        "joint.armature", "reflected inertia", "kg m^2", file=armature, value=mean, sd=sd,
        known=HALF_WIDTH * sd < 0.5 * armature,
    ))  # fmt: skip
    return rows


def changes(estimates: list[ParameterEstimate], robot: RobotConfig) -> dict[str, Value]:
    """Return the robot file's new values by key: those that lie outside their interval.

    A vector is written whole: rows that the record does not show stay as they are. Where a smaller
    torque constant gives less than the joints' limit at the drives' current limit, the joints'
    limit goes down with it: a current limit is the motors' affair, and is not raised here.
    """
    file: Mapping[str, tuple[float, float, float]] = {
        "mass.payload_com": robot.mass.payload_com,
        "geometry.harness_point": robot.geometry.harness_point,
    }
    found: dict[str, Value] = {}
    for row in estimates:
        if not row.key or row.verdict is not Verdict.CHANGE:
            continue
        if row.key == "mass.payload" and not _is_written(row, robot):
            continue
        if row.key not in file:
            found[row.key] = round(row.value, row.digits)
            continue
        values = list(found.get(row.key, file[row.key]))  # type: ignore[arg-type]  # a vector
        values["xyz".index(row.what[-1])] = round(row.value, row.digits)
        found[row.key] = (values[0], values[1], values[2])
    constant = found.get("drive.torque_constant", robot.drive.torque_constant)
    assert isinstance(constant, float)  # noqa: S101 - for the type checker
    most = 2.0 * robot.joint.gear_ratio * constant * robot.drive.current_lim
    if most < robot.joint.tau_module_max:
        found["joint.tau_module_max"] = math.floor(10.0 * most) / 10.0
    return found


def remarks(estimates: Sequence[ParameterEstimate], robot: RobotConfig) -> list[str]:
    """Return what a person has to know beside the lines to write."""
    said = []
    for row in estimates:
        if row.verdict is not Verdict.CHANGE:
            continue
        if row.key == "mass.payload" and not _is_written(row, robot):
            said.append(
                f"mass.payload: {row.value:.1f} kg is not within 0 .. mass.payload_max "
                f"({robot.mass.payload_max:g} kg): not written; correct the load or the maximum"
            )
        if row.key == "drive.torque_constant":
            said.append(
                "drive.torque_constant: the drives have a copy. After it is written: "
                "`xrl drive configure --apply`, which restarts them, then zero them; until then "
                "the drives use the old value, and to measure and write again would count the "
                "error twice"
            )
    return said


def measured(estimates: list[ParameterEstimate]) -> set[str]:
    """Return the robot file's keys all of whose rows are known: nothing is assumed of them now."""
    known = {row.key for row in estimates if row.verdict is not Verdict.UNKNOWN}
    return known - {row.key for row in estimates if row.verdict is Verdict.UNKNOWN} - {""}


def zero_corrections(estimates: list[ParameterEstimate]) -> dict[str, tuple[float, float]]:
    """Return what `xrl drive zero MODULE --by` takes: (phi, theta), rad, of each module."""
    by_joint = {
        row.what.removeprefix("zero ").split()[0]: -row.value
        for row in estimates
        if row.what.startswith("zero ") and row.verdict is Verdict.CHANGE
    }
    return {
        module: (by_joint.get(f"{module}_phi", 0.0), by_joint.get(f"{module}_theta", 0.0))
        for module in MODULES
        if f"{module}_phi" in by_joint or f"{module}_theta" in by_joint
    }
