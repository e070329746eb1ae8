"""The drives: their wanted settings, and the load of their CAN buses."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from services.joint.drive_setpoint import GAIN_UPDATE_MIN_MS, DriveGains, DriveSetpointLaw
from services.joint.drivers.resend_policy import GainRow, ResendPolicy
from services.joint.pd_law import ZERO, Setpoint
from services.simulator.drives.axis_settings import (
    AXIS_SETTINGS,
    DRIVE_SETTINGS,
    NAMES,
    PHASE_RESISTANCE,
    Settings,
    configured,
)
from shared.can.cansimple import Command, arbitration_id, pack_input_pos, pack_two_floats
from shared.can.drive_settings import (
    AXIS_TABLE,
    Compare,
    WantedSetting,
    of_module,
)
from shared.config.can_load import BLEND_HZ, LOAD_MAX, bus_load, frame_bits
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError, DriveError
from shared.joints import MODULES
from tests.shared.test_config import Table, load_changed

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


def test_a_drive_as_shipped_trips_at_the_first_braking_leg_or_warm_winding(
    robot: RobotConfig,
) -> None:
    row = next(r for r in of_module(robot, "hip_left") if r.name.endswith("negative_current"))
    assert not row.fits(DRIVE_SETTINGS[row.name])
    assert row.fits(robot.drive.dc_max_negative_current)
    # Copper at 100 C has 30 % more resistance; the firmware takes off what it had when cold.
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


def test_the_wanted_rows_have_their_nodes_and_order_and_nothing_that_calibration_finds(
    robot: RobotConfig,
) -> None:
    rows = {row.name: row.value for row in of_module(robot, "hip_right")}
    assert (rows["axis0.config.can.node_id"], rows["axis1.config.can.node_id"]) == (4, 5)
    names = [row.name for row in of_module(robot, "knee_left")]
    for axis in ("axis0", "axis1"):
        timeout = names.index(f"{axis}.config.watchdog_timeout")
        assert timeout < names.index(f"{axis}.config.enable_watchdog")
    assert not {row.name for row in AXIS_TABLE} & {
        "encoder.config.direction",
        "motor.config.phase_resistance",
    }


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


def test_a_saved_setting_is_kept_by_its_drive_alone_and_only_a_value_of_its_kind() -> None:
    settings, period = Settings(), "axis0.config.can.encoder_rate_ms"
    index = MODULES.index("knee_left")
    settings.set(index, period, 7)
    settings.save(index)
    settings.set(index, period, 8)
    settings.restore(index)
    assert (settings.get(index, period), settings.get(0, period)) == (7, 10)
    with pytest.raises(DriveError, match=r"did you mean axis0\.controller\.config\.vel_limit"):
        settings.get(index, "axis0.vel_limit")
    for name, value in ((period, 1.5), ("axis0.controller.config.vel_limit", math.nan)):
        with pytest.raises(DriveError, match=r"int|float"):
            settings.set(index, name, value)


def bits_on_the_wire(can_id: int, data: bytes) -> int:
    """Return the length of a standard data frame with its stuff bits and the gap after it."""
    bits = [0, *_bits(can_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    bits += [bit for byte in data for bit in _bits(byte, 8)]
    checksum = 0
    for bit in bits:
        invert = bit ^ (checksum >> 14)
        checksum = (checksum << 1 & 0x7FFF) ^ (0x4599 if invert else 0)
    stuffed, run, last = 0, 0, -1
    for bit in [*bits, *_bits(checksum, 15)]:
        run, last = (run + 1, last) if bit == last else (1, bit)
        if run == 5:
            stuffed, run, last = stuffed + 1, 1, 1 - bit
    return len(bits) + 15 + stuffed + 13


def _bits(value: int, count: int) -> list[int]:
    return [value >> at & 1 for at in reversed(range(count))]


def standing(seed: int = 1) -> list[tuple[int, bytes]]:
    """Return frames as two axes and their service send them while the robot stands."""
    dice = random.Random(seed)
    frames = []
    for _ in range(500):
        for node in (4, 5):
            pos = 64.0 + dice.gauss(2.0, 0.01)
            estimate = pack_two_floats(pos, dice.gauss(0.0, 0.02))
            target = pack_input_pos(pos, dice.gauss(0.0, 0.02), dice.gauss(0.4, 0.05))
            frames.append((arbitration_id(node, Command.GET_ENCODER_ESTIMATES), estimate))
            frames.append((arbitration_id(node, Command.SET_INPUT_POS), target))
    return frames


def test_the_usual_frame_length_and_the_loads_are_those_of_the_design() -> None:
    alternating = bytes([0x55] * 8)
    assert 111 <= bits_on_the_wire(0x2AA, alternating) <= 114
    assert bits_on_the_wire(0, bytes(8)) > 111 + 14
    frames = standing()
    real = sum(bits_on_the_wire(*each) for each in frames) / len(frames)
    assert frame_bits(8) == pytest.approx(real, rel=0.03)
    assert torques(2, 1000.0) == pytest.approx(0.40, abs=0.02)
    assert torques(12, 1000.0 / 3.0) == pytest.approx(0.8, abs=0.03)
    assert torques(12, 1000.0 / 3.0) < LOAD_MAX < torques(12, 500.0)


def torques(axes: int, rate_hz: float) -> float:
    """Return the load of torques alone, with heartbeats as the drives are shipped."""
    load = bus_load(axes, rate_hz, onboard=False, heartbeat_period_ms=100)
    assert load.blending == load.steady, "there are no gains"
    return load.steady


def test_a_blend_sends_gains_no_more_often_than_planned() -> None:
    """As the law of the drives' own loops changes them, and as they are told over CAN."""
    rate_hz, blend_s = 500.0, 0.3
    law, gains, due = DriveSetpointLaw(17.5, 60.0), DriveGains(), ResendPolicy()
    due.armed(0)
    sent, cycles = 0, round(blend_s * rate_hz)
    for cycle in range(1, cycles + 1):
        now_ns, done = round(cycle * 1e9 / rate_hz), cycle / cycles
        k_p, k_d = (900.0 * done, 600.0 * (1.0 - done)), (60.0 * done, 20.0)
        target = law.target(
            gains, now_ns, Setpoint(ZERO, ZERO, ZERO, ZERO, k_p, k_d), ZERO, ZERO, ZERO
        )
        sent += due.with_target((target.pos_gain, target.vel_gain), now_ns) is not GainRow.INPUTS
    assert 0.9 * blend_s * BLEND_HZ <= sent <= blend_s * BLEND_HZ + 2, "the first two at once"
    assert BLEND_HZ == 1e3 / GAIN_UPDATE_MIN_MS


