"""`xrl down`: lower the robot, stop the fleet, and leave nothing behind."""

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
xrl down                      # a robot that bears weight goes down first, and waits to be hung
xrl down --wait 300
xrl down --limp               # idle the drives at once: a standing robot falls
xrl down --lower-only         # go down and wait; the services go on
xrl down --sit                # the same with the simulator, where it is not the rule
xrl down --limp --keep-stops  # from a systemd unit
"""


class DownFlags(RunDirFlags):
    """Which fleet, and what becomes of a robot that bears weight."""

    limp: Annotated[bool, Arg(exclusive="weight")] = False
    """idle the drives at once, whatever they bear: a standing robot falls"""
    lower_only: Annotated[bool, Arg(exclusive="weight")] = False
    """go down and wait until nothing bears on the legs, but stop nothing"""
    sit: Annotated[bool, Arg(exclusive="weight")] = False
    """go down also where the robot is simulated (default: stop the simulator at once)"""
    wait: Duration = 60.0
    """once it is down, how long its weight may take to be taken, s"""
    keep_stops: bool = False
    """keep an emergency stop in force for the next `xrl up --disarmed`"""


def run(flags: DownFlags) -> int:
    """Lower the robot, then stop every service, also without a supervisor; keep the logs.

    Then store where the joints rest, which `xrl drive zero --resume` goes by.
    """
    fleet = SupervisedFleet(flags.run_dir)
    manifest = fleet.run.read_manifest()
    was_up = manifest is not None
    was_up |= bool(procfs.fleet_pids(fleet.run.path))  # its directory may have been removed
    if not flags.limp:
        _lower(fleet, flags)
    if flags.lower_only:
        print("nothing bears on its legs" if was_up else f"no fleet was up in {fleet.run.path}")
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
    """Lower the robot, if a service here holds a drive of it."""
    running = procfs.service_pids(fleet.run.path)
    simulated = "simulator" in running
    if not {*running} & {*MODULES} or (simulated and not (flags.sit or flags.lower_only)):
        return
    manifest = fleet.run.read_manifest()
    if manifest is None:
        raise FleetError(
            f"{fleet.run.path}: the fleet's files are gone, so nobody knows whether the robot "
            f"bears weight: {WAYS}"
        )
    robot = manifest.robot()
    lower(robot, fleet.run.path, partial(print, flush=True), wait_s=flags.wait, simulated=simulated)
