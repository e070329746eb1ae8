"""`xrl log play`: replays a log on a separate bus, under `replay/` and never under a live key."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import Annotated, Final, NamedTuple, Protocol

import msgspec
from rich.progress import Progress, TextColumn

from shared.bus.pubsub import RawPublisher
from shared.bus.session import open_session
from shared.clock import NS_PER_MS, NS_PER_S, now_ns
from shared.config import files as config_file
from shared.config.robot_config import expand
from shared.exceptions import RunError
from shared.places import DEFAULT_CONFIG
from shared.toml_file import Range
from tools.cli import INTERRUPTED
from tools.flags import Arg, Run, RunDirFlags, Seconds, option
from tools.judge.run_parts import PartFlags, part_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, RunPart
from tools.terminal import Console
from tools.topic_keys import keys_named

PREFIX: Final = "replay"
LISTEN: Final = "unixsock-stream/{run}/play.zenoh"
RATE_MIN: Final = 0.001
RATE_MAX: Final = 1000.0
SHOW_NS: Final = 200 * NS_PER_MS
DROPPED_NS: Final = round(4.9 * NS_PER_S)
"""A `put` that takes longer than this, ns, has dropped the link of a subscriber that read nothing
for 5 s."""
_POLL_S: Final = 0.01
_SETTLED_S: Final = 0.1
_FLUSH_S: Final = 1.0
"""Wait before closing, s: a closing session drops queued messages after a quarter of a second."""

EXAMPLES: Final = """
xrl log play out/a/run.mcap
xrl log play out/a --from 10 --to 12.5 --topic 'joint/*/state'
"""

ABOUT: Final = f"""
Messages are sent byte for byte, in the recorded order and at the recorded intervals, divided by
--rate. Key xrl/<robot>/x becomes {PREFIX}/xrl/<robot>/x, to which no service subscribes. The player
connects to no peer. Subscribers, any Zenoh 1.x peers or clients, connect to --listen:
  session = open_session(robot, "mine", run_dir, connect=["{LISTEN}"])
  messages = session.stream(["{PREFIX}/**"])
Exit code 2 also means that messages could not be sent, or that a subscriber that read nothing for
5 s was dropped. The summary counts the messages sent before the first subscriber.
"""


class PlayFlags(RunDirFlags, PartFlags):
    """Part of a log to replay, and its speed."""

    file: Run
    topic: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """only this topic, such as 'joint/*/state'; repeatable"""
    rate: Annotated[float, Range(RATE_MIN, RATE_MAX, ""), option("--rate", "-r", metavar="R")] = 1.0
    """speed relative to the recording"""
    wait: Seconds = 1.0
    """maximum wait for the first subscriber"""
    listen: Annotated[
        str, Arg(metavar="ENDPOINT", help=f"endpoint to listen on (default: {LISTEN})")
    ] = LISTEN


class Entry(NamedTuple):
    """Recorded message."""

    after_ns: int
    """Time since the start of the replayed part, ns."""
    key: str
    payload: bytes


def entries(index: RunIndex, part: RunPart, keys: Collection[str]) -> Iterator[Entry]:
    """Yield a part's messages of some keys as they were recorded; hold one chunk in memory."""
    begin_ns = index.began_ns + round(part.begin_s * NS_PER_S)
    end_ns = index.ended_ns + 1
    if part.end_s < index.length_s:
        end_ns = index.began_ns + math.ceil(part.end_s * NS_PER_S)
    for record, known in index.records(begin_ns, end_ns, frozenset(keys)):
        for channel, _, log_ns, _, start, end in sorted(record.rows, key=itemgetter(2, 3)):
            key = known.get(channel, "")
            if key in keys and begin_ns <= log_ns < end_ns:
                yield Entry(log_ns - begin_ns, key, record.body[start:end])


class _Port(Protocol):
    """Sender to one key of the bus."""

    def put(self, payload: bytes) -> bool:
        """Send; return False if the message cannot be sent."""


class Played(msgspec.Struct):
    """Counts of the messages played."""

    sent: int = 0
    failed: int = 0
    """Not sent: the session is closed."""
    unheard: int = 0
    """Sent before there was a subscriber."""
    dropped: int = 0
    """Links that were dropped because a subscriber read nothing for 5 s."""
    late_max_ns: int = 0
    """Maximum delay of a message behind its due time, ns."""

    def summary(self, keys: int, took_s: float) -> str:
        """Return the counts in one line."""
        late_ms = self.late_max_ns / NS_PER_MS
        sent = f"{self.failed} not sent: the session is closed" if self.failed else "all sent"
        line = (
            f"{self.sent} messages on {keys} keys in {took_s:.2f} s, up to {late_ms:.1f} ms late; "
            f"{sent}"
        )
        if self.dropped:
            line += "; NOT ALL ARRIVED: a subscriber read nothing for 5 s and its link was dropped"
        if self.unheard == self.sent:
            return f"{line}; there was no subscriber"
        if self.unheard:
            line += f"; no subscriber for the first {self.unheard}: give a longer --wait"
        return line


