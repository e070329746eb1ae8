"""The harness in the loop: assist, easing of the lead, overload."""

from __future__ import annotations

import math

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
from shared.bus.messages import Pair, Wrench
from shared.clock import NS_PER_MS
from shared.config.sections import AssistConfig
from tests.planner import oracle
from tests.planner.states import DT, ROBOT, Kept, wrench

FORCE_MAX, RATE_MAX, INTEGRAL_MAX, INTEGRAL_S = 200.0, 100.0, 50.0, 3.0
ASSIST = AssistConfig(
    force_max=FORCE_MAX, rate_max=RATE_MAX, integral_max=INTEGRAL_MAX, integral_s=INTEGRAL_S
)


def run(
    law: Kept, seconds: float, wanted: float, measured: float | None, *, still: bool = True
) -> AssistState:
    for _ in range(round(seconds / DT)):
        law.advance(wanted, measured, DT, still=still)
    assert isinstance(law.state, AssistState)
    return law.state


def carrying(wanted: float = 100.0) -> Kept:
    """Return a law that has carried `wanted` for long enough to integrate."""
    law = Kept(AssistLaw(ASSIST), AssistState())
    run(law, SETTLE_S + 2 * DT, wanted, wanted)
    assert (law.state.assist, law.state.integral) == (wanted, 0.0)
    return law


def test_the_first_tick_takes_over_what_hold_carries() -> None:
    law = Kept(AssistLaw(ASSIST), AssistState())
    assert law.advance(150.0, None, DT, still=False) == 0.0
    assert law.state.assist == 150.0


@pytest.mark.parametrize("wanted", [-1e4, 1e4])
def test_the_wish_is_capped_and_rate_limited(wanted: float) -> None:
    law = carrying()
    for _ in range(600):
        before = law.state.assist
        rate = law.advance(wanted, None, DT, still=True)
        assert rate == pytest.approx((law.state.assist - before) / DT)
        assert abs(rate) <= RATE_MAX + 1e-6
    assert law.state.assist == (FORCE_MAX if wanted > 0.0 else 0.0)


@pytest.mark.parametrize("error", [30.0, -30.0])
def test_a_steady_error_is_integrated_beyond_what_friction_hides(error: float) -> None:
    state = run(carrying(), 1.5, 100.0, 100.0 - error)
    expected = math.copysign(abs(error) - ERROR_MIN, error) * 1.5 / INTEGRAL_S
    assert state.integral == pytest.approx(expected)
    assert state.assist == pytest.approx(100.0 + expected)


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
    state = run(carrying(wanted), 60.0, wanted, measured, still=still)
    assert (state.integral, state.assist) == (0.0, wanted)


@pytest.mark.parametrize(("measured", "end"), [(-1e3, INTEGRAL_MAX), (1e3, -INTEGRAL_MAX)])
def test_the_integral_stops_at_its_limit_and_turns_at_once(measured: float, end: float) -> None:
    law = carrying()
    assert run(law, 60.0, 100.0, measured).integral == end
    turned = run(law, DT, 100.0, 100.0 + math.copysign(50.0, end))
    assert abs(turned.integral) < INTEGRAL_MAX


def test_the_robot_never_pulls_the_operator_down() -> None:
    law = carrying(20.0)
    assert run(law, 60.0, 20.0, 500.0).assist == 0.0
    assert run(law, DT, 10.0, 500.0).assist >= 0.0


def test_the_integral_freezes_without_a_reading_and_a_little_longer_than_the_lead() -> None:
    law, led, moving, wanted = carrying(), carrying(), carrying(), 100.0
    before = run(law, 1.0, 100.0, 70.0).integral
    assert before > 0.0
    assert run(law, 5.0, 100.0, None).integral == before
    run(led, 5.0, 100.0, 60.0, still=False)
    assert run(led, SETTLE_S - DT, 100.0, 60.0).integral == 0.0
    assert run(led, 3 * DT, 100.0, 60.0).integral > 0.0
    for _ in range(500):
        wanted += 0.1
        assert run(moving, DT, wanted, 60.0).integral == 0.0, "while the wish moves"


