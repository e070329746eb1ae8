from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.exceptions import ConfigError
from shared.robot.stewart import condition_number, geometry_matrix, leg_points
from tests.harness.helpers import HARNESS, G

Array = npt.NDArray[np.float64]
GEOMETRY = (HARNESS.base_radius, HARNESS.platform_radius, HARNESS.height)

lengths = st.floats(0.05, 0.2)
forces = st.lists(st.floats(-1500.0, 1500.0), min_size=6, max_size=6).map(np.array)


def leg_lengths(base: Array, platform: Array, rotation: Array, shift: Array) -> Array:
    """Leg lengths with the torso side moved by a small rigid motion about the harness point."""
    moved = base @ rotation.T + shift
    return np.asarray(np.linalg.norm(platform - moved, axis=1))


@given(base_radius=lengths, platform_radius=lengths, height=lengths, leg_forces=forces)
def test_wrench_is_the_sum_of_forces_and_moments_leg_by_leg(
    base_radius: float, platform_radius: float, height: float, leg_forces: Array
) -> None:
    base, platform = leg_points(base_radius, platform_radius, height)
    force, moment = np.zeros(3), np.zeros(3)
    for b, p, f in zip(base, platform, leg_forces, strict=True):
        pull = f * (p - b) / math.dist(b, p)
        force += pull
        # About the origin; the other end of the leg is on the same line, so it must agree.
        moment += [p[1] * pull[2] - p[2] * pull[1], p[2] * pull[0] - p[0] * pull[2],
                   p[0] * pull[1] - p[1] * pull[0]]  # fmt: skip
    wrench = geometry_matrix(base_radius, platform_radius, height) @ leg_forces
    np.testing.assert_allclose(wrench, np.concatenate((force, moment)), atol=1e-9)


@given(leg_forces=forces)
def test_wrench_does_the_work_of_the_legs(leg_forces: Array) -> None:
    """Virtual work: wrench . twist = tension . shortening, by differences of leg lengths."""
    base, platform = leg_points(*GEOMETRY)
    step = 1e-6
    for axis in range(6):
        ends = []
        for sign in (1.0, -1.0):
            shift, rotation = np.zeros(3), np.eye(3)
            if axis < 3:
                shift[axis] = sign * step
            else:
                i, j = [(1, 2), (2, 0), (0, 1)][axis - 3]
                rotation[i, i] = rotation[j, j] = math.cos(step)
                rotation[j, i], rotation[i, j] = sign * math.sin(step), -sign * math.sin(step)
            ends.append(leg_lengths(base, platform, rotation, shift))
        shortening = (ends[1] - ends[0]) / (2.0 * step)
        assert (G @ leg_forces)[axis] == pytest.approx(float(leg_forces @ shortening), abs=1e-4)


def test_the_robots_sensor_is_well_conditioned_and_takes_its_loads() -> None:
    """A condition number does not depend on the unit of length."""
    in_m = condition_number(G, HARNESS.platform_radius)
    assert in_m < 3.0
    in_mm = geometry_matrix(*GEOMETRY)
    in_mm[3:] *= 1e3
    assert condition_number(in_mm, HARNESS.platform_radius * 1e3) == pytest.approx(in_m)
    assist_and_lead = np.array([0.0, 0.0, 350.0, 0.0, 60.0, 0.0])  # 200 N assist, 150 N hand
    assert np.abs(np.linalg.solve(G, assist_and_lead)).max() < HARNESS.leg_force_max


@pytest.mark.parametrize(
    ("base_radius", "platform_radius", "height"),
    [
        (2.0, 2.0, 0.005),  # flat: no leg can lift
        (0.005, 0.005, 2.0),  # a bundle of parallel legs
        (0.0, 0.07, 0.06),
        (0.1, 0.0, 0.06),
        (0.0, 0.0, 0.0),
        (0.1, 0.07, 0.0),
        (float("nan"), 0.07, 0.06),
    ],
)
def test_a_singular_geometry_is_refused_with_its_numbers(
    base_radius: float, platform_radius: float, height: float
) -> None:
    with pytest.raises(ConfigError, match="condition number") as refusal:
        geometry_matrix(base_radius, platform_radius, height)
    assert f"base_radius {base_radius:g} m" in str(refusal.value)
    assert "similar size" in str(refusal.value)
