"""A fleet's status and other fleets on this machine, as text and tables."""

from __future__ import annotations

import shlex
from collections.abc import Hashable, Iterable, Iterator
from pathlib import Path
from typing import Final, Literal, TypeVar

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from shared.bus.messages import LEFT_MAX_S, DriveStatus, Refusal
from tools.fleet import procfs
from tools.fleet.fleet_status import OPEN, SILENT_PROXY, FleetStatus, LeadStatus
from tools.guarded_streams import printable
from tools.terminal import Console, marked

K = TypeVar("K", bound=Hashable)

_LABELS: Final = ("state", "last exit")
_GOOD_STATES: Final = ("running", "starting")


def _describe_lead(lead: LeadStatus | None) -> str:
    """Return one line about the planner."""
    if lead is None:
        return "planner silent: each module holds on its own"
    words = f"planner {lead.mode}, margin {lead.margin:.2f}, carries {lead.carried_n:.0f} N"
    if lead.wearer:
        words += f"; {lead.wearer}"
    if lead.wait_s > 0.0:
        words += f"; leads again in {lead.wait_s:.0f} s at the earliest, after dropouts or trips"
    if lead.why:
        words += f"; {printable(lead.why)}"
    return words


REMEDIES: Final = {
    Refusal.TOO_OLD.name: "a slow link or a slow planner",
    Refusal.FOREIGN_SESSION.name: "a second planner, or one that the module has left: end one",
    Refusal.NOT_NEWER.name: "repeated packets, or a command forged in the planner's name",
    Refusal.OUT_OF_ENVELOPE.name: "a faulty planner, or a forged command: run xrl kill planner",
    Refusal.OUT_OF_LIMITS.name: "a faulty planner, or a forged command: run xrl kill planner",
    Refusal.TOO_FAR_AHEAD.name: "a sequence number that no planner reaches: find the sender",
    Refusal.FROM_THE_FUTURE.name: "mixed clocks of several hosts, or a forged command",
    Refusal.MALFORMED.name: "no planner sends null, NaN or broken JSON: find the sender",
}
"""Likely cause or remedy, by the cause of a refusal."""


def _describe_refusals(status: FleetStatus) -> list[str]:
    """Return a line for each cause and sender of refused commands."""
    found = _gathered(
        ((row.cause, row.session), f"{name} {row.hz:.0f}/s")
        for name, module in status.modules.items()
        for row in module.refusals
    )
    return [
        f"refused, {cause}{f' of session {session}' if session else ''}: {', '.join(words)}; "
        f"{REMEDIES[cause]}"
        for (cause, session), words in found.items()
    ]


def _describe_ways_out(status: FleetStatus) -> list[str]:
    """Return a line with the modules for each remedy that a person must apply."""
    found = _gathered((module.way_out, name) for name, module in status.modules.items())
    return [
        f"{', '.join(names)}: {words.replace('MODULE', names[0]) if len(names) == 1 else words}"
        for words, names in found.items()
        if words
    ]


def _describe_stop(status: FleetStatus) -> list[str]:
    """Return a line for each source of an active emergency stop."""
    found = _gathered((module.stopped_by, name) for name, module in status.modules.items())
    return [
        f"emergency stop by {printable(source)}: {', '.join(names)}"
        for source, names in found.items()
        if source
    ]


def _describe_sessions(status: FleetStatus) -> str:
    """Return a warning if some modules do not follow the planner that is leading, else ""."""
    lead = status.lead.session if status.lead is not None else 0
    others = _gathered(
        (module.session, name)
        for name, module in status.modules.items()
        if module.session and lead and module.session != lead and module.mode is not None
    )
    return "; ".join(
        f"{', '.join(names)}: last followed session {session}, but the planner's session is {lead}"
        for session, names in others.items()
    )


def _gathered(pairs: Iterable[tuple[K, str]]) -> dict[K, list[str]]:
    found: dict[K, list[str]] = {}
    for key, word in pairs:
        found.setdefault(key, []).append(word)
    return found


def _describe_real_time(status: FleetStatus) -> str:
    """Return the services without the real-time priority that they need; "" if there are none."""
    without = [name for name, row in status.services.items() if row.real_time is False]
    words = "without real-time priority, commands may be late (`xrl doctor` shows the remedy)"
    return f"{words}: {', '.join(without)}" if without else ""


