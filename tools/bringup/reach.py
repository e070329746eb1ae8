"""The drives within reach of bring-up: real ones as they are, emulated ones by the same code.

Where the drives are emulated, `xrl doctor` and `xrl drive configure` look at them by the same code
as at real ones: over the emulated CAN buses, and with the genuine `odrive` package over the
stand-in of libusb. A fleet that is up is looked at as it is; else the simulator runs alone
for the while.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final

from services.simulator.drives.axis_settings import Settings, plant
from services.simulator.fronts import usb_standin
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import CanConfig
from shared.exceptions import FleetError
from shared.extras import require
from tools.bringup.boards import FoundBoards
from tools.bringup.can_monitor import listen
from tools.flags import Arg, Flags
from tools.fleet import procfs
from tools.fleet.process_table import SIMULATED_CAN, is_simulated
from tools.fleet.run_dir import RunDir
from tools.fleet.supervise import SupervisedFleet

STARTED_S: Final = 15.0
"""Longest wait for the first frames of a simulator that was started."""
UP_S: Final = 3.0
"""The same where a fleet is up: its simulator may be dead, or another verb's that is starting."""
_POLL_S = 0.05


class DriveSettingFlags(Flags):
    """Settings that the emulated drives have kept."""

    plant: Annotated[tuple[str, ...], Arg(metavar="MODULE.NAME=VALUE")] = ()
    """emulated robot only: a setting that a drive has kept, as
    knee_left.axis0.controller.config.vel_limit=2; may be given several times"""


def check_plants(robot: RobotConfig, run_dir: Path, plants: Sequence[str]) -> None:
    """Refuse planted settings with which no emulated drive can start.

    Raises:
        FleetError: the robot is a real one, or its fleet is up already.
        DriveError: there is no such module or setting, or it cannot have that value.
    """
    if not plants:
        return
    if not is_simulated(robot):
        raise FleetError("--plant is for emulated drives; these are real ones")
    if is_up(run_dir):
        raise FleetError(
            f"--plant is for drives that are started for it, and a fleet is up in {run_dir}: "
            "`xrl down` first, or give another --run-dir"
        )
    scratch = Settings()
    for words in plants:
        plant(scratch, words)


def refuse_half_emulated(robot: RobotConfig) -> None:
    """Refuse a robot file some of whose buses are emulated and others real.

    One bus that was forgotten would make its USB the emulated one: emulated drives are as wanted.

    Raises:
        FleetError: naming the buses.
    """
    used = sorted(robot.buses)
    emulated = [name for name in used if robot.can[name].interface == SIMULATED_CAN]
    if emulated and len(emulated) < len(used):
        real = [name for name in used if name not in emulated]
        raise FleetError(
            f"robot file: {_tables(emulated)} {'is' if len(emulated) == 1 else 'are'} emulated "
            f'(interface = "{SIMULATED_CAN}"), {_tables(real)} not: which drives are meant? Make '
            "all of them real ones, or all emulated"
        )


def _tables(buses: Sequence[str]) -> str:
    return ", ".join(f"[can.{name}]" for name in buses)


def is_up(run_dir: Path) -> bool:
    """Return True if a fleet has a process in this run directory."""
    return bool(procfs.fleet_pids(RunDir(run_dir).path))


@contextlib.contextmanager
def drives_within_reach(
    robot: RobotConfig,
    config_path: Path,
    run_dir: Path,
    plants: Sequence[str] = (),
    *,
    lifted: float = 0.0,
) -> Iterator[bool]:
    """Have the drives there for a while; yields True if the simulator was started for it.

    Real drives are there or not; nothing is started for them.

    Args:
        robot: what stands in the robot file.
        config_path: the robot file.
        run_dir: of the fleet.
        plants: settings that the emulated drives have kept, as `--drive-setting` takes them.
        lifted: a simulator that is started hangs the robot this much higher, m.

    Raises:
        FleetError: the simulator cannot be started, or it ended meanwhile, or the robot file has
            emulated buses and real ones.
    """
    refuse_half_emulated(robot)
    if not is_simulated(robot):
        yield False
        return
    simulator: SupervisedFleet | None = None
    if not is_up(run_dir):
        words = [word for planted in plants for word in ("--drive-setting", planted)]
        # a light foot in the air on a damped drivetrain wants a finer step than a standing robot
        words += ["--lifted", f"{lifted:g}", "--plant", "steps=4"] if lifted else []
        simulator = SupervisedFleet.start(
            config_path,
            run_dir,
            overrides={"simulator": words},
            no_restart=frozenset({"simulator"}),
            services=["simulator"],
            leashed=True,
        )
    try:
        wait_for_simulator(robot, run_dir, UP_S if simulator is None else STARTED_S)
        yield simulator is not None
        if simulator is not None and not simulator.pids():
            log = simulator.run.log_of("simulator")
            tail = "\n".join(log.read_text(encoding="utf-8").splitlines()[-5:])
            raise FleetError(f"the simulator has ended by itself; its log:\n{tail}")
    finally:
        if simulator is not None:
            simulator.stop()


def wait_for_simulator(robot: RobotConfig, run_dir: Path, seconds: float) -> None:
    """Wait until an emulated robot's load cells speak: its buses are there, and its loop runs.

    Not for ever: its simulator may be dead.
    """
    bus = robot.can[robot.harness.bus]
    config = CanConfig(interface=bus.interface, channel=expand(bus.channel, RunDir(run_dir).path))
    until = time.monotonic() + seconds
    while (
        time.monotonic() < until
        and not listen(config, (), poll_nodes=False, seconds=_POLL_S).frames
    ):
        time.sleep(_POLL_S)


@contextlib.contextmanager
def no_fleet_meanwhile(robot: RobotConfig, run_dir: Path) -> Iterator[None]:
    """Keep a fleet from being started on real drives for a while, in this run directory.

    A fleet that is up stays; an emulated robot's simulator holds the directory itself.

    Raises:
        FleetError: one is being started now, or the directory cannot be used.
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
def emulated_usb(run_dir: Path) -> Iterator[None]:
    """Put the emulated drives on this process's USB, before anything imports `odrive`.

    The environment is as it was afterwards; the stand-in stays loaded.

    Raises:
        FleetError: the stand-in cannot be built: there is no C compiler.
    """
    with tempfile.TemporaryDirectory(prefix="xrl-usb-") as folder:
        usb_standin.load(usb_standin.build(Path(folder)))
        wanted = {
            usb_standin.VARIABLE: str(RunDir(run_dir).path / usb_standin.FOLDER),
            # where the package keeps drives' descriptors: not those of emulated ones at home
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
    """Connect to the boards of these modules over USB, or to the emulated ones.

    Modules without a serial number have none.

    Raises:
        DriveError: there is no libusb-1.0.
        FleetError: the stand-in for it cannot be built.
    """
    serials = [robot.module_named(module).serial_number for module in modules]
    with contextlib.ExitStack() as stack:
        if is_simulated(robot):
            stack.enter_context(emulated_usb(run_dir))
        require("usb")  # not before the stand-in is there
        from tools.bringup.usb_board import UsbBus  # noqa: PLC0415

        bus = UsbBus()
        stack.callback(bus.close)
        yield bus.open([serial for serial in serials if serial])
