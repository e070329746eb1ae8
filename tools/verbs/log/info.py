"""`xrl log info`: shows the contents of a log, finished or not."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Final

import msgspec
from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.exceptions import XrlError
from shared.mcap_log.recover import (
    clock_time,
    describe_count,
    describe_earlier_ends,
    describe_lost,
    describe_passed_over,
)
from shared.mcap_log.writer import SCHEMA_VERSION
from tools.flags import Arg, Flags, option, positional
from tools.guarded_streams import printable
from tools.judge.run_parts import zero_ns
from tools.logs.impairment_intervals import impairments
from tools.logs.run_index import RunIndex, files_in, files_of_run
from tools.logs.run_log import NOTHING, RunLog
from tools.logs.survey import FileFacts, Survey, TopicFacts
from tools.terminal import Console, marked

SLOW: Final = 0.9
"""A rate below this fraction of the topic's nominal rate is marked."""
MIB: Final = 1 << 20
LARGE: Final = 128 * MIB
"""Size above which finished files are read completely only with --full, bytes."""
INJECTED_MAX: Final = 12
"""Maximum number of impairments listed."""


EXAMPLES: Final = """
xrl log info out/a/run.mcap
xrl log info out/a/run.mcap --json | jq '.topics | map_values(.sequence.missing)'
"""


class InfoFlags(Flags):
    """Log to inspect, and the output format."""

    file: Annotated[Path, positional("FILE")]
    """MCAP file, finished or not; or a directory, for the first file of its run"""
    whole_run: Annotated[bool, option("--run")] = False
    """count all files of the run together"""
    full: Annotated[
        bool,
        Arg(
            help=f"read every message of a finished file over {LARGE >> 20} MiB, for sizes, "
            "longest gaps and damage (default: the recorder's counts)"
        ),
    ] = False
    json: bool = False
    """print JSON"""


def run(flags: InfoFlags) -> int:
    """Print the survey; return 0 if the file can be read."""
    survey = Survey()
    file = files_in(flags.file)[0] if flags.file.is_dir() else flags.file
    first = _add(survey, file, full=flags.full)
    run_files = files_of_run(file, first.metadata)
    if flags.whole_run and len(run_files) > 1:
        survey = Survey()
        for path in run_files:
            _add(survey, path, full=flags.full)
    if flags.json:
        found = {"run_files": run_files, "files": survey.files, "topics": survey.topics}
        print(msgspec.json.format(msgspec.json.encode(found, enc_hook=str)).decode())
    else:
        show(survey, run_files, Console())
    return 0


def _add(survey: Survey, path: Path, *, full: bool) -> FileFacts:
    large = path.is_file() and path.stat().st_size > LARGE
    return survey.add(path, by_index=large and not full)


def show(survey: Survey, run_files: list[Path], console: Console) -> None:
    """Print the survey."""
    for file in survey.files:
        _show_file(file, console)
    others = [path for path in run_files if path not in [file.path for file in survey.files]]
    if others:
        names = ", ".join(path.name for path in others)
        console.print(f"further files of this run: {printable(names)} (--run counts all together)")
    _show_run(survey, console)
    present = {name: topic for name, topic in survey.topics.items() if topic.sequence.count}
    robot = survey.files[0].metadata.get("run", {}).get("robot", "")
    if present:
        console.print()
        console.print(_table(present, f"xrl/{robot}/", events=survey.files[0].ours))
    if any(topic.longest_gap_ns is None for topic in present.values()):
        console.print("counts are the recorder's; --full reads every message", style="dim")
    silent = len(survey.topics) - len(present)
    if silent:
        console.print(f"{silent} more topics without a message", style="dim")


def _show_file(file: FileFacts, console: Console) -> None:
    state = Text("finished")
    if not file.finished:
        state = Text("being written" if file.in_use else "not finished", "yellow")
    size = f"{file.size / MIB:.2f} MiB" if file.size >= MIB else f"{file.size} bytes"
    console.print(marked("[bold]{}[/]: {}, {}", file.path, size, state), soft_wrap=True)
    lines = describe_count(file.counted, file.messages + file.orphans)
    if file.damage or not file.finished:
        lines = [*describe_lost(file.cut, file.damage, finished=file.finished), *lines]
    if file.earlier_ends:
        lines.append(describe_earlier_ends(file.earlier_ends))
    for line in lines:
        console.print(f"  {line}", style="yellow", soft_wrap=True)
    if file.orphans:
        console.print(f"  {file.orphans} messages of channels without a description")
    if file.passed_over:
        console.print(f"  passed over: {describe_passed_over(file.passed_over)}")
    flush_ms = file.metadata.get("recorder", {}).get("flush_ms", "")
    if not file.finished and not file.in_use:
        if flush_ms:
            console.print(
                f"  written every {printable(flush_ms)} ms: messages after the last are lost"
            )
        command = f"xrl log recover {printable(shlex.quote(str(file.path)))}"
        console.print(f"  finish it with: {command}", soft_wrap=True)
    elif lines and not file.in_use:
        command = f"xrl log recover {printable(shlex.quote(str(file.path)))}"
        console.print(f"  to copy all that can be read: {command}", soft_wrap=True)
    note = file.metadata.get("recovered")
    if note is not None:
        console.print(f"  recovered from {printable(note.get('from', '?'))}", style="dim")


