"""Exclusive access of bring-up commands to the drives, real or emulated.

A drive has one master. Before a command writes to a drive, it checks that no joint service holds
the drive. While the command runs, no fleet can be started in the same run directory.

Emulated drives are accessed by the same code as real ones: over emulated CAN buses, and with the
genuine `odrive` package over a stand-in for libusb. If no fleet is up, the simulator runs alone
until the command ends.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from services.simulator.fronts import usb_standin
from shared import places
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, XrlError
from shared.extras import require
from shared.joints import MODULES
from tools.bringup.boards import FoundBoards
from tools.bringup.can_monitor import bus_config, listen
from tools.flags import FleetRobotFlags
from tools.fleet import procfs
from tools.fleet.process_table import FleetOptions, is_simulated, refuse_half_emulated
from tools.fleet.run_dir import RunDir
from tools.fleet.supervise import SupervisedFleet

STARTED_S: Final = 15.0
"""Timeout for the first frames after the simulator was started, s."""
UP_S: Final = 3.0
"""Timeout for frames if a fleet is up, s: its simulator may be dead or still starting."""
SETTLE_S: Final = 1.5
"""Time until an emulated robot hangs at rest, s."""
GONE: Final = (
    "the drives were emulated for this command only, so the written values are lost; to keep "
    "them, run `xrl up --only simulator` first"
)
_POLL_S = 0.05


def robot_file(flags: FleetRobotFlags) -> Path:
    """Return the robot file of the fleet in `--run-dir`; if none is up, `places.robot_file`.

    Raises:
        ConfigError: no fleet is up, and the file that was found belongs to another user.
        FleetError: `--config` is not the fleet's robot file.
    """
    run = RunDir(flags.run_dir)
    manifest = run.read_manifest()
    if manifest is None or not is_up(run.path):
        return Path(os.path.abspath(places.robot_file(flags.config)))  # noqa: PTH100 - keeps links
    if flags.config is None:
        return Path(manifest.config)
    given = Path(os.path.abspath(flags.config))  # noqa: PTH100 - as the manifest has it
    if given != Path(manifest.config):
        raise FleetError(
            f"the fleet in {run.path} runs with {manifest.config}, not with {given}; "
            "remove --config, or choose another fleet with --run-dir"
        )
    return Path(manifest.config)


def is_up(run_dir: Path) -> bool:
    """Return True if a process of a fleet runs in this run directory."""
    return bool(procfs.fleet_pids(RunDir(run_dir).path))


def service_on(robot: RobotConfig, module: str, run_dir: Path) -> SupervisedFleet | None:
    """Return this user's fleet whose joint service uses a module's drive, or None.

    All run directories are searched, because another fleet may use the same drive.
    """
    drive = _drive_of(robot, module, RunDir(run_dir).path)
    for path in sorted(map(Path, procfs.fleets())):
        manifest = RunDir(path).read_manifest()
        if manifest is None:
            continue
        with contextlib.suppress(XrlError):  # ignore a file that has become unreadable
            other = config_file.load_without_schedule(Path(manifest.config))
            services = [name for name in manifest.services if name in MODULES]
            if any(_drive_of(other, name, path) == drive for name in services):
                return SupervisedFleet(path)
    return None


def _drive_of(robot: RobotConfig, module: str, run_dir: Path) -> tuple[str, ...]:
    """Return a unique id of a drive; for an emulated drive it includes the run directory."""
    wiring = robot.module_named(module)
    place = str(run_dir) if is_simulated(robot) else ""
    if robot.joint_service.driver == "odrive_usb":
        return (place, wiring.serial_number.upper())
    bus = bus_config(robot, wiring.bus, run_dir)
    return (place, bus.interface, bus.channel, *map(str, wiring.node_ids))


def refuse_service(robot: RobotConfig, module: str, run_dir: Path) -> None:
    """Raise FleetError if a joint service uses a module's drive."""
    fleet = service_on(robot, module, run_dir)
    if fleet is not None:
        raise FleetError(
            f"{module}: its joint service in {fleet.run.path} holds the drive; hang the robot and "
            f"run `xrl down --run-dir {shlex.quote(str(fleet.run.path))}` first"
        )


def confirm(question: str, *, yes: bool) -> bool:
    """Ask a yes-or-no question on the terminal; with `yes`, return True without asking."""
    if yes:
        return True
    if not sys.stdin.isatty():
        raise FleetError(
            "no terminal to ask on; use --yes to move or change the robot without confirmation"
        )
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


