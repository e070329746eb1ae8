"""HOLD and DAMP while a knee may be limp: the module rises to all support gains, and stays."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.joint import pd_law
from services.joint.failsafe import Failsafe
from services.joint.neighbours import NeighbourView
from services.joint.setpoint_law import SetpointLaw
from shared.bus.messages import Mode, Pair
from shared.clock import NS_PER_MS
from shared.joints import MODULES, kind_of
from tests.joint.helpers import ROBOT, Bench

SOFT_P: Pair = (500.0, 12.0)

SOFT_D: Pair = (20.0, 0.8)

POSES = {"ankle": (0.02, 0.1), "knee": (0.02, -1.0), "hip": (0.02, 0.4)}

gain = st.floats(0.0, 3000.0)

damping = st.floats(0.0, 200.0)


def holding(module: str, k_p: Pair = SOFT_P, k_d: Pair = SOFT_D) -> Bench:
    """Bring a module from TRACK on these gains to HOLD, at its reference."""
    bench = Bench(ROBOT, module)
    bench.q = POSES[kind_of(module)]
    bench.to_track(q_ref=bench.q, k_p=k_p, k_d=k_d)
    bench.run(1, fresh=True, hold=True, q_ref=bench.q, k_p=k_p, k_d=k_d)
    assert bench.mode is Mode.HOLD
    return bench


def blended(bench: Bench) -> int:
    """Return how many cycles `stiffen_ms` takes."""
    return round(ROBOT.joint_service.stiffen_ms * NS_PER_MS / bench.cycle_ns)


def at_least(module: str, k_p: Pair, k_d: Pair) -> tuple[Pair, Pair]:
    support_p, support_d = ROBOT.support_gains(module)
    return (
        (max(k_p[0], support_p[0]), max(k_p[1], support_p[1])),
        (max(k_d[0], support_d[0]), max(k_d[1], support_d[1])),
    )


@pytest.mark.parametrize("module", MODULES)
def test_on_request_it_rises_to_its_support_gains(module: str) -> None:
    bench = holding(module)
    bench.run(2 * blended(bench), fresh=True, hold=True, k_p=SOFT_P, k_d=SOFT_D)
    plain = bench.controller.setpoint
    assert not bench.is_stiffened
    for _ in range(blended(bench) + 1):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        assert bench.is_stiffened
    stiffened = bench.controller.setpoint
    assert (stiffened.k_p, stiffened.k_d) == at_least(module, SOFT_P, SOFT_D)
    frozen = (plain.q_ref, plain.v_ref, plain.tau_ff, plain.tau_coupled)
    assert (stiffened.q_ref, stiffened.v_ref, stiffened.tau_ff, stiffened.tau_coupled) == frozen


@pytest.mark.parametrize("away", [0.05, 0.3, -0.3])
@pytest.mark.parametrize("at_once", [True, False], ids=["as it holds", "later"])
def test_a_hip_that_a_hand_has_turned_is_not_pulled_back_beyond_the_envelopes_bound(
    away: float, at_once: bool
) -> None:
    """At 0.3 rad the spring rose to 810 N m within the blend, against the person's hand."""
    bench = Bench(ROBOT, "hip_left")
    bench.q = POSES["hip"]
    sent = {
        "q_ref": bench.q, "k_p": (500.0, 26.0), "k_d": SOFT_D, "tau_coupled": (0.0, 30.0),
    }  # fmt: skip
    bench.to_track(**sent)
    for _ in range(100):
        bench.q = (bench.q[0], bench.q[1] + 0.01 * away)
        bench.run(1, fresh=True, **sent)
    assert bench.mode is Mode.TRACK
    bench.run(5 if at_once else 2 * blended(bench), fresh=True, **sent | {"hold": True})
    assert bench.mode is Mode.HOLD
    before = pd_law.torque(bench.controller.setpoint, bench.q, pd_law.ZERO)
    bench.run(1, fresh=True, hold=True, stiffen=True)
    after = pd_law.torque(bench.controller.setpoint, bench.q, pd_law.ZERO)
    assert after == pytest.approx(before, abs=4.0), "no step: the coupled torque fades by 3 a cycle"
    most = 0.0
    for _ in range(2 * blended(bench)):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        setpoint = bench.controller.setpoint
        most = max(most, abs(setpoint.k_p[1] * (setpoint.q_ref[1] - bench.q[1])))
    assert setpoint.k_p[1] >= ROBOT.support_gains("hip_left")[0][1]
    assert most <= ROBOT.envelope.hold_torque


@pytest.mark.parametrize("module", ["ankle_left", "knee_left", "hip_left"])
@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.DAMP])
def test_a_service_that_begins_beside_a_limp_module_begins_with_the_torque_it_takes_over(
    module: str, mode: Mode
) -> None:
    law, q, tau = SetpointLaw(ROBOT, module), POSES[kind_of(module)], (4.0, -30.0)
    law.start(mode, 1, pd_law.take_over(q, pd_law.ZERO, tau, SOFT_P, SOFT_D))
    found = law.evaluate(1, Failsafe(mode=mode), q, NeighbourView(stiffen=True))
    assert pd_law.torque(found, q, pd_law.ZERO) == pytest.approx(tau)


