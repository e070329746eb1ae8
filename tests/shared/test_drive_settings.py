"""The table of what is wanted of the drives, against the emulated firmware and the design."""

from __future__ import annotations

import math

import msgspec
import pytest

from services.simulator.drives.axis_settings import (
    AXIS_SETTINGS,
    DRIVE_SETTINGS,
    NAMES,
    PHASE_RESISTANCE,
    Settings,
    configured,
    preset,
)
from shared.can.drive_settings import (
    AXIS_TABLE,
    Compare,
    WantedSetting,
    of_module,
    same,
)
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import MODULES

TRAPS = (
    "controller.config.vel_limit",
    "controller.config.vel_integrator_gain",
    "controller.config.enable_torque_mode_vel_limit",
    "motor.config.current_lim",
    "config.can.encoder_rate_ms",
    "controller.config.spinout_electrical_power_threshold",
    "controller.config.spinout_mechanical_power_threshold",
)
"""Each axis's, from docs/drives.md: an ODrive ships with others."""


@pytest.mark.parametrize("module", MODULES)
def test_every_wanted_setting_exists_in_the_firmware_with_its_type(
    robot: RobotConfig, module: str
) -> None:
    shipped = Settings().table(MODULES.index(module))
    wanted = of_module(robot, module)
    assert len({row.name for row in wanted}) == len(wanted)
    for row in wanted:
        assert row.name in NAMES
        assert isinstance(row.value, bool) is isinstance(shipped[row.name], bool)


def test_the_simulators_drives_are_as_wanted_but_for_the_nodes_that_their_front_gives(
    robot: RobotConfig,
) -> None:
    counts = robot.joint.encoder_counts_per_turn
    settings = configured(robot.drive, encoder_counts_per_turn=counts)
    for index, module in enumerate(MODULES):
        misfits = [
            row.name
            for row in of_module(robot, module)
            if not row.fits(settings.get(index, row.name))
        ]
        assert [name for name in misfits if not name.endswith("node_id")] == []


@pytest.mark.parametrize("trap", TRAPS)
def test_a_drive_as_shipped_does_not_fit_at_any_trap(robot: RobotConfig, trap: str) -> None:
    rows = [row for row in of_module(robot, "knee_left") if row.name.endswith(f".{trap}")]
    assert len(rows) == 2
    assert not any(row.fits(AXIS_SETTINGS[trap]) for row in rows)


def test_a_drive_as_shipped_trips_at_the_first_braking_leg(robot: RobotConfig) -> None:
    row = next(r for r in of_module(robot, "hip_left") if r.name.endswith("negative_current"))
    assert not row.fits(DRIVE_SETTINGS[row.name])
    assert row.fits(robot.drive.dc_max_negative_current)


def test_no_winding_gets_so_warm_that_a_leg_that_sinks_is_taken_for_a_slipped_encoder(
    robot: RobotConfig,
) -> None:
    """Copper at 100 C has 30 % more resistance; the firmware takes off what it had when cold."""
    warm = 0.3 * 1.5 * PHASE_RESISTANCE * robot.drive.current_lim**2
    electrical, mechanical = (
        row
        for row in of_module(robot, "knee_left")
        if row.name.startswith("axis0.controller.config.spinout")
    )
    assert not electrical.fits(warm)
    assert not mechanical.fits(-warm)
    assert electrical.fits(150.0)
    assert mechanical.fits(-150.0)


def test_what_calibration_finds_is_never_written() -> None:
    assert not {row.name for row in AXIS_TABLE} & {
        "encoder.config.direction",
        "motor.config.phase_resistance",
    }


def test_each_axis_is_wanted_at_its_own_node(robot: RobotConfig) -> None:
    rows = {row.name: row.value for row in of_module(robot, "hip_right")}
    assert (rows["axis0.config.can.node_id"], rows["axis1.config.can.node_id"]) == (4, 5)


def test_a_watchdogs_timeout_is_written_before_it_is_enabled(robot: RobotConfig) -> None:
    names = [row.name for row in of_module(robot, "knee_left")]
    for axis in ("axis0", "axis1"):
        timeout = names.index(f"{axis}.config.watchdog_timeout")
        assert timeout < names.index(f"{axis}.config.enable_watchdog")


@pytest.mark.parametrize("timeout_s", [0.0, 0.1])
def test_the_watchdog_runs_only_if_the_robot_file_gives_it_a_time(
    robot: RobotConfig, timeout_s: float
) -> None:
    drive = msgspec.structs.replace(robot.drive, watchdog_timeout=timeout_s)
    rows = of_module(msgspec.structs.replace(robot, drive=drive), "knee_left")
    values = {row.name: row.value for row in rows}
    assert values["axis1.config.enable_watchdog"] is (timeout_s > 0.0)


@pytest.mark.parametrize(
    ("compare", "found", "fits"),
    [
        (Compare.EQUAL, 1.2000000476837158, True),
        (Compare.EQUAL, 1.2001, False),
        (Compare.AT_LEAST, 1.2000000476837158, True),
        (Compare.AT_LEAST, 1.1999999, True),
        (Compare.AT_LEAST, 1.19, False),
        (Compare.AT_LEAST, math.inf, True),
        (Compare.AT_MOST, 1.19, True),
        (Compare.AT_MOST, 1.21, False),
        (Compare.AT_LEAST, math.nan, False),
        (Compare.AT_MOST, math.nan, False),
    ],
)
def test_a_value_fits_to_within_single_precision(
    compare: Compare, found: float, fits: bool
) -> None:
    assert WantedSetting("x", 1.2, "", compare).fits(found) is fits


def test_true_is_one_to_a_drive_and_infinity_is_itself() -> None:
    assert same(True, 1)
    assert same(math.inf, math.inf)
    assert same(math.nan, math.nan)
    assert not same(math.inf, 1e30)


def test_a_planted_setting_is_kept_by_that_drive_alone() -> None:
    settings = Settings()
    preset(settings, "knee_left.axis0.config.can.encoder_rate_ms=7")
    preset(settings, "knee_left.axis1.config.enable_watchdog=TRUE")
    preset(settings, "hip_left.config.dc_max_positive_current=inf")
    index = MODULES.index("knee_left")
    settings.restore(index)
    assert settings.get(index, "axis0.config.can.encoder_rate_ms") == 7
    assert settings.get(index, "axis1.config.enable_watchdog") is True
    assert settings.get(0, "axis0.config.can.encoder_rate_ms") == 10


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("knee_lft.axis0.config.can.node_id=1", "knee_left"),
        ("nothing", "ankle_right, "),
        ("knee_left.axis0.vel_limit=2", "axis0.controller.config.vel_limit"),
        ("knee_left.axis0.controller.config.vel_limit=fast", "a number"),
        ("knee_left.axis0.controller.config.vel_limit", "a number"),
        ("knee_left.axis0.config.enable_watchdog=2", "true or false"),
        ("knee_left.axis0.config.can.encoder_rate_ms=1.5", "int"),
        ("knee_left.axis0.controller.config.vel_limit=nan", "float"),
    ],
)
def test_a_plant_that_makes_no_sense_is_refused_with_what_would_be_right(
    words: str, says: str
) -> None:
    with pytest.raises(DriveError, match=says):
        preset(Settings(), words)
