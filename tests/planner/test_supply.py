"""A battery that runs low is told early, and the robot goes down before it switches off."""

from __future__ import annotations

import pytest

from services.planner.watch.supply import POLE_S, RECOVERED_V, SupplyState, SupplyWatch
from shared.config.sections import SupplyConfig
from tests.messages import all_states
from tests.planner.states import DT, Kept

LEVELS = SupplyConfig(low_v=44.0, sit_v=42.0)


def kept(levels: SupplyConfig) -> Kept:
    return Kept(SupplyWatch(levels), SupplyState())


def watched(watch: Kept, volts: float, seconds: float) -> Kept:
    states = all_states(supply_v=48.0)
    states["knee_left"] = all_states(supply_v=volts)["knee_left"]
    for _ in range(round(seconds / DT)):
        watch.advance(list(states.values()), DT)
    return watch


@pytest.mark.parametrize(
    ("volts", "low", "sits"),
    [(44.01, False, False), (43.99, True, False), (42.01, True, False), (41.99, True, True)],
)
def test_the_lowest_supply_counts_and_is_named(volts: float, low: bool, sits: bool) -> None:
    watch = watched(watched(kept(LEVELS), 48.0, DT), volts, 20 * POLE_S)
    assert (watch.state.low, watch.state.sits) == (low, sits)
    words = watch.describe()
    assert ("the supply of knee_left is at 4" in words) is low
    assert ("now" in words) is sits


def test_a_step_of_the_load_is_no_empty_battery() -> None:
    watch = watched(kept(LEVELS), 46.0, 1.0)
    watched(watch, 38.0, 0.3)
    assert watch.describe() == ""


def test_a_level_lasts_until_the_supply_has_recovered() -> None:
    watch = watched(watched(kept(LEVELS), 48.0, DT), 41.0, 10 * POLE_S)
    watched(watch, 42.0 + 0.9 * RECOVERED_V, 20 * POLE_S)
    assert watch.state.sits
    watched(watch, 42.0 + 1.1 * RECOVERED_V, 20 * POLE_S)
    assert (watch.state.low, watch.state.sits) == (True, False)
    watched(watch, 48.0, 20 * POLE_S)
    assert watch.describe() == ""


def test_a_drive_that_tells_nothing_is_none_with_an_empty_battery() -> None:
    watch = kept(LEVELS)
    watch.advance(list(all_states().values()), DT)
    assert (watch.state.volts, watch.describe()) == (0.0, "")
    watched(watch, 0.0, 5.0)
    assert watch.state.volts == pytest.approx(48.0)


def test_another_battery_than_the_file_says_moves_nothing() -> None:
    watch = kept(LEVELS)
    states = list(all_states(supply_v=24.0).values())
    for _ in range(2000):
        watch.advance(states, DT)
    assert (watch.state.low, watch.state.sits) == (True, False)


def test_without_levels_nothing_is_told() -> None:
    watch = watched(kept(SupplyConfig(low_v=0.0, sit_v=0.0)), 20.0, 5.0)
    assert watch.describe() == ""