def test_the_integral_leaks_away_when_nothing_is_wanted() -> None:
    law = carrying()
    before = run(law, 2.0, 100.0, 20.0).integral
    assert before > 20.0
    left = run(law, INTEGRAL_S, 0.0, 300.0).integral
    assert left == pytest.approx(before * math.exp(-1.0), rel=0.01)
    assert run(law, 10 * INTEGRAL_S, 0.0, 300.0).assist == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("stop", ["request", "lead", "reading"])
def test_the_assist_makes_no_step_when_the_integral_starts_or_stops(stop: str) -> None:
    law, last = carrying(), 100.0
    for tick in range(3000):
        on = tick // 500 % 2 == 0
        wanted = 0.0 if stop == "request" and not on else 100.0
        measured = None if stop == "reading" and not on else -500.0
        law.advance(wanted, measured, DT, still=on or stop != "lead")
        assert abs(law.state.assist - last) <= (RATE_MAX + 700.0 / INTEGRAL_S) * DT + 1e-9
        last = law.state.assist


@pytest.mark.parametrize("roll", [-0.3, 0.0, 0.2])
@pytest.mark.parametrize("pitch", [-0.2, 0.0, 1.2])
def test_force_up_is_the_world_z_of_a_force_in_torso_axes(roll: float, pitch: float) -> None:
    R = oracle.rz(0.7) @ oracle.rx(roll) @ oracle.ry(pitch)
    force = np.random.default_rng(1).standard_normal(3)
    x, y, z = (R.T @ force).tolist()
    assert force_up((x, y, z), roll, pitch) == pytest.approx(force[2])


@pytest.mark.parametrize("share", [-1.01, -0.99, 0.0, 0.99, 1.01])
def test_still_is_within_both_rates(share: float) -> None:
    still = abs(share) < 1.0
    assert is_still(share * STILL_RATE_Z, 0.0) is still
    assert is_still(0.0, share * STILL_RATE_PITCH) is still


def easing_of(alpha: float, *hand: float | None) -> tuple[Kept, Pair]:
    """Return an easing that a hand has led for long enough, and what it adds."""
    easing = Kept(LeadEasing(alpha), EasingState())
    for _ in range(round(LEAD_FADE_S / DT) + 1):
        force, moment = easing.ease(*hand, DT)
    return easing, (force, moment)


@pytest.mark.parametrize(
    ("alpha", "up", "moment", "assist", "added"),
    [
        # only what exceeds the assist's load
        (0.5, -200.0, 0.0, 200.0, (0.0, 0.0)),
        (0.5, -180.0, 8.0, 200.0, (10.0, 4.0)),
        (0.0, 100.0, 50.0, 0.0, (0.0, 0.0)),
        # no more than a hand can do
        (0.5, 1e4, 1e4, 0.0, (0.5 * LEAD_MAX[0], 0.5 * LEAD_MAX[1])),
        (0.5, -1e4, -1e4, 0.0, (-0.5 * LEAD_MAX[0], -0.5 * LEAD_MAX[1])),
    ],
)
def test_only_what_a_hand_leads_with_is_amplified(
    alpha: float, up: float, moment: float, assist: float, added: Pair
) -> None:
    assert easing_of(alpha, up, moment, assist)[1] == pytest.approx(added)


def test_the_easing_fades_out_when_the_wrench_is_lost_and_in_when_it_is_back() -> None:
    easing, (last, _) = easing_of(0.5, 100.0, 0.0, 0.0)
    assert last == pytest.approx(50.0)
    for up in (None, 100.0):
        for _ in range(round(LEAD_FADE_S / DT)):
            force, _ = easing.ease(up, 0.0, 0.0, DT)
            assert abs(force - last) <= 50.0 * DT / LEAD_FADE_S + 1e-9
            last = force
        assert last == pytest.approx(0.0 if up is None else 50.0)


