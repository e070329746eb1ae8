"""What joint services tell each other in shared memory, and what they make of it."""

from __future__ import annotations

import zlib
from itertools import permutations, product
from pathlib import Path

import pytest

from services.joint import neighbours
from services.joint.neighbours import (
    GONE_NS,
    STALE_NS,
    UNKNOWN,
    NeighbourRow,
    Neighbours,
    NeighbourView,
    path_of,
    view_of,
)
from shared.bus.messages import Mode
from shared.joints import MODULES, kind_of
from tests.joint.helpers import T0


def rows(**changes: NeighbourRow | None) -> list[NeighbourRow | None]:
    """Return six modules that sink, with some replaced."""
    known = {name: NeighbourRow(T0, 0.1 * i, 0.01 * i, Mode.DAMP) for i, name in enumerate(MODULES)}
    return [changes.get(name, row) for name, row in known.items()]


NEVER = NeighbourRow(0, 0.0, 0.0, 0)
DEAD = NeighbourRow(T0 - GONE_NS - 1, 0.0, 0.0, Mode.DAMP)
CAUGHT = NeighbourRow(T0, 0.0, 0.0, Mode.DAMP, caught=1)
LIMP = NeighbourRow(T0, 0.0, 0.0, Mode.FAULT)
AHEAD = NeighbourRow(T0 + STALE_NS + 1, 0.0, 0.0, Mode.HOLD)
"""By a clock far ahead, which is another host's."""


def test_a_hip_and_an_ankle_know_how_their_own_leg_has_turned() -> None:
    for module, theta, rate in (
        ("hip_right", 0.0 + 0.1, 0.0 + 0.01),
        ("hip_left", 0.3 + 0.4, 0.03 + 0.04),
        ("ankle_right", 0.1, 0.01),
        ("ankle_left", 0.4, 0.04),
    ):
        assert view_of(module, rows(), T0) == NeighbourView(pytest.approx((theta, rate)))


@pytest.mark.parametrize("age_ns", [0, STALE_NS, STALE_NS + 1, -STALE_NS, -STALE_NS - 1])
@pytest.mark.parametrize(("asks", "of"), [("hip", "ankle"), ("hip", "knee"), ("ankle", "knee")])
def test_a_row_that_is_old_being_written_or_never_was_is_not_known(
    asks: str, of: str, age_ns: int
) -> None:
    aged = rows(**{f"{of}_left": NeighbourRow(T0 - age_ns, 0.5, 0.0, Mode.DAMP)})
    known = view_of(f"{asks}_left", aged, T0) != UNKNOWN
    assert known is (abs(age_ns) <= STALE_NS)
    assert view_of(f"{asks}_right", aged, T0) != UNKNOWN, "it is no business of the other leg"
    for row in (None, NEVER):
        assert view_of(f"{asks}_left", rows(**{f"{of}_left": row}), T0) == UNKNOWN


def test_which_module_holds_beside_which() -> None:
    """Each module against each other's mode, age and whether it is caught."""
    ages = (-STALE_NS, -1, 0, GONE_NS, GONE_NS + 1)
    for (asks, other), mode, age_ns, caught in product(
        permutations(MODULES, 2), Mode, ages, (0, 1)
    ):
        row = NeighbourRow(T0 - age_ns, 0.0, 0.0, mode, caught)
        found = view_of(asks, rows(**{other: row}), T0)
        pair = kind_of(asks), kind_of(other)
        stays = age_ns > GONE_NS or mode != Mode.DAMP or caught == 1
        assert found.sinks is not (pair[0] == "knee" and stays), (asks, other, mode, age_ns)
        braces = pair[1] == "knee" or pair == ("knee", "ankle")
        assert found.stiffen is (mode is Mode.FAULT and braces), (asks, other, mode, age_ns)


@pytest.mark.parametrize(
    "others",
    [
        {"knee_left": CAUGHT}, {"hip_right": None}, {"hip_right": NEVER}, {"knee_right": NEVER},
        {"knee_right": AHEAD}, {"hip_left": DEAD, "knee_right": NEVER},
        {"hip_left": DEAD, "knee_right": AHEAD},
    ],
)  # fmt: skip
def test_a_knee_waits_neither_for_itself_nor_for_what_is_not_known(
    others: dict[str, NeighbourRow | None],
) -> None:
    """Its like on another host makes it blind to that leg: to stop alone would tip the robot.

    It stiffens for its own ankle whatever is known of the other leg.
    """
    assert view_of("knee_left", rows(**others), T0).sinks
    assert view_of("knee_left", rows(**(others | {"ankle_left": LIMP})), T0).stiffen


