"""What a fit means for the robot file: each value, its interval, and the line to write. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.identify.body_fit import COM, COMPLIANCE, HARNESS, MASS, SCALE, ZEROS, BodyFit
from tools.identify.sines import MASS_SD, YIELDS, JointFit

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
    if file is None:
        verdict = Verdict.MEASURED
    else:
        verdict = Verdict.AGREES if abs(value - file) <= half_width else Verdict.CHANGE
    return ParameterEstimate(
        key, what, unit, file, value, half_width, verdict if known else Verdict.UNKNOWN
    )


def of_body(fit: BodyFit, robot: RobotConfig) -> list[ParameterEstimate]:
    """Return what a standing record says of the body.

    Args:
        fit: of the record.
        robot: that the fit was made against.
    """
    return [*_masses(fit, robot), *_harness(fit, robot), *_drive(fit, robot), *_zeros(fit)]


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
    rows = []
    for joint, fit, leg_inertia in results:
        for what, unit, (value, sd) in (
            ("dry friction", "N m", fit.dry),
            ("viscous friction", "N m s/rad", fit.viscous),
        ):
            rows.append(estimate(
                "", f"{what} {joint}", unit, file=None, value=value, sd=sd, known=True
            ))  # fmt: skip
        file = leg_inertia + robot.joint.armature
        value, sd = fit.inertia
        sd = math.hypot(sd, MASS_SD * leg_inertia)
        rows.append(estimate(
            "", f"inertia {joint}", "kg m^2", file=file, value=value, sd=sd, known=True
        ))  # fmt: skip
    rotors = [result.rotor for result in results]
    weight = sum(1.0 / sd**2 for _, sd in rotors)
    mean, sd = (
        sum(value / sd**2 for value, sd in rotors) / weight,
        max(weight**-0.5, YIELDS * robot.joint.armature),
    )
    rows.append(estimate(
        "joint.armature", "reflected inertia", "kg m^2", file=robot.joint.armature, value=mean,
        sd=sd, known=HALF_WIDTH * sd < 0.5 * robot.joint.armature,
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
                f"({robot.mass.payload_max:g} kg): not written; put the load or the maximum right"
            )
        if row.key == "drive.torque_constant":
            said.append(
                "drive.torque_constant: the drives have a copy. After it is written: `xrl "
                "configure --apply`, which restarts them, then zero them; until then the robot is "
                "as it was, and to measure and write again would count the error twice"
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


def _masses(fit: BodyFit, robot: RobotConfig) -> Iterator[ParameterEstimate]:
    more, sd = fit.of(MASS)
    mass = estimate(
        "mass.payload", "payload", "kg",
        file=robot.mass.payload, value=robot.mass.payload + more, sd=sd,
        known=fit.known(MASS) >= KNOWN_MIN,
    )  # fmt: skip
    yield mass
    # a moment is what is measured; its place goes with the payload that the file will have
    is_new = _is_written(mass, robot)
    payload = max(mass.value if is_new else robot.mass.payload, LIGHT)
    for axis, name in enumerate(COM):
        at_file = robot.mass.payload_com[axis]
        moment, moment_sd = fit.of(name)
        place = (robot.mass.payload * at_file + moment) / payload
        variance = moment_sd**2
        if is_new:
            variance += place * (place * sd**2 - 2.0 * fit.covariance_of(name, MASS))
        yield estimate(
            "mass.payload_com", f"payload's centre {'xyz'[axis]}", "m",
            file=at_file, value=place, sd=math.sqrt(max(0.0, variance)) / payload,
            known=fit.known(name) >= KNOWN_MIN and payload > LIGHT,
        )  # fmt: skip


def _is_written(mass: ParameterEstimate, robot: RobotConfig) -> bool:
    return mass.verdict is Verdict.CHANGE and 0.0 <= mass.value <= robot.mass.payload_max


def _harness(fit: BodyFit, robot: RobotConfig) -> Iterator[ParameterEstimate]:
    for axis, name in enumerate(HARNESS):
        at_file = robot.geometry.harness_point[axis]
        by, sd = fit.of(name)
        yield estimate(
            "geometry.harness_point", f"harness point {'xyz'[axis]}", "m",
            file=at_file, value=at_file + by, sd=sd, known=fit.known(name) >= KNOWN_MIN,
        )  # fmt: skip


def _drive(fit: BodyFit, robot: RobotConfig) -> Iterator[ParameterEstimate]:
    scale, sd = fit.of(SCALE)
    constant = robot.drive.torque_constant
    yield estimate(
        "drive.torque_constant", "torque constant", "N m/A",
        file=constant, value=constant * (1.0 + scale), sd=constant * sd,
        known=fit.known(SCALE) >= KNOWN_MIN,
    )  # fmt: skip
    compliance, sd = fit.of(COMPLIANCE)
    if compliance > 2.0 * HALF_WIDTH * sd:
        stiffness = 1.0 / compliance
        yield estimate(
            "", "drivetrain's stiffness", "N m/rad",
            file=None, value=stiffness, sd=sd * stiffness * stiffness, known=True,
        )  # fmt: skip


def _zeros(fit: BodyFit) -> Iterator[ParameterEstimate]:
    for name in ZEROS:
        value, sd = fit.of(name)
        yield estimate(
            "", name, "rad", file=0.0, value=value, sd=sd, known=fit.known(name) >= KNOWN_MIN
        )
