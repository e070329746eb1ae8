"""`xrl estop` and `xrl pendant`: set every module to DAMP, now or when a pendant falls silent."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
import time
from pathlib import Path
from typing import Annotated, Final

from services.joint.rearm_guard import Pendant
from shared import places
from shared.bus.credentials import require_operator
from shared.bus.session import open_session
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, XrlError
from shared.joints import MODULES
from shared.places import ROBOT_FILE
from shared.process import StopFlag
from shared.run_directory import default_run_dir
from tools.flags import Arg, Duration, Flags, RunDirFlags, names_of, option, parsed
from tools.fleet.emergency_stop import BusStop, refuse_going, request_here, stop_all, wait_here
from tools.fleet.run_dir import RunDir
from tools.keyboard import typed_line
from tools.terminal import Console

EVERY_S: Final = 0.02
LINKS_S: Final = 2.0
"""Time for the links to come up before silent modules are reported, s."""
OTHER_S: Final = 0.2
"""Time to watch for the heartbeats of another pendant, s."""


EXAMPLES: Final = """
xrl estop
xrl estop --local                       # on the robot's host, without the bus
xrl estop --config lab.toml             # from another computer, with an operator's key
xrl estop --config lab.toml --wait
xrl pendant               # Enter lays it down without a stop; Ctrl-C stops every module
"""


class EstopFlags(Flags):
    """Robot to stop, and the way to reach it."""

    run_dir: Annotated[Path, parsed(Path, "DIR")] = dataclasses.field(
        default_factory=default_run_dir  # may be another user's: all who reach a robot may stop it
    )
    """the fleet's run directory, with its logs (default: $XRL_RUN_DIR, else /tmp/xrl-UID)"""
    local: bool = False
    """stop only this host's joint services, through shared memory (default: also over the bus)"""
    partly: Annotated[
        tuple[str, ...] | None, parsed(names_of(MODULES), "MODULE,...", is_one=True)
    ] = None
    """with --local: modules of this host that must stop (default: all six)"""
    wait: bool = False
    """connect now, report silent modules, and stop on Enter, Ctrl-C or a closed terminal;
    typing q, then Enter, quits without a stop"""
    config: Annotated[
        Path | None,
        Arg(help=f"robot file (default: the fleet's, else {ROBOT_FILE} in the working directory)"),
    ] = None

    def check(self) -> None:
        """Refuse flags that do not apply to the chosen way of stopping."""
        super().check()
        if self.partly and not self.local:
            raise FleetError("--partly needs --local: over the bus all six modules must stop")
        if self.wait and self.local:
            raise FleetError("--wait needs the bus; remove --local, or use `xrl pendant`")


def estop(flags: EstopFlags) -> int:
    """Request the stop, and wait until every module has stopped, or report those that have not."""
    run_dir = flags.run_dir
    is_here = _is_here(flags)
    if flags.wait:
        return _wait(_robot(flags), run_dir, here=is_here)
    here, errors = request_here(run_dir) if is_here else ([], [])  # first: it needs no bus
    for line in errors:
        print(f"xrl: {line}", file=sys.stderr)
    wanted = flags.partly or MODULES
    if flags.local:
        if not here:
            raise FleetError(
                f"{run_dir}: no joint service of this robot is on this host; remove --local, or "
                "run this on the robot's host"
            )
        going = wait_here(run_dir, here, wanted)
    else:
        try:
            going = stop_all(_robot(flags), run_dir, here=is_here)
        except XrlError as error:
            if not here:
                raise
            print(f"xrl: cannot stop over the bus: {error}", file=sys.stderr)
            going = wait_here(run_dir, here)
    _conclude(going, ", ".join(flags.partly) if flags.partly else "all six modules")
    return 0


def _is_here(flags: EstopFlags) -> bool:
    """Return True if the run directory's fleet uses the --config file, or without --config."""
    if flags.config is None:
        return True
    manifest = RunDir(flags.run_dir).read_manifest()
    return manifest is not None and Path(manifest.config).resolve() == flags.config.resolve()


