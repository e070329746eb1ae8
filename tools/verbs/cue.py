"""`xrl cue`: alerts the wearer as soon as the robot stops or resumes following.

A wearer who keeps leading while the robot holds can tip it over
(docs/results.md#a-hand-that-leads-on). At each change the terminal's bell rings, or your own
command makes a sound, a light or a vibration.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from enum import Enum
from typing import Annotated, Final

from shared.bus import topics
from shared.bus.messages import JointState, Mode, PlannerMode, PlannerStatus
from shared.bus.pubsub import Latest
from shared.bus.session import Session, open_session
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.process import StopFlag
from tools.flags import RunDirFlags, positional
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console

POLL_S: Final = 0.005
ENDS_IN_S: Final = 1.0
"""Timeout for the command to end after SIGTERM, s."""
SILENT_S: Final = 0.5
"""A module or planner that is silent for this time, s, counts as not following."""


class Cue(Enum):
    """State announced to the wearer; its value is the argument of the command."""

    FOLLOWS = "follows"
    """The planner leads, and all six modules track: the robot follows the hand."""
    HOLDS = "holds"
    """The robot stands and does not follow the hand. The wearer should stop leading."""
    SINKS = "sinks"
    """A module is in DAMP, DISARMED or FAULT: the robot sinks."""
    FALLEN = "fallen"


def cue_of(modes: Sequence[int | None], planner: int | None) -> Cue:
    """Return the state to announce.

    Args:
        modes: `Mode` of each module; None if it is silent.
        planner: `PlannerMode`; None if it is silent.
    """
    if planner == PlannerMode.FALLEN:
        return Cue.FALLEN
    if any(mode not in (None, Mode.HOLD, Mode.TRACK) for mode in modes):
        return Cue.SINKS
    leads = planner == PlannerMode.LEADING and all(mode == Mode.TRACK for mode in modes)
    return Cue.FOLLOWS if leads else Cue.HOLDS


EXAMPLES: Final = """
xrl cue
xrl cue play-for-wearer.sh
xrl cue -- spd-say --rate 50     # speak the state
"""


class CueFlags(RunDirFlags):
    """Command that announces the state."""

    command: Annotated[tuple[str, ...], positional("COMMAND")] = ()
    """command to run at each change, with follows, holds, sinks or fallen as its last argument
    (default: ring the terminal's bell)"""


class _Heard:
    """Newest mode of each sender that is not silent."""

    def __init__(self, session: Session) -> None:
        self._latest: dict[str, Latest[JointState] | Latest[PlannerStatus]] = {
            module: session.latest_in_batch(topics.JOINT_STATE, JointState, module)
            for module in MODULES
        }
        self._latest["planner"] = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._seen: dict[str, tuple[float, int]] = {}

    def look(self) -> Cue:
        """Return the current state."""
        now = time.monotonic()
        for name, latest in self._latest.items():
            message = latest.take()
            if message is not None:
                self._seen[name] = now, message.mode
        modes = {name: mode for name, (heard, mode) in self._seen.items() if now - heard < SILENT_S}
        return cue_of([modes.get(module) for module in MODULES], modes.get("planner"))

    @property
    def complete(self) -> bool:
        """True if a message has arrived from every sender."""
        return len(self._seen) == len(self._latest)


def run(flags: CueFlags) -> int:
    """Announce each change until Ctrl-C."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    console, stop = Console(), StopFlag()
    told: Cue | None = None
    sounding: subprocess.Popen[bytes] | None = None
    with open_session(fleet.manifest.robot(), "cue", fleet.run.path) as session:
        watched, began = _Heard(session), time.monotonic()
        while not stop:
            time.sleep(POLL_S)
            now = watched.look()
            if told is None and not watched.complete and time.monotonic() - began < SILENT_S:
                continue  # wait for the first messages
            if now is not told:
                told = now
                console.print(now.value)
                if not flags.command:
                    console.bell()
                if sounding is not None and sounding.poll() is None:
                    sounding.terminate()
                sounding = _start([*flags.command, now.value]) if flags.command else None
    if sounding is not None:
        _end(sounding)
    return 0


def _end(sounding: subprocess.Popen[bytes]) -> None:
    """End a command that may still run."""
    sounding.terminate()
    try:
        sounding.wait(ENDS_IN_S)
    except subprocess.TimeoutExpired:
        sounding.kill()
        sounding.wait()


def _start(command: Sequence[str]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise FleetError(
            f"{command[0]}: cannot be run: {error.strerror}; give an executable command"
        ) from None
