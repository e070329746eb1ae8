"""The evidence for `tools.bringup.whole_turns` from the drives, the IMU and the file of zeros."""

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
from shared.bus.messages import Pair
from shared.can.can_sensor import sensor_of
from shared.can.sensor_frames import ImuAssembler
from shared.clock import now_ns
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError, XrlError
from shared.joints import MODULES
from tools.bringup import zero_record
from tools.bringup.drive_access import boards_on_usb
from tools.bringup.free_leg import Upright
from tools.bringup.module_motion import open_drives
from tools.bringup.swing import Swing
from tools.bringup.whole_turns import BESIDE_MOVED, UNMOVED, ModuleEvidence
from tools.bringup.zero_record import IDENTITY, Identity, ZeroRecord, why_stranger
from tools.bringup.zeroing import DriveLook, look, refusal
from tools.fleet.process_table import is_simulated
from tools.fleet.run_dir import RunDir

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
    evidence = {}
    for module, seen in looks.items():
        zero = record.modules.get(module)
        if zero is None or seen.angles is None:
            continue
        evidence[module] = ModuleEvidence(
            offsets=zero.offsets,
            angles=seen.angles,
            rest=zero.rest,
            about=about.get(module),
            swing=swings.get(module),
            untouched=untouched,
            stranger=why_stranger(zero, robot, module, found.get(module)),
        )
    return evidence


def store_rests(
    robot: RobotConfig, config: Path, run_dir: Path, modules: Collection[str], progress: Progress
) -> int:
    """Store where modules rest now, once their legs have swung out; return how many do.

    A module that does not rest, or has another zero than the stored one, keeps no rest.

    Raises:
        DriveError: no zero is stored, or the file cannot be written.
    """
    path = zero_record.path_of(robot, config, run_dir)
    record = zero_record.read(path, robot)
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
    zero_record.write(path, zero_record.with_rests(record, rests))
    return sum(rest is not None for rest in rests.values())


def rests_after_down(config: Path, run_dir: Path, services: Iterable[str]) -> str:
    """Store where the modules of a fleet that is down rest, on real drives; return what came of it.

    "" where there is nothing to say: emulated drives are gone, and without a zero nothing is kept.
    """
    modules = [name for name in services if name in MODULES]
    lines: list[str] = []
    try:
        robot = config_file.load_without_schedule(config)
        path = zero_record.path_of(robot, config, run_dir)
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
    off = [
        turn - angle - offset
        for turn, angle, offset in zip(turns, seen.angles, offsets, strict=True)
    ]
    if max(abs(each - round(each)) for each in off) > UNMOVED:
        return "its zero is not the stored one: `xrl drive zero` it again"
    return ""