# ---- overload

AFTER, RELEASE = 100 * NS_PER_MS, 1000 * NS_PER_MS
LIMITS = {
    "overload_force": 500.0, "overload_moment": 100.0,
    "overload_after_ms": AFTER / NS_PER_MS, "overload_release_s": 1e-3 * RELEASE / NS_PER_MS,
}  # fmt: skip
T0 = 10**12
INVALID = wrench(valid=False)
both_kinds = pytest.mark.parametrize("kind", ["force", "moment"])


def at(share: float, kind: str = "force") -> Wrench:
    """Return a wrench at a share of one limit, in a slanted direction."""
    part = share / math.sqrt(3.0)
    if kind == "force":
        return wrench(force=(500.0 * part, -500.0 * part, 500.0 * part))
    return wrench(moment=(100.0 * part, 100.0 * part, -100.0 * part))


def held(*course: tuple[int, Wrench], holds: bool = False) -> list[bool]:
    """Return whether it holds after each reading; `holds`: a cell was saturated before."""
    overload = Kept(Overload(msgspec.structs.replace(ROBOT.harness, **LIMITS)), OverloadState())
    if holds:
        overload.receive(wrench(valid=False, saturated=True), T0)
    found = []
    for after_ns, reading in course:
        overload.receive(reading, T0 + after_ns)
        found.append(overload.state.hold)
    return found


@both_kinds
@pytest.mark.parametrize("share", [0.0, 0.5, 0.999, 1.001, 2.0])
@pytest.mark.parametrize("for_ns", [0, AFTER - 1, AFTER, 10 * AFTER])
def test_hold_is_asked_for_beyond_a_limit_in_time(kind: str, share: float, for_ns: int) -> None:
    course = [(t_ns, at(share, kind)) for t_ns in sorted({0, for_ns // 3, for_ns})]
    assert held(*course)[-1] is (share > 1.0 and for_ns >= AFTER)


def test_a_moment_below_the_limit_begins_the_time_anew() -> None:
    course = ((0, 1.1), (60, 1.1), (64, 0.99), (68, 1.1), (167, 1.1), (168, 1.1))
    assert held(*((ms * NS_PER_MS, at(share)) for ms, share in course)) == [*[False] * 5, True]


@pytest.mark.parametrize("valid", [True, False])
def test_a_saturated_cell_asks_for_hold_at_once(valid: bool) -> None:
    assert held((0, wrench(valid=valid, saturated=True))) == [True]


@both_kinds
@pytest.mark.parametrize("share", [0.0, RELEASE_FRACTION - 0.001, RELEASE_FRACTION + 0.001, 0.99])
@pytest.mark.parametrize("for_ns", [RELEASE - 1, RELEASE, 3 * RELEASE])
def test_hold_ends_below_the_lower_limit_for_its_time(kind: str, share: float, for_ns: int) -> None:
    ends = share < RELEASE_FRACTION and for_ns >= RELEASE
    assert held((0, at(share, kind)), (for_ns, at(share, kind)), holds=True)[-1] is not ends


def test_an_invalid_reading_holds_no_overload_off_and_begins_its_end_anew() -> None:
    now_and_then = [(t * NS_PER_MS, INVALID if t % 40 == 20 else at(1.1)) for t in range(0, 104, 4)]
    assert held(*now_and_then)[-1]
    course = ((0, wrench()), (RELEASE // 2, INVALID), (RELEASE, wrench()), (2 * RELEASE, wrench()))
    assert held(*course, holds=True) == [True, True, True, False]


def test_numbers_that_are_not_valid_neither_begin_nor_end_it() -> None:
    old = msgspec.structs.replace(at(2.0), valid=False)
    times = (0, AFTER, RELEASE, 10 * RELEASE)
    assert not any(held(*((t_ns, old) for t_ns in times)))
    assert all(held(*((t_ns, INVALID) for t_ns in times), holds=True))
