from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest

from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import (
    FAULT_KINDS,
    Fault,
    FaultKind,
    Keyframe,
    Kill,
    Push,
    Scenario,
    lead,
    push_at,
)  # fmt: skip
from tests.conftest import ROBOT_FILE
from tests.shared.test_config import Change, Table, changed_file, check_refusal

SHIPPED = sorted((ROBOT_FILE.parent / "scenarios").glob("*.toml"))
SQUAT = ROBOT_FILE.parent / "scenarios" / "squat.toml"
CRAWL = ROBOT_FILE.parent / "scenarios" / "crawl.toml"
SHIFT = ROBOT_FILE.parent / "scenarios" / "shift.toml"

RAW: Table = {
    "name": "two",
    "about": "one way and back",
    "duration": 10.0,
    "keyframe": [{"at": 1.0, "height": 1.1}, {"at": 3.0, "height": 0.9, "pitch": 0.4}],
    "push": [{"at": 2.0, "duration": 0.3, "force": [40.0, 0.0, 0.0]}],
    "kill": [{"service": "planner", "at": 4.0}],
    "restart": [{"service": "planner", "at": 6.0}],
    "fault": [{"module": "knee_left", "kind": "encoder", "at": 5.0, "axis": 1, "duration": 0.5}],
}


def row(table: str, **changes: object) -> Change:
    """Return a change of a table's first row; of a keyframe, the second."""
    return lambda raw: raw[table][-1].update(changes)


# change; the key the error names; what stands there; a word of what would be right
REFUSALS: list[tuple[Change, str, str, str]] = [
    (row("keyframe", roll=0.1), "keyframe[1].roll", "unknown", "spelling"),
    (row("keyframe", height=0.2), "keyframe[1].height", "0.2", "0.3 to 2 m"),
    (row("keyframe", at=1.0), "keyframe[1].at", "1 s is not later than 1 s", "increase"),
    (lambda raw: raw.update(keyframe=[]), "keyframe", "missing", "at least one"),
    (lambda raw: raw.pop("duration"), "duration", "missing", "required"),
    (row("push", force=[0.0, 2001.0, 0.0]), "push[0].force[1]", "2001.0", "2000 N"),
    (row("push", at=10.0), "push[0].at", "10 s is not before the end", "longer duration"),
    (row("kill", service="toe"), "kill[0].service", "'toe'", "planner, harness"),
    (row("kill", at=10.0), "kill[0].at", "10 s is not before the end", "longer duration"),
    (row("kill", signal="HUP"), "kill[0].signal", "'HUP'", "one of KILL, STOP"),
    (row("restart", service="toe"), "restart[0].service", "'toe'", "planner, harness"),
    (row("restart", at=11.0), "restart[0].at", "11 s is not before the end", "longer duration"),
    (row("restart", at=4.0), "restart[0]", "not killed before 4 s", "kill it first"),
    (row("restart", service="recorder"), "restart[0]", "recorder is not killed", "kill it first"),
    (row("fault", module="toe"), "fault[0].module", "'toe'", "ankle_right, knee_right"),
    (row("fault", kind="fire"), "fault[0].kind", "'fire'", "one of over_temperature"),
    (row("fault", at=10.0), "fault[0].at", "10 s is not before the end", "longer duration"),
    (row("fault", duration=math.nan), "fault[0].duration", "nan", "0.001 to 600 s"),
    (row("fault", kind="disarmed"), "fault[0].duration", "is momentary", "remove it"),
    (row("fault", kind="brown_out"), "fault[0].axis", "the whole ODrive", "remove it"),
]


@pytest.mark.parametrize(
    ("change", "key", "found", "right"), REFUSALS, ids=[f"{r[1]}-{r[2]}" for r in REFUSALS]
)
def test_a_refusal_names_file_key_value_and_what_would_be_right(
    tmp_path: Path, change: Change, key: str, found: str, right: str
) -> None:
    path = changed_file(tmp_path / "scenario.toml", RAW, change)
    check_refusal(scenarios.load, path, key, found, right)


PLAIN_FAULT = {"module": "hip_left", "kind": "watchdog", "at": 1}

HELD = {"at": 1.0, "height": 1.1, "side": 0.02}


@pytest.mark.parametrize("about", [{"hand": False}, {"fault": [PLAIN_FAULT]}, {"keyframe": [HELD]}])
def test_a_scenario_is_taken_and_comes_back_from_its_own_toml(tmp_path: Path, about: Table) -> None:
    path = changed_file(tmp_path / "scenario.toml", RAW, lambda raw: raw.update(about))
    first = scenarios.load(path)
    path.write_text(scenarios.to_toml(first), encoding="utf-8")
    assert scenarios.load(path) == first
    assert first.name == "two"


