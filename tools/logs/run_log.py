"""Read a run's messages from its files, finished or not: the whole run, or a part of its time.

The file of a killed recorder has no summary, and may end inside a record. The readers of the mcap
package find nothing without a summary, and may fail at a truncated record (docs/logs.md).
`shared.mcap_log.reader` reads every complete record from the start; this module sorts the messages
by key.

A run takes about 3 MB of memory per second, and 10 MB with decoded messages. `parts_of` reads a
long run part by part.
"""

from __future__ import annotations

import bisect
import copy
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from services.planner.controller import ATTACHED
from shared.bus import topics
from shared.bus.messages import JointCommand, PlannerStatus
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import files as config_file
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.config.sections import WearerThresholds
from shared.exceptions import RunError
from shared.joints import MODULE_INDEX, N_MODULES
from shared.mcap_log.sequence_stats import KeyCount
from shared.toml_file import decoded, parse_toml
from tools.logs.run_index import RunIndex
from tools.topic_keys import sender_of

PART_S: Final = 30.0
"""Length of a part, s: its decoded messages take about 0.4 GB."""
MARGIN_S: Final = 1.0
"""Time before and after a part that is also read, s, for the inputs and outputs of its ticks."""
WHOLE_MAX_S: Final = 600.0
"""Maximum time that is read at once, s."""
PICTURE_MAX_S: Final = 120.0
"""Maximum time in one picture of a run, s."""
RESTART_NS: Final = 60 * NS_PER_S
"""A clock that jumps by more than this has restarted with its host; no link causes such a delay."""
ONE_CLOCK_NS: Final = 100 * NS_PER_MS
"""Clocks with a smaller offset are the same clock: two hosts never start that simultaneously."""

SEE_INFO: Final = "`xrl log info` shows the content of the file"
"""Advice for a part without messages."""


class RunPart(NamedTuple):
    """A time range of a run, s since its first message."""

    begin_s: float = 0.0
    end_s: float = math.inf


_EVER: Final = 1 << 62
WHOLE: Final = RunPart()
NOTHING: Final = RunPart(0.0, 0.0)
"""Part with only the topics of events."""


