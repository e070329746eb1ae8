"""The fit of the standing body on made-up moments whose every error is known."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.exceptions import RunError
from shared.joints import JOINTS
from shared.robot.robot_model import stand_pose
from tests.conftest import ROBOT_FILE
from tools.bringup.identify import report
from tools.bringup.identify.body_fit import (
    COM,
    HARNESS,
    MASS,
    PRIORS,
    SCALE,
    ZEROS,
    BodyFit,
    Record,
    fit,
)
from tools.bringup.identify.estimates import (
    Verdict,
    changes,
    measured,
    of_body,
    remarks,
    zero_corrections,
)
from tools.bringup.identify.quasi_static import Moments
from tools.terminal import Console

FRICTION = 0.3
SCALE_TRUE, PAYLOAD_TRUE = 0.94, 17.0
COM_TRUE = (0.02, -0.015, 0.05)
ARM_TRUE = (0.1, 0.02, 0.03)
ZERO = {"knee_right_theta": -0.01, "hip_left_theta": 0.012}


def with_mass(robot: RobotConfig, **masses: object) -> RobotConfig:
    return msgspec.structs.replace(robot, mass=msgspec.structs.replace(robot.mass, **masses))


@pytest.fixture(scope="module")
def true_robot(robot: RobotConfig) -> RobotConfig:
    geometry = msgspec.structs.replace(robot.geometry, harness_point=ARM_TRUE)
    heavy = with_mass(robot, payload=PAYLOAD_TRUE, payload_com=COM_TRUE)
    return msgspec.structs.replace(heavy, geometry=geometry)


def poses(robot: RobotConfig, count: int, *, rich: bool) -> list[Array]:
    """Return closed stands along a slow path; only a little squat if it is not rich."""
    kinematics = Kinematics(robot)
    ik = InverseKinematics(kinematics, np.array(robot.joint_limits()))
    ik.q[:] = stand_pose(robot, 1.1)
    found = []
    for k in range(count):
        a = 2.0 * np.pi * k / count
        p = np.array([0.0, 0.0, 0.82 + 0.05 * np.sin(a), 0.0, 0.0, 0.0])
        if rich:
            p += [
                0.03 * np.sin(5 * a), 0.04 * np.cos(7 * a), 0.04 * np.sin(3 * a),
                0.06 * np.sin(11 * a), 0.2 + 0.3 * np.sin(2 * a), 0.12 * np.cos(4 * a),
            ]  # fmt: skip
        if k == 0:
            assert ik.solve_from_anywhere(p).converged
        assert ik.solve(p).residual < 1e-3
        ik.solve(p)
        found.append(ik.q.copy())
    return found


def moments(
    true_robot: RobotConfig, count: int = 240, *, rich: bool = True, added_kg: float = 0.0
) -> Moments:
    """Return what would be reported at rest, by the law's statics of the true robot."""
    dice = np.random.default_rng(3)
    laden = true_robot
    if added_kg:
        payload = true_robot.mass.payload + added_kg
        place = tuple(true_robot.mass.payload / payload * c for c in COM_TRUE)
        laden = with_mass(true_robot, payload=payload, payload_max=100.0, payload_com=place)
    kinematics = Kinematics(laden)
    stands = poses(laden, count, rich=rich)
    v = np.gradient(np.array(stands), 0.5, axis=0)
    force, tau = np.zeros((count, 3)), np.zeros((count, 12))
    for k, q in enumerate(stands):
        kinematics.update(q)
        load = 60.0 * (1.0 + np.sin(40.0 * k / count)) if rich else 0.0
        roll, pitch = kinematics.p[3:5]
        up = [-np.cos(roll) * np.sin(pitch), np.sin(roll), np.cos(roll) * np.cos(pitch)]
        force[k] = -load * np.array(up)
        held = laden.total_mass * GRAVITY * kinematics.J[2] + load * kinematics.J_harness[2]
        tau[k] = held + FRICTION * np.sign(v[k]) + 0.05 * dice.standard_normal(12)
    errors = np.array([ZERO.get(joint, 0.0) for joint in JOINTS])
    t = 0.2 * np.arange(count)
    return Moments(t, np.array(stands) + errors, v, tau / SCALE_TRUE, force, np.zeros((count, 3)))


