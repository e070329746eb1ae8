"""How somebody led the simulated hand in a run, to lead it so again."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.messages import HandLead, SimTruth
from shared.clock import NS_PER_S
from tools.runs.run_log import RunLog

EARLY_NS: Final = 1000
"""Scenario time in lockstep is a sum of steps: a rounding error less than a message's, at times."""


class HandRow(msgspec.Struct, frozen=True):
    """One message of the person's, at its scenario time."""

    at: float
    hand: HandLead


def hand_path(log: RunLog) -> tuple[HandRow, ...]:
    """Return how the hand was led while the scenario ran, in order; empty if nobody led it.

    Raises:
        RunError: a message of the record cannot be read.
    """
    led: list[HandLead] = log.messages(topics.OPERATOR_HAND)
    truths: list[SimTruth] = log.messages(topics.SIM_TRUTH) if led else []
    begin = next((truth for truth in truths if truth.scenario_s >= 0.0), None)
    if begin is None:
        return ()
    zero_ns = begin.t_ns - round(begin.scenario_s * NS_PER_S)
    rows = (HandRow((hand.t_ns - zero_ns - EARLY_NS) / NS_PER_S, hand) for hand in led)
    return tuple(sorted((row for row in rows if row.at >= 0.0), key=lambda row: row.at))