def _show_run(survey: Survey, console: Console) -> None:
    file = survey.files[0]
    about = file.metadata.get("run", {})
    grid = Table.grid(padding=(0, 2))
    if survey.messages:
        duration = f"{_seconds(survey.first_ns, survey.last_ns):.2f} s"
        grid.add_row("duration", f"{duration} from {clock_time(survey.first_ns)}")
    grid.add_row("messages", str(survey.messages))
    for label, name in (("robot", "robot"), ("scenario", "scenario"), ("lockstep", "lockstep")):
        if about.get(name):
            grid.add_row(label, printable(about[name]))
    if about.get("git_commit"):
        dirty = " with changes" if about.get("git_dirty") == "true" else ""
        grid.add_row("git commit", printable(about["git_commit"]) + dirty)
    if file.attachments:
        sizes = ", ".join(f"{name} ({size} bytes)" for name, size in file.attachments.items())
        grid.add_row("attachments", printable(sizes))
    version = about.get("schema_version", "")
    if not file.ours:
        written = printable(f"profile {file.profile!r}, written by {file.library}")
        grid.add_row("foreign", f"{written}: `xrl` can read nothing else in it")
    elif version != SCHEMA_VERSION:
        grid.add_row(
            "version", f"{printable(version) or 'unknown'}; this code writes {SCHEMA_VERSION}"
        )
    for number, line in enumerate(_injected(survey)):
        grid.add_row("" if number else "injected", printable(line))
    console.print(grid)


def _injected(survey: Survey) -> list[str]:
    """Return a line for each impairment of the network, in scenario time if the scenario began.

    Files without impairments are not read again.
    """
    robot = survey.files[0].metadata.get("run", {}).get("robot", "")
    topic = survey.topics.get(topics.LINK_EVENT.key(robot))
    if topic is None or not topic.sequence.count or not survey.files[0].ours:
        return []
    try:
        indices = [RunIndex(file.path) for file in survey.files]
        events = [
            event
            for index in indices
            for event in RunLog(index, NOTHING).messages(topics.LINK_EVENT)
        ]
        zero = zero_ns(indices[0])
    except XrlError as error:
        return [str(error)]
    lines = [f"{row.title}: {row.when(zero)}; {row.counts()}" for row in impairments(events)]
    since = " (s since the start of the log)" if zero == indices[0].span_ns[0] else ""
    more = len(lines) - INJECTED_MAX
    if more > 0:
        lines[INJECTED_MAX:] = [f"and {more} more"]
    return [line + since for line in lines[:1]] + lines[1:]


def _table(found: dict[str, TopicFacts], prefix: str, *, events: bool) -> Table:
    """Return a row for each topic."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("topic", overflow="fold")
    for name in ("count", "Hz", "nominal", "gap ms", "lost", "restarts"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, topic in sorted(found.items()):
        rate, nominal = topic.rate_hz, topic.nominal_hz
        slow = rate is not None and nominal > 0.0 and rate < SLOW * nominal
        steady = rate is not None and (nominal > 0.0 or not events)
        lost, known = topic.sequence.missing, not topic.sequence.several
        table.add_row(
            printable(name.removeprefix(prefix)),
            str(topic.sequence.count),
            Text(f"{rate:.1f}" if steady else "", style="yellow" if slow else ""),
            f"{nominal:g}" if nominal else "",
            f"{topic.longest_gap_ns * 1e-6:.1f}"
            if steady and topic.longest_gap_ns is not None
            else "",
            Text(str(lost) if known else "", style="yellow" if lost else ""),
            str(topic.sequence.restarts) if known else "",
        )
    return table


def _seconds(first_ns: int, last_ns: int) -> float:
    return (last_ns - first_ns) / NS_PER_S