class Series:
    """The messages of one key, in the order of recording."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.received_ns: list[int] = []
        """Times of reception by the recorder, on the monotonic clock."""
        self.seq: list[int] = []
        self.decoded: list[Any] | None = None

    def until(self, received_ns: int) -> Series:
        """Return the messages received up to a time."""
        count, cut = bisect.bisect_right(self.received_ns, received_ns), Series()
        cut.payloads, cut.received_ns = self.payloads[:count], self.received_ns[:count]
        cut.seq = self.seq[:count]
        return cut


class NewestAt:
    """Finds the newest row at a time, among rows in the order of their stamps."""

    def __init__(self, rows: Sequence[Any], stamps: Sequence[int] | None = None) -> None:
        self._rows = rows
        self._stamps = [row.t_ns for row in rows] if stamps is None else stamps

    def at(self, t_ns: int) -> Any | None:
        """Return the newest row at or before a time, or None before the first row."""
        index = bisect.bisect_right(self._stamps, t_ns) - 1
        return self._rows[index] if index >= 0 else None


class RunLog:
    """The messages of a run, or of a part of it, in memory.

    Messages are decoded on request, once per key. Topics of events, which have no rate, are always
    read for the whole run, because a mode or a cut link from before a part still applies in it.

    If services ran on several hosts, `t_ns` of messages from other hosts than the recorder's is
    converted to the recorder's clock (`_on_recorders_clock`), so that times are comparable. With
    `as_sent`, for re-execution, it is not converted. Other times in a message remain on its
    sender's clock.
    """

    def __init__(
        self,
        index: RunIndex,
        part: RunPart = WHOLE,
        margin_s: float = 0.0,
        *,
        as_sent: bool = False,
    ) -> None:
        self.index = index
        self.path, self.files = index.path, index.files
        self.metadata, self.attachments = index.metadata, index.attachments
        self.robot, self.offset_ns = index.robot, index.offset_ns
        began_ns, ended_ns = index.span_ns
        self.begin_ns = began_ns + _ns(part.begin_s)
        self.end_ns = min(began_ns + _ns(part.end_s), ended_ns + 1)
        """End of the part on the monotonic clock, exclusive; the part begins at `begin_ns`."""
        self.is_first = part.begin_s <= 0.0
        self.is_last = self.end_ns > ended_ns
        self.is_whole = self.is_first and self.is_last
        self._hosts = {} if as_sent else index.hosts
        self._series: dict[str, Series] = {}
        self._read(_ns(margin_s))
        self.complete, self.damage, self.cut = index.complete, index.damage, index.cut

    @property
    def has_world(self) -> bool:
        """True if the log contains a simulated world."""
        return bool(self.count(topics.SIM_TRUTH.key(self.robot)))

    def keys(self) -> list[str]:
        """Return every key that has at least one message."""
        return [key for key, series in self._series.items() if series.payloads]

    def count(self, key: str) -> int:
        """Return the number of messages on a key; 0 for an unknown key."""
        return len(self._of(key).payloads)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        """Return the messages of a topic as `topic.type`, in the order of the file.

        Raises RunError if another version wrote them, or the module does not fit the topic.
        """
        key = self._key(topic, module)
        if topic is topics.JOINT_COMMAND:
            return [command for _, command in self._commands(module)]
        series = self._of(key)
        if series.decoded is None:
            decode = msgspec.json.Decoder(topic.type).decode
            try:
                decoded = [decode(payload) for payload in series.payloads]
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                version = self.metadata["run"].get("schema_version", "unknown")
                raise RunError(
                    f"{self.path}: {key}: a message is not a {topic.type.__name__}: {error}; "
                    f"the file has schema version {version}: read it with the code that wrote it"
                ) from None
            series.decoded = self._aligned(decoded, topic, module, series.received_ns)
        return series.decoded

    def newest(self, topic: Topic, module: str = "") -> NewestAt:
        """Return a `NewestAt` over `messages(topic, module)`."""
        return NewestAt(self.messages(topic, module))

    def raw(self, key: str) -> list[tuple[int, bytes, int]]:
        """Return (monotonic time of reception, payload, sequence number) of a key's messages."""
        series = self._of(key)
        return list(zip(series.received_ns, series.payloads, series.seq, strict=True))

    def began_ns(self) -> int:
        """Return the monotonic time at which the recorder received the run's first message."""
        return self.index.span_ns[0]

    def received_ns(self, topic: Topic, module: str = "") -> list[int]:
        """Return the time at which the recorder received each of `messages(topic, module)`.

        The times are on the monotonic clock of the recorder's host.
        """
        if topic is topics.JOINT_COMMAND:
            return [at_ns for at_ns, _ in self._commands(module)]
        return self._of(self._key(topic, module)).received_ns

    def holds(self, received_ns: int) -> bool:
        """Return True for a message of this part, False for one of its margins."""
        return (self.is_first or self.begin_ns <= received_ns) and (
            self.is_last or received_ns < self.end_ns
        )

    def count_into(self, counts: dict[str, KeyCount]) -> None:
        """Add the counts of this part, without its margins, to `counts` of the earlier parts."""
        for key in self.keys():
            count = counts.setdefault(key, KeyCount(several=topics.several_may_write(key)))
            for t_ns, _, seq in self.raw(key):
                if self.holds(t_ns):
                    count.feed(seq)

    def gaps(self) -> dict[str, KeyCount]:
        """Return counts, gaps and restarts of every key with messages."""
        found: dict[str, KeyCount] = {}
        self.count_into(found)
        return found

    def until(self, received_ns: int) -> RunLog:
        """Return the log with only the messages received up to a time."""
        cut = copy.copy(self)
        series = {key: one.until(received_ns) for key, one in self._series.items()}
        cut._series = series  # noqa: SLF001 - an instance of the same class
        return cut

    def forget(self) -> None:
        """Drop all messages; metadata and attachments stay."""
        self._series = {}

    def _aligned(
        self, messages: list[Any], topic: Topic, module: str, received_ns: list[int]
    ) -> list[Any]:
        """Return the messages with `t_ns` on the recorder's clock."""
        here = self._hosts.get(self.index.recorded_beside)
        if len(set(self._hosts.values())) < 2 or here is None:
            return messages
        if self._hosts.get(sender_of(topic, module)) == here:
            return messages
        times_ns = _on_recorders_clock([message.t_ns for message in messages], received_ns)
        return [
            msgspec.structs.replace(message, t_ns=t_ns)
            for message, t_ns in zip(messages, times_ns, strict=True)
        ]

    def _commands(self, module: str) -> list[tuple[int, JointCommand]]:
        """Return a module's commands, with the stamps and reception times of their statuses."""
        statuses: list[PlannerStatus] = self.messages(topics.PLANNER_STATUS)
        received, index = self.received_ns(topics.PLANNER_STATUS), MODULE_INDEX[module]
        found = []
        for at_ns, status in zip(received, statuses, strict=True):
            if len(status.commands) == N_MODULES:
                command = status.commands[index]
                if command.t_ns != status.t_ns:  # converted to the recorder's clock
                    command = msgspec.structs.replace(command, t_ns=status.t_ns)
                found.append((at_ns, command))
        return found

    def _key(self, topic: Topic, module: str) -> str:
        if topic.per_module != bool(module):
            right = "name a module" if topic.per_module else "remove the module"
            raise RunError(f"{topic.name}: module {module!r} does not fit this topic; {right}")
        return topic.key(self.robot, module)

    def _of(self, key: str) -> Series:
        return self._series.get(key) or Series()

    def _read(self, margin_ns: int) -> None:
        if self.is_whole:
            self._sort(0, _EVER)
            return
        known = topics.all_keys(self.robot).items()
        events = frozenset(key for key, topic in known if not topic.rate_hz)
        self._sort(0, _EVER, events, others=False)
        self._sort(self.begin_ns - margin_ns, self.end_ns + margin_ns, events, others=True)

    def _sort(
        self,
        first_ns: int,
        last_ns: int,
        keys: frozenset[str] = frozenset(),
        *,
        others: bool = True,
    ) -> None:
        offset_ns = self.offset_ns
        first_ns, last_ns = first_ns + offset_ns, last_ns + offset_ns
        for record, keys_by_channel in self.index.records(
            first_ns, last_ns, None if others else keys
        ):
            body = record.body
            by_channel = {
                number: self._series.setdefault(key, Series())
                for number, key in keys_by_channel.items()
                if (key in keys) != others
            }
            for channel, seq, log_ns, _, start, end in record.rows:  # the hot loop of reading
                series = by_channel.get(channel)
                if series is not None and first_ns <= log_ns < last_ns:
                    series.payloads.append(body[start:end])
                    series.received_ns.append(log_ns - offset_ns)
                    series.seq.append(seq)


