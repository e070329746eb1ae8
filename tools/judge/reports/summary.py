"""Top and bottom of a page: verdict, facts about the run, input files."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterable, Sequence
from datetime import datetime
from html import escape
from typing import Any, Final, NamedTuple

from shared.exceptions import XrlError
from shared.mcap_log.recover import describe_lost
from shared.mcap_log.sequence_stats import KeyCount
from shared.toml_file import decoded
from tools.judge import verdict, verdict_table
from tools.judge.reports.run_data import RunData
from tools.judge.verdict import Summary
from tools.judge.wearer import WearerFigures, merged_figures, wearer_figures
from tools.terminal import Console

MACHINE: Final = {
    "python": "Python", "platform": "platform", "cpu_model": "CPU", "cpu_count": "CPUs",
}  # fmt: skip
INCOMPLETE: Final = "incomplete: the recorder did not close the file"


class _RunVerdict(NamedTuple):
    """The verdict on a run, for its page."""

    sentence: str
    good: bool | None
    """None if there is no verdict."""
    rows: list[tuple[str, str, str, str]]
    """(figure, measured, limit, `ok` or `over`, the latter possibly with the reason)."""
    caution: str = ""
    """Reason to distrust the figures."""
    wearer: str = ""
    """Effect on the wearer, in one line."""


class Judge:
    """Judges a run from its parts, in order, in the words of the command that ran it."""

    def __init__(self) -> None:
        self._summaries: list[Summary] = []
        self._wearer: list[WearerFigures] = []
        self._why_not = ""

    def add(self, run: RunData, counts: dict[str, KeyCount]) -> None:
        """Add a run, or the next part of it; `counts` cover all messages up to its end."""
        if run.course is None:
            self._why_not = self._why_not or run.without_course
            if run.robot is not None and (found := wearer_figures(run.log, run.robot)):
                self._wearer.append(found)
            return
        try:
            planned = _scenario_of(run).get("duration")
            last_s = float(run.course.t[-1])
            duration_s = float(planned) if isinstance(planned, int | float) else last_s
            self._summaries.append(verdict.summarise(run.log, duration_s, counts))
        except XrlError as error:
            self._why_not = str(error)

    def verdict(self, *, whole: bool = True) -> _RunVerdict:
        """Return the verdict; for a part of a run (`whole` is False), only its figures."""
        if not self._summaries:
            said = merged_figures(self._wearer).describe() if self._wearer else ""
            return _RunVerdict(f"No verdict: {self._why_not}", None, [], wearer=said)
        summary = verdict.merged(self._summaries)
        rows, said = verdict_table.rows(summary), ""
        if summary.wearer is not None:
            said = summary.wearer.describe()
        if not whole:
            what = "Figures of a part of a run, without a verdict"
            return _RunVerdict(what, None, rows, wearer=said)
        text = io.StringIO()
        console = Console(file=text, width=200, color_system=None, soft_wrap=True)
        verdict_table.show(summary, console)
        lines = [line.strip() for line in text.getvalue().strip().splitlines()]
        cautions = verdict_table.stalls(summary)
        cautions += [] if summary.in_real_time else [lines[-2]]
        caution = " ".join(f"{line.rstrip('.')}." for line in cautions)
        return _RunVerdict(lines[-1], summary.sound, rows, caution, said)


def _scenario_of(run: RunData) -> dict[str, Any]:
    """Return the scenario of a run; empty if the log has no readable one."""
    try:
        return tomllib.loads(decoded(run.log.attachments.get("scenario.toml", b"")))
    except (ValueError, RecursionError):
        return {}


def verdict_and_facts(
    run: RunData, found: _RunVerdict, name: str, counts: dict[str, KeyCount]
) -> str:
    """Return the top of the page."""
    word = {True: "good", False: "bad", None: "none"}[found.good]
    caution = f'<p class="caution">{escape(found.caution)}</p>' if found.caution else ""
    table = ""
    if found.rows:
        marks = [mark for *_, mark in found.rows if mark]
        over = sum(mark.startswith(verdict_table.OVER) for mark in marks)
        count = f"{over} of {len(marks)} over" if over else f"all {len(marks)} ok"
        cells = _table(("figure", "measured", "limit", ""), found.rows, numbers=(1, 2))
        table = _details(f"Figures against their limits: {count}", cells, is_open=True)
    facts = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape(value)}</dd></div>"
        for key, value in (*_facts(run, counts), *_wearer(found))
    )
    return (
        f"<header><h1>{escape(run.log.robot)}: {escape(name)}</h1>"
        f'<p class="verdict {word}" id="verdict">{escape(found.sentence)}</p>{caution}'
        f'<div class="head">{table}<dl>{facts}</dl></div></header>'
    )


def _wearer(found: _RunVerdict) -> list[tuple[str, str]]:
    name, _, figures = found.wearer.partition(": ")
    return [(name.lower(), figures)] if figures else []


def _facts(run: RunData, counts: dict[str, KeyCount]) -> list[tuple[str, str]]:
    """Return (name, value) of the facts that a reader needs first."""
    log, about = run.log, run.log.metadata["run"]
    begin, end = run.span
    scenario = (about.get("scenario", ""), str(_scenario_of(run).get("about", "")))
    recording = [] if log.complete else [INCOMPLETE]
    if log.damage or not log.complete:
        recording += describe_lost(log.cut, log.damage, finished=log.complete)
    missing = sum(one.missing for one in counts.values())
    changed = " with changes" if about.get("git_dirty") == "true" else ""
    rows = [
        ("scenario", ": ".join(filter(None, scenario))),
        ("started", _date(about.get("started", ""))),
        ("virtual time", about.get("lockstep", "")),
        ("length", f"{end - begin:.1f} s"),
        ("file", log.path.name),
        ("recording", "; ".join(recording) or "complete"),
        ("messages lost", f"{missing}; `xrl log info` shows the topics" if missing else "none"),
        ("git commit", about.get("git_commit", "") + changed),
        ("robot", log.robot),
        ("xrl", log.metadata.get("packages", {}).get("xrl", "")),
        *((name, about.get(key, "")) for key, name in MACHINE.items()),
    ]
    return [(name, value) for name, value in rows if value]


def _date(started: str) -> str:
    """Return a readable date, or the raw text if it is not in ISO format."""
    try:
        return f"{datetime.fromisoformat(started):%Y-%m-%d %H:%M:%S %Z}".strip()
    except ValueError:
        return started


def inputs(run: RunData) -> str:
    """Return the input files of the run, those written by people first, and its packages."""
    texts = {name: raw.decode(errors="replace") for name, raw in run.log.attachments.items()}
    written = sorted(name for name in texts if name.endswith(".toml"))
    computed = sorted(name for name in texts if name.endswith(".json"))
    parts = [_details(name, f"<pre>{escape(texts[name])}</pre>") for name in (*written, *computed)]
    found: dict[str, str] = run.log.metadata.get("packages", {})
    if found:
        rows = sorted(found.items(), key=lambda row: row[0].lower())
        parts.append(_details(f"{len(rows)} packages", _table(("package", "version"), rows)))
    return f'<section id="inputs"><h2>Inputs of the run</h2>{"".join(parts)}</section>'


def _details(title: str, body: str, *, is_open: bool = False) -> str:
    flag = " open" if is_open else ""
    return f"<details{flag}><summary>{escape(title)}</summary>{body}</details>"


def _table(
    names: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[int] = ()
) -> str:
    """Return a table; `numbers` are number columns, and `ok` and `over` have colours."""
    kinds = ["n" if column in numbers else "" for column in range(len(names))]
    head = "".join(
        f'<th scope="col" class="{kind}">{escape(name)}</th>'
        for name, kind in zip(names, kinds, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(
            f'<td class="{kind or _word(value)}">{escape(value)}</td>'
            for value, kind in zip(row, kinds, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="wide">{table}</div>'


def _word(value: str) -> str:
    word = value.partition(",")[0]
    return word if word in (verdict_table.OK, verdict_table.OVER) else ""
