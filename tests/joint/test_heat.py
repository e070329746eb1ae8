"""The estimate of a module's heat, and how long its load can last."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

import msgspec
import pytest

from services.joint.heat import HeatEstimate, HeatFile, HeatState
from shared.bus.messages import LEFT_MAX_S, Pair
from shared.clock import NS_PER_S
from shared.run_directory import make_live_dir
from tests.joint.helpers import ROBOT

SQUAT: Pair = (20.2 * 0.0827, 14.9 * 0.0827)
"""Torques of a knee's motors, torso at 0.948 m; N m."""
LIGHT: Pair = (12.5 * 0.0827, 7.1 * 0.0827)
"""At 1.25 m."""


class Loaded:
    """An estimate under a load, by one cycle each 0.1 s."""

    def __init__(self, **changes: object) -> None:
        """Take the robot with some keys of [heat] changed."""
        heat = msgspec.structs.replace(ROBOT.heat, **changes)
        self.estimate = HeatEstimate(msgspec.structs.replace(ROBOT, heat=heat))
        self.heat = self.estimate.cold()
        self.now_s = 1.0

    def run(
        self, torque: Pair, seconds: float, fet: Pair | None = None, motor: Pair | None = None
    ) -> None:
        for k in range(round(10.0 * seconds)):
            told = (fet, motor) if k % 10 == 0 else (None, None)
            self.estimate.advance(self.heat, round(self.now_s * NS_PER_S), torque, *told)
            self.now_s += 0.1


@pytest.mark.parametrize("before_s", [30.0, 300.0])
def test_the_seconds_left_are_those_until_a_limit(before_s: float) -> None:
    loaded = Loaded()
    loaded.run(SQUAT, before_s)
    left_s = loaded.heat.left_s
    assert 60.0 < left_s < 900.0
    loaded.run(SQUAT, left_s * 0.9)
    assert max(loaded.heat.winding) < ROBOT.heat.winding_max
    loaded.run(SQUAT, left_s * 0.2)
    assert max(loaded.heat.winding) > ROBOT.heat.winding_max
    assert loaded.heat.left_s == 0.0


def test_a_light_load_can_last_and_a_load_taken_off_leaves_more_time_within_seconds() -> None:
    light, loaded = Loaded(), Loaded()
    light.run(LIGHT, 20.0)
    assert light.heat.left_s == LEFT_MAX_S
    loaded.run(SQUAT, 60.0)
    loaded.estimate.skip(loaded.heat, 400.0)
    assert loaded.heat.left_s < 200.0
    loaded.run(LIGHT, 15.0)
    assert loaded.heat.left_s > 600.0


def test_no_seconds_left_are_negative_or_no_number_at_any_load_and_temperature() -> None:
    heat = HeatEstimate(ROBOT)
    windings, housings = (-20.0, 40.0, 80.0, 94.99, 95.0, 250.0), (-20.0, 40.0, 95.0, 140.0)
    for winding, housing, amperes in product(windings, housings, (0.0, 1e-6, 5.0, 20.0, 48.0, 4e2)):
        state = heat.cold()
        state.winding, state.housing = (winding, 40.0), (housing, 40.0)
        state.load = ((amperes * 0.0827) ** 2, 0.0)
        left_s = min(heat._stage_left_s(state, 0), heat._winding_left_s(state, 0))
        assert 0.0 <= left_s <= LEFT_MAX_S
        assert (left_s == 0.0) == (winding >= ROBOT.heat.winding_max)


def test_what_the_drive_reports_counts_more_than_the_estimate() -> None:
    loaded = Loaded(ambient=20.0)
    loaded.run(LIGHT, 60.0, fet=(85.0, 60.0), motor=(90.0, 88.0))
    assert loaded.heat.winding == pytest.approx((90.0, 88.0), abs=4.0)
    assert loaded.heat.stage[0] == pytest.approx(85.0, abs=1.0)
    silent = Loaded(ambient=20.0)
    silent.run(LIGHT, 60.0)
    assert max(silent.heat.winding) < 40.0


def test_a_thermistor_shows_how_warm_the_housing_is_and_with_it_how_much_time_is_left() -> None:
    """The air is taken 20 K too cool: of that, the thermistor knows nothing."""
    truth, told, deaf = (Loaded(ambient=air) for air in (45.0, 25.0, 25.0))
    for second in range(420):
        truth.run(SQUAT, 1.0)
        told.run(SQUAT, 1.0, motor=truth.heat.winding)
        left_s = truth.heat.left_s
        if second < 240:
            deaf.run(SQUAT, 1.0)
        if second == 239:
            assert told.heat.left_s == pytest.approx(left_s, rel=0.4)
            assert deaf.heat.left_s > 2.0 * left_s
    assert told.heat.left_s == pytest.approx(left_s, abs=20.0)


def test_a_process_that_stood_still_takes_its_last_load_for_a_while_only() -> None:
    loaded, off = Loaded(), Loaded(estimate=False)
    loaded.run(SQUAT, 10.0)
    before = loaded.heat.winding
    loaded.now_s += 3600.0
    loaded.run(SQUAT, 0.1)
    assert math.dist(before, loaded.heat.winding) < 6.0
    assert (off.estimate.enabled, off.heat.left_s) == (False, -1.0), "by the robot file"


def restarted(run_dir: Path, now_s: float) -> HeatState:
    """Return the estimate of a service that starts now."""
    estimate = HeatEstimate(ROBOT)
    heat = estimate.cold()
    HeatFile(run_dir, "knee_left").restore(estimate, heat, round(now_s * NS_PER_S))
    return heat


def test_a_service_that_restarts_finds_the_module_as_warm_as_it_was_left(tmp_path: Path) -> None:
    loaded, file = Loaded(), HeatFile(tmp_path, "knee_left")
    assert restarted(tmp_path, 1.0).winding == (40.0, 40.0), "nothing is kept yet"
    loaded.run(SQUAT, 200.0)
    file.write(loaded.heat)
    warm = max(loaded.heat.winding)
    soon = restarted(tmp_path, loaded.now_s + 5.0)
    assert max(soon.winding) >= warm, "its drive may have held on"
    assert soon.load == loaded.heat.load
    late = restarted(tmp_path, loaded.now_s + 600.0)
    assert 40.0 < max(late.winding) < warm - 10.0
    next_day = restarted(tmp_path, loaded.now_s + 86_400.0)
    assert max(next_day.winding) == pytest.approx(40.0, abs=0.1)
    rebooted = restarted(tmp_path, 1.0)
    assert max(rebooted.winding) == pytest.approx(warm)


@pytest.mark.parametrize(
    "content", [b"\xff" * 72, bytes(72), b"\x01" + bytes(63) + b"\xf0\x7f" * 4]
)
def test_a_file_that_holds_nonsense_holds_nothing(tmp_path: Path, content: bytes) -> None:
    (make_live_dir(tmp_path) / "knee_left.heat").write_bytes(content)
    state = restarted(tmp_path, 100.0)
    assert max(state.winding) <= 40.0
    assert all(map(math.isfinite, (*state.winding, *state.housing, *state.load)))
