"""Zeros as they are kept over a loss of power, and the evidence by which they are resumed.

The file stands beside the robot file; an emulated robot's in its run directory, where it ends with
the emulated drives. It is written by `xrl drive zero` and `xrl down`, never by a service: what it
says of the last rest may be wrong since, and is evidence only (`tools.bringup.whole_turns`).
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
from tools.bringup.boards import Value, equal
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
"""Settings that an encoder's calibration finds anew, or that tell which encoder it is."""


IMU_WITHIN: Final = 0.02
"""rad of an IMU's error, its mounting's included."""
LEVEL_WITHIN: Final = 0.035
"""rad to which a person levels a torso by a spirit level: 2 degrees."""
IMU_S: Final = 1.0
REST_WAIT_S: Final = 20.0
"""Longest wait until legs that were let go have swung out."""
ROUND_S: Final = 0.8
"""From one look to the next: not half a swing of a leg, which takes 1 s."""
ABSOLUTE: Final = 0x100
"""Bit of `encoder.config.mode`: an absolute encoder."""

Progress = Callable[[str], None]


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

    gear_ratio: float
    encoder_counts_per_turn: int
    modules: dict[str, ModuleZero] = {}


def path_of(robot: RobotConfig, config: Path, run_dir: Path) -> Path:
    """Return where a robot's zeros are kept."""
    if is_simulated(robot):
        return RunDir(run_dir).path / "zeros.json"
    return config.with_name(f"{config.stem}.zeros.json")


def read_zeros(path: Path, robot: RobotConfig) -> ZeroRecord:
    """Read the zeros; none if there is no file."""
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
    for key in ("gear_ratio", "encoder_counts_per_turn"):
        if getattr(record, key) != getattr(empty, key):
            raise DriveError(
                f"{path}: {key} {getattr(record, key):g}, and the robot file has "
                f"{getattr(empty, key):g}: these are no zeros of this robot; remove it, and zero "
                "by a protractor"
            )
    return record


def write_zeros(path: Path, record: ZeroRecord) -> None:
    """Write the zeros, whole and on the disk."""
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
    now, modules = timestamp(), dict(record.modules)
    for name, rest in rests.items():
        modules[name] = msgspec.structs.replace(modules[name], rest=rest, rest_time=now)
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


def drives_of(
    robot: RobotConfig, modules: Iterable[str], run_dir: Path
) -> AbstractContextManager[dict[str, Drive]]:
    """Have modules' drives as they count themselves, without the mark of a zero."""
    unmarked = msgspec.structs.replace(robot.drive, zero_mark_turns=0.0)
    return open_drives(msgspec.structs.replace(robot, drive=unmarked), modules, run_dir)


def looks_at_rest(
    drives: Mapping[str, Drive], robot: RobotConfig
) -> tuple[dict[str, DriveLook], set[str]]:
    """Look at drives until their joints rest, `REST_WAIT_S` at the most; return which do not.

    A leg that swings out turns round slowly: its encoders have to read the same a while later.
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
    """Return True if two looks show the same angles, within so many turns."""
    if before is None or seen.angles is None or before.angles is None:
        return False
    off = [a - b for a, b in zip(seen.angles, before.angles, strict=True)]
    return max(abs(each - round(each)) for each in off) <= within


def identities(
    robot: RobotConfig, run_dir: Path, modules: Collection[str], progress: Progress
) -> dict[str, Identity]:
    """Return what the boards that are on USB tell of themselves; they are read, no more.

    An emulated robot's boards are on USB only where its services use that.
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
            f"{', '.join(missing)}: not on USB; whether board and calibration are those of the "
            "zero is not compared"
        )
    return found


def why_not_kept(robot: RobotConfig, seen: DriveLook, identity: Identity | None) -> str:
    """Return why a zero cannot be kept over a loss of power; "" if it can."""
    if seen.angles is None:
        return (
            "its drive tells no angle within the turn, as firmware 0.6 over CAN; after each loss "
            "of power zero it by a protractor"
        )
    modes = [] if identity is None else [
        value for name, value in identity.calibration.items() if name.endswith("config.mode")
    ]  # fmt: skip
    if not is_simulated(robot) and any(not int(mode or 0) & ABSOLUTE for mode in modes):
        return "its encoders are not absolute; after each loss of power zero it by a protractor"
    return ""


def upright(robot: RobotConfig, run_dir: Path, *, level: bool) -> Upright:
    """Return which way is up: by the IMU, or by the person who has levelled the torso.

    Raises:
        DriveError: the IMU that is fitted tells nothing valid.
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
            "the IMU tells nothing valid; see `xrl doctor`, or set imu.fitted = false, level the "
            "torso by a spirit level and add --level"
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
    """Return the evidence of every module that has a stored zero and tells its angles."""
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
    """Store where modules rest now, once their legs have swung out; return how many do.

    A module that does not rest, or has another zero than the stored one, keeps no rest.

    Raises:
        DriveError: no zero is stored, or the file cannot be written.
    """
    path = path_of(robot, config, run_dir)
    record = read_zeros(path, robot)
    known = [module for module in modules if module in record.modules]
    if not known:
        raise DriveError(f"{path}: no zero of {', '.join(modules)} is stored: `xrl drive zero`")
    ratio = robot.joint.gear_ratio
    rests: dict[str, Pair | None] = {}
    with drives_of(robot, known, run_dir) as drives:
        looks, restless = looks_at_rest(drives, robot)
        for module, seen in looks.items():
            why = refusal(seen) or "it does not come to rest" * (module in restless)
            why = why or not_its_zero(seen, record.modules[module].offsets, ratio)
            rests[module] = None if why else motor_from_joint(seen.q_there, ratio)
            if why:
                progress(f"{module}: where it rests is not kept: {why}")
    write_zeros(path, with_rests(record, rests))
    return sum(rest is not None for rest in rests.values())


def rests_after_down(config: Path, run_dir: Path, services: Iterable[str]) -> str:
    """Store where the modules of a fleet that is down rest, on real drives; return what came of it.

    "" where there is nothing to say: emulated drives are gone, and without a zero nothing is kept.
    """
    modules = [name for name in services if name in MODULES]
    lines: list[str] = []
    try:
        robot = config_file.load_without_schedule(config)
        path = path_of(robot, config, run_dir)
        if is_simulated(robot) or not modules or not path.is_file():
            return ""
        kept = store_rests(robot, config, run_dir, modules, lines.append)
        lines.append(f"{kept} of {len(modules)} modules rest; where is kept in {path}")
    except XrlError as error:
        lines.append(f"where the joints rest is not kept: {error}")
    return "\n".join(lines)


def not_its_zero(seen: DriveLook, offsets: Pair, gear_ratio: float) -> str:
    """Return why a drive's zero is not the stored one; "" if it is, up to whole turns."""
    if not seen.zeroed:
        return "it is unzeroed"
    if seen.angles is None:
        return "its drive tells no angle within the turn"
    turns = motor_from_joint(seen.q_there, gear_ratio)
    off = [t - a - o for t, a, o in zip(turns, seen.angles, offsets, strict=True)]
    if max(abs(each - round(each)) for each in off) > UNMOVED:
        return "its zero is not the stored one: `xrl drive zero` it again"
    return ""