def pace(
    entries: Iterable[Entry],
    ports: Mapping[str, _Port],
    rate: float,
    played: Played,
    *,
    now_ns: Callable[[], int],
    sleep: Callable[[float], None],
    heard: Callable[[], bool],
    show: Callable[[int], None],
) -> None:
    """Send each message at its due time, in order; late messages are sent at once.

    Args:
        entries: the messages.
        ports: sender for each key.
        rate: recorded seconds per second.
        played: counts to update.
        now_ns: monotonic clock.
        sleep: waits for a time, s.
        heard: returns True if there is a subscriber.
        show: receives the position from time to time, ns.
    """
    began_ns = show_ns = now_ns()
    is_heard = False
    for after_ns, key, payload in entries:
        due_ns = began_ns + math.ceil(after_ns / rate)
        while (time_ns := now_ns()) < due_ns or time_ns >= show_ns:
            if time_ns >= show_ns:
                show(math.floor((time_ns - began_ns) * rate))
                show_ns = time_ns + SHOW_NS
            sleep(max(0, min(due_ns, show_ns) - time_ns) / NS_PER_S)
        played.late_max_ns = max(played.late_max_ns, time_ns - due_ns)
        is_heard = is_heard or heard()
        if not ports[key].put(payload):
            played.failed += 1
            continue
        played.sent += 1
        played.unheard += not is_heard
        played.dropped += now_ns() - time_ns > DROPPED_NS


def run(flags: PlayFlags) -> int:
    """Play until the end or Ctrl-C."""
    console = Console()
    index = RunIndex(flags.file)
    part = part_of(flags, index)
    chosen = {key.topic.key(index.robot, key.module) for key in keys_named(flags.topic)}
    keys = chosen & index.keys_with_messages()
    if next(entries(index, part, keys), None) is None:
        raise RunError(f"none of these topics has a message in this part of the log; {SEE_INFO}")
    if not index.complete or index.damage:
        words = f"{flags.file}: incomplete; replayed as far as readable; see `xrl log info`"
        console.print(words, style="yellow", markup=False, soft_wrap=True)
    # Never take endpoints from a log, whose origin is unknown: the player would connect to them.
    robot = config_file.load_without_schedule(DEFAULT_CONFIG)
    with contextlib.ExitStack() as stack:
        stack.callback(_leave_no_directory, flags, made=not flags.run_dir.exists())
        session = stack.enter_context(
            open_session(robot, "play", flags.run_dir, listen=[flags.listen], only=())
        )
        ports = {key: session.raw_publisher(f"{PREFIX}/{key}", patient=True) for key in keys}
        length_s = min(part.end_s, index.length_s) - part.begin_s
        words = (
            f"{length_s:.2f} s of {index.robot}, {len(ports)} keys, onto {PREFIX}/**; "
            f"subscribers connect to {expand(flags.listen, flags.run_dir)}"
        )
        console.print(words, markup=False, soft_wrap=True)
        _await_subscriber(ports, flags.wait)
        return _play(flags.rate, entries(index, part, keys), ports, length_s, console)


def _play(
    rate: float,
    messages: Iterator[Entry],
    ports: Mapping[str, RawPublisher],
    length_s: float,
    console: Console,
) -> int:
    """Replay, and print the counts at the end."""
    columns = (TextColumn("{task.completed:.2f} / {task.total:.2f} s"),)
    played, began_ns = Played(), now_ns()
    try:
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task("", total=length_s)
            pace(
                messages, ports, rate, played, now_ns=now_ns, sleep=time.sleep,
                heard=lambda: any(port.matched for port in ports.values()),
                show=lambda at_ns: progress.update(task, completed=at_ns / NS_PER_S),
            )  # fmt: skip
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        print(played.summary(len(ports), (now_ns() - began_ns) / NS_PER_S), flush=True)
    if played.unheard < played.sent:
        time.sleep(_FLUSH_S)
    return RunError.exit_code if played.failed or played.dropped else 0


def _await_subscriber(ports: Mapping[str, RawPublisher], wait_s: float) -> None:
    """Wait for the first subscriber and all its subscriptions."""
    deadline, matched, since = time.monotonic() + wait_s, 0, time.monotonic()
    while time.monotonic() < deadline and not (matched and time.monotonic() > since + _SETTLED_S):
        before, matched = matched, sum(port.matched for port in ports.values())
        since = since if matched == before else time.monotonic()
        time.sleep(_POLL_S)


def _leave_no_directory(flags: PlayFlags, *, made: bool) -> None:
    """Remove the run directory if it was created for this replay's socket and is unused."""
    if made:
        with contextlib.suppress(OSError):
            flags.run_dir.rmdir()
