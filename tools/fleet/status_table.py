"""A fleet's status as text and tables, for `xrl status` and `xrl hosts status`."""

from __future__ import annotations

from typing import Final

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from shared.bus.messages import DriveStatus, Refusal
from tools.fleet.fleet_status import OPEN, SILENT_PROXY, FleetStatus, LeadStatus
from tools.guarded_streams import printable
from tools.terminal import marked

_LABELS: Final = ("state", "last exit")
GOOD_STATES: Final = ("running", "starting")


def describe_lead(lead: LeadStatus | None) -> str:
    """Return one line on the planner."""
    if lead is None:
        return "planner silent: each module holds by itself"
    words = f"planner {lead.mode}, margin {lead.margin:.2f}"
    if lead.wait_s > 0.0:
        words += f"; leads again in {lead.wait_s:.0f} s at the earliest, after drop-outs or trips"
    if lead.why:
        words += f"; {printable(lead.why)}"
    return words


REMEDIES: Final = {
    Refusal.TOO_OLD.name: "a slow link, a slow planner, or a record played onto the live keys",
    Refusal.FOREIGN_SESSION.name: "a second planner, or one that the module has left: end one",
    Refusal.NOT_NEWER.name: "a network that repeats, or a command forged in the planner's name",
    Refusal.OUT_OF_ENVELOPE.name: "a wrong planner, or a forged command: xrl kill planner",
    Refusal.OUT_OF_LIMITS.name: "a wrong planner, or a forged command: xrl kill planner",
    Refusal.TOO_FAR_AHEAD.name: "a number that no planner counts to: find out who sends it",
    Refusal.FROM_THE_FUTURE.name: "clocks of several hosts mixed up, or a forged command",
    Refusal.MALFORMED.name: "no planner sends null, NaN or broken JSON: find out who does",
}
"""By the cause of a refusal: what it is likely to be, or what to do."""


def describe_refusals(status: FleetStatus) -> list[str]:
    """Return a line for each cause and sender of refused commands."""
    found: dict[tuple[str, int], list[str]] = {}
    for name, module in status.modules.items():
        for row in module.refusals:
            words = f"{name} {row.hz:.0f}/s"
            found.setdefault((row.cause, row.session), []).append(words)
    return [
        f"refused, {cause}{f' of session {session}' if session else ''}: {', '.join(words)}; "
        f"{REMEDIES[cause]}"
        for (cause, session), words in found.items()
    ]


def describe_ways_out(status: FleetStatus) -> list[str]:
    """Return a line for each way out of a state that a person must end, with its modules."""
    found: dict[str, list[str]] = {}
    for name, module in status.modules.items():
        if module.way_out:
            found.setdefault(module.way_out, []).append(name)
    return [
        f"{', '.join(names)}: {words.replace('MODULE', names[0]) if len(names) == 1 else words}"
        for words, names in found.items()
    ]


def describe_stop(status: FleetStatus) -> list[str]:
    """Return a line for each source of an emergency stop that holds."""
    found: dict[str, list[str]] = {}
    for name, module in status.modules.items():
        if module.stopped_by:
            found.setdefault(module.stopped_by, []).append(name)
    return [
        f"emergency stop by {printable(source)}: {', '.join(names)}"
        for source, names in found.items()
    ]


def describe_sessions(status: FleetStatus) -> str:
    """Return what to say if the modules do not all follow the planner that is heard; else ""."""
    lead = status.lead.session if status.lead is not None else 0
    others: dict[int, list[str]] = {}
    for name, module in status.modules.items():
        if module.session and lead and module.session != lead and module.mode is not None:
            others.setdefault(module.session, []).append(name)
    return "; ".join(
        f"{', '.join(names)}: last followed session {session}, and the planner heard is {lead}"
        for session, names in others.items()
    )


def describe_real_time(status: FleetStatus) -> str:
    """Return which services were refused a real-time priority; "" if none."""
    without = [name for name, row in status.services.items() if row.real_time is False]
    words = "without real-time priority, commands may come late (`xrl doctor` has the remedy)"
    return f"{words}: {', '.join(without)}" if without else ""


def describe_tools(status: FleetStatus) -> str:
    """Return the tools that are linked, for example "view on lab3, lead on pad"."""
    words = []
    for name in status.tools:
        tool, _, place = name.partition(".")
        host = place.rpartition(".")[0]
        words.append(printable(f"{tool} on {host}" if host else tool))
    return ", ".join(words)


def tables(status: FleetStatus) -> Group:
    """Return the status as two tables for the terminal, and what there is to say beside."""
    services = Table(
        title=f"services in {status.run_dir}", title_justify="left", box=box.SIMPLE_HEAD
    )
    services.add_column(
        "service", no_wrap=True, min_width=max(map(len, status.services), default=0)
    )
    for heading in (
        "state",
        "pid",
        "up s",
        "age ms",
        "rate Hz",
        "restarts",
        "last exit",
    ):
        words = heading in _LABELS
        services.add_column(
            heading, justify="left" if words else "right", no_wrap=heading != "last exit"
        )
    for name, row in status.services.items():
        services.add_row(
            name,
            row.state if row.state in GOOD_STATES else Text(row.state, "bold red"),
            "-" if row.pid is None else str(row.pid),
            f"{row.uptime_s:.0f}",
            "-" if row.age_s is None else f"{1e3 * row.age_s:.0f}",
            "-" if row.rate_hz is None else f"{row.rate_hz:.0f}",
            str(row.restarts),
            row.last_exit,
        )
    modules = Table(title="modules", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("module", "mode", "tier", "because", "drive", "phi", "theta"):
        modules.add_column(heading, no_wrap=True)
    for name, module in status.modules.items():
        mode = module.mode or "silent"
        if module.stiffened:
            mode = f"{mode}, stiffened"
        drive = module.drive or "-"
        angles = ("-", "-") if module.q is None else (f"{a:+.3f}" for a in module.q)
        modules.add_row(
            name,
            mode,
            str(module.tier or "-"),
            module.cause or "",
            drive if drive == DriveStatus.ARMED.name else Text(drive, "bold red"),
            *angles,
        )
    way_out = "kill network_proxy" if SILENT_PROXY in status.network else "inject --clear"
    line = marked(
        "[bold yellow]impaired on purpose: {}[/] (xrl {})", "; ".join(status.network), way_out
    )
    slow = f" in slow motion: the fleet's clock goes at {status.pace:g} of real time"
    lines: list[str | Text] = [f" {describe_lead(status.lead)}"]
    lines += [marked(" [bold yellow]way out[/], {}", text) for text in describe_ways_out(status)]
    lines += [marked(" [bold red]{}[/]", OPEN)] if status.security == "open" else []
    lines += [marked(" [bold red]{}[/]", text) for text in status.bus_faults]
    lines += [marked(" [bold yellow]{}[/]", text) for text in describe_stop(status)]
    lines += [slow] if status.pace != 1.0 else []
    lines += [line] if status.network else []
    lines += [marked(" [bold yellow]{}[/]", text) for text in describe_refusals(status)]
    lines += [f" linked: {describe_tools(status)}"] if status.tools else []
    refused = describe_real_time(status)
    lines += [Text(f" {refused}", "dim")] if refused else []
    sessions = describe_sessions(status)
    lines += [marked(" [bold yellow]{}[/]", sessions)] if sessions else []
    lines += [marked(" [bold red]{}[/]", words) for words in status.trouble]
    return Group(services, modules, *lines)