@pytest.fixture(scope="module")
def fitted(robot: RobotConfig, true_robot: RobotConfig) -> BodyFit:
    return fit(robot, [Record(moments(true_robot))], level_sd=0.003)


@pytest.fixture(scope="module")
def squat(true_robot: RobotConfig) -> Record:
    """Return the record of a robot that hardly moves."""
    return Record(moments(true_robot, 60, rich=False))


@pytest.fixture(scope="module")
def by_squat(robot: RobotConfig, squat: Record) -> BodyFit:
    return fit(robot, [squat], level_sd=0.003)


def test_each_planted_error_is_found_within_its_interval(
    robot: RobotConfig, true_robot: RobotConfig, fitted: BodyFit
) -> None:
    arm = np.array(ARM_TRUE) - robot.geometry.harness_point
    truth = {SCALE: SCALE_TRUE - 1.0, MASS: PAYLOAD_TRUE - robot.mass.payload}
    truth |= dict(zip(COM, true_robot.torso_mass * np.array(true_robot.torso_com), strict=True))
    truth |= dict(zip(HARNESS, arm, strict=True)) | dict.fromkeys(ZEROS, 0.0)
    truth |= {f"zero {joint}": value for joint, value in ZERO.items()}
    for name, value in truth.items():
        found, sd = fitted.of(name)
        assert abs(found - value) < 1.96 * sd, (name, found, value, sd)
    assert fitted.of(SCALE)[1] < 0.02
    assert fitted.of(MASS)[1] < 1.0


def test_what_is_left_over_is_less_than_by_the_robot_file(fitted: BodyFit) -> None:
    for before, after in (
        (fitted.residuals_before, fitted.residuals), (fitted.feet_before, fitted.feet),
    ):  # fmt: skip
        assert np.abs(after).mean() < 0.5 * np.abs(before).mean()


def test_the_findings_name_the_lines_to_write_and_the_zeros_to_correct(
    robot: RobotConfig, fitted: BodyFit
) -> None:
    estimates = of_body(fitted, robot)
    values = changes(estimates, robot)
    assert values.keys() == {
        "mass.payload", "mass.payload_com", "geometry.harness_point", "drive.torque_constant",
        "joint.tau_module_max",
    }  # fmt: skip
    assert values["mass.payload"] == pytest.approx(PAYLOAD_TRUE, abs=1.5)
    assert values["mass.payload_com"] == pytest.approx(COM_TRUE, abs=0.01)
    assert values["geometry.harness_point"] == pytest.approx(ARM_TRUE, abs=0.02)
    # 40 A give less now, and a current limit is not raised by a measurement
    most = 2.0 * robot.joint.gear_ratio * robot.drive.current_lim
    constant = values["drive.torque_constant"]
    assert isinstance(constant, float)
    assert values["joint.tau_module_max"] == pytest.approx(most * constant, abs=0.1)
    assert "drive.torque_constant" in measured(estimates)
    assert any("xrl drive configure" in remark for remark in remarks(estimates, robot)), (
        "drives copy it"
    )
    corrections = zero_corrections(estimates)
    assert corrections["knee_right"][1] == pytest.approx(0.01, abs=5e-3)
    assert corrections["hip_left"][1] == pytest.approx(-0.012, abs=6e-3)