def test_faults_last_as_their_kind_does_by_default_and_every_kind_is_in_the_table() -> None:
    for kind, traits in FAULT_KINDS.items():
        plain = msgspec.convert({"module": "hip_left", "kind": kind, "at": 1.0}, Fault)
        assert plain.axis is None
        assert plain.lasts_s == (traits.duration or 0.0)
    given = Fault(module="hip_left", kind="link_lost", at=1.0, duration=3.0)
    assert given.lasts_s == 3.0
    assert set(get_args(FaultKind)) == set(FAULT_KINDS)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_lead_passes_through_every_keyframe_at_rest(path: Path) -> None:
    shipped = scenarios.load(path)
    for frame in shipped.keyframe:
        at = lead(shipped, frame.at)
        assert (at.height, at.pitch) == pytest.approx((frame.height, frame.pitch))
        assert at.assist == pytest.approx(frame.assist)
        assert at.shift == pytest.approx(frame.shift)
        assert (at.height_rate, at.pitch_rate) == pytest.approx((0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize("path", [SQUAT, CRAWL, SHIFT], ids=lambda path: path.stem)
def test_lead_and_its_rates_are_continuous_and_fit_each_other(path: Path) -> None:
    shipped = scenarios.load(path)
    dt = 1e-4
    times = np.arange(-1.0, shipped.duration + 1.0, dt)
    rows = np.array([(*at[:5], *at.shift) for at in (lead(shipped, t) for t in times)])
    height, height_rate, pitch, pitch_rate, assist, *shift = rows.T
    for value, rate in ((height, height_rate), (pitch, pitch_rate)):
        assert np.abs(rate).max() > 0.0 or not np.ptp(value)
        middle = 0.5 * (rate[1:] + rate[:-1])
        np.testing.assert_allclose(np.diff(value) / dt, middle, atol=1e-6)
        assert np.abs(np.diff(rate)).max() < 10.0 * dt
    assert np.abs(np.diff(assist)).max() < 200.0 * dt
    assert np.abs(np.diff(shift)).max() < 0.2 * dt
    assert np.ptp(height) > (0.1 if path == SHIFT else 0.2)


def test_squat_and_crawl_are_those_of_the_reference() -> None:
    squat = scenarios.load(SQUAT)
    for t in np.linspace(0.0, 10.0, 1001):
        expected = 1.188 - 0.12 * (1.0 - math.cos(2.0 * math.pi * t / 5.0))
        assert lead(squat, t).height == pytest.approx(expected, abs=1e-12)
        assert (lead(squat, t).pitch, lead(squat, t).assist) == (0.0, 0.0)
    squat = scenarios.load(SQUAT)
    assert squat.kill == (Kill(service="planner", at=10.0, signal="KILL"),)
    assert squat.push == tuple(
        Push(at=at, duration=0.3, force=(x, y, 0.0))
        for at, x, y in ((12.0, 40.0, 0.0), (14.0, 0.0, 40.0), (16.0, -40.0, 0.0))
    )
    assert (squat.duration, squat.hand) == (20.0, True)
    crawl = scenarios.load(CRAWL)
    for t in (5.0, 7.5, 10.0):
        assert lead(crawl, t)[:5] == pytest.approx((0.79, 0.0, 1.2, 0.0, 200.0), abs=1e-12)
    assert lead(crawl, 15.0).height == pytest.approx(1.188)


def test_lead_waits_at_the_first_keyframe_stays_at_the_last_and_holds_sideways_if_asked() -> None:
    frames = (Keyframe(at=1.0, height=1.1), Keyframe(at=3.0, height=0.9, pitch=0.4))
    two = Scenario(name="two", about="", duration=10.0, keyframe=frames)
    for t in (-5.0, 0.0, 1.0):
        assert lead(two, t)[:5] == (1.1, 0.0, 0.0, 0.0, 0.0)
    for t in (3.0, 100.0):
        assert lead(two, t)[:5] == (0.9, 0.0, 0.4, 0.0, 0.0)
    stand = Scenario(name="one", about="", duration=1.0, keyframe=frames[:1])
    assert {lead(stand, t).height for t in (-1.0, 0.0, 1.5, 2.0)} == {1.1}
    sides = (None, 0.02, -0.04, None)
    frames = tuple(Keyframe(at=float(at), height=1.1, side=side) for at, side in enumerate(sides))
    leaned = Scenario(name="leaned", about="", duration=10.0, keyframe=frames)
    assert {lead(leaned, t)[6:] for t in (-1.0, 0.5, 0.999, 2.001, 9.0)} == {(None, 0.0)}
    assert [lead(leaned, t).side for t in (1.0, 1.5)] == pytest.approx([0.02, -0.01])
    dt = 1e-6
    sides_there = [lead(leaned, 1.3 + t).side or 0.0 for t in (-dt, dt)]
    assert lead(leaned, 1.3).side_rate == pytest.approx(np.diff(sides_there)[0] / (2 * dt))


def test_pushes_act_from_start_to_end_and_add_up() -> None:
    squat = scenarios.load(SQUAT)
    before, start = push_at(squat, math.nextafter(12.0, 0.0)), push_at(squat, 12.0)
    last, end = push_at(squat, math.nextafter(12.3, 0.0)), push_at(squat, 12.3)
    assert before == end == (0.0, 0.0, 0.0)
    assert start == last == (40.0, 0.0, 0.0)
    one = Push(at=0.0, duration=2.0, force=(1.0, 2.0, 3.0))
    other = Push(at=1.0, duration=2.0, force=(10.0, 0.0, -3.0))
    frames = (Keyframe(at=0.0, height=1.0),)
    both = Scenario(name="both", about="", duration=5.0, keyframe=frames, push=(one, other))
    found = [push_at(both, t) for t in (0.5, 1.5, 2.5)]
    assert found == [one.force, (11.0, 2.0, 0.0), other.force]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_scenario_loads_under_its_own_name(path: Path, robot: RobotConfig) -> None:
    shipped = scenarios.load(path)
    assert shipped.name == path.stem
    assert shipped.keyframe[0].height == robot.simulation.stand_height
    assert shipped.keyframe[-1].at <= shipped.duration
