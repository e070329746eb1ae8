"""Zeros as they are kept over a loss of power: where each encoder is at its joint's zero.

The file stands beside the robot file; an emulated robot's in its run directory, where it ends with
the emulated drives. It is written by `xrl drive zero` and `xrl down`, never by a service: what it
says of the last rest may be wrong since, and is evidence only (`tools.bringup.whole_turns`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from services.joint.differential import motor_from_joint
from services.joint.drivers.wired_drive import Signs
from shared.atomic_file import atomic_file
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.toml_file import read_text
from tools.bringup.boards import Value, equal
from tools.fleet.process_table import is_simulated
from tools.fleet.run_dir import RunDir

VERSION: Final = 1
IDENTITY: Final = tuple(
    f"axis{axis}.{name}"
    for axis in (0, 1)
    for name in (
        "encoder.config.mode",
        "encoder.config.cpr",
        "encoder.config.direction",
        "encoder.config.phase_offset",
        "encoder.config.phase_offset_float",
        "motor.config.pole_pairs",
    )
)
"""Settings that an encoder's calibration finds anew, or that tell which encoder it is."""


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a board on USB tells of itself and its encoders."""

    serial_number: str
    calibration: dict[str, Value]
    """Of `IDENTITY` what the board has."""


class ModuleZero(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One module's zero; motor turns are from q = 0, as the joint counts them."""

    time: str
    """When it was zeroed, ISO 8601."""
    serial_number: str
    """The board's, as the robot file had it."""
    motor_signs: Signs
    offsets: Pair
    """Motor turns, but for whole ones, at which each encoder reads 0."""
    identity: Identity | None
    """None: the board was not on USB."""
    rest: Pair | None
    """Motor turns where it last rested with its drive idle."""
    rest_time: str


class ZeroRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file."""

    version: int = VERSION
    gear_ratio: float
    encoder_counts_per_turn: int
    modules: dict[str, ModuleZero] = {}


def path_of(robot: RobotConfig, config: Path, run_dir: Path) -> Path:
    """Return where a robot's zeros are kept."""
    if is_simulated(robot):
        return RunDir(run_dir).path / "zeros.json"
    return config.with_name(f"{config.stem}.zeros.json")


def read(path: Path, robot: RobotConfig) -> ZeroRecord:
    """Read the zeros; none if there is no file.

    Raises:
        DriveError: it cannot be read, or is of another gear or encoder.
    """
    joint = robot.joint
    empty = ZeroRecord(
        gear_ratio=joint.gear_ratio, encoder_counts_per_turn=joint.encoder_counts_per_turn
    )
    try:
        record = msgspec.json.decode(read_text(path), type=ZeroRecord)
    except FileNotFoundError:
        return empty
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        raise DriveError(
            f"{path}: no zeros of `xrl drive zero`: {error}; remove it, and zero by a protractor"
        ) from None
    for key in ("version", "gear_ratio", "encoder_counts_per_turn"):
        if getattr(record, key) != getattr(empty, key):
            raise DriveError(
                f"{path}: {key} {getattr(record, key):g}, and the robot file has "
                f"{getattr(empty, key):g}: these are no zeros of this robot; remove it, and zero "
                "by a protractor"
            )
    return record


def write(path: Path, record: ZeroRecord) -> None:
    """Write the zeros, whole and on the disk.

    Raises:
        DriveError: it cannot be written.
    """
    try:
        with atomic_file(path, lasting=True) as file:
            file.write(msgspec.json.format(msgspec.json.encode(record)) + b"\n")
    except OSError as error:
        raise DriveError(
            f"{path}: the zeros cannot be kept over a loss of power: {error.strerror}"
        ) from None


def zeroed(
    robot: RobotConfig, module: str, q: Pair, angles: Pair, identity: Identity | None
) -> ModuleZero:
    """Return the zero of a module that rests at q, rad, its encoders at these angles, turns."""
    turns, now = motor_from_joint(q, robot.joint.gear_ratio), timestamp()
    wiring = robot.module_named(module)
    return ModuleZero(
        time=now,
        serial_number=wiring.serial_number.upper(),
        motor_signs=wiring.motor_signs,
        offsets=((turns[0] - angles[0]) % 1.0, (turns[1] - angles[1]) % 1.0),
        identity=identity,
        rest=turns,
        rest_time=now,
    )


def with_rests(record: ZeroRecord, rests: Mapping[str, Pair | None]) -> ZeroRecord:
    """Return the zeros with other rests, motor turns; None: unknown."""
    now = timestamp()
    modules = {
        name: msgspec.structs.replace(zero, rest=rests[name], rest_time=now)
        if name in rests
        else zero
        for name, zero in record.modules.items()
    }
    return msgspec.structs.replace(record, modules=modules)


def why_stranger(
    zero: ModuleZero, robot: RobotConfig, module: str, identity: Identity | None
) -> str:
    """Return why a board or its encoders are not those of a zero; "" if nothing speaks for it."""
    wiring = robot.module_named(module)
    if wiring.serial_number.upper() != zero.serial_number:
        return (
            f"the robot file has board {wiring.serial_number or 'without number'}, and the zero "
            f"is of board {zero.serial_number or 'without number'}"
        )
    if wiring.motor_signs != zero.motor_signs:
        return f"motor_signs are {wiring.motor_signs}, and were {zero.motor_signs} at its zero"
    if identity is None or zero.identity is None:
        return ""
    if identity.serial_number != zero.identity.serial_number:
        return f"board {identity.serial_number} is not {zero.identity.serial_number} of its zero"
    for name, before in zero.identity.calibration.items():
        now = identity.calibration.get(name)
        if not equal(now, before):
            return f"it was calibrated since its zero: {name} is {now}, and was {before}"
    return ""


def timestamp() -> str:
    """Return the time now, ISO 8601, local with its offset."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
