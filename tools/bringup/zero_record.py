"""Zeros stored for a loss of power, and the evidence for resuming them.

The file is beside the robot file. An emulated robot's file is in its run directory, and is lost
with the emulated drives. `xrl drive zero` and `xrl down` write it, never a service. Its last rest
positions may be outdated, so they are only evidence (`tools.bringup.whole_turns`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

import msgspec

from services.imu.attitude import AttitudeLaw
from services.joint.differential import motor_from_joint
from services.joint.drivers.base import Drive
from services.joint.drivers.wired_drive import Signs
from shared.atomic_file import atomic_file
from shared.bus.messages import Pair
from shared.can.can_sensor import sensor_of
from shared.can.sensor_frames import ImuAssembler
from shared.clock import now_ns
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError, XrlError
from shared.joints import MODULES
from shared.toml_file import read_text
from tools.bringup.boards import ABSOLUTE, Value, equal
from tools.bringup.drive_access import boards_on_usb
from tools.bringup.hanging_leg import Upright
from tools.bringup.motion_runner import open_drives
from tools.bringup.whole_turns import BESIDE_MOVED, UNMOVED, ModuleEvidence
from tools.bringup.zeroing import DriveLook, Swing, look, refusal
from tools.fleet.process_table import is_simulated
from tools.fleet.run_dir import RunDir

_CALIBRATION = ("mode", "cpr", "direction", "phase_offset", "phase_offset_float")
IDENTITY: Final = tuple(
    f"axis{axis}.{name}"
    for axis in (0, 1)
    for name in (*(f"encoder.config.{each}" for each in _CALIBRATION), "motor.config.pole_pairs")
)
"""Settings that identify an encoder, or that its calibration changes."""

IMU_WITHIN: Final = 0.02
"""Maximum error of an IMU, including its mounting, rad."""
LEVEL_WITHIN: Final = 0.035
"""Maximum error of a torso levelled with a spirit level, rad: 2 degrees."""
IMU_S: Final = 1.0
REST_WAIT_S: Final = 20.0
"""Timeout for released legs to stop swinging, s."""
ROUND_S: Final = 0.8
"""Period of the readings, s; it must differ from half a swing of a leg, which takes 1 s."""

Progress = Callable[[str], None]


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Identity of a board on USB, and of its encoders."""

    serial_number: str
    calibration: dict[str, Value]
    """Values of `IDENTITY`, except settings that the board lacks."""


class ModuleZero(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Zero of one module; motor turns are counted from q = 0."""

    time: str
    """Time of zeroing, ISO 8601."""
    serial_number: str
    """Serial number of the board in the robot file."""
    motor_signs: Signs
    offsets: Pair
    """Motor turns, modulo 1, at which each encoder reads 0."""
    identity: Identity | None
    """None if the board was not on USB."""
    rest: Pair | None
    """Motor turns at the last rest with an idle drive, or None."""
    rest_time: str


class ZeroRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Contents of the file of zeros."""

    gear_ratio: float
    encoder_counts_per_turn: int
    modules: dict[str, ModuleZero] = {}


def path_of(robot: RobotConfig, config: Path, run_dir: Path) -> Path:
    """Return the path of a robot's file of zeros."""
    if is_simulated(robot):
        return RunDir(run_dir).path / "zeros.json"
    return config.with_name(f"{config.stem}.zeros.json")


def read_zeros(path: Path, robot: RobotConfig) -> ZeroRecord:
    """Read the zeros; return an empty record if there is no file."""
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
            f"{path}: not a file of `xrl drive zero`: {error}; remove it and zero with a protractor"
        ) from None
    for key in ("gear_ratio", "encoder_counts_per_turn"):
        if getattr(record, key) != getattr(empty, key):
            raise DriveError(
                f"{path}: {key} is {getattr(record, key):g}, but the robot file has "
                f"{getattr(empty, key):g}: these zeros belong to another robot; remove the file, "
                "and zero with a protractor"
            )
    return record


def write_zeros(path: Path, record: ZeroRecord) -> None:
    """Write the zeros atomically, and flush them to disk."""
    try:
        with atomic_file(path, lasting=True) as file:
            file.write(msgspec.json.format(msgspec.json.encode(record)) + b"\n")
    except OSError as error:
        raise DriveError(
            f"{path}: the zeros cannot be saved, and will not survive a loss of power: "
            f"{error.strerror}"
        ) from None