def _on_recorders_clock(sent_ns: Sequence[int], received_ns: Sequence[int]) -> list[int]:
    """Return the times of one sender's messages on the clock of the recorder that received them.

    A monotonic clock counts from its host's start, so the clocks of two hosts may differ by hours.
    The fastest message is assumed to have no delay. So the returned times are late by its delay, up
    to a few milliseconds, and by the drift of the clocks over the part that is read (1.5 ms in 30 s
    at 50 ppm; topics of events are read over the whole run). A host that restarts has another clock
    from then on. Messages that were delayed by a cut link keep their times.
    """
    late_ns = [got - sent for sent, got in zip(sent_ns, received_ns, strict=True)]
    restarts = [n for n, (a, b) in enumerate(pairwise(late_ns), 1) if abs(b - a) > RESTART_NS]
    found: list[int] = []
    for first, last in pairwise([0, *restarts, len(late_ns)]):
        offset_ns = min(late_ns[first:last], default=0)
        if abs(offset_ns) < ONE_CLOCK_NS:
            offset_ns = 0
        found += [sent + offset_ns for sent in sent_ns[first:last]]
    return found


def read_run(path: Path, *, as_sent: bool = False) -> RunLog:
    """Read a run, finished or killed: a file, or all files of the run in a directory.

    Raises RunError if a file is missing, empty or not a run, the directory contains no run or
    several, or the run is too long to read at once. `as_sent` keeps all times as sent.
    """
    return read_part(RunIndex(path), WHOLE, as_sent=as_sent)


