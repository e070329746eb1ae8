from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.recorder.disk_guard import MIB, DiskChange, SpaceGuard


def changes(least_mib: float, *free_mib: float) -> list[DiskChange]:
    guard = SpaceGuard(least_mib)
    return [guard.feed(round(free * MIB)) for free in free_mib]


NONE, LOW, FULL, BACK = DiskChange
CASES = {
    "it warns once before it stops": (100, (900, 201, 199, 150, 101), [NONE, NONE, LOW]),
    "it stops below the limit once": (100, (99, 50, 0), [FULL]),
    "it goes on when there is clearly more": (100, (99, 101, 149, 151), [FULL, NONE, NONE, BACK]),
    "a disk that hovers is told once": (100, (199, 201, 199, 240, 199), [LOW]),
    "and again after clearly more": (100, (199, 300, 199), [LOW, NONE, LOW]),
    "zero switches it off": (0, (0, 0), []),
}
"""Least space, free space look by look, and what changes; NONE after the last."""


@pytest.mark.parametrize(("least", "free", "expected"), CASES.values(), ids=CASES)
def test_what_changes_by_the_free_space(
    least: float, free: tuple[float, ...], expected: list[DiskChange]
) -> None:
    assert changes(least, *free) == expected + [NONE] * (len(free) - len(expected))


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