@pytest.mark.parametrize("own_age_ns", [0, STALE_NS, STALE_NS + 1])
def test_a_drive_that_is_silent_beside_one_that_is_heard_may_be_limp(own_age_ns: int) -> None:
    """A machine that stood still silences them all, and is no reason to stiffen.

    Nor is a drive that never sent a state.
    """
    for asks, other in permutations(MODULES, 2):
        own = NeighbourRow(T0 - own_age_ns, 0.0, 0.0, Mode.HOLD)
        silent = {asks: own, other: own._replace(silent=1)}
        limp = view_of(asks, rows(**{other: LIMP}), T0).stiffen
        wanted = own_age_ns <= STALE_NS and limp
        assert view_of(asks, rows(**silent), T0).stiffen is wanted, (asks, other)
        for t_ns in (0, 1):
            first = view_of(asks, rows(**{other: LIMP._replace(t_ns=t_ns)}), T0)
            assert first.stiffen is (limp and t_ns > 0)


def test_a_row_half_written_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`xrl estop` read one half written, and said that a module had not stopped."""
    own = Neighbours(tmp_path, "hip_right")
    own.write(NeighbourRow(T0, 0.1, 0.0, Mode.HOLD))
    path = path_of(tmp_path)
    before = path.read_bytes()
    own.write(NeighbourRow(T0 + 1, 0.1, 0.0, Mode.DAMP))
    after, reads = path.read_bytes(), []

    def crc32(data: bytes) -> int:
        reads.append(data)
        if len(reads) == 2:  # then its writer goes on
            path.write_bytes(after)
        return zlib.crc32(data)

    monkeypatch.setattr(neighbours, "crc32", crc32)
    at = MODULES.index("hip_right") * neighbours._ROW.size + 16  # the checksum and the time are new
    path.write_bytes(after[:at] + before[at:])
    assert Neighbours.mode_of(tmp_path, "hip_right") is Mode.DAMP
    assert len(reads) == 3
    assert Neighbours.mode_of(tmp_path, "hip_left") is None, "it never wrote"


@pytest.fixture
def six(tmp_path: Path) -> dict[str, Neighbours]:
    return {name: Neighbours(tmp_path, name) for name in MODULES}


def test_what_one_writes_the_others_read(tmp_path: Path, six: dict[str, Neighbours]) -> None:
    assert Neighbours.mode_of(tmp_path, "hip_left") is None
    modes = dict(zip(MODULES, (*Mode, Mode.HOLD), strict=True))
    for name, mode in modes.items():
        six[name].write(NeighbourRow(T0, 0.0, 0.0, mode))
    assert {name: Neighbours.mode_of(tmp_path, name) for name in MODULES} == modes
    for cycle in range(300):  # the number's low byte goes round
        for i, name in enumerate(MODULES):
            six[name].write(NeighbourRow(T0 + cycle, 0.1 * i + cycle, 0.01 * i, Mode.DAMP))
        leg = pytest.approx((0.7 + 2 * cycle, 0.07))
        assert six["hip_left"].view(T0 + cycle) == NeighbourView(leg)
    assert six["ankle_left"].view(T0) == NeighbourView(pytest.approx((0.4 + 299, 0.04)))
    assert six["knee_left"].view(T0 + 299).sinks
    assert not six["knee_left"].view(T0 + 300 + GONE_NS).sinks, "the others are dead"


def test_a_row_left_half_written_is_not_read(tmp_path: Path, six: dict[str, Neighbours]) -> None:
    for name in MODULES:
        six[name].write(NeighbourRow(T0, 0.1, 0.0, Mode.DAMP))
    assert six["hip_left"].view(T0).leg is not None
    whole = path_of(tmp_path).read_bytes()
    row_of_the_knee = len(whole) // 6 * MODULES.index("knee_left")
    with path_of(tmp_path).open("r+b") as file:
        file.seek(row_of_the_knee)
        file.write(bytes([whole[row_of_the_knee] ^ 1]))
    assert six["hip_left"].view(T0).leg is None
    successor = Neighbours(tmp_path, "knee_left")
    successor.write(NeighbourRow(T0, 0.3, 0.0, Mode.DAMP))
    assert six["hip_left"].view(T0) == NeighbourView(pytest.approx((0.4, 0.0)))


def test_a_row_mixed_of_two_is_never_read(tmp_path: Path, six: dict[str, Neighbours]) -> None:
    """On Arm a reader may see a writer's stores in any order, but each word whole."""
    rows_written = (
        NeighbourRow(T0, -1.9999, 0.0, Mode.HOLD),
        NeighbourRow(T0 + 1, -2.0, -0.1, Mode.DAMP, 1, 1),
    )
    words = []
    for row in rows_written:
        six["ankle_right"].write(row)
        data = path_of(tmp_path).read_bytes()[: neighbours._ROW.size]
        words.append([data[at : at + 8] for at in range(0, len(data), 8)])
    for chosen in product((0, 1), repeat=len(words[0])):
        mixed = b"".join(words[each][at] for at, each in enumerate(chosen))
        with path_of(tmp_path).open("r+b") as file:
            file.write(mixed)
        expected = rows_written[chosen[0]] if len(set(chosen)) == 1 else None
        assert six["hip_left"]._read(0) == expected, chosen
