"""`xrl down`: lowers the robot and stops the fleet."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Final

from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.bringup.zero_record import rests_after_down
from tools.flags import Arg, Duration, RunDirFlags
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet
from tools.live.descent import WAYS, lower

EXAMPLES: Final = """
xrl down                      # lower the robot, wait for the hoist
xrl down --limp
xrl down --limp --keep-stops  # from a systemd unit
"""


class DownFlags(RunDirFlags):
    """Fleet to stop, and how to treat a robot that stands on its legs."""

    limp: Annotated[bool, Arg(exclusive="weight")] = False
    """idle the drives at once, under any load: a standing robot falls"""
    lower_only: Annotated[bool, Arg(exclusive="weight")] = False
    """lower the robot and wait until its legs bear no weight, but keep the services running"""
    sit: Annotated[bool, Arg(exclusive="weight")] = False
    """also lower a simulated robot (default: stop the simulator at once)"""
    wait: Duration = 60.0
    """timeout for a hoist or stand to take the lowered robot's weight, s"""
    keep_stops: bool = False
    """keep an emergency stop in force for the next `xrl up --disarmed`"""


def run(flags: DownFlags) -> int:
    """Lower the robot, then stop every service, even without a supervisor; keep the logs.

    Then store where the joints rest, for `xrl drive zero --resume`.
    """
    fleet = SupervisedFleet(flags.run_dir)
    manifest = fleet.run.read_manifest()
    was_up = manifest is not None
    was_up |= bool(procfs.fleet_pids(fleet.run.path))  # its directory may have been removed
    if not flags.limp:
        _lower(fleet, flags)
    if flags.lower_only:
        print(
            "the robot's legs bear no weight" if was_up else f"no fleet was up in {fleet.run.path}"
        )
        return 0
    fleet.stop(keep_logs=True, keep_stops=flags.keep_stops)
    if was_up:
        print(f"the fleet in {fleet.run.path} is down; its logs stay in {fleet.run.logs}")
    else:
        print(f"no fleet was up in {fleet.run.path}")
    if manifest is not None:
        rests = rests_after_down(Path(manifest.config), flags.run_dir, manifest.services)
        print(rests, end="\n" if rests else "")
    return 0


def _lower(fleet: SupervisedFleet, flags: DownFlags) -> None:
    """Lower the robot if its joint services run here; a simulated one only if a flag says so."""
    running = procfs.service_pids(fleet.run.path)
    simulated = "simulator" in running
    if not {*running} & {*MODULES} or (simulated and not (flags.sit or flags.lower_only)):
        return
    manifest = fleet.run.read_manifest()
    if manifest is None:
        raise FleetError(
            f"{fleet.run.path}: the fleet's files are missing, so it is unknown whether the legs "
            f"carry the robot; {WAYS}"
        )
    robot = manifest.robot()
    lower(robot, fleet.run.path, partial(print, flush=True), wait_s=flags.wait, simulated=simulated)