def test_a_file_that_is_not_the_records_robot_is_not_written(
    robot: RobotConfig, fitted: BodyFit, tmp_path: Path
) -> None:
    lab, text = tmp_path / "lab.toml", ROBOT_FILE.read_text(encoding="utf-8")
    other = text.replace("payload = 20.4", "payload = 15.0", 1)
    lab.write_text(other, encoding="utf-8")
    with pytest.raises(RunError, match=r"mass\.payload is 15\.0, and was 20\.4"):
        report.tell(of_body(fitted, robot), robot, lab, Console(quiet=True))
    assert lab.read_text(encoding="utf-8") == other


def test_a_record_that_hardly_moves_claims_little(
    robot: RobotConfig, fitted: BodyFit, by_squat: BodyFit
) -> None:
    rows = {row.what: row for row in of_body(by_squat, robot)}
    assert rows["harness point z"].verdict is Verdict.UNKNOWN
    assert rows["harness point x"].verdict is Verdict.UNKNOWN
    assert "geometry.harness_point" not in changes(list(rows.values()), robot)
    assert rows["torque constant"].half_width > 2.0 * 1.96 * 0.0827 * fitted.of(SCALE)[1]
    assert rows["torque constant"].describes(0.0827 * SCALE_TRUE)


def test_a_known_weight_and_a_weighed_payload_sharpen_the_torques_scale(
    robot: RobotConfig, true_robot: RobotConfig, squat: Record, by_squat: BodyFit
) -> None:
    heavier = Record(moments(true_robot, 60, rich=False, added_kg=10.0), added_kg=10.0)
    added = fit(robot, [squat, heavier], level_sd=0.003)
    weighed = with_mass(robot, payload=PAYLOAD_TRUE)
    known = fit(weighed, [squat], level_sd=0.003, payload_sd=0.1)
    assert of_body(known, weighed)[0].verdict is Verdict.AGREES
    for value, sd in (added.of(SCALE), known.of(SCALE)):
        assert sd < 0.5 * by_squat.of(SCALE)[1]
        assert abs(value - (SCALE_TRUE - 1.0)) < 1.96 * sd


def test_too_few_moments_are_refused_in_words(robot: RobotConfig, squat: Record) -> None:
    few = Moments(*(part[:30] for part in squat.moments))
    with pytest.raises(RunError, match=r"30 quasi-static moments.*50 or more"):
        fit(robot, [Record(few)], level_sd=0.003)


def fit_of(robot: RobotConfig, more_kg: float, moment: float, sd: float) -> BodyFit:
    """Return a fit with a payload and a moment about y, each with a standard deviation."""
    names = tuple(row.name for row in PRIORS)
    x, variance = np.zeros(len(names)), np.full(len(names), 1e-12)
    x[names.index(MASS)], variance[names.index(MASS)] = more_kg, sd**2
    x[names.index(COM[0])], variance[names.index(COM[0])] = moment, 0.01**2
    nothing = np.zeros((1, 6))
    covariance = np.diag(variance)
    return BodyFit(names, PRIORS, x, covariance, nothing, nothing, nothing, nothing)


def test_a_moment_is_kept_with_the_payload_that_the_file_will_have(robot: RobotConfig) -> None:
    for more_kg, sd in ((-4.0, 0.3), (-4.0, 9.0), (3.0, 0.3)):
        rows = of_body(fit_of(robot, more_kg, 0.5, sd), robot)
        values = changes(rows, robot)
        payload = values.get("mass.payload", robot.mass.payload)
        place = values["mass.payload_com"]
        assert isinstance(payload, float)
        assert isinstance(place, tuple)
        assert payload * place[0] == pytest.approx(0.5, abs=0.03), (more_kg, sd)


def test_a_payload_beyond_the_largest_is_not_written_but_the_rest_is(robot: RobotConfig) -> None:
    rows = of_body(fit_of(robot, 3.0, 0.5, 0.3), robot)
    assert robot.mass.payload + 3.0 > robot.mass.payload_max
    assert changes(rows, robot).keys() == {"mass.payload_com"}
    assert any("mass.payload_max" in remark for remark in remarks(rows, robot))
