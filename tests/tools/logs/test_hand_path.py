"""A person's path by hand, as a record has it."""

from __future__ import annotations

from typing import Any

import pytest

from shared.bus import topics
from shared.bus.messages import HandLead
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from tests.shared.mcap_log.runs import sample
from tools.logs.hand_path import hand_path

BEGIN_NS = 50 * NS_PER_S


class Log:
    """A record of a simulator that left out half a second after the first one."""

    def __init__(self, *led: HandLead) -> None:
        late = ((s, s + 0.5 * (s >= 1.0)) for s in (n / 100 for n in range(-100, 300)))
        self._rows: dict[Any, list[Any]] = {
            topics.OPERATOR_HAND: list(led),
            topics.SIM_TRUTH: [
                sample(
                    SimTruth,
                    scenario_s=scenario_s if scenario_s >= 0.0 else -1.0,
                    t_ns=BEGIN_NS + round(wall_s * NS_PER_S),
                )
                for scenario_s, wall_s in late
            ],
        }

    def messages(self, topic: Any) -> list[Any]:
        return self._rows[topic]


def hand(at_s: float, height: float, *, leads: bool = True) -> HandLead:
    t_ns = BEGIN_NS + round(at_s * NS_PER_S)
    return HandLead(
        t_ns=t_ns, seq=1, leads=leads, height=height, pitch=0.0, push=(1.0, 0.0, 0.0), source="t"
    )


def path_of(*led: HandLead) -> list[tuple[float, float]]:
    log: Any = Log(*led)
    return [(row.at, row.hand.height) for row in hand_path(log)]


def test_a_row_has_the_scenario_time_at_which_the_simulator_was() -> None:
    found = path_of(hand(0.5, 1.0), hand(2.0, 1.1))
    assert [height for _, height in found] == [1.0, 1.1]
    assert [at for at, _ in found] == pytest.approx([0.5, 1.5], abs=1e-5)


def test_where_it_was_led_before_the_scenario_it_stays_when_that_begins() -> None:
    log: Any = Log(hand(-0.8, 1.2), hand(-0.5, 1.0), hand(-0.2, 0.0, leads=False), hand(0.3, 0.9))
    rows = hand_path(log)
    assert [(round(row.at, 3), row.hand.height) for row in rows] == [(0.0, 1.0), (0.3, 0.9)]
    assert rows[0].hand.push == (0.0, 0.0, 0.0)


def test_where_nobody_led_there_is_no_path() -> None:
    assert path_of() == []
