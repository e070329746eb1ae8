"""What joint services tell each other in shared memory, and what they make of it."""

from __future__ import annotations

import zlib
from itertools import product
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


def test_a_hip_knows_how_its_own_leg_has_turned() -> None:
    assert view_of("hip_right", rows(), T0) == NeighbourView(pytest.approx((0.0 + 0.1, 0.0 + 0.01)))
    assert view_of("hip_left", rows(), T0) == NeighbourView(pytest.approx((0.3 + 0.4, 0.03 + 0.04)))


@pytest.mark.parametrize("age_ns", [0, STALE_NS, STALE_NS + 1, -STALE_NS - 1])
def test_an_ankle_knows_how_its_own_knee_has_turned_lately(age_ns: int) -> None:
    knee = NeighbourRow(T0 - age_ns, -0.7, -0.1, Mode.DAMP)
    known = abs(age_ns) <= STALE_NS
    assert view_of("ankle_left", rows(knee_left=knee), T0).leg == ((-0.7, -0.1) if known else None)
    assert view_of("ankle_right", rows(knee_left=knee), T0).leg == pytest.approx((0.1, 0.01))
    assert view_of("ankle_left", rows(knee_left=None), T0).leg is None


@pytest.mark.parametrize("age_ns", [-STALE_NS - 1, STALE_NS + 1])
@pytest.mark.parametrize("kind", ["ankle", "knee"])
def test_what_is_old_or_of_another_clock_is_not_known(kind: str, age_ns: int) -> None:
    name = f"{kind}_left"
    old = rows(**{name: NeighbourRow(T0 - age_ns, 0.5, 0.0, Mode.DAMP)})
    assert view_of("hip_left", old, T0).leg is None
    assert view_of("hip_right", old, T0).leg is not None, "it is no business of the other leg"
    just = rows(**{name: NeighbourRow(T0 - STALE_NS, 0.5, 0.0, Mode.DAMP)})
    assert view_of("hip_left", just, T0).leg is not None


@pytest.mark.parametrize("kind", ["ankle", "knee"])
def test_what_is_being_written_or_never_was_is_not_known(kind: str) -> None:
    for row in (None, NeighbourRow(0, 0.0, 0.0, 0)):
        found = view_of("hip_left", rows(**{f"{kind}_left": row}), T0)
        assert found == UNKNOWN
    assert view_of("knee_right", rows(knee_left=NeighbourRow(0, 0.0, 0.0, 0)), T0).sinks, (
        "on another host"
    )


def test_which_module_holds_beside_which() -> None:
    """Each module against each other's mode, age and whether it is caught."""
    ages = (-STALE_NS, -1, 0, GONE_NS, GONE_NS + 1)
    for asks, other, mode, age_ns, caught in product(MODULES, MODULES, Mode, ages, (0, 1)):
        if asks == other:
            continue
        found = view_of(
            asks, rows(**{other: NeighbourRow(T0 - age_ns, 0.0, 0.0, mode, caught)}), T0
        )
        pair = kind_of(asks), kind_of(other)
        stays = age_ns > GONE_NS or mode != Mode.DAMP or caught == 1
        assert found.sinks is not (pair[0] == "knee" and stays), (asks, other, mode, age_ns)
        for_knee, for_ankle = pair[1] == "knee", pair == ("knee", "ankle")
        stiffens = mode is Mode.FAULT and (for_knee or for_ankle)
        assert found.stiffen is stiffens, (asks, other, mode, age_ns)


def test_a_knee_whose_like_is_on_another_host_sinks_on_with_it() -> None:
    """The other leg knows nothing: to stop alone would tip the robot for sure."""
    dead = NeighbourRow(T0 - GONE_NS - 1, 0.0, 0.0, Mode.DAMP)
    assert not view_of("knee_left", rows(hip_left=dead), T0).sinks
    limp = NeighbourRow(T0, 0.0, 0.0, Mode.FAULT)
    for elsewhere in (NeighbourRow(0, 0.0, 0.0, 0), NeighbourRow(T0 + STALE_NS + 1, 0.0, 0.0, 3)):
        assert view_of("knee_left", rows(hip_left=dead, knee_right=elsewhere), T0).sinks
        assert view_of("knee_left", rows(ankle_left=limp, knee_right=elsewhere), T0).stiffen


def test_a_knee_waits_neither_for_itself_nor_for_what_is_not_known() -> None:
    caught = NeighbourRow(T0, 0.0, 0.0, Mode.DAMP, caught=1)
    never = NeighbourRow(0, 0.0, 0.0, 0)
    for known in ({"knee_left": caught}, {"hip_right": None}, {"hip_right": never}):
        assert view_of("knee_left", rows(**known), T0).sinks


@pytest.mark.parametrize("own_age_ns", [0, STALE_NS, STALE_NS + 1])
def test_a_drive_that_is_silent_beside_one_that_is_heard_may_be_limp(own_age_ns: int) -> None:
    """A machine that stood still silences them all, and is no reason to stiffen."""
    for asks, other in product(MODULES, MODULES):
        silent = {asks: NeighbourRow(T0 - own_age_ns, 0.0, 0.0, Mode.HOLD)}
        silent[other] = NeighbourRow(T0 - own_age_ns, 0.0, 0.0, Mode.HOLD, silent=1)
        found = view_of(asks, rows(**silent), T0)
        if asks != other:
            limp = rows(**{other: NeighbourRow(T0, 0.0, 0.0, Mode.FAULT)})
            wanted = own_age_ns <= STALE_NS and view_of(asks, limp, T0).stiffen
            assert found.stiffen is wanted, (asks, other)


def test_a_drive_that_never_sent_a_state_is_not_limp() -> None:
    for asks, other in (("hip_right", "knee_left"), ("knee_right", "ankle_left")):
        assert not view_of(asks, rows(**{other: NeighbourRow(0, 0.0, 0.0, Mode.FAULT)}), T0).stiffen
        assert view_of(asks, rows(**{other: NeighbourRow(1, 0.0, 0.0, Mode.FAULT)}), T0).stiffen


def test_a_clock_far_ahead_is_of_another_host() -> None:
    ahead = rows(knee_left=NeighbourRow(T0 + STALE_NS + 1, 0.0, 0.0, Mode.HOLD))
    assert view_of("knee_right", ahead, T0).sinks


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
    for cycle in range(300):  # the number's low byte goes round
        for i, name in enumerate(MODULES):
            six[name].write(NeighbourRow(T0 + cycle, 0.1 * i + cycle, 0.01 * i, Mode.DAMP))
        assert six["hip_left"].view(T0 + cycle) == NeighbourView(
            pytest.approx((0.7 + 2 * cycle, 0.07))
        )
    assert six["ankle_left"].view(T0) == NeighbourView(pytest.approx((0.4 + 299, 0.04)))
    assert six["knee_left"].view(T0 + 299).sinks
    assert not six["knee_left"].view(T0 + 300 + GONE_NS).sinks, "the others are dead"
    assert Neighbours.mode_of(tmp_path, "hip_left") is Mode.DAMP


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


def test_each_service_finds_its_own_row(tmp_path: Path, six: dict[str, Neighbours]) -> None:
    for name, mode in zip(MODULES, (*Mode, Mode.HOLD), strict=True):
        six[name].write(NeighbourRow(T0, 0.0, 0.0, mode))
    for name, mode in zip(MODULES, (*Mode, Mode.HOLD), strict=True):
        assert Neighbours.mode_of(tmp_path, name) is mode


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
