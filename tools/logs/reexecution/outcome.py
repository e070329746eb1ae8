"""What came of executing a service again."""

from __future__ import annotations

from tools.logs.reexecution.compare import Comparison


class ReexecutionResult:
    """Counts of one service, filled in as it is executed.

    Attributes:
        service: its name.
        exact: the memory is compared as well; not where a parameter was changed.
        ticks: cycles or ticks that were executed.
        skipped: that were not: before the first memory in the log, or after a loss.
        starts: how often execution began from a recorded memory.
        lost_inputs: messages that the service took and the log lacks.
        comparison: of what came out.
    """

    def __init__(self, service: str, tolerance: float, *, exact: bool) -> None:
        self.service = service
        self.exact = exact
        self._tolerance = tolerance
        self.forget()

    def forget(self) -> None:
        """Count from here on."""
        self.ticks = 0
        self.skipped = 0
        self.starts = 0
        self.lost_inputs = 0
        self.comparison = Comparison(self._tolerance)

    def add(self, later: ReexecutionResult) -> None:
        """Add what came of the same service in a later part of the run."""
        self.ticks += later.ticks
        self.skipped += later.skipped
        self.starts += later.starts
        self.lost_inputs += later.lost_inputs
        self.comparison.add(later.comparison)

    @property
    def equal(self) -> bool:
        """True if something was executed, and nothing came out otherwise."""
        return self.ticks > 0 and self.comparison.first is None
