from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from services.recorder.disk_guard import MIB, DiskChange, SpaceGuard


def changes(least_mib: float, *free_mib: float) -> list[DiskChange]:
    guard = SpaceGuard(least_mib)
    return [guard.feed(round(free * MIB)) for free in free_mib]


def test_it_warns_once_before_it_stops() -> None:
    assert changes(100, 900, 201, 199, 150, 101) == [
        DiskChange.NONE, DiskChange.NONE, DiskChange.LOW, DiskChange.NONE, DiskChange.NONE,
    ]  # fmt: skip


def test_it_stops_below_the_limit_and_reports_it_once() -> None:
    assert changes(100, 99, 50, 0) == [DiskChange.FULL, DiskChange.NONE, DiskChange.NONE]


def test_it_goes_on_only_when_there_is_clearly_more() -> None:
    assert changes(100, 99, 101, 149, 151) == [
        DiskChange.FULL, DiskChange.NONE, DiskChange.NONE, DiskChange.BACK,
    ]  # fmt: skip


def test_a_disk_that_hovers_at_the_warning_is_reported_once() -> None:
    assert changes(100, 199, 201, 199, 240, 199).count(DiskChange.LOW) == 1
    assert changes(100, 199, 300, 199).count(DiskChange.LOW) == 2


def test_zero_switches_it_off() -> None:
    assert changes(0, 0, 0) == [DiskChange.NONE, DiskChange.NONE]


@given(st.lists(st.floats(0, 400)))
def test_it_never_lets_recording_go_on_below_the_limit(free_mib: list[float]) -> None:
    guard = SpaceGuard(100)
    for free in free_mib:
        before = guard.enough
        change = guard.feed(round(free * MIB))
        assert guard.enough or change in (DiskChange.FULL, DiskChange.NONE)
        assert (change is DiskChange.BACK) == (guard.enough and not before)
        assert (change is DiskChange.FULL) == (before and not guard.enough)
        if round(free * MIB) < 100 * MIB:
            assert not guard.enough