def _describe_tools(status: FleetStatus) -> str:
    """Return the linked tools, for example "view on lab3, lead on pad"."""
    words = []
    for name in status.tools:
        tool, _, place = name.partition(".")
        host = place.rpartition(".")[0]
        words.append(printable(f"{tool} on {host}" if host else tool))
    return ", ".join(words)


def tables(status: FleetStatus) -> Group:
    """Return the status as two tables for the terminal, with lines of text below them."""
    services = Table(
        title=f"services in {status.run_dir}", title_justify="left", box=box.SIMPLE_HEAD
    )
    longest = max(map(len, status.services), default=0)
    services.add_column("service", no_wrap=True, min_width=longest)
    for heading in ("state", "pid", "up s", "age ms", "rate Hz", "restarts", "last exit"):
        justify: Literal["left", "right"] = "left" if heading in _LABELS else "right"
        services.add_column(heading, justify=justify, no_wrap=heading != "last exit")
    for name, row in status.services.items():
        services.add_row(
            name,
            _state_cell(row.state),
            "-" if row.pid is None else str(row.pid),
            f"{row.uptime_s:.0f}",
            "-" if row.age_s is None else f"{1e3 * row.age_s:.0f}",
            "-" if row.rate_hz is None else f"{row.rate_hz:.0f}",
            str(row.restarts),
            row.last_exit,
        )
    modules = Table(title="modules", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("module", "mode", "tier", "because", "drive", "phi", "theta", "heat"):
        modules.add_column(heading, no_wrap=True)
    for name, module in status.modules.items():
        drive = module.drive or "-"
        modules.add_row(
            name,
            f"{module.mode or 'silent'}{', stiffened' if module.stiffened else ''}",
            str(module.tier or "-"),
            module.cause or "",
            drive if drive == DriveStatus.ARMED.name else Text(drive, "bold red"),
            *(("-", "-") if module.q is None else (f"{a:+.3f}" for a in module.q)),
            _heat_cell(module.celsius, module.heat_left_s),
        )
    return Group(services, modules, *_lines(status))


def _lines(status: FleetStatus) -> Iterator[str | Text]:
    red, yellow = " [bold red]{}[/]", " [bold yellow]{}[/]"
    way_out = "kill network_proxy" if SILENT_PROXY in status.network else "inject --clear all"
    impaired = f" [bold yellow]impaired on purpose: {{}}[/] (xrl {way_out})"
    slow = f"in slow motion: the fleet's clock runs at {status.pace:g} of real time"
    sections: tuple[tuple[str, Iterable[str]], ...] = (
        (" {}", [_describe_lead(status.lead)]),
        (" [bold yellow]way out[/], {}", _describe_ways_out(status)),
        (red, [OPEN] if status.security == "open" else []),
        (red, status.bus_faults),
        (yellow, _describe_stop(status)),
        (" {}", [slow] if status.pace != 1.0 else []),
        (impaired, ["; ".join(status.network)]),
        (yellow, _describe_refusals(status)),
        (" linked: {}", [_describe_tools(status)]),
        (" [dim]{}[/]", [_describe_real_time(status)]),
        (yellow, [_describe_sessions(status)]),
        (red, status.trouble),
    )
    for template, texts in sections:
        yield from (marked(template, text) for text in texts if text)


HOT_S: Final = 60.0
"""Seconds left at this load below which a module's heat is shown in red."""


def _heat_cell(celsius: tuple[float, float] | None, left_s: float | None) -> str | Text:
    """Return the warmer winding's temperature, and the seconds left at this load if below 1 h."""
    if celsius is None or left_s is None:
        return "-"
    words = f"{max(celsius):.0f} C"
    if left_s < LEFT_MAX_S:
        words += f", {left_s:.0f} s left"
    return Text(words, "bold red") if left_s < HOT_S else words


def _state_cell(state: str) -> str | Text:
    return state if state in _GOOD_STATES else Text(state, "bold red")


def warn_of_others(console: Console, own: Path | None = None) -> None:
    """Print a line for each other fleet of this user on this machine."""
    for other in sorted(procfs.fleets()):
        if own is None or Path(other) != own:
            console.print(
                marked(
                    "[yellow]another fleet runs in {}: two cores are too few for both, and either "
                    "may lose drives; `xrl down --run-dir {}` stops it[/]",
                    other,
                    shlex.quote(other),
                ),
                soft_wrap=True,
            )