def zeroed(
    robot: RobotConfig, module: str, q: Pair, angles: Pair, identity: Identity | None
) -> ModuleZero:
    """Return the zero of a module that rests at q, rad, with its encoders at `angles`, turns."""
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
    """Return the zeros with new rest positions in motor turns; None for an unknown one."""
    now, modules = timestamp(), dict(record.modules)
    for name, rest in rests.items():
        modules[name] = msgspec.structs.replace(modules[name], rest=rest, rest_time=now)
    return msgspec.structs.replace(record, modules=modules)


def why_stranger(
    zero: ModuleZero, robot: RobotConfig, module: str, identity: Identity | None
) -> str:
    """Return why a board or its encoders differ from those at the zero, or ""."""
    wiring = robot.module_named(module)
    if wiring.serial_number.upper() != zero.serial_number:
        return (
            f"the robot file has board {wiring.serial_number or '(no serial number)'}, but the "
            f"zero is of board {zero.serial_number or '(no serial number)'}"
        )
    if wiring.motor_signs != zero.motor_signs:
        return f"motor_signs are {wiring.motor_signs}, but were {zero.motor_signs} at its zero"
    if identity is None or zero.identity is None:
        return ""
    if identity.serial_number != zero.identity.serial_number:
        return (
            f"it is board {identity.serial_number}, but its zero is of board "
            f"{zero.identity.serial_number}"
        )
    for name, before in zero.identity.calibration.items():
        now = identity.calibration.get(name)
        if not equal(now, before):
            return f"it was calibrated after it was zeroed: {name} is {now}, but was {before}"
    return ""


def timestamp() -> str:
    """Return the local time with its UTC offset, ISO 8601."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def drives_of(
    robot: RobotConfig, modules: Iterable[str], run_dir: Path
) -> AbstractContextManager[dict[str, Drive]]:
    """Open the drives of modules in the drives' own counts, without the mark of a zero."""
    unmarked = msgspec.structs.replace(robot.drive, zero_mark_turns=0.0)
    return open_drives(msgspec.structs.replace(robot, drive=unmarked), modules, run_dir)


def looks_at_rest(
    drives: Mapping[str, Drive], robot: RobotConfig
) -> tuple[dict[str, DriveLook], set[str]]:
    """Observe drives until their joints rest, for at most `REST_WAIT_S`.

    Returns the observations, and the modules that still move. A swinging leg is slow where it
    reverses, so its encoders must read the same after `ROUND_S`.
    """
    until = time.monotonic() + REST_WAIT_S
    before: dict[str, DriveLook] = {}
    while True:
        begun = time.monotonic()
        looks = {module: look(drive, robot) for module, drive in drives.items()}
        restless = {
            module
            for module, seen in looks.items()
            if seen.angles is not None
            and not same_angles(seen, before.get(module), BESIDE_MOVED * UNMOVED)
        }
        if before and (not restless or time.monotonic() > until):
            return looks, restless
        before = looks
        time.sleep(max(0.0, ROUND_S - (time.monotonic() - begun)))


def same_angles(seen: DriveLook, before: DriveLook | None, within: float) -> bool:
    """Return True if two observations have the same encoder angles within a tolerance, turns."""
    if before is None or seen.angles is None or before.angles is None:
        return False
    off = [a - b for a, b in zip(seen.angles, before.angles, strict=True)]
    return max(abs(each - round(each)) for each in off) <= within


def identities(
    robot: RobotConfig, run_dir: Path, modules: Collection[str], progress: Progress
) -> dict[str, Identity]:
    """Read the identities of the boards that are on USB.

    Emulated boards are on USB only if the services use USB.
    """
    if is_simulated(robot) and robot.joint_service.driver != "odrive_usb":
        return {}
    serials = {module: robot.module_named(module).serial_number.upper() for module in modules}
    found: dict[str, Identity] = {}
    try:
        with boards_on_usb(robot, run_dir, modules) as boards:
            for module, serial in serials.items():
                board = boards.boards.get(serial)
                if board is not None:
                    found[module] = Identity(board.serial_number.upper(), board.read(IDENTITY))
    except XrlError as error:
        progress(f"USB: {error}")
    missing = [module for module in modules if module not in found]
    if missing:
        progress(
            f"{', '.join(missing)}: not on USB, so board and calibration are not compared with "
            "those of the zero"
        )
    return found


def why_not_kept(robot: RobotConfig, seen: DriveLook, identity: Identity | None) -> str:
    """Return why a zero cannot be stored for a loss of power, or ""."""
    if seen.angles is None:
        return (
            "its drive does not report the angle within the turn, as with firmware 0.6 over CAN; "
            "zero it with a protractor after each loss of power"
        )
    modes = [] if identity is None else [
        value for name, value in identity.calibration.items() if name.endswith("config.mode")
    ]  # fmt: skip
    if not is_simulated(robot) and any(not int(mode or 0) & ABSOLUTE for mode in modes):
        return "its encoders are not absolute; zero it with a protractor after each loss of power"
    return ""


