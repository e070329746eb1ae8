"""`xrl down`: stop the fleet and leave nothing behind."""

from __future__ import annotations

from typing import Final

from tools.flags import RunDirFlags
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet

EXAMPLES: Final = """
xrl down
xrl down --run-dir /tmp/bench
xrl down --keep-stops      # from a systemd unit
"""


class DownFlags(RunDirFlags):
    """Which fleet."""

    keep_stops: bool = False
    """keep an emergency stop in force for the next `xrl up --disarmed`"""


def run(flags: DownFlags) -> int:
    """Stop every service, also of a fleet whose supervisor is dead; keep the logs."""
    fleet = SupervisedFleet(flags.run_dir)
    was_up = fleet.run.is_marked and fleet.run.read_manifest() is not None
    was_up |= bool(procfs.fleet_pids(fleet.run.path))  # its directory may have been removed
    fleet.stop(keep_logs=True, keep_stops=flags.keep_stops)
    if was_up:
        print(f"the fleet in {fleet.run.path} is down; its logs stay in {fleet.run.logs}")
    else:
        print(f"no fleet was up in {fleet.run.path}")
    return 0
