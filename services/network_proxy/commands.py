"""Carries out the requests of the control socket."""

from __future__ import annotations

import math
from typing import Final

from shared.clock import NS_PER_S, now_ns
from shared.exceptions import ConfigError
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.network.proxy_protocol import Begin, Clear, Reply, Request, RequestedImpairment
from shared.toml_file import check_ranges

ASKED_MAX: Final = 64
"""Impairments at once: each costs a little with every message, and a line in every answer."""
WAIT_MAX_S: Final = 86_400.0
"""Latest begin, from now."""


class CommandHandler:
    """Obeys, or says why not."""

    def __init__(self, impairments: ImpairmentSchedule) -> None:
        """Take where it is kept."""
        self._injections = impairments
        self.changed = False
        """An impairment has started or ended; the loop clears it."""

    def obey(self, request: Request) -> Reply:
        """Carry a request out and reply with the impairments."""
        at_ns = now_ns()
        try:
            if isinstance(request, Begin):
                if problem := self._problem(request):
                    return Reply(error=problem)
                self._begin(request, at_ns)
            elif isinstance(request, Clear):
                self._injections.clear(request.link, at_ns)
        except ConfigError as error:
            return Reply(error=f"{error.key}: {error.found}; {error.expected}")
        self.changed = True
        return Reply(requested=tuple(self._asked(at_ns)))

    def _problem(self, request: Begin) -> str:
        """Return why not; empty if it can be done.

        Raises:
            ConfigError: a number is out of its range.
        """
        check_ranges("inject", request.inject)
        if not 0.0 <= request.in_s <= WAIT_MAX_S:
            return f"in {request.in_s:g} s; from now to {WAIT_MAX_S:g} s on"
        if len(self._injections.requested) >= ASKED_MAX:
            return (
                f"{ASKED_MAX} impairments are active or planned already; clear some of them first"
            )
        return request.inject.fault()

    def _begin(self, request: Begin, at_ns: int) -> None:
        inject, begins_ns = request.inject, at_ns + request.in_s * NS_PER_S
        lasts_s = math.inf if inject.duration is None else inject.duration
        until_ns = begins_ns + lasts_s * NS_PER_S
        if request.in_s > 0.0:
            self._injections.plan(inject.link, inject, begins_ns, until_ns)
        else:
            self._injections.begin(inject.link, inject, until_ns, at_ns)

    def _asked(self, at_ns: int) -> list[RequestedImpairment]:
        rows = []
        for number, row in self._injections.requested.items():
            passed, lost = self._injections.counts(number)
            left_s = None if math.isinf(row.until) else (row.until - at_ns) / NS_PER_S
            in_s = max(0.0, (row.begins - at_ns) / NS_PER_S)
            hidden = self._injections.hidden(number)
            words = row.what.describe()
            rows.append(
                RequestedImpairment(number, row.link, words, left_s, passed, lost, in_s, hidden)
            )
        return rows