@contextlib.contextmanager
def drives_within_reach(
    robot: RobotConfig,
    config_path: Path,
    run_dir: Path,
    *,
    lifted: float = 0.0,
) -> Iterator[bool]:
    """Make the drives accessible; yield True if the simulator was started for this.

    For real drives nothing is started. The simulator hangs the robot higher by `lifted`, m.
    """
    refuse_half_emulated(robot)
    if not is_simulated(robot):
        yield False
        return
    simulator: SupervisedFleet | None = None
    if not is_up(run_dir):
        # a light foot on a damped drivetrain needs a finer step in the air than on the floor
        words = ["--lifted", f"{lifted:g}", "--plant", "steps=4"] if lifted else []
        alone = FleetOptions(
            overrides={"simulator": words},
            no_restart=("simulator",),
            services=["simulator"],
            leashed=True,
        )
        simulator = SupervisedFleet.start(config_path, run_dir, alone)
    try:
        _await_simulator(robot, run_dir, UP_S if simulator is None else STARTED_S)
        yield simulator is not None
        if simulator is not None and not simulator.pids():
            log = simulator.run.log_of("simulator")
            tail = "\n".join(log.read_text(encoding="utf-8").splitlines()[-5:])
            raise FleetError(f"the simulator ended unexpectedly; its log:\n{tail}")
    finally:
        if simulator is not None:
            simulator.stop()


def _await_simulator(robot: RobotConfig, run_dir: Path, seconds: float) -> None:
    """Wait at most `seconds` for frames of an emulated robot's load cells: its simulator runs."""
    config = bus_config(robot, robot.harness.bus, RunDir(run_dir).path)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if listen(config, (), poll_nodes=False, seconds=_POLL_S).frames:
            return
        time.sleep(_POLL_S)


@contextlib.contextmanager
def no_fleet_meanwhile(robot: RobotConfig, run_dir: Path) -> Iterator[None]:
    """Prevent a fleet from being started on real drives in this run directory.

    A fleet that is up stays up. For an emulated robot the simulator reserves the directory.
    """
    if is_simulated(robot) or is_up(run_dir):
        yield
        return
    run = RunDir(run_dir)
    lock = run.claim()
    try:
        yield
    finally:
        run.clear(keep_logs=True)
        os.close(lock)


@contextlib.contextmanager
def drives_to_ourselves(
    robot: RobotConfig,
    config_path: Path,
    run_dir: Path,
    progress: Callable[[str], None],
    *,
    lifted: float = 0.0,
) -> Iterator[bool]:
    """Make the drives accessible and prevent a new fleet; yield as `drives_within_reach` does."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(no_fleet_meanwhile(robot, run_dir))
        started = stack.enter_context(
            drives_within_reach(robot, config_path, run_dir, lifted=lifted)
        )
        if started:
            progress("no fleet is up and the drives are emulated: starting the simulator")
            time.sleep(SETTLE_S)
        if is_simulated(robot) and robot.joint_service.driver == "odrive_usb":
            stack.enter_context(emulated_usb(run_dir))
        yield started


@contextlib.contextmanager
def emulated_usb(run_dir: Path) -> Iterator[None]:
    """Connect the emulated drives to this process's USB, before anything imports `odrive`.

    The environment is restored afterwards; the stand-in for libusb stays loaded.
    """
    with tempfile.TemporaryDirectory(prefix="xrl-usb-") as folder:
        usb_standin.load(usb_standin.build(Path(folder)))
        wanted = {
            usb_standin.VARIABLE: str(RunDir(run_dir).live / usb_standin.FOLDER),
            # the package's cache: keep emulated drives out of the home directory
            "XDG_CACHE_HOME": str(Path(folder) / "cache"),
        }
        before = {name: os.environ.get(name) for name in wanted}
        os.environ.update(wanted)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


@contextlib.contextmanager
def boards_on_usb(
    robot: RobotConfig, run_dir: Path, modules: Iterable[str]
) -> Iterator[FoundBoards]:
    """Connect to the real or emulated boards of modules over USB.

    Modules without a serial number are skipped.
    """
    serials = [robot.module_named(module).serial_number for module in modules]
    with contextlib.ExitStack() as stack:
        if is_simulated(robot):
            stack.enter_context(emulated_usb(run_dir))
        require("usb")  # only after the stand-in is loaded
        from tools.bringup.usb_board import UsbBus  # noqa: PLC0415

        bus = UsbBus()
        stack.callback(bus.close)
        yield bus.open([serial for serial in serials if serial])
