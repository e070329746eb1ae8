"""`xrl log play`: put a log back onto the bus, beside the live robot and not into it."""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec

from shared.bus.session import RawPublisher, Session, open_session
from shared.clock import NS_PER_S, now_ns
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import ConfigError, FleetError, RunError
from shared.places import DEFAULT_CONFIG
from shared.toml_file import Range
from tools.cli import INTERRUPTED
from tools.flags import FINITE_MAX, Arg, RunDirFlags, Seconds, option, positional
from tools.fleet.supervise import SupervisedFleet
from tools.keyboard import Keyboard
from tools.logs.playback import guard, reading, selection
from tools.logs.playback.player import PRESSES, Display, Player, Press, introduce, summary, where
from tools.logs.playback.reading import Recording
from tools.logs.playback.schedule import (
    RATE_MAX,
    RATE_MIN,
    Entry,
    EntryStream,
    Playhead,
    Schedule,
    Window,
    window,
)
from tools.logs.playback.selection import CLOCK
from tools.terminal import Console

PREFIX: Final = "replay"
LISTEN: Final = "unixsock-stream/{run}/play.zenoh"
NOWHERE: Final = "none"
CLOCK_HZ: Final = 100.0
CLOCK_HZ_MAX: Final = 1000.0
WAIT_S: Final = 1.0
_POLL_S: Final = 0.01
_SETTLED_S: Final = 0.1
_FLUSH_S: Final = 1.0
"""A closing session gives queued messages a quarter of a second, then drops them."""


class Bus(NamedTuple):
    """Where the player joins."""

    robot: RobotConfig
    note: str
    """A note for the person on how the bus was chosen; else empty."""


EXAMPLES: Final = """
xrl log play out/a/run.mcap
xrl log play out/a --rate 0.5 --loop --clock
xrl log play run.mcap run_1.mcap --start-offset 10 --duration 2.5
xrl log play run.mcap --topics 'joint/*/state' harness/wrench --start-paused
xrl log play run.mcap --exclude 'joint/*/trace' --remap harness/wrench=harness/before
"""


