"""Head and foot of a page: verdict, facts about the run, lost messages, input files."""

from __future__ import annotations

import io
import json
import tomllib
from datetime import datetime
from typing import Any, Final, NamedTuple

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.exceptions import XrlError
from shared.mcap_log.recover import describe_lost
from shared.mcap_log.sequence_stats import KeyCount
from shared.text_file import decoded
from tools.judge import verdict, verdict_table
from tools.judge.reports.run_data import RunData
from tools.judge.verdict import Summary
from tools.terminal import Console

MACHINE: Final = {
    "python": "Python", "platform": "platform", "cpu_model": "CPU", "cpu_count": "CPUs",
}  # fmt: skip


INCOMPLETE: Final = "incomplete: the recorder did not close the file"


class RunVerdict(NamedTuple):
    """Verdict on a run."""

    sentence: str
    good: bool | None
    """None: no verdict."""
    rows: list[tuple[str, str, str, str]]
    """(figure, measured, limit, `ok` or `over`, the latter possibly with the reason)."""
    caution: str = ""
    """Reason not to trust the figures."""


class TopicLoss(NamedTuple):
    """Recorded and lost messages of one topic."""

    name: str
    rate_hz: float | None
    """Mean rate from the first to the last message."""
    nominal_hz: float
    counted: KeyCount


class Judge:
    """Judges a run in the words of the command that made it, from its parts in their order."""

    def __init__(self) -> None:
        self._summaries: list[Summary] = []
        self._counts: dict[str, KeyCount] = {}
        self._why_not = ""

    def add(self, run: RunData) -> None:
        """Add a run, or the next part of it."""
        run.log.count_into(self._counts)
        if run.course is None:
            self._why_not = self._why_not or run.without_course
            return
        try:
            planned = _scenario_of(run).get("duration")
            last_s = float(run.course.t[-1])
            duration_s = float(planned) if isinstance(planned, int | float) else last_s
            self._summaries.append(verdict.summarise(run.log, duration_s, self._counts))
        except XrlError as error:
            self._why_not = str(error)

    def verdict(self, *, whole: bool = True) -> RunVerdict:
        """Return the verdict; a part of a run (`whole` is False) has figures alone."""
        if not self._summaries:
            return RunVerdict(f"No verdict: {self._why_not}", None, [])
        summary = verdict.merged(self._summaries)
        if not whole:
            return RunVerdict(
                "A part of a run, and its figures: no verdict", None, verdict_table.rows(summary)
            )
        lines = _verdict_lines(summary)
        cautions = verdict_table.stalls(summary)
        cautions += [] if summary.in_real_time else [lines[-2]]
        caution = " ".join(f"{line.rstrip('.')}." for line in cautions)
        return RunVerdict(lines[-1], summary.sound, verdict_table.rows(summary), caution)


def _scenario_of(run: RunData) -> dict[str, Any]:
    """Return the scenario of a run; nothing if the log has none that can be read."""
    raw = run.log.attachments.get("scenario.toml", b"")
    try:
        return tomllib.loads(decoded(raw))
    except (ValueError, RecursionError):
        return {}


def _verdict_lines(summary: Summary) -> list[str]:
    """Return the printed lines of the verdict; the last line is the verdict itself."""
    text = io.StringIO()
    console = Console(file=text, width=200, color_system=None, soft_wrap=True)
    verdict_table.show(summary, console)
    return [line.strip() for line in text.getvalue().strip().splitlines()]


def head(run: RunData) -> list[tuple[str, str]]:
    """Return (name, value) of the facts that a reader needs first."""
    log, about = run.log, run.log.metadata["run"]
    begin, end = run.span
    scenario = (about.get("scenario", ""), str(_scenario_of(run).get("about", "")))
    changed = " with changes" if about.get("git_dirty") == "true" else ""
    rows = [
        ("scenario", ": ".join(filter(None, scenario))),
        ("started", _date(about.get("started", ""))),
        ("virtual time", about.get("lockstep", "")),
        ("length", f"{end - begin:.1f} s"),
        ("file", log.path.name),
        ("recording", "complete" if log.complete else INCOMPLETE),
        ("git commit", about.get("git_commit", "") + changed),
        ("robot", log.robot),
        ("xrl", log.metadata.get("packages", {}).get("xrl", "")),
        ("log version", about.get("schema_version", "")),
    ]
    rows += [(name, about.get(key, "")) for key, name in MACHINE.items()]
    rows.append(("threads", _threads(about.get("thread_env", ""))))
    return [(name, value) for name, value in rows if value]


def _threads(raw: str) -> str:
    """Return the environment variables that limit threads; the raw text if it is not JSON."""
    try:
        found = json.loads(raw or "{}")
        return ", ".join(f"{name}={value}" for name, value in sorted(found.items()))
    except (ValueError, AttributeError, RecursionError):
        return raw


def _date(started: str) -> str:
    """Return a readable date; the raw text if it is not in ISO format."""
    try:
        return f"{datetime.fromisoformat(started):%Y-%m-%d %H:%M:%S %Z}".strip()
    except ValueError:
        return started


class MessageLosses:
    """Recorded and lost messages of each topic, by sequence numbers."""

    def __init__(self) -> None:
        self.counts: dict[str, KeyCount] = {}
        self._times_ns: dict[str, tuple[int, int]] = {}

    def add(self, run: RunData) -> None:
        """Add a run, or the next part of it."""
        log = run.log
        log.count_into(self.counts)
        for key in log.keys():  # noqa: SIM118 - a log is no mapping
            times = [t_ns for t_ns, _, _ in log.raw(key) if log.holds(t_ns)]
            if not times:
                continue
            first_ns, last_ns = min(times), max(times)
            self._times_ns[key] = (self._times_ns.get(key, (first_ns, 0))[0], last_ns)

    def rows(self, robot: str) -> list[TopicLoss]:
        """Return a row for each topic that has messages."""
        known, rows = topics.all_keys(robot), []
        for key, count in sorted((key, one) for key, one in self.counts.items() if one.count):
            first_ns, last_ns = self._times_ns[key]
            span_s = (last_ns - first_ns) / NS_PER_S
            nominal_hz = known[key].rate_hz if key in known else 0.0
            rate = (count.count - 1) / span_s if nominal_hz > 0.0 and span_s > 0.0 else None
            name = key.removeprefix(f"xrl/{robot}/")
            rows.append(TopicLoss(name, rate, nominal_hz, count))
        return rows


def damage(run: RunData) -> list[str]:
    """Return the unreadable parts of the file, one line each."""
    log = run.log
    if log.complete and not log.damage:
        return []
    return describe_lost(log.cut, log.damage, finished=log.complete)


def files(run: RunData) -> list[tuple[str, str]]:
    """Return (name, text) of the input files of the run, from its log."""
    texts = {name: raw.decode(errors="replace") for name, raw in run.log.attachments.items()}
    written = sorted(name for name in texts if name.endswith(".toml"))  # by people, so first
    computed = sorted(name for name in texts if name.endswith(".json"))
    return [(name, texts[name]) for name in (*written, *computed)]


def packages(run: RunData) -> list[tuple[str, str]]:
    """Return (name, version) of all installed packages."""
    found: dict[str, Any] = run.log.metadata.get("packages", {})
    return sorted(found.items(), key=lambda row: row[0].lower())
