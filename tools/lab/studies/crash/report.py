"""The crash matrix for people and for machines: a table, JSON and JUnit XML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from rich.table import Table
from rich.text import Text

from shared.atomic_file import replace_file
from tools.lab.studies.crash.cases import BACK_S, CRASH_S, CrashCase, CrashVerdict, scenario_of
from tools.lab.studies.crash.outcome import CrashResult, as_expected
from tools.terminal import Console, marked

RESULTS: Final = "results.json"
JUNIT: Final = "junit.xml"
SUITE: Final = "xrl study crash"
COLOUR: Final = {
    CrashVerdict.STOOD: "green",
    CrashVerdict.SANK: "yellow",
    CrashVerdict.FELL: "red",
    CrashVerdict.UNJUDGED: "magenta",
}


COLUMNS: Final = ("case", "verdict", "may", "fell", "safe", "step", "back", "leads", "x", "y")
LEGEND: Final = (
    "may: what is allowed, if not to stand only; fell: s from the crash; safe: ms from it to "
    "HOLD, slowest of the modules not hit; step: N m, largest of their torques then; back: N m, "
    "largest of any module after the request; leads: s from the restart to the last TRACK; "
    "x, y: mm, COM farthest from the middle after the crash"
)


class Result(NamedTuple):
    """A case and what came of it."""

    case: CrashCase
    outcome: CrashResult

    @property
    def good(self) -> bool:
        """True if it came out no worse than it has to."""
        return as_expected(self.case, self.outcome)


def describe(case: CrashCase) -> str:
    """Return the actions of a case."""
    scenario = scenario_of(case)
    words = [
        f"{row.service} {row.signal} at {row.at:g} s" for row in scenario.kill if row.at <= CRASH_S
    ]
    words += [f"{row.service} back at {row.at:g} s" for row in scenario.restart if row.at < CRASH_S]
    if case.triggered_kill is not None:
        when = f"{case.triggered_kill.after_s:g} s after" if case.triggered_kill.after_s else "as"
        many = "all modules track" if case.triggered_kill.modules > 1 else "the first module tracks"
        words.append(f"{case.triggered_kill.service} KILL {when} {many} again")
    words += [f"{row.module} {row.kind} at {row.at:g} s" for row in scenario.fault]
    return f"{', '.join(words)}; asked back at {BACK_S:g} s"


def list_cases(cases: Sequence[CrashCase], console: Console) -> None:
    """Print cases."""
    table = Table(title=f"{len(cases)} cases", title_justify="left")
    table.add_column("name", no_wrap=True)
    table.add_column("at worst")
    table.add_column("why", overflow="fold")
    for case in cases:
        name = marked("{} [dim](quick)[/]", case.name) if case.quick else case.name
        table.add_row(name, Text(case.expected, COLOUR[case.expected]), case.why)
    console.print(table)


def line_of(result: Result) -> Text:
    """Return a result in one line."""
    case, outcome = result
    verdict = Text(f"{outcome.verdict.upper():8}", COLOUR[outcome.verdict])
    words = [marked("{} {}", verdict, case.name)]
    for value, text in (
        (outcome.fell_after_s, "{:.2f} s after the crash"),
        (outcome.safe_ms, "safe after {:.0f} ms"),
        (outcome.leads_again_s, "leads again {:.2f} s after the request"),
    ):
        if value is not None:
            words.append(Text(text.format(value)))
    if outcome.tries > 1:
        words.append(Text(f"at try {outcome.tries}"))
    if not result.good:
        words.append(marked("[bold red]expected at worst: {}[/]", case.expected))
    words += [Text(text, "yellow") for text in _remarks(outcome)]
    return Text(", ").join(words)


def show(results: Sequence[Result], console: Console) -> None:
    """Print the verdict table and the sentence under it."""
    table = Table(title="Verdict", title_justify="left", box=None, padding=(0, 1, 0, 0))
    for name in COLUMNS:
        table.add_column(name, justify="left" if name in COLUMNS[:3] else "right", no_wrap=True)
    for case, outcome in results:
        table.add_row(
            case.name,
            Text(outcome.verdict, COLOUR[outcome.verdict]),
            "" if case.expected is CrashVerdict.STOOD else str(case.expected),
            _figure(outcome.fell_after_s, ".2f"),
            _figure(outcome.safe_ms, ".0f"),
            _figure(outcome.torque_step_nm, ".2f"),
            _figure(outcome.torque_step_back_nm, ".2f"),
            _figure(outcome.leads_again_s, ".2f"),
            *(_farthest(span) for span in (outcome.com_x_mm, outcome.com_y_mm)),
        )
    console.print(table)
    console.print(LEGEND, style="dim", highlight=False)
    for case, outcome in results:
        for text in _remarks(outcome):
            console.print(marked("[yellow]{}[/]: {}", case.name, text), highlight=False)
    bad = [result for result in results if not result.good]
    for case, outcome in bad:
        verdict = outcome.verdict.upper()
        console.print(marked("[bold red]{}[/] {}: {}", verdict, case.name, case.why))
    counts = ", ".join(f"{many} {name}" for name, many in count_by_verdict(results).items() if many)
    good = len(results) - len(bad)
    text = f"[bold {'red' if bad else 'green'}]{{}} of {{}} as expected or better[/]: {{}}"
    console.print(marked(text, good, len(results), counts), highlight=False)


def count_by_verdict(results: Sequence[Result]) -> dict[str, int]:
    """Return how often each verdict was given."""
    verdicts = [outcome.verdict for _, outcome in results]
    return {str(name): verdicts.count(name) for name in CrashVerdict}


def write(results: Sequence[Result], out: Path, about: Mapping[str, str], *, planned: int) -> None:
    """Rewrite JSON and JUnit of the results so far; `about`: code, machine and robot."""
    replace_file(out / RESULTS, as_json(results, about, planned=planned))
    replace_file(out / JUNIT, as_junit(results, about))


def as_json(results: Sequence[Result], about: Mapping[str, str], *, planned: int) -> bytes:
    """Return the results as JSON, with null for None and unrounded numbers."""
    rows = [
        {
            "name": case.name,
            "kind": case.kind,
            "what": describe(case),
            "why": case.why,
            "expected": case.expected,
            "as_expected": as_expected(case, outcome),
            **msgspec.to_builtins(outcome),
        }
        for case, outcome in results
    ]
    document = {
        "about": dict(about),
        "planned": planned,
        "complete": len(results) == planned,
        "counts": count_by_verdict(results),
        "cases": rows,
    }
    return msgspec.json.format(msgspec.json.encode(document), indent=2) + b"\n"


def as_junit(results: Sequence[Result], about: Mapping[str, str]) -> bytes:
    """Return the results as JUnit XML: worse than expected is a failure, unjudged an error."""
    bad = [result for result in results if not result.good]
    errors = sum(outcome.verdict is CrashVerdict.UNJUDGED for _, outcome in bad)
    suites = ET.Element("testsuites")
    suite = ET.SubElement(
        suites,
        "testsuite",
        name=SUITE,
        tests=str(len(results)),
        failures=str(len(bad) - errors),
        errors=str(errors),
        skipped="0",
        time=f"{sum(outcome.wall_s for _, outcome in results):.1f}",
    )
    properties = ET.SubElement(suite, "properties")
    for name, value in about.items():
        ET.SubElement(properties, "property", name=name, value=value)
    for result in results:
        case, outcome = result
        row = ET.SubElement(suite, "testcase", classname=f"crash.{case.kind}", name=case.name)
        row.set("time", f"{outcome.wall_s:.1f}")
        if not result.good:
            tag = "error" if outcome.verdict is CrashVerdict.UNJUDGED else "failure"
            words = f"{outcome.verdict}; expected at worst: {case.expected}"
            fault = ET.SubElement(row, tag, message=words, type=str(outcome.verdict))
            fault.text = case.why
        figures = ET.SubElement(row, "system-out")
        figures.text = f"{describe(case)}\n" + "\n".join(
            f"{name}: {value}" for name, value in msgspec.to_builtins(outcome).items()
        )
    ET.indent(suites)
    text: bytes = ET.tostring(suites, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _remarks(outcome: CrashResult) -> tuple[str, ...]:
    late = () if outcome.in_real_time else ("not in real time: the machine was too slow",)
    return (*outcome.remarks, *late)


def _figure(value: float | None, form: str) -> str:
    return "" if value is None else f"{value:{form}}"


def _farthest(span: tuple[float, float] | None) -> str:
    return "" if span is None else f"{max(span, key=abs):+.0f}"
