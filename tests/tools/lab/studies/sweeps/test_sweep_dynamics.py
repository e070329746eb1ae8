"""The dynamic certificate on trial: what is drawn, what is asked, and what counts as growth."""

from __future__ import annotations

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from tools.lab.studies.sweeps import dynamics_trial
from tools.lab.studies.sweeps.dynamics_trial import (
    delay_s,
    draw,
    drawn,
    has_grown,
    run_trial,
)


def test_a_case_is_within_its_ranges() -> None:
    for number in range(200):
        trial = draw(3, number)
        for value, (low, high) in (
            (trial.height, dynamics_trial.HEIGHTS),
            (trial.stiffness, dynamics_trial.STIFFNESS),
            (trial.bandwidth_hz, dynamics_trial.BANDWIDTH_HZ),
            (trial.coupling, dynamics_trial.COUPLING),
            *((factor, dynamics_trial.DAMPING) for factor in trial.damping),
        ):
            assert low * 0.999 <= value <= high * 1.001


@pytest.mark.parametrize(("way_ms", "wanted_ms"), [(0, 2), (1, 2), (2, 4), (7, 14), (12, 24)])
def test_the_delay_asked_about_is_from_a_sample_to_its_first_use(
    robot: RobotConfig, way_ms: int, wanted_ms: int
) -> None:
    trial = msgspec.structs.replace(draw(1, 0), delay_ms=way_ms)
    assert delay_s(robot, trial) == pytest.approx(wanted_ms / 1e3)


@pytest.mark.parametrize(
    ("early_rad_s", "late_rad_s", "ended", "grew"),
    [
        (0.04, 0.01, "tracked", False),
        (0.04, 0.05, "tracked", False),
        (0.04, 0.06, "tracked", True),
        (0.001, 0.015, "tracked", False),
        (0.3, 0.3, "tracked", True),
        (0.04, 0.0, "fell", True),
        (0.04, 0.0, "left", True),
        (0.0, 0.0, "unready", False),
    ],
)
def test_motion_that_rises_stays_large_or_ends_the_lead_has_grown(
    early_rad_s: float, late_rad_s: float, ended: str, grew: bool
) -> None:
    assert has_grown(early_rad_s, late_rad_s, ended) is grew


def test_drawn_gains_change_the_schedule_and_nothing_else(robot: RobotConfig) -> None:
    trial = draw(1, 0)
    other = drawn(robot, trial)
    assert other.gain_schedule is not None
    assert other.gain_schedule.coupling_bandwidth_hz == trial.bandwidth_hz
    assert msgspec.structs.replace(other, gain_schedule=robot.gain_schedule) == robot


@pytest.mark.usefixtures("on_its_feet")
def test_the_shipped_gains_are_predicted_to_fade_and_fade_and_far_too_fast_a_coupling_grows(
    robot: RobotConfig,
) -> None:
    assert robot.gain_schedule is not None
    shipped = msgspec.structs.replace(
        draw(1, 0),
        stiffness=8000.0,
        delay_ms=1,
        damping=(1.0,) * 6,
        bandwidth_hz=robot.gain_schedule.coupling_bandwidth_hz,
        coupling=robot.gain_schedule.coupling_damping,
    )
    stood = run_trial(shipped, robot)
    assert (stood.said_stable, stood.grew) == (True, False)
    shook = run_trial(
        msgspec.structs.replace(shipped, bandwidth_hz=20.0, coupling=6.0, delay_ms=8), robot
    )
    assert (shook.said_stable, shook.grew) == (False, True)
