"""How somebody led the simulated hand in a run, to lead it so again."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.messages import HandLead
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from tools.logs.run_log import NewestAt, RunLog

EARLY_NS: Final = 1000
"""Scenario time in lockstep is a sum of steps: a rounding error less than a message's, at times."""


class HandRow(msgspec.Struct, frozen=True):
    """One message of the person's, at its scenario time."""

    at: float
    hand: HandLead


def hand_path(log: RunLog) -> tuple[HandRow, ...]:
    """Return how the hand was led while the scenario ran, in order; empty if nobody led it.

    Where it was led last before the scenario began is its first row: there it stayed.
    """
    led: list[HandLead] = log.messages(topics.OPERATOR_HAND)
    truths: list[SimTruth] = log.messages(topics.SIM_TRUTH) if led else []
    truths = [truth for truth in truths if truth.scenario_s >= 0.0]
    if not truths:
        return ()
    newest = NewestAt(truths)
    begin_ns = truths[0].t_ns - round(truths[0].scenario_s * NS_PER_S)
    before = [hand for hand in led if hand.t_ns < begin_ns and hand.leads]
    rows = []
    if before:
        rows.append(HandRow(0.0, msgspec.structs.replace(before[-1], push=(0.0, 0.0, 0.0))))
    for hand in led:
        if hand.t_ns >= begin_ns:
            # by the newest truth: a simulator that is late leaves time out
            truth = newest.at(hand.t_ns) or truths[0]
            after_ns = hand.t_ns - truth.t_ns - EARLY_NS
            rows.append(HandRow(max(0.0, truth.scenario_s + after_ns / NS_PER_S), hand))
    return tuple(rows)
