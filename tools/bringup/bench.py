"""Whose a module's drive is now, and what else the verbs for single drives share.

A drive has one master. Before a verb writes to one it asks whether a joint service has it; while
it works, no fleet can be started in the same run directory.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from shared import places
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import FleetError, XrlError
from shared.joints import MODULES
from tools.bringup import reach
from tools.flags import FleetRobotFlags
from tools.fleet import process_table, procfs
from tools.fleet.run_dir import RunDir
from tools.fleet.supervise import SupervisedFleet

SETTLE_S: Final = 1.5
"""Until an emulated robot hangs still in its hoist."""
GONE: Final = (
    "the drives were emulated for this command only, and the written values are gone; "
    "`xrl up --only simulator` keeps them"
)


def robot_file(flags: FleetRobotFlags) -> Path:
    """Return the robot file: of the fleet that is up in `--run-dir`, else as `places.robot_file`.

    Raises:
        ConfigError: there is no fleet, and the file found may not be taken.
        FleetError: `--config` is not the fleet's.
    """
    run = RunDir(flags.run_dir)
    manifest = run.read_manifest()
    if manifest is None or not reach.is_up(run.path):
        return Path(os.path.abspath(places.robot_file(flags.config)))  # noqa: PTH100 - links stay
    if flags.config is None:
        return Path(manifest.config)
    given = Path(os.path.abspath(flags.config))  # noqa: PTH100 - as the manifest has it
    if given != Path(manifest.config):
        raise FleetError(
            f"the fleet in {run.path} runs with {manifest.config}, not with {given}; "
            "leave --config out, or name another fleet with --run-dir"
        )
    return Path(manifest.config)


def service_on(robot: RobotConfig, module: str, run_dir: Path) -> SupervisedFleet | None:
    """Return the fleet of this user's that has a joint service on a module's drive, or None.

    In whatever run directory: two fleets may mean the same drive.
    """
    drive = _drive_of(robot, module, RunDir(run_dir).path)
    for path in sorted(map(Path, procfs.fleets())):
        manifest = RunDir(path).read_manifest()
        if manifest is None:
            continue
        with contextlib.suppress(XrlError):  # a file that has become unreadable since is ignored
            other = config_file.load_without_schedule(Path(manifest.config))
            services = [name for name in manifest.services if name in MODULES]
            if any(_drive_of(other, name, path) == drive for name in services):
                return SupervisedFleet(path)
    return None


def refuse_service(robot: RobotConfig, module: str, run_dir: Path) -> None:
    """Refuse a module whose joint service is up: a drive has one master.

    Raises:
        FleetError: it is.
    """
    fleet = service_on(robot, module, run_dir)
    if fleet is not None:
        raise FleetError(
            f"{module}: its joint service in {fleet.run.path} has the drive; hang the robot and "
            f"`xrl down --run-dir {fleet.run.path}` first"
        )


@contextlib.contextmanager
def drives_to_ourselves(
    robot: RobotConfig,
    config_path: Path,
    run_dir: Path,
    progress: Callable[[str], None],
    *,
    lifted: float = 0.0,
) -> Iterator[bool]:
    """Have the drives within reach, and no new fleet on them, for a while.

    A fleet that is up is left as it is. If none is and the robot is an emulated one, its
    simulator runs for the while; if the drives are real the run directory is held, so that
    none is started meanwhile.

    Args:
        robot: what stands in the robot file.
        config_path: the robot file.
        run_dir: of the fleet.
        progress: is told what was started.
        lifted: the simulator that is started hangs the robot this much higher, m.

    Yields:
        True if the simulator was started.

    Raises:
        FleetError: the simulator cannot be started, or a fleet is being started.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(reach.no_fleet_meanwhile(robot, run_dir))
        started = stack.enter_context(
            reach.drives_within_reach(robot, config_path, run_dir, lifted=lifted)
        )
        if started:
            progress(
                "no fleet is up and the drives are emulated: their simulator runs for the while"
            )
            time.sleep(SETTLE_S)
        if process_table.is_simulated(robot) and robot.joint_service.driver == "odrive_usb":
            stack.enter_context(reach.emulated_usb(run_dir))
        yield started


def confirm(question: str, *, yes: bool) -> bool:
    """Ask on the terminal; True at once if it was answered by `--yes`.

    Raises:
        FleetError: there is no terminal to ask on.
    """
    if yes:
        return True
    if not sys.stdin.isatty():
        raise FleetError("no terminal to ask on; give --yes if the robot may be touched unasked")
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


def _drive_of(robot: RobotConfig, module: str, run_dir: Path) -> tuple[str, ...]:
    """Return a unique id of a drive; of an emulated one with its run directory."""
    wiring = robot.module_named(module)
    place = str(run_dir) if process_table.is_simulated(robot) else ""
    if robot.joint_service.driver == "odrive_usb":
        return (place, wiring.serial_number.upper())
    bus = robot.can[wiring.bus]
    channel = expand(bus.channel, run_dir)
    return (place, bus.interface, channel, *map(str, wiring.node_ids))
