"""The harness's wrench is believed as long as the load beneath it stays what it was."""

from __future__ import annotations

import pytest

from services.planner.law.load import LoadState
from services.planner.watch.harness_trust import AFTER_S, CHANGE_MAX, EASE_S, HarnessTrust
from shared.bus.messages import Tare
from tests.planner.states import DT

LASTS = round(AFTER_S / DT) + 2


def led(load: LoadState) -> HarnessTrust:
    """Return the watch of a planner that has led with a load."""
    trust = HarnessTrust()
    trust.advance(load, Tare.DONE, DT, leads=False)
    assert trust.advance(load, Tare.DONE, DT, leads=True) == 1.0
    return trust


def go_on(
    trust: HarnessTrust,
    load: LoadState,
    ticks: int = LASTS,
    tare: Tare = Tare.DONE,
    *,
    leads: bool = True,
) -> float:
    for _ in range(ticks):
        scale = trust.advance(load, tare, DT, leads=leads)
    return scale


@pytest.mark.parametrize("leads", [True, False])
@pytest.mark.parametrize(
    ("kg", "a", "b"),
    [
        (CHANGE_MAX[0], 0.0, 0.0),
        (-CHANGE_MAX[0], 0.0, 0.0),
        (0.0, CHANGE_MAX[1], 0.0),
        (0.0, 0.0, -CHANGE_MAX[1]),
    ],
)
def test_a_load_that_changes_once_it_was_led_is_the_sensors_fault_and_not_learnt(
    kg: float, a: float, b: float, leads: bool
) -> None:
    before = (1.0, -2.0, 0.5)
    trust = led(LoadState(*before))
    just, wrong = (
        LoadState(*(x + part * change for x, change in zip(before, (kg, a, b), strict=True)))
        for part in (0.99, 1.01)
    )
    go_on(trust, just, leads=leads)
    assert not trust.doubted
    wrong.refused, wrong.weighing_s = True, 1.0
    go_on(trust, wrong, leads=leads)
    assert trust.doubted
    assert wrong == LoadState(*before)
    assert "xrl drive tare" in trust.describe()


def test_a_change_that_does_not_last_is_a_robot_that_swings() -> None:
    trust = led(LoadState(0.0))
    for _ in range(10):
        go_on(trust, LoadState(9.0), LASTS - 4)
        go_on(trust, LoadState(0.0), 1)
    assert not trust.doubted


def test_a_load_that_changes_before_it_is_led_is_a_load() -> None:
    trust = HarnessTrust()
    for kg in (0.0, 7.0):
        go_on(trust, LoadState(kg), leads=False)
    go_on(trust, LoadState(7.0))
    assert not trust.doubted
    assert trust.describe() == ""


def test_the_assist_fades_while_the_wrench_is_doubted_and_comes_back_with_a_new_zero() -> None:
    trust, ticks = led(LoadState(0.0)), round(EASE_S / DT)
    go_on(trust, LoadState(5.0))
    assert go_on(trust, LoadState(0.0), ticks // 2) == pytest.approx(0.5, abs=0.01)
    assert go_on(trust, LoadState(0.0), ticks) == 0.0
    assert go_on(trust, LoadState(0.0), leads=False) == 0.0, "HOLD is no new zero"
    go_on(trust, LoadState(0.0), 1, Tare.RUNNING, leads=False)
    assert not trust.doubted
    assert go_on(trust, LoadState(0.0), ticks) == 1.0
