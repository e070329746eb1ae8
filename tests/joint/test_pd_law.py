"""The algebra of setpoints: blended, raised, frozen, damped and caught."""

from __future__ import annotations

from itertools import product

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.joint import pd_law
from services.joint.pd_law import Setpoint
from shared.bus.messages import Pair
from tests.joint.helpers import FULL

shares = st.floats(0.0, 1.0)

gains = st.just(0.0) | st.floats(1e-3, 6000.0)


def pairs(elements: st.SearchStrategy[float]) -> st.SearchStrategy[Pair]:
    return st.tuples(elements, elements)


angles = pairs(st.floats(-6.0, 6.0))

rates = pairs(st.floats(-20.0, 20.0))

torques = pairs(st.floats(-200.0, 200.0))

setpoints = st.builds(Setpoint, angles, rates, torques, torques, pairs(gains), pairs(gains))

SOFT = Setpoint((0.1, -1.0), (0.2, -0.4), (3.0, -20.0), (5.0, -6.0), (100.0, 0.0), (10.0, 0.0))
SLACK = msgspec.structs.replace(SOFT, k_p=(0.5, 0.4), k_d=(0.3, 0.2))
OFF = msgspec.structs.replace(SLACK, q_ref=(0.7, 0.8), v_ref=(-0.6, 0.5))


@given(s=setpoints, q=angles, v=rates)
def test_torque_is_pd_plus_feedforward_plus_coupled(s: Setpoint, q: Pair, v: Pair) -> None:
    k_p, k_d = np.diag(s.k_p), np.diag(s.k_d)
    expected = k_p @ np.subtract(s.q_ref, q) + k_d @ np.subtract(s.v_ref, v)
    expected += np.add(s.tau_ff, s.tau_coupled)
    np.testing.assert_allclose(pd_law.torque(s, q, v), expected, rtol=1e-12, atol=1e-9)


@given(a=setpoints, b=setpoints, share=shares, q=angles, v=rates)
@example(a=SOFT, b=SOFT, share=0.5, q=(0.0, 0.0), v=(0.0, 0.0))
@example(a=SLACK, b=OFF, share=0.5, q=(0.0, 0.0), v=(0.0, 0.0))
def test_blend_of_two_laws_gives_the_blended_torque_everywhere_and_no_negative_gain(
    a: Setpoint, b: Setpoint, share: float, q: Pair, v: Pair
) -> None:
    """With no gain at all it goes to the later reference."""
    blended = pd_law.blend(a, b, share)
    apart = np.array([pd_law.torque(a, q, v), pd_law.torque(b, q, v)])
    together = [1.0 - share, share] @ apart
    np.testing.assert_allclose(pd_law.torque(blended, q, v), together, rtol=1e-9, atol=1e-6)
    assert min(*blended.k_p, *blended.k_d) >= 0.0
    limp, later = (msgspec.structs.replace(x, k_p=(0.0, 0.0), k_d=(0.0, 0.0)) for x in (a, b))
    blended = pd_law.blend(limp, later, 0.5)
    assert (blended.q_ref, blended.v_ref) == (later.q_ref, later.v_ref)


@given(s=setpoints, k_p=pairs(gains), k_d=pairs(gains), share=shares)
def test_raising_never_lowers_a_gain_and_fully_it_has_the_gains_asked_for(
    s: Setpoint, k_p: Pair, k_d: Pair, share: float
) -> None:
    risen, full = (pd_law.raise_gains(s, k_p, k_d, part) for part in (share, 1.0))
    assert np.all(np.subtract(risen.k_p, s.k_p) >= 0.0)
    assert np.all(np.subtract(risen.k_d, s.k_d) >= 0.0)
    changed = msgspec.structs.replace(s, k_p=risen.k_p, k_d=risen.k_d)
    assert risen == changed, "only gains are changed"
    np.testing.assert_allclose(full.k_p, np.maximum(s.k_p, k_p), rtol=1e-12)
    np.testing.assert_allclose(full.k_d, np.maximum(s.k_d, k_d), rtol=1e-12)