ABOUT: Final = f"""
Messages go out in the order and at the times at which the recorder had them, byte for byte:
t_ns and every other stamp in them is that of the recording. Compare them with --clock, not with
your own clock. Late messages go at once.

Keys: xrl/<robot>/x becomes {PREFIX}/xrl/<robot>/x, which no service subscribes to. With
--prefix "" it is xrl/<robot>/x itself. What a robot acts on (joint states and commands,
harness wrench and tare, attitude, operator intent and hand, estop, sim/control) is then
refused while a joint service is on the bus. --force puts tare, intent, hand, estop and
sim/control anyway; states, commands, wrenches and attitudes would move the robot, and are
never put beside a live drive.

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


def run(flags: PlayFlags) -> int:
    """Play until the end, q or Ctrl-C."""
    console = Console()
    prefix = selection.check_prefix(flags.prefix)
    paths = reading.files_named(flags.files)
    recording = reading.read(paths)
    chosen = selection.choose(recording.keys, flags.topics, flags.exclude)
    targets = selection.targets(chosen, prefix, flags.remap, recording.robot)
    part = part_of(recording, flags)
    bus = bus_of(recording, flags)
    introduce(recording, paths, bus.note, console)
    with contextlib.ExitStack() as stack:
        stack.callback(_leave_no_directory, flags.run_dir, made=not flags.run_dir.exists())
        acting = [] if prefix else guard.those_of(guard.ACTED_ON, targets.values())
        watch = guard.LiveRobotWatch(bus.robot, flags.run_dir) if acting else None
        if watch is not None:
            stack.callback(watch.close)
            targets = _permitted(targets, watch, console, force=flags.force)
        executor = stack.enter_context(ThreadPoolExecutor(1, "read ahead"))
        schedule = schedule_of(recording, targets, part, executor, loop=flags.loop)
        listen = [] if flags.listen == NOWHERE else [flags.listen]
        session = stack.enter_context(open_session(bus.robot, "play", flags.run_dir, listen=listen))
        listening = expand(flags.listen, flags.run_dir) if listen else ""
        words = where(list(targets.values()), recording.robot, part, listening)
        console.print(words, markup=False, soft_wrap=True)
        keyboard = stack.enter_context(Keyboard(PRESSES))
        if flags.start_paused and not keyboard.present:
            raise RunError("--start-paused: there is no terminal here to press space on")
        return _play(flags, schedule, targets, session, keyboard, _alarm(watch, targets, flags))


def part_of(recording: Recording, flags: PlayFlags) -> Window:
    """Return what of the log is to be played."""
    part = window(
        recording.began_ns,
        recording.ended_ns,
        round(flags.start_offset * NS_PER_S),
        None if flags.duration is None else math.ceil(flags.duration * NS_PER_S),
    )
    if part.start_ns > recording.ended_ns:
        length_s = (recording.ended_ns - recording.began_ns) / NS_PER_S
        raise RunError(f"--start-offset {flags.start_offset:g}: the log is {length_s:.2f} s long")
    return part


def bus_of(recording: Recording, flags: PlayFlags) -> Bus:
    """Return the robot whose bus to join: as given, of the fleet that is up, or of the log.

    Endpoints are never taken from a log, which may be a stranger's: the player would dial them.
    """
    file = flags.config
    with contextlib.suppress(FleetError):
        file = file or Path(SupervisedFleet.attach(flags.run_dir).manifest.config)
    shipped = config_file.load_without_schedule(DEFAULT_CONFIG)
    if file is not None:
        robot = config_file.load_without_schedule(file)
        if robot.bus.security.mode != "mtls":
            return Bus(robot, "")
        if not flags.prefix.strip("/"):
            right = "leave --prefix as it is: subscribers dial the player"
            raise RunError(f"{file}: under mtls no process may write another's keys; {right}")
        note = "the fleet's bus is mtls, which refuses a player: it plays on a bus of its own"
        return Bus(msgspec.structs.replace(robot, bus=shipped.bus), note)
    why = "the log holds no robot file"
    if recording.robot_file is not None:
        try:
            robot = config_file.parse(recording.robot_file, f"{reading.ROBOT_FILE} in the log")
            return Bus(msgspec.structs.replace(robot, bus=shipped.bus), "")
        except ConfigError as error:
            why = f"{error}: of another version"
    note = f"{why}; the bus is that of {DEFAULT_CONFIG.name} as shipped (--config: another)"
    return Bus(shipped, note)


def schedule_of(
    recording: Recording,
    targets: dict[str, str],
    part: Window,
    executor: Executor | None = None,
    *,
    loop: bool,
) -> Schedule:
    """Return the messages to be put, numbered by the keys of `targets`."""
    keys = list(targets)

    def read(begin_ns: int, end_ns: int) -> list[Entry]:
        return recording.entries(begin_ns, end_ns, keys)

    schedule = Schedule(EntryStream(read, part, executor), part, loop=loop)
    if schedule.is_empty:
        raise RunError("none of these topics has a message in this part of the log")
    return schedule


def _permitted(
    targets: dict[str, str], watch: guard.LiveRobotWatch, console: Console, *, force: bool
) -> dict[str, str]:
    live = watch.find_live()
    left = guard.allowed(targets, live, force=force)
    out = [target for key, target in targets.items() if key not in left]
    if out:
        words = f"{live}: left out even with --force: {guard.describe(out)}"
        console.print(words, style="yellow", soft_wrap=True)
    return left


def _alarm(
    watch: guard.LiveRobotWatch | None, targets: dict[str, str], flags: PlayFlags
) -> Callable[[], None]:
    """Return what ends a play onto live keys when a joint service comes up meanwhile."""
    rows = guard.IN_THE_LOOP if flags.force else guard.ACTED_ON
    refused = guard.those_of(rows, targets.values())

    def look() -> None:
        if watch is not None and refused and (subscribers := watch.subscribers()):
            raise FleetError(f"stopped: {subscribers}, and it acts on {guard.describe(refused)}")

    return look


def _play(
    flags: PlayFlags,
    schedule: Schedule,
    targets: dict[str, str],
    session: Session,
    keyboard: Keyboard[Press],
    alarm: Callable[[], None],
) -> int:
    """Play, and say at the end how it went."""
    patient = bool(flags.prefix.strip("/"))  # nobody on the live keys is to be waited for
    ports = [session.raw_publisher(key, patient=patient) for key in targets.values()]
    clock = None
    if flags.clock:
        key = selection.clock_key(selection.check_prefix(flags.prefix))
        clock = session.raw_publisher(key, patient=patient)
    if not flags.start_paused:
        _await_subscriber(ports, flags.wait, keyboard)
    display = Display(ports)

    def show() -> None:
        alarm()
        display.show(player)

    gc.freeze()  # the log is not garbage: a collector that walks it makes messages late
    player = Player(
        schedule,
        Playhead(now_ns(), flags.rate, paused=flags.start_paused),
        ports,
        keyboard,
        now_ns=now_ns,
        show=show,
        listening=lambda: any(port.matched for port in ports),
        clock=clock,
        clock_hz=flags.clock_hz,
    )
    began_ns = now_ns()
    try:
        player.run()
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        display.clear()
        print(summary(player, (now_ns() - began_ns) / NS_PER_S), flush=True)
    if patient and player.heard:
        time.sleep(_FLUSH_S)
    return RunError.exit_code if player.stats.failed or player.stats.dropped else 0


def _await_subscriber(
    ports: Sequence[RawPublisher], wait_s: float, keyboard: Keyboard[Press]
) -> None:
    """Wait for the first subscriber, and until its subscriptions are all there."""
    deadline, matched, since = time.monotonic() + wait_s, 0, time.monotonic()
    while time.monotonic() < deadline and not (matched and time.monotonic() > since + _SETTLED_S):
        before, matched = matched, sum(port.matched for port in ports)
        since = since if matched == before else time.monotonic()
        if Press.QUIT in keyboard.wait(_POLL_S):
            return


def _leave_no_directory(run_dir: Path, *, made: bool) -> None:
    """Remove the run directory if it was made for this play's socket and nobody uses it."""
    if made:
        with contextlib.suppress(OSError):
            run_dir.rmdir()
