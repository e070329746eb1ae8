"""What a person sees while a run goes on: one line, renewed."""

from __future__ import annotations

import time

from rich.console import Console
from rich.live import Live
from rich.text import Text

from tools.runs.conductor import Snapshot

PERIOD_S = 0.1
PLAIN_PERIOD_S = 1.0


class LiveView:
    """A line that is renewed in a terminal, or printed once a second into a file."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._period_s = PERIOD_S if console.is_terminal else PLAIN_PERIOD_S
        self._next_s = 0.0
        self._live: Live | None = None

    def __enter__(self) -> LiveView:
        """Start the display."""
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """End the display; the line goes away."""
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def show(self, snapshot: Snapshot) -> None:
        """Show the run as it is now, unless that was done a moment ago."""
        now = time.monotonic()
        if now < self._next_s or snapshot.truth is None:
            return
        self._next_s = now + self._period_s
        line = _line(snapshot)
        if self._live is not None:
            self._live.update(Text(line), refresh=True)
        else:
            self._console.print(line, highlight=False, soft_wrap=True)


def _line(snapshot: Snapshot) -> str:
    truth = snapshot.truth
    assert truth is not None  # noqa: S101 - `show` has looked
    clock = f"{truth.scenario_s:6.2f} s" if truth.scenario_s >= 0.0 else "   --  s"
    x, y = truth.com[0] * 1e3, truth.com[1] * 1e3
    return (
        f"{clock}  height {truth.torso[2]:.3f} m  COM {x:+5.1f} {y:+5.1f} mm  "
        f"hand {truth.operator_force[2]:+6.1f} N  modes {''.join(snapshot.modes)}  {snapshot.note}"
    )
