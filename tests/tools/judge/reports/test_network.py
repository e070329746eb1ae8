"""The network panel shows the active impairments, by the rule of the links themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_S
from shared.config.impairment import Direction, Impairment
from shared.links import DIRECTIONS, WRENCHES
from shared.network.impairment_schedule import ImpairmentSchedule
from tools.judge.reports.panels import ImpairedLink, histories


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 6), st.integers(1, 9)), max_size=8))
def test_the_state_is_cut_exactly_when_no_message_passes(
    requested: list[tuple[bool, int, int]],
) -> None:
    directions = {name: Direction(name, 0) for name in DIRECTIONS}
    events: list[LinkEvent] = []
    impairments = ImpairmentSchedule(directions, events.append)
    for cut, begin_s, duration_s in requested:
        what = Impairment(delay_ms=0.0 if cut else 5.0, partition=cut)
        impairments.plan(WRENCHES, what, float(begin_s), float(begin_s + duration_s))
    for s in range(20):
        impairments.advance(float(s), s * NS_PER_S)
        rows = histories(events, 0).get(WRENCHES, ())
        shown = rows[-1][1] if rows else ImpairedLink.CLEAR
        now_ns = s * NS_PER_S
        passed = directions[WRENCHES].passes(now_ns, 0)
        assert (shown is ImpairedLink.CUT) is (passed == ())
        assert (shown is ImpairedLink.CLEAR) is (passed == (now_ns,))
