"""Recorded motion of the simulated hand in a run, for repeating it."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.messages import HandLead
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from tools.logs.run_log import NewestAt, RunLog

EARLY_NS: Final = 1000
"""Margin, ns: scenario time in lockstep is a sum of steps and may be early by rounding errors."""


class HandRow(msgspec.Struct, frozen=True):
    """One message of the hand, at its scenario time."""

    at: float
    hand: HandLead


def hand_path(log: RunLog) -> tuple[HandRow, ...]:
    """Return the motion of the hand during the scenario, in order.

    If the hand led before the scenario, the first row is its last position then. The result is
    empty if nobody moved the hand, or the scenario never started.
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
            # relative to the newest truth, because a late simulator skips time
            truth = newest.at(hand.t_ns) or truths[0]
            after_ns = hand.t_ns - truth.t_ns - EARLY_NS
            rows.append(HandRow(max(0.0, truth.scenario_s + after_ns / NS_PER_S), hand))
    return tuple(rows)
