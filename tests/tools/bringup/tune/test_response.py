"""What is told of an answer, on systems whose every number is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from shared.arrays import Array
from tools.bringup.tune.excitation import FREQUENCIES_HZ, Excitation, excitation
from tools.bringup.tune.response import ResponseFit, SecondOrder, answer_of, propose

DT = 0.004


def offsets(plan: Excitation) -> tuple[Array, Array]:
    """Return times and offsets of an excitation."""
    t = DT * np.arange(round(plan.duration_s / DT))
    return t, np.array([plan.offset(float(one)) for one in t])


def answered(
    model: SecondOrder, plan: Excitation, *, delay_s: float = 0.0, noise: float = 0.0
) -> ResponseFit | None:
    """Return what is told of a system that answers late, by the exact solution."""
    t, r = offsets(plan)
    late = np.concatenate([np.zeros(round(delay_s / DT)), r])[: len(t)]
    _, y, _ = signal.lsim(([model.b_0], [1.0, model.a_1, model.a_0]), late, t, interp=False)
    y = y + noise * np.random.default_rng(1).standard_normal(len(t))
    return answer_of(t, r, y, plan)


@pytest.mark.parametrize(("omega", "zeta"), [(6.0, 0.4), (4.0, 0.7), (9.0, 1.0)])
def test_natural_frequency_and_damping_ratio_are_found(omega: float, zeta: float) -> None:
    model = SecondOrder(0.9 * omega**2, 2.0 * zeta * omega, omega**2)
    answer = answered(model, excitation(0.01), noise=2e-5)
    assert answer is not None
    assert answer.is_second_order
    assert answer.model.natural_frequency == pytest.approx(omega, rel=0.05)
    assert answer.model.damping_ratio == pytest.approx(zeta, rel=0.1)
    assert answer.step.final == pytest.approx(0.9, abs=0.01)
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)) if zeta < 1.0 else 0.0
    assert answer.step.overshoot == pytest.approx(overshoot, abs=0.03)


def test_rise_and_settling_of_a_critically_damped_step_are_the_textbooks() -> None:
    answer = answered(SecondOrder(36.0, 12.0, 36.0), excitation(0.01))
    assert answer is not None
    assert answer.step.rise_s == pytest.approx(3.36 / 6.0, rel=0.05)
    assert answer.step.settling_s == pytest.approx(4.74 / 6.0, rel=0.05)


def margin_of(K: float, B: float, M: float, K_geo: float) -> float:
    """Return the phase margin of L = (K + B s) / (M s^2 + K_geo), degrees."""
    omega = np.geomspace(1.0, 100.0, 200_000)
    L = (K + 1j * B * omega) / (K_geo - M * omega**2)
    crossing = omega[np.argmin(np.abs(np.log(np.abs(L))))]
    at = (K + 1j * B * crossing) / (K_geo - M * crossing**2)
    angle = math.degrees(math.atan2(at.imag, at.real)) + 180.0
    return float((angle + 180.0) % 360.0 - 180.0)


def test_the_phase_margin_is_that_of_the_loop_cut_at_its_torque() -> None:
    K, B, M, K_geo = 2810.0, 300.0, 60.0, -500.0
    answer = answered(SecondOrder(K / M, B / M, (K + K_geo) / M), excitation(0.01))
    assert answer is not None
    assert answer.phase_margin_deg == pytest.approx(margin_of(K, B, M, K_geo), abs=6.0)


def test_a_late_answer_has_less_margin() -> None:
    margins = []
    for delay_s in (0.0, 0.04):
        answer = answered(SecondOrder(36.0, 5.0, 36.0), excitation(0.01), delay_s=delay_s)
        assert answer is not None
        margins.append(answer.phase_margin_deg)
    assert margins[1] < margins[0] - 5.0


def test_no_answer_is_said_to_be_none() -> None:
    assert answered(SecondOrder(0.5, 5.0, 36.0), excitation(0.01), noise=1e-5) is None


def test_what_is_no_second_order_system_is_said_to_be_none() -> None:
    plan = excitation(0.01)
    t, r = offsets(plan)
    y = 0.8 * r  # a motor that moves within its play
    y += 0.5 * 0.01 * np.sign(np.sin(37.0 * t))
    answer = answer_of(t, r, np.roll(y, 60), plan)
    assert answer is None or not answer.is_second_order


def test_proposed_gains_make_the_wanted_answer() -> None:
    K, B, M, K_geo = 2810.0, 300.0, 60.0, -500.0
    measured = SecondOrder(K / M, B / M, (K + K_geo) / M)
    K_p, B_p = propose(measured, (K, B), M, bandwidth=8.0, damping_ratio=0.6)
    after = SecondOrder(K_p / M, B_p / M, (K_p + K_geo) / M)
    assert after.natural_frequency == pytest.approx(8.0)
    assert after.damping_ratio == pytest.approx(0.6)
    stiff = SecondOrder(K / M, B / M, (K + 9000.0) / M)
    soft, _ = propose(stiff, (K, B), M, bandwidth=0.1, damping_ratio=0.1)
    assert soft < 0.0, "there is none"


def test_the_excitation_is_as_large_as_asked_and_returns() -> None:
    plan = excitation(0.01, scale=2.0)
    t = np.linspace(0.0, plan.duration_s, 20_001)
    values = np.array([plan.offset(float(one)) for one in t])
    assert np.abs(values).max() == pytest.approx(0.01, rel=1e-3)
    assert (values[0], values[-1]) == (0.0, 0.0)
    assert [sine.frequency_hz for sine in plan.sines] == [2.0 * hz for hz in FREQUENCIES_HZ]