def _robot(flags: EstopFlags) -> RobotConfig:
    """Return the requested robot, or the one whose fleet is up."""
    if flags.config is not None:
        return load(flags.config)
    manifest = RunDir(flags.run_dir).read_manifest()  # even if its supervisor is dead
    if manifest is not None:
        return manifest.robot()
    if places.robot_file_here() is None:  # no module would receive a stop for the shipped robot
        raise FleetError(
            f"no fleet is up in {flags.run_dir}; to stop a robot on another host, give that "
            "robot's file with --config"
        )
    return load(places.robot_file())


def _wait(robot: RobotConfig, run_dir: Path, *, here: bool) -> int:
    """Keep the links open until a person requests the stop or quits."""
    require_operator(robot, "estop")
    console, asked = Console(), StopFlag(signal.SIGHUP)
    with open_session(robot, "estop", run_dir) as session:
        stop = BusStop(robot, session, run_dir if here else None)
        console.print(
            "Enter, Ctrl-C or closing this terminal stops all modules; q, then Enter, quits"
        )
        told: list[str] | None = None
        since_s = time.monotonic()
        typed = None
        with contextlib.suppress(OSError):  # the terminal is gone
            while not asked and typed is None:
                typed = typed_line(EVERY_S)
                silent = stop.listen()
                if silent != told and time.monotonic() - since_s > LINKS_S:
                    told = silent
                    words = f"silent: {', '.join(silent)}" if silent else "all six modules respond"
                    console.print(words, style="bold red" if silent else None)
        if not asked and typed is not None and typed.strip().lower() == "q":
            console.print("quit without a stop")
            return 0
        if here:
            request_here(run_dir)
        going = stop.stop()
    _conclude(going, "all six modules")
    return 0


def _conclude(going: list[str], which: str) -> None:
    refuse_going(going)
    Console().print(
        f"stopped (DAMP): {which}. The robot sinks slowly, or holds if a module on its host is "
        "limp or dead. To end the stop, run `xrl rearm` or `xrl down`"
    )


class PendantFlags(RunDirFlags):
    """Duration of the pendant."""

    for_s: Annotated[Duration | None, option("--for")] = None
    """lay the pendant down after S seconds, without a stop"""


def pendant(flags: PendantFlags) -> int:
    """Send heartbeats until the pendant is laid down or stops the modules; both return 0."""
    try:
        handle = Pendant(flags.run_dir, MODULES)
    except OSError as error:
        raise FleetError(
            f"{flags.run_dir}: cannot open the pendant's shared memory: {error.strerror}"
        ) from None
    if not handle.modules:
        raise FleetError(
            f"{flags.run_dir}: no joint service of a fleet is on this host; run this on the "
            "robot's host, after `xrl up`"
        )
    before = handle.beats
    time.sleep(OTHER_S)
    if handle.beats != before:
        raise FleetError("another pendant is active; lay it down first")
    console, stop = Console(), StopFlag(signal.SIGHUP)
    elsewhere = [module for module in MODULES if module not in handle.modules]
    if elsewhere:
        console.print(f"this pendant does not stop {', '.join(elsewhere)}: no service on this host")
    console.print(
        "held: Enter lays it down; Ctrl-C or a crash of this program stops this host's modules"
    )
    ends = None if flags.for_s is None else time.monotonic() + flags.for_s
    shown = None
    while not stop and shown != "":
        handle.beat()
        shown = typed_line(EVERY_S)
        if shown or (ends is not None and time.monotonic() >= ends):
            handle.lay_down()
            console.print("laid down: the robot continues without it")
            return 0
    request_here(flags.run_dir)  # faster than the pendant's timeout
    going = wait_here(flags.run_dir, list(handle.modules), handle.modules)
    _conclude(going, f"{len(handle.modules)} modules")
    return 0