@given(s=setpoints, share=shares)
@example(s=SOFT, share=0.0)
@example(s=SOFT, share=-0.1)
def test_held_keeps_all_but_rates_and_coupled_torque_which_fade(s: Setpoint, share: float) -> None:
    kept, left = pd_law.freeze(s, share), max(0.0, share)
    assert (kept.q_ref, kept.tau_ff, kept.k_p, kept.k_d) == (s.q_ref, s.tau_ff, s.k_p, s.k_d)
    np.testing.assert_allclose(kept.v_ref, left * np.array(s.v_ref), rtol=1e-12)
    np.testing.assert_allclose(kept.tau_coupled, left * np.array(s.tau_coupled), rtol=1e-12)


@given(s=setpoints, share=shares, q=angles, v=rates)
def test_damped_only_feedforward_is_left_and_axes_that_do_not_sink_hold_on(
    s: Setpoint, share: float, q: Pair, v: Pair
) -> None:
    expected = share * np.array(s.tau_ff) - 60.0 * np.array(v)
    frozen = pd_law.freeze(s, 0.0)
    damped = pd_law.damp(frozen, (True, True), 60.0, share, 1.0)
    np.testing.assert_allclose(pd_law.torque(damped, q, v), expected, rtol=1e-12, atol=1e-9)
    for sinks, axis in (((False, True), 0), ((True, False), 1)):
        damped = pd_law.damp(frozen, sinks, 60.0, share, 1.0)
        assert pd_law.torque(damped, q, v)[axis] == pd_law.torque(frozen, q, v)[axis]


@given(s=setpoints, q=angles, v=rates, k_d=gains)
def test_damping_begins_with_the_torque_before(s: Setpoint, q: Pair, v: Pair, k_d: float) -> None:
    both = (True, True)
    begun = pd_law.torque(
        pd_law.damp(pd_law.load_to_feedforward(s, both, q), both, k_d, 1.0, 0.0), q, v
    )
    np.testing.assert_allclose(begun, pd_law.torque(s, q, v), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("away_phi", [-0.126, -0.125, 0.0, 0.125, 0.126])
@pytest.mark.parametrize("away_theta", [-0.063, -0.0625, 0.0, 0.0625, 0.063])
def test_too_far_for_a_stiffer_spring_it_holds_here(away_phi: float, away_theta: float) -> None:
    """50 N m more are allowed: phi rises by 400 N m/rad, theta by 800."""
    s = msgspec.structs.replace(FULL, q_ref=(0.25, -1.0))
    q = (0.25 - away_phi, -1.0 - away_theta)
    near = pd_law.limit_stiffening(s, q, (500.0, 1600.0), 50.0)
    far = abs(away_phi) > 0.1255, abs(away_theta) > 0.06275
    carried = (3.0 + 100.0 * (0.25 - q[0]), -20.0 + 800.0 * (-1.0 - q[1]))
    expected = msgspec.structs.replace(
        s,
        q_ref=(q[0] if far[0] else 0.25, q[1] if far[1] else -1.0),
        tau_ff=(carried[0] if far[0] else 3.0, carried[1] if far[1] else -20.0),
    )
    assert near == expected
    np.testing.assert_allclose(
        pd_law.torque(near, q, (0, 0)), pd_law.torque(s, q, (0, 0)), rtol=1e-12
    )


def test_each_axis_that_is_to_sink_carries_its_own_load_on() -> None:
    """And a theta that is levelled or caught leaves phi as it was."""
    for sinks in product((False, True), repeat=2):
        tau_ff = (3.0 - 20.0 * sinks[0], -20.0 + 400.0 * sinks[1])
        carried = pd_law.load_to_feedforward(FULL, sinks, (0.3, -1.5))
        assert carried == msgspec.structs.replace(FULL, tau_ff=pytest.approx(tau_ff))
    assert pd_law.hold_theta(FULL, -0.7, 0.3, 900.0, 60.0) == Setpoint(
        (0.1, -0.7), (0.2, 0.3), FULL.tau_ff, FULL.tau_coupled, (100.0, 900.0), (10.0, 60.0)
    )