@settings(max_examples=25)
@given(st.sampled_from(MODULES), st.tuples(gain, gain), st.tuples(damping, damping))
def test_no_gain_is_ever_lowered_and_none_jumps(module: str, k_p: Pair, k_d: Pair) -> None:
    bench = holding(module, k_p, k_d)
    gains, cycles = ROBOT.support_gains(module), blended(bench)
    steps = [max(p, d) / cycles for p, d in zip(*gains, strict=True)]
    last = bench.controller.setpoint
    for _ in range(cycles + 5):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        now = bench.controller.setpoint
        for before, after in ((last.k_p, now.k_p), (last.k_d, now.k_d)):
            for i in (0, 1):  # HOLD's own rise comes on top
                assert before[i] - 1e-9 <= after[i] <= before[i] + 2.0 * steps[i] + 1e-9
        last = now
    wanted = at_least(module, k_p, k_d)
    assert last.k_p == pytest.approx(wanted[0])
    assert last.k_d == pytest.approx(wanted[1])


@pytest.mark.parametrize("after", ["told so no more", "told nothing"])
def test_it_stays_stiff_until_it_tracks_again(after: str) -> None:
    """A knee that a restarted service reports for a moment is not to loosen the other five."""
    bench, soft = holding("hip_right"), {"k_p": SOFT_P, "k_d": SOFT_D}
    bench.run(1, fresh=True, hold=True, stiffen=True)
    bench.run(500, fresh=after == "told so no more", hold=True)
    assert bench.is_stiffened
    assert bench.controller.setpoint.k_p == ROBOT.support_gains("hip_right")[0]
    bench.until(Mode.TRACK, lambda: bench.run(1, fresh=True, **soft))
    assert not bench.is_stiffened
    bench.run(400, fresh=True, **soft)
    assert bench.controller.setpoint.k_p == SOFT_P
    bench.run(1000)
    assert bench.mode is Mode.HOLD
    assert not bench.is_stiffened


@pytest.mark.parametrize("by_a_neighbour", [False, True])
def test_track_does_not_brace(by_a_neighbour: bool) -> None:
    """Its gains are certified together: the hold that comes with it is what braces."""
    bench = Bench(ROBOT, "hip_right")
    bench.q = POSES["hip"]
    sent = {"q_ref": bench.q, "k_p": SOFT_P, "k_d": SOFT_D}
    bench.to_track(**sent)
    before = bench.controller.setpoint
    for _ in range(100):
        told = bench.fresh(stiffen=not by_a_neighbour, **sent)
        bench.cycle(told, near=NeighbourView(stiffen=by_a_neighbour))
    assert bench.mode is Mode.TRACK
    assert not bench.is_stiffened
    assert bench.controller.setpoint == before
    bench.run(1, fresh=True, hold=True, stiffen=True, **sent)
    assert bench.is_stiffened


def test_stiffening_and_tracking_again_is_without_a_step() -> None:
    """With the joint off its reference, where a gain is a torque."""
    bench = holding("hip_right")
    bench.move((bench.q[0] + 0.02, bench.q[1] - 0.05))
    off = {"q_ref": (bench.q[0], bench.q[1] + 0.03), "k_p": SOFT_P, "k_d": SOFT_D}
    bench.run(blended(bench), fresh=True, hold=True, **off)
    last, largest = bench.controller.tau, 0.0
    for told in ({"hold": True, "stiffen": True}, {}):
        for _ in range(2 * blended(bench)):
            bench.run(1, fresh=True, **(off | told))
            tau = bench.controller.tau
            largest = max(largest, *(abs(b - a) for a, b in zip(last, tau, strict=True)))
            last = tau
    assert bench.mode is Mode.TRACK
    whole = ROBOT.support_gains("hip_right")[0][1] * 0.05
    assert largest < 3.0 * whole / blended(bench), "a share of it in each cycle"


@pytest.mark.parametrize("module", ["ankle_left", "knee_right", "hip_right"])
def test_stiffened_it_goes_on_holding_when_stopped(module: str) -> None:
    """Its planner has told it of a limp knee, which may be on another host."""
    bench = holding(module)
    bench.run(300, fresh=True, hold=True, stiffen=True)
    bench.cycle(bench.fresh(hold=True, stiffen=True), estop=True)
    bench.run(2 * blended(bench))
    assert (bench.mode, bench.is_stiffened) == (Mode.DAMP, True)
    assert bench.controller.setpoint.k_p == pytest.approx(ROBOT.support_gains(module)[0])


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.DAMP])
@pytest.mark.parametrize("module", ["ankle_left", "knee_right", "hip_right"])
def test_a_limp_neighbour_braces_it_alone(module: str, mode: Mode) -> None:
    """Once is enough: its row may be lost with its service."""
    bench = holding(module)
    bench.cycle(estop=mode is Mode.DAMP)
    bench.run(10)
    assert not bench.is_stiffened
    bench.cycle(near=NeighbourView(stiffen=True))
    bench.run(2 * blended(bench))
    assert (bench.mode, bench.is_stiffened) == (mode, True)
    k_p, k_d = at_least(module, (0.0, 0.0), (0.0, 0.0))
    assert bench.controller.setpoint.k_p == pytest.approx(k_p)
    assert bench.controller.setpoint.k_d == pytest.approx(k_d)
