"""Two signs that agree are a fall; one alone is none, whatever it is."""

from __future__ import annotations

import itertools
import math
from typing import Any, Final

import pytest

from services.planner.watch.fallen import (
    AFTER_NS,
    APART_MAX,
    BORNE,
    MOMENT_NS,
    PITCH,
    ROLL_YAW_MAX,
    TILT_MAX,
    TIPPING,
    UNLOADED,
    WHIRL_MIN,
    FallState,
    FallWatch,
    Seen,
)
from shared.bus.messages import Mode
from shared.config.robot_config import GRAVITY
from shared.joints import N_MODULES
from tests.planner.states import TICK_NS
from tests.robots import ROBOT

T0 = 5_000_000_000
WEIGHT = ROBOT.total_mass * GRAVITY
LEVEL = (0.0, 0.0, 1.0)
HOLD, DAMP = [Mode.HOLD] * N_MODULES, [Mode.DAMP] * N_MODULES
STANDS = Seen(
    pose=(0.0, 0.0, 0.8, 0.0, 0.2, 0.0), rates=(0.0,) * 6, closure=(0.0,) * 6,
    soles=(0.5 * WEIGHT, 0.5 * WEIGHT), tipping=0.0, up=None, turning=None,
)  # fmt: skip


def leans(by: float) -> tuple[float, float, float]:
    """Return up as the IMU of that robot has it when its soles are tilted by an angle, rad."""
    return -math.sin(0.2 + by), 0.0, math.cos(0.2 + by)


SIGNS: Final[dict[str, dict[str, Any]]] = {
    "apart": {"closure": (0.8 * APART_MAX[0], 0.7 * APART_MAX[0], 0.0, 0.0, 0.0, 0.0)},
    "turned": {"pose": (0.0, 0.0, 0.8, 1.01 * ROLL_YAW_MAX[0], 0.2, 0.0)},
    "tipped": {"tipping": 1.01 * TIPPING},
    "unloaded": {"soles": (0.6 * UNLOADED * WEIGHT, 0.3 * UNLOADED * WEIGHT)},
    "tilted": {"up": leans(1.05 * TILT_MAX)},
    "whirled": {"turning": (0.0, 1.01 * WHIRL_MIN, 0.0)},
}
BY_LEGS = ("apart", "turned", "tipped", "unloaded")


def found(*steps: tuple[int, Seen], modes: list[Mode] = HOLD) -> FallState:
    """Return the state after some robots were seen, each for so many ns."""
    state, watch, now_ns = FallState(), FallWatch(ROBOT), T0
    for lasts_ns, seen in steps:
        for _ in range(0, lasts_ns, TICK_NS):
            watch.advance(state, now_ns, modes, seen)
            now_ns += TICK_NS
    return state


def seen(*signs: str, imu: bool = False) -> tuple[tuple[int, Seen], ...]:
    """Return the steps of a robot that shows these signs; it tips before it is unloaded."""
    with_imu = STANDS._replace(up=leans(0.0), turning=(0.0, 0.0, 0.0)) if imu else STANDS
    changes = {key: value for sign in signs for key, value in SIGNS[sign].items()}
    lasting = with_imu._replace(**changes)
    return (TICK_NS, lasting._replace(soles=STANDS.soles)), (AFTER_NS + 2 * TICK_NS, lasting)


@pytest.mark.parametrize("imu", [False, True])
@pytest.mark.parametrize("sign", ["none", *SIGNS])
def test_no_sign_alone_is_a_fall(sign: str, imu: bool) -> None:
    assert not found(*seen(*[sign] * (sign != "none"), imu=imu)).fell_ns


@pytest.mark.parametrize("pair", list(itertools.combinations(BY_LEGS, 2)))
def test_any_two_signs_of_the_legs_are_a_fall_and_are_named(pair: tuple[str, str]) -> None:
    state = found(*seen(*pair))
    assert state.fell_ns
    assert all(sign in state.describe() for sign in pair)


@pytest.mark.parametrize("pair", list(itertools.combinations(SIGNS, 2)))
def test_with_an_imu_the_soles_must_be_tilted_or_the_legs_apart(pair: tuple[str, str]) -> None:
    """A hoist pulls a robot over its edge and unloads it; its soles then stay nearly level."""
    assert bool(found(*seen(*pair, imu=True)).fell_ns) == ("tilted" in pair or "apart" in pair)


def test_the_imu_is_compared_with_the_legs_whatever_the_torso_does() -> None:
    bows = STANDS._replace(
        pose=(0.0, 0.0, 0.7, 0.0, 1.2, 0.0),
        rates=(0.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        up=(-math.sin(1.2), 0.0, math.cos(1.2)),
        turning=(0.0, 1.0, 0.0),
        **SIGNS["unloaded"],
    )
    assert not found((AFTER_NS + TICK_NS, bows)).fell_ns


@pytest.mark.parametrize(
    ("held_ns", "fell"), [(AFTER_NS - TICK_NS, False), (AFTER_NS + TICK_NS, True)]
)
def test_signs_must_last(held_ns: int, fell: bool) -> None:
    both = STANDS._replace(**SIGNS["apart"], **SIGNS["turned"])
    assert bool(found((held_ns, both), (AFTER_NS, STANDS), (held_ns, both)).fell_ns) == fell


@pytest.mark.parametrize("pitch", [PITCH[0] - 0.01, PITCH[1] + 0.01])
def test_on_straight_legs_a_torso_far_out_of_its_range_is_a_fall(pitch: float) -> None:
    nowhere = STANDS._replace(soles=(math.nan, math.nan))
    assert not found((AFTER_NS + TICK_NS, nowhere)).fell_ns
    turned = nowhere._replace(pose=(0.0, 0.0, 0.9, 0.0, pitch, 0.0))
    assert found((AFTER_NS + TICK_NS, turned)).fell_ns


@pytest.mark.parametrize(("borne", "fell"), [(BORNE - 0.05, False), (BORNE + 0.05, True)])
@pytest.mark.parametrize("late_ns", [0, MOMENT_NS])
def test_tipping_counts_for_a_moment_and_under_the_robots_weight(
    borne: float, fell: bool, late_ns: int
) -> None:
    """Unloaded by a hoist, soles whose ankles are held have their pressure at an edge."""
    tips = STANDS._replace(soles=(borne * WEIGHT, 0.0), **SIGNS["tipped"])
    light = STANDS._replace(**SIGNS["unloaded"])
    state = found((TICK_NS, tips), (late_ns, STANDS), (AFTER_NS + 2 * TICK_NS, light))
    assert bool(state.fell_ns) == (fell and not late_ns)


def test_modules_that_are_not_stiff_fall_no_harder() -> None:
    assert not found(*seen("apart", "turned"), modes=DAMP).fell_ns
    one = [*DAMP[:5], Mode.HOLD]
    assert found(*seen("apart", "turned"), modes=one).fell_ns


def test_it_has_fallen_until_a_module_that_let_go_is_stiff_again() -> None:
    watch, state = FallWatch(ROBOT), found(*seen("apart", "turned"))
    for modes in (HOLD, DAMP, [*DAMP[:5], Mode.FAULT], [Mode.DISARMED, *DAMP[1:]]):
        assert not watch.advance(state, T0 + MOMENT_NS, modes, STANDS)
        assert state.fell_ns
    assert watch.advance(state, T0 + MOMENT_NS, [Mode.HOLD, *DAMP[1:]], STANDS)
    assert not state.fell_ns
    assert state.describe() == ""
