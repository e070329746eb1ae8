"""The harness in the loop: assist, easing of the lead, overload."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from services.planner.law.assist import (
    ERROR_MIN,
    LEAD_FADE_S,
    LEAD_MAX,
    RELEASE_FRACTION,
    SETTLE_S,
    STILL_RATE_PITCH,
    STILL_RATE_Z,
    AssistLaw,
    AssistState,
    EasingState,
    LeadEasing,
    Overload,
    OverloadState,
    force_up,
    is_still,
)
from shared.bus.messages import Wrench
from shared.clock import NS_PER_MS
from shared.config.sections import AssistConfig
from tests.planner import oracle
from tests.planner.states import DT, Kept, shipped, wrench

FORCE_MAX, RATE_MAX, INTEGRAL_MAX, INTEGRAL_S = 200.0, 100.0, 50.0, 3.0
ASSIST = AssistConfig(
    force_max=FORCE_MAX, rate_max=RATE_MAX, integral_max=INTEGRAL_MAX, integral_s=INTEGRAL_S
)


def make_law(wanted: float = 100.0) -> Kept:
    """Return a law that has carried `wanted` for long enough to integrate."""
    law = Kept(AssistLaw(ASSIST), AssistState())
    run(law, SETTLE_S + 2 * DT, wanted, wanted)
    assert (law.state.assist, law.state.integral) == (wanted, 0.0)
    return law


def run(
    law: Kept, seconds: float, wanted: float, measured: float | None, *, still: bool = True
) -> None:
    for _ in range(round(seconds / DT)):
        law.advance(wanted, measured, DT, still=still)


def test_the_first_tick_takes_over_what_hold_carries() -> None:
    law = Kept(AssistLaw(ASSIST), AssistState())
    assert law.advance(150.0, None, DT, still=False) == 0.0
    assert law.state.assist == 150.0


@pytest.mark.parametrize("wanted", [-1e4, 1e4])
def test_the_wish_is_capped_and_rate_limited(wanted: float) -> None:
    law, step = make_law(), RATE_MAX * DT
    target = FORCE_MAX if wanted > 0.0 else 0.0
    for _ in range(600):
        before = law.state.assist
        rate = law.advance(wanted, None, DT, still=True)
        assert rate == pytest.approx((law.state.assist - before) / DT)
        assert abs(law.state.assist - before) <= step + 1e-9
    assert law.state.assist == target


@pytest.mark.parametrize("error", [30.0, -30.0])
def test_a_steady_error_is_integrated_beyond_what_friction_hides(error: float) -> None:
    law = make_law()
    run(law, 1.5, 100.0, 100.0 - error)
    expected = math.copysign(abs(error) - ERROR_MIN, error) * 1.5 / INTEGRAL_S
    assert law.state.integral == pytest.approx(expected)
    assert law.state.assist == pytest.approx(100.0 + expected)


@pytest.mark.parametrize(
    ("wanted", "measured", "still"),
    [
        *[pytest.param(100.0, 100.0 + x * ERROR_MIN, True, id=f"{x} of friction")
          for x in (-1.0, -0.9, 0.9, 1.0)],
        # the squat: the operator leads with up to 30 N and asks for nothing
        pytest.param(0.0, 30.0, True, id="no wish"),
        pytest.param(100.0, None, True, id="no reading"),
        pytest.param(100.0, 60.0, False, id="the operator leads"),
    ],
)  # fmt: skip
def test_nothing_is_integrated_of(wanted: float, measured: float | None, still: bool) -> None:
    law = make_law(wanted)
    run(law, 60.0, wanted, measured, still=still)
    assert (law.state.integral, law.state.assist) == (0.0, wanted)


@pytest.mark.parametrize(("measured", "end"), [(-1e3, INTEGRAL_MAX), (1e3, -INTEGRAL_MAX)])
def test_the_integral_stops_at_its_limit_and_turns_at_once(measured: float, end: float) -> None:
    law = make_law()
    run(law, 60.0, 100.0, measured)
    assert law.state.integral == end
    law.advance(100.0, 100.0 + math.copysign(50.0, end), DT, still=True)
    assert abs(law.state.integral) < INTEGRAL_MAX


def test_the_robot_never_pulls_the_operator_down() -> None:
    law = make_law(20.0)
    run(law, 60.0, 20.0, 500.0)
    assert law.state.assist == 0.0
    law.advance(10.0, 500.0, DT, still=True)
    assert law.state.assist >= 0.0


def test_the_integral_freezes_without_a_reading() -> None:
    law = make_law()
    run(law, 1.0, 100.0, 70.0)
    before = law.state.integral
    assert before > 0.0
    run(law, 5.0, 100.0, None)
    assert law.state.integral == before


def test_the_integral_freezes_a_little_longer_than_the_operator_leads() -> None:
    law = make_law()
    run(law, 5.0, 100.0, 60.0, still=False)
    run(law, SETTLE_S - DT, 100.0, 60.0)
    assert law.state.integral == 0.0
    run(law, 3 * DT, 100.0, 60.0)
    assert law.state.integral > 0.0


def test_the_integral_freezes_while_the_wish_moves() -> None:
    law, wanted = make_law(), 100.0
    for _ in range(500):
        wanted += 0.1
        law.advance(wanted, 60.0, DT, still=True)
    assert law.state.integral == 0.0


def test_the_integral_leaks_away_when_nothing_is_wanted() -> None:
    law = make_law()
    run(law, 2.0, 100.0, 20.0)
    before = law.state.integral
    assert before > 20.0
    run(law, INTEGRAL_S, 0.0, 300.0)
    assert law.state.integral == pytest.approx(before * math.exp(-1.0), rel=0.01)
    run(law, 10 * INTEGRAL_S, 0.0, 300.0)
    assert law.state.assist == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("stop", ["request", "lead", "reading"])
def test_the_assist_makes_no_step_when_the_integral_starts_or_stops(stop: str) -> None:
    law, last = make_law(), 100.0
    for tick in range(3000):
        on = tick // 500 % 2 == 0
        wanted = 0.0 if stop == "request" and not on else 100.0
        measured = None if stop == "reading" and not on else -500.0
        law.advance(wanted, measured, DT, still=on or stop != "lead")
        step_max = (RATE_MAX + 700.0 / INTEGRAL_S) * DT
        assert abs(law.state.assist - last) <= step_max + 1e-9
        last = law.state.assist


@pytest.mark.parametrize("roll", [-0.3, 0.0, 0.2])
@pytest.mark.parametrize("pitch", [-0.2, 0.0, 1.2])
def test_force_up_is_the_world_z_of_a_force_in_torso_axes(roll: float, pitch: float) -> None:
    rng = np.random.default_rng(1)
    R = oracle.rz(0.7) @ oracle.rx(roll) @ oracle.ry(pitch)
    force = rng.standard_normal(3)
    x, y, z = (R.T @ force).tolist()
    assert force_up((x, y, z), roll, pitch) == pytest.approx(force[2])


@pytest.mark.parametrize("share", [-1.01, -0.99, 0.0, 0.99, 1.01])
def test_still_is_within_both_rates(share: float) -> None:
    still = abs(share) < 1.0
    assert is_still(share * STILL_RATE_Z, 0.0) is still
    assert is_still(0.0, share * STILL_RATE_PITCH) is still


def eased(easing: Kept, up: float | None, moment: float = 0.0, assist: float = 0.0) -> Any:
    for _ in range(round(LEAD_FADE_S / DT) + 1):
        result = easing.ease(up, moment, assist, DT)
    return result


def test_only_what_exceeds_the_assist_load_is_amplified() -> None:
    assert eased(Kept(LeadEasing(0.5), EasingState()), -200.0, assist=200.0) == (0.0, 0.0)
    assert eased(Kept(LeadEasing(0.5), EasingState()), -180.0, 8.0, assist=200.0) == pytest.approx(
        (10.0, 4.0)
    )


def test_alpha_zero_adds_nothing() -> None:
    assert eased(Kept(LeadEasing(0.0), EasingState()), 100.0, 50.0) == (0.0, 0.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_no_more_than_a_hand_can_do_is_amplified(sign: float) -> None:
    expected = (sign * 0.5 * LEAD_MAX[0], sign * 0.5 * LEAD_MAX[1])
    assert eased(Kept(LeadEasing(0.5), EasingState()), sign * 1e4, sign * 1e4) == pytest.approx(
        expected
    )


def test_the_easing_fades_out_when_the_wrench_is_lost_and_in_when_it_is_back() -> None:
    easing, last = Kept(LeadEasing(0.5), EasingState()), 50.0
    assert eased(easing, 100.0)[0] == pytest.approx(last)
    for up in (None, 100.0):
        for _ in range(round(LEAD_FADE_S / DT)):
            force, _ = easing.ease(up, 0.0, 0.0, DT)
            assert abs(force - last) <= 50.0 * DT / LEAD_FADE_S + 1e-9
            last = force
        assert last == pytest.approx(0.0 if up is None else 50.0)


AFTER, RELEASE = 100 * NS_PER_MS, 1000 * NS_PER_MS
LIMITS = {
    "overload_force": 500.0, "overload_moment": 100.0,
    "overload_after_ms": AFTER / NS_PER_MS, "overload_release_s": 1e-3 * RELEASE / NS_PER_MS,
}  # fmt: skip


T0 = 10**12


def at(share: float, kind: str) -> Wrench:
    """Return a wrench at a share of one limit, in a slanted direction."""
    part = share / math.sqrt(3.0)
    if kind == "force":
        return wrench(force=(500.0 * part, -500.0 * part, 500.0 * part))
    return wrench(moment=(100.0 * part, 100.0 * part, -100.0 * part))


def make_overload(*, holds: bool = False) -> Kept:
    """Return an overload that holds, by a cell that was saturated, or not."""
    robot, _ = shipped()
    overload = Kept(Overload(msgspec.structs.replace(robot.harness, **LIMITS)), OverloadState())
    if holds:
        overload.receive(wrench(valid=False, saturated=True), T0)
    return overload


@pytest.mark.parametrize("kind", ["force", "moment"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.999, 1.001, 2.0])
@pytest.mark.parametrize("for_ns", [0, AFTER - 1, AFTER, 10 * AFTER])
def test_hold_is_asked_for_beyond_a_limit_in_time(kind: str, share: float, for_ns: int) -> None:
    overload = make_overload()
    for t_ns in sorted({0, for_ns // 3, for_ns}):
        overload.receive(at(share, kind), T0 + t_ns)
    assert overload.state.hold is (share > 1.0 and for_ns >= AFTER)


def test_a_moment_below_the_limit_begins_the_time_anew() -> None:
    overload = make_overload()
    for t_ns, share in ((0, 1.1), (60, 1.1), (64, 0.99), (68, 1.1), (167, 1.1)):
        overload.receive(at(share, "force"), T0 + t_ns * NS_PER_MS)
        assert not overload.state.hold
    overload.receive(at(1.1, "force"), T0 + 168 * NS_PER_MS)
    assert overload.state.hold


@pytest.mark.parametrize("valid", [True, False])
def test_a_saturated_cell_asks_for_hold_at_once(valid: bool) -> None:
    overload = make_overload()
    overload.receive(wrench(valid=valid, saturated=True), T0)
    assert overload.state.hold


@pytest.mark.parametrize("kind", ["force", "moment"])
@pytest.mark.parametrize("share", [0.0, RELEASE_FRACTION - 0.001, RELEASE_FRACTION + 0.001, 0.99])
@pytest.mark.parametrize("for_ns", [RELEASE - 1, RELEASE, 3 * RELEASE])
def test_hold_ends_below_the_lower_limit_for_its_time(kind: str, share: float, for_ns: int) -> None:
    overload = make_overload(holds=True)
    for now_ns in (T0, T0 + for_ns):
        overload.receive(at(share, kind), now_ns)
    assert overload.state.hold is not (share < RELEASE_FRACTION and for_ns >= RELEASE)


def test_an_invalid_reading_now_and_then_does_not_hold_an_overload_off() -> None:
    overload = make_overload()
    for t in range(0, 104, 4):
        reading = wrench(valid=False) if t % 40 == 20 else at(1.1, "force")
        overload.receive(reading, T0 + t * NS_PER_MS)
    assert overload.state.hold


def test_an_invalid_reading_begins_the_end_of_an_overload_anew() -> None:
    overload = make_overload(holds=True)
    for reading, at_ns, hold in (
        (wrench(), 0, True),
        (wrench(valid=False), RELEASE // 2, True),
        (wrench(), RELEASE, True),
        (wrench(), 2 * RELEASE, False),
    ):
        overload.receive(reading, T0 + at_ns)
        assert overload.state.hold is hold


def test_numbers_that_are_not_valid_neither_begin_nor_end_it() -> None:
    old = msgspec.structs.replace(at(2.0, "force"), valid=False)
    for overload, reading in (
        (make_overload(), old),
        (make_overload(holds=True), wrench(valid=False)),
    ):
        before = overload.state.hold
        for t_ns in (0, AFTER, RELEASE, 10 * RELEASE):
            overload.receive(reading, T0 + t_ns)
            assert overload.state.hold is before
