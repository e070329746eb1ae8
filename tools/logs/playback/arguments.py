"""The arguments of `xrl log play`, and its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from shared.toml_file import Range
from tools.flags import FINITE_MAX, Arg, RunDirFlags, Seconds, option, positional
from tools.logs.playback.schedule import RATE_MAX, RATE_MIN
from tools.logs.playback.selection import CLOCK

PREFIX: Final = "replay"
LISTEN: Final = "unixsock-stream/{run}/play.zenoh"
NOWHERE: Final = "none"
CLOCK_HZ: Final = 100.0
CLOCK_HZ_MAX: Final = 1000.0
WAIT_S: Final = 1.0

ABOUT: Final = f"""
Messages go out in the order and at the times at which the recorder had them, byte for byte:
t_ns and every other stamp in them is that of the recording. Compare them with --clock, not with
your own clock. Late messages go at once.

Keys: xrl/<robot>/x becomes {PREFIX}/xrl/<robot>/x, which no service subscribes to. With
--prefix "" it is xrl/<robot>/x itself. What a robot acts on (joint states and commands,
harness wrench and tare, attitude, operator intent, estop, sim/control) is then refused while a
joint service is on the bus. --force puts tare, intent, estop and sim/control anyway;
states, commands, wrenches and attitudes would move the robot, and are never put beside a live
drive.

Subscribers dial the player at --listen:
  open_session(robot, "mine", run_dir, connect=["{LISTEN}"])
  .stream(["{PREFIX}/**"])
or any Zenoh 1.x peer or client that connects there. The player dials the services of a
fleet that is up in --run-dir.

In a terminal: space pauses and resumes; right sends the next message of a paused play (or
skips 100 ms); up and down change the rate by a tenth; q ends.

Exit code: 0 played; 2 refused, messages could not be sent, or a subscriber that took nothing for
5 s was dropped; 130 Ctrl-C. A subscriber that links later misses earlier messages: the
summary says how many messages nobody received.
"""


class PlayFlags(RunDirFlags):
    """What of a log is put, when, and under which keys."""

    files: Annotated[tuple[Path, ...], positional("FILE")] = ()
    """files of a run in any order, finished or not, or its directory; put it before the flags"""
    topics: Annotated[tuple[str, ...], Arg(metavar="NAME", takes_many=True)] = ()
    """play only these: names below xrl/<robot>/, or globs such as joint/*/state"""
    exclude: Annotated[tuple[str, ...], Arg(metavar="NAME", takes_many=True)] = ()
    """leave these out: names below xrl/<robot>/, or globs such as joint/*/state"""
    remap: Annotated[tuple[str, ...], Arg(metavar="OLD=NEW", takes_many=True)] = ()
    """play OLD under the name NEW, both below xrl/<robot>/; * stands for the same in both"""
    prefix: Annotated[str, Arg(metavar="WORD")] = PREFIX
    """prefix of each key (default: replay); empty: the live keys"""
    force: bool = False
    """on the live keys beside a live drive: also send what it acts on, except what moves it"""
    rate: Annotated[float, Range(RATE_MIN, RATE_MAX, ""), option("--rate", "-r", metavar="R")] = 1.0
    """recorded seconds per second"""
    start_offset: Annotated[Seconds, option("--start-offset", "-s")] = 0.0
    """start S seconds after the first message of the log"""
    duration: Annotated[float | None, Range(1e-9, FINITE_MAX, "s"), option("--duration", "-d")] = (
        None
    )
    """length of the part to play, in recorded seconds"""
    loop: Annotated[bool, option("--loop", "-l")] = False
    """repeat until Ctrl-C"""
    start_paused: Annotated[bool, option("--start-paused", "-p")] = False
    """wait until you press space; on a terminal"""
    clock: Annotated[
        bool, Arg(help=f"publish the recorded time on PREFIX/{CLOCK}, as {{t_ns, seq}}")
    ] = False
    clock_hz: Annotated[float, Range(RATE_MIN, CLOCK_HZ_MAX, "Hz")] = CLOCK_HZ
    """its rate, in real time"""
    wait: Seconds = WAIT_S
    """longest wait for the first subscriber"""
    listen: Annotated[
        str,
        Arg(
            metavar="ENDPOINT",
            help=f"where subscribers dial (default {LISTEN}); {NOWHERE}: nowhere",
        ),
    ] = LISTEN
    config: Path | None = None
    """robot file with the bus's endpoints (default: that of the fleet in --run-dir, else as
    shipped: never a log's)"""