def on_buses(*names: str) -> Callable[[Table], None]:
    """Return a change that puts the six modules on these buses in turn."""

    def change(raw: Table) -> None:
        for module, name in zip(raw["module"], names, strict=True):
            module["bus"] = name

    return change


RIGHT, LEFT = "hip_right", "hip_left"


def test_a_bus_for_each_leg_carries_three_modules_a_sensor_counts_and_usb_loads_none(
    tmp_path: Path,
) -> None:
    robot = load_changed(tmp_path, on_buses(*[RIGHT] * 3, *[LEFT] * 3))
    assert robot.module_named("knee_left").bus == LEFT

    def change(raw: Table) -> None:
        on_buses(*[RIGHT] * 6)(raw)
        raw["joint_service"]["driver"] = "odrive_usb"
        for index, module in enumerate(raw["module"]):
            module["serial_number"] = f"3A000000000{index}"

    load_changed(tmp_path, change)

    def change(raw: Table) -> None:
        on_buses(*[RIGHT] * 3, *[LEFT] * 3)(raw)
        raw["harness"]["bus"] = RIGHT
        raw["harness"]["rate_hz"] = 500.0

    with pytest.raises(ConfigError, match=r"can\.hip_right"):
        load_changed(tmp_path, change)


def test_one_bus_for_all_six_is_refused_with_what_it_would_carry_and_that_is_accepted(
    tmp_path: Path,
) -> None:
    with pytest.raises(ConfigError) as refused:
        load_changed(tmp_path, on_buses(*[RIGHT] * 6))
    assert str(refused.value).partition("can.hip_right: ")[2] == (
        "6 modules at 500 Hz would load the bus to 150% of 1 Mbit/s (177% while gains blend); must "
        "be at most 85% (98%): connect at most 3 modules to a bus at this rate, or lower "
        "joint_service.rate_hz"
    )

    def change(raw: Table) -> None:
        on_buses(*[RIGHT] * 6)(raw)
        raw["joint_service"].update(rate_hz=200.0, state_rate_hz=200.0)
        raw["planner"]["rate_hz"] = 200.0
        raw["simulation"]["encoder_rate_hz"] = 200.0
        raw["drive"]["encoder_period_ms"] = 5

    assert load_changed(tmp_path, change).joint_service.rate_hz == 200.0