def upright(robot: RobotConfig, run_dir: Path, *, level: bool) -> Upright:
    """Return the direction of up from the IMU, or from a person who levelled the torso.

    Raises:
        DriveError: the fitted IMU sends no valid attitude.
    """
    imu = robot.imu
    if not imu.fitted:
        return Upright((0.0, 0.0, 1.0), LEVEL_WITHIN if level else math.inf)
    law = AttitudeLaw(imu)
    sensor = sensor_of(robot, imu, ImuAssembler(), RunDir(run_dir).path)
    try:
        until = time.monotonic() + IMU_S
        while time.monotonic() < until:
            reading = law.step(now_ns(), sensor.newest(now_ns()))
            time.sleep(0.5 / imu.rate_hz)
    finally:
        sensor.close()
    if not reading.valid:
        raise DriveError(
            "the IMU sends no valid attitude; see `xrl doctor`. Or set imu.fitted = false, level "
            "the torso with a spirit level and add --level"
        )
    return Upright(reading.up, IMU_WITHIN)


def evidence_of(
    robot: RobotConfig,
    record: ZeroRecord,
    looks: Mapping[str, DriveLook],
    found: Mapping[str, Identity],
    *,
    untouched: bool,
    about: Mapping[str, Pair],
    swings: Mapping[str, Swing],
) -> dict[str, ModuleEvidence]:
    """Return the evidence of every module that has a stored zero and reports its angles."""
    return {
        module: ModuleEvidence(
            zero.offsets, seen.angles, zero.rest, about.get(module), swings.get(module),
            untouched=untouched, stranger=why_stranger(zero, robot, module, found.get(module)),
        )
        for module, seen in looks.items()
        if (zero := record.modules.get(module)) is not None and seen.angles is not None
    }  # fmt: skip


def store_rests(
    robot: RobotConfig, config: Path, run_dir: Path, modules: Collection[str], progress: Progress
) -> int:
    """Wait until modules rest, and store their rest positions; return how many were stored.

    The stored position of a module that is not idle and at rest, or has another zero, is erased.

    Raises:
        DriveError: no zero is stored, or the file cannot be written.
    """
    path = path_of(robot, config, run_dir)
    record = read_zeros(path, robot)
    known = [module for module in modules if module in record.modules]
    if not known:
        raise DriveError(f"{path}: has no zero of {', '.join(modules)}; run `xrl drive zero`")
    ratio = robot.joint.gear_ratio
    rests: dict[str, Pair | None] = {}
    with drives_of(robot, known, run_dir) as drives:
        looks, restless = looks_at_rest(drives, robot)
        for module, seen in looks.items():
            why = refusal(seen) or "it does not come to rest" * (module in restless)
            why = why or not_its_zero(seen, record.modules[module].offsets, ratio)
            rests[module] = None if why else motor_from_joint(seen.q_there, ratio)
            if why:
                progress(f"{module}: its rest position is not stored: {why}")
    write_zeros(path, with_rests(record, rests))
    return sum(rest is not None for rest in rests.values())


def rests_after_down(config: Path, run_dir: Path, services: Iterable[str]) -> str:
    """Store the rest positions of a stopped fleet's real modules; return a description.

    The result is "" if the drives were emulated or no zeros are stored.
    """
    modules = [name for name in services if name in MODULES]
    lines: list[str] = []
    try:
        robot = config_file.load_without_schedule(config)
        path = path_of(robot, config, run_dir)
        if is_simulated(robot) or not modules or not path.is_file():
            return ""
        kept = store_rests(robot, config, run_dir, modules, lines.append)
        lines.append(f"{kept} of {len(modules)} modules rest; their positions are stored in {path}")
    except XrlError as error:
        lines.append(f"the joints' rest positions are not stored: {error}")
    return "\n".join(lines)


def not_its_zero(seen: DriveLook, offsets: Pair, gear_ratio: float) -> str:
    """Return why a drive's zero, apart from whole turns, is not the stored one, or ""."""
    if not seen.zeroed:
        return "it is unzeroed"
    if seen.angles is None:
        return "its drive does not report the angle within the turn"
    turns = motor_from_joint(seen.q_there, gear_ratio)
    off = [t - a - o for t, a, o in zip(turns, seen.angles, offsets, strict=True)]
    if max(abs(each - round(each)) for each in off) > UNMOVED:
        return "its zero is not the stored one; run `xrl drive zero` again"
    return ""