def read_part(index: RunIndex, part: RunPart, *, as_sent: bool = False) -> RunLog:
    """Read a part of a run at once."""
    length_s = index.length_s
    if part.begin_s > length_s:
        raise RunError(f"{index.path}: --from {part.begin_s:g}: must be at most {length_s:.1f}")
    read_s = min(part.end_s, length_s) - max(part.begin_s, 0.0)
    if read_s > WHOLE_MAX_S:
        raise RunError(
            f"{index.path}: {read_s:.0f} s exceeds the {WHOLE_MAX_S:g} s that can be read at once; "
            "choose a part with --from and --to"
        )
    return RunLog(index, part, as_sent=as_sent)


def divided(index: RunIndex, part: RunPart, longest_s: float, multiple: int = 1) -> list[RunPart]:
    """Divide a part of a run into equal pieces: one, or a multiple of `multiple`."""
    begin_s, end_s = max(part.begin_s, 0.0), min(part.end_s, index.length_s)
    count = max(1, math.ceil((end_s - begin_s) / longest_s))
    count = multiple * math.ceil(count / multiple) if count > 1 else 1
    step_s = (end_s - begin_s) / count
    edges = [*(begin_s + number * step_s for number in range(count)), part.end_s]
    return [RunPart(*piece) for piece in pairwise(edges)]


def parts_of(
    index: RunIndex,
    part: RunPart = WHOLE,
    *,
    part_s: float = PART_S,
    margin_s: float = MARGIN_S,
    as_sent: bool = False,
    done: Callable[[float], None] = lambda _s: None,
) -> Iterator[RunLog]:
    """Yield a run, or a part of it, in consecutive parts with only one in memory at a time.

    Each part drops its messages when the next is requested; `margin_s` before and after is also
    read. `done` receives the time of the run that has been read, s.
    """
    for piece in divided(index, part, part_s):
        log = RunLog(index, piece, margin_s, as_sent=as_sent)
        yield log
        log.forget()
        done((log.end_ns - log.began_ns()) / NS_PER_S)


def robot_of(log: RunLog | RunIndex) -> RobotConfig:
    """Return the robot of a log."""
    raw = text_of(log, "robot.toml")
    robot = config_file.parse(raw, f"{log.path}: robot.toml")
    if "robot.wearer.toml" in log.attachments:
        text, name = text_of(log, "robot.wearer.toml"), f"{log.path}: robot.wearer.toml"
        robot = config_file.worn_by(robot, parse_toml(text, name, WearerThresholds))
    schedule = log.attachments.get("robot.gains.json")
    if schedule is None:
        return robot
    try:
        table = msgspec.json.decode(decoded(schedule), type=GainSchedule)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise RunError(f"{log.path}: robot.gains.json is not a gain schedule: {error}") from None
    return msgspec.structs.replace(robot, gain_schedule=table)


def text_of(log: RunLog | RunIndex, name: str) -> str:
    """Return a text file from a log."""
    try:
        return decoded(log.attachments[name])
    except KeyError:
        raise RunError(f"{log.path}: has no {name}; give a log that XRL recorded") from None
    except UnicodeError as error:
        raise RunError(f"{log.path}: its {name} {error}") from None


def has_own_controller(log: RunLog | RunIndex) -> bool:
    """Return True if a user's own controller ran instead of the law."""
    return ATTACHED in log.attachments


def refuse_own_controller(log: RunLog | RunIndex) -> None:
    """Refuse a log whose planner ran a user's own controller."""
    if has_own_controller(log):
        raise RunError(
            f"{log.path}: your own controller ran ({ATTACHED} is attached), but this command "
            "computes the shipped law; use `xrl log resim --controller FILE`"
        )


def _ns(seconds: float) -> int:
    return round(min(seconds, 1e9) * NS_PER_S)
