"""What `xrl drive configure` is going to write, for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from tools.bringup import changes
from tools.bringup.changes import SettingChange


def shown(difference: Sequence[SettingChange]) -> Group:
    """Return the difference for the terminal: a table, and below it why each is wanted."""
    rows = Table(title="difference", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("module", "setting", "now"):
        rows.add_column(heading, no_wrap=heading != "now")
    rows.add_column("new")
    reasons: dict[str, None] = {}
    for change in difference:
        head, _, tail = change.name.rpartition(".")
        rows.add_row(
            change.module,
            f"{head}.\n{tail}" if head else tail,
            changes.describe(change.before),
            changes.describe(change.after),
        )
        if change.why:
            reasons.setdefault(f"{tail}: {change.why}")
        if change.inhibit:
            inhibit = f"{change.module} {change.name} cannot be written: {change.inhibit}"
            reasons.setdefault(inhibit)
    return Group(rows, *(Padding(Text(reason), (0, 1, 0, 2)) for reason in reasons))
