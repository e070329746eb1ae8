"""HOLD and DAMP while a knee may be limp: the module rises to all support gains, and stays."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.joint import pd_law
from services.joint.failsafe import Failsafe
from services.joint.neighbours import UNKNOWN, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.setpoint_law import SetpointLaw
from services.joint.sinking import DOUBT_NS, LEVEL_MAX, Sinking, SinkingState
from shared.bus.messages import Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, kind_of
from tests.joint.helpers import FULL, ROBOT, Bench

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
    """Of these only a hip's theta is stiffer than in a stand."""
    stand, (k_p, k_d) = ROBOT.stand_gains(module), ROBOT.support_gains(module)
    assert (stand.k_p[0], stand.k_d[0]) == (k_p[0], k_d[0])
    if kind_of(module) == "hip":
        assert (k_p[1] >= 2.0 * stand.k_p[1], k_d[1] > stand.k_d[1]) == (True, True)
    else:
        assert (stand.k_p, stand.k_d) == (k_p, k_d)
    bench = holding(module)
    bench.run(2 * blended(bench), fresh=True, hold=True, k_p=SOFT_P, k_d=SOFT_D)
    plain = bench.controller.law.current
    assert not bench.is_stiffened
    for _ in range(blended(bench) + 1):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        assert bench.is_stiffened
    k_p, k_d = at_least(module, SOFT_P, SOFT_D)
    assert bench.controller.law.current == msgspec.structs.replace(plain, k_p=k_p, k_d=k_d)


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
    before = pd_law.torque(bench.controller.law.current, bench.q, pd_law.ZERO)
    bench.run(1, fresh=True, hold=True, stiffen=True)
    after = pd_law.torque(bench.controller.law.current, bench.q, pd_law.ZERO)
    assert after == pytest.approx(before, abs=4.0), "no step: the coupled torque fades by 3 a cycle"
    most = 0.0
    for _ in range(2 * blended(bench)):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        setpoint = bench.controller.law.current
        most = max(most, abs(setpoint.k_p[1] * (setpoint.q_ref[1] - bench.q[1])))
    assert setpoint.k_p[1] >= ROBOT.support_gains("hip_left")[0][1]
    assert most <= ROBOT.envelope.hold_torque


@pytest.mark.parametrize("module", ["ankle_left", "knee_left", "hip_left"])
@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.DAMP])
def test_a_service_that_begins_beside_a_limp_module_begins_with_the_torque_it_takes_over(
    module: str, mode: Mode
) -> None:
    law, q, tau = SetpointLaw(ROBOT, module), POSES[kind_of(module)], (4.0, -30.0)
    state = law.at_rest()
    law.start(state, mode, 1, pd_law.take_over(q, pd_law.ZERO, tau, SOFT_P, SOFT_D))
    found = law.evaluate(state, 1, Failsafe(mode=mode), q, NeighbourView(stiffen=True))
    assert pd_law.torque(found, q, pd_law.ZERO) == pytest.approx(tau)


@settings(max_examples=25)
@given(st.sampled_from(MODULES), st.tuples(gain, gain), st.tuples(damping, damping))
def test_no_gain_is_ever_lowered_and_none_jumps(module: str, k_p: Pair, k_d: Pair) -> None:
    bench = holding(module, k_p, k_d)
    gains, cycles = ROBOT.support_gains(module), blended(bench)
    steps = [max(p, d) / cycles for p, d in zip(*gains, strict=True)]
    last = bench.controller.law.current
    for _ in range(cycles + 5):
        bench.run(1, fresh=True, hold=True, stiffen=True)
        now = bench.controller.law.current
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
    assert bench.controller.law.current.k_p == ROBOT.support_gains("hip_right")[0]
    bench.until(Mode.TRACK, lambda: bench.run(1, fresh=True, **soft))
    assert not bench.is_stiffened
    bench.run(400, fresh=True, **soft)
    assert bench.controller.law.current.k_p == SOFT_P
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
    before = bench.controller.law.current
    for _ in range(100):
        told = bench.fresh(stiffen=not by_a_neighbour, **sent)
        bench.cycle(told, near=NeighbourView(stiffen=by_a_neighbour))
    assert bench.mode is Mode.TRACK
    assert not bench.is_stiffened
    assert bench.controller.law.current == before
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
    assert bench.controller.law.current.k_p == pytest.approx(ROBOT.support_gains(module)[0])


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
    assert bench.controller.law.stays is (mode is Mode.DAMP), "no longer sinks: the knees are told"
    k_p, k_d = at_least(module, (0.0, 0.0), (0.0, 0.0))
    assert bench.controller.law.current.k_p == pytest.approx(k_p)
    assert bench.controller.law.current.k_d == pytest.approx(k_d)


# ---- how one module sinks after an emergency stop

Q: Pair = (0.02, -0.4)

LONG_NS = 10 * NS_PER_S
"""All has faded and risen by then."""

UNHEARD = NeighbourView(sinks=False)


class Begun:
    """A module's sinking with its state."""

    def __init__(self, robot: RobotConfig, module: str) -> None:
        self._sinking = Sinking(robot, module)
        self.state = self._sinking.start()

    def begin(self, setpoint: Setpoint, q: Pair) -> Setpoint:
        return self._sinking.begin(self.state, setpoint, q)

    def law(self, *given: Any) -> Setpoint:
        return self._sinking.law(self.state, *given)


def begun(robot: RobotConfig, module: str, q: Pair = Q) -> tuple[Begun, Setpoint]:
    sinking = Begun(robot, module)
    return sinking, sinking.begin(FULL, q)


def test_a_hip_holds_the_torso_while_its_leg_folds_as_softly_as_its_stiffness_has_risen() -> None:
    sinking, frozen = begun(ROBOT, "hip_right")
    most = ROBOT.stand_gains("hip_right").k_p[1]
    for share in (0.0, 0.25, 1.0):
        since_ns = round(share * ROBOT.joint_service.blend_ms * 1e6)
        found = sinking.law(frozen, frozen, since_ns, Q, NeighbourView((0.3, 0.05)))
        assert found.k_p[1] == pytest.approx(share * most)
    assert sinking.state.upright == pytest.approx(0.3 - 0.4)
    for theta in (-0.4, -0.45, -0.35):
        found = sinking.law(frozen, frozen, LONG_NS, (0.02, theta), NeighbourView((0.32, 0.07)))
        assert found.q_ref == pytest.approx((0.1, -0.42)), "0.02 rad farther back than it stood"
        assert found.v_ref == pytest.approx((0.0, -0.07))
        assert found.k_p[1] == most
    for below, clipped in ((0.9, -0.4 - LEVEL_MAX), (-0.9, -0.4 + LEVEL_MAX)):
        found = sinking.law(frozen, frozen, LONG_NS, Q, NeighbourView((below, 0.0)))
        assert found.q_ref[1] == pytest.approx(clipped), "a torso far off returns gently"


def test_a_hip_that_never_received_its_legs_states_damps_and_a_leg_fallen_silent_stays() -> None:
    sinking, frozen = begun(ROBOT, "hip_right")
    found = sinking.law(frozen, frozen, LONG_NS, Q, UNKNOWN)
    assert (found.k_p[1], found.tau_ff[1]) == (0.0, 0.0)
    assert found.k_d[1] == ROBOT.joint_service.damp_k_d
    assert sinking.state.upright is None
    sinking, frozen = begun(ROBOT, "hip_right")
    for since_ns, leg in ((0, 0.3), (1, 0.35)):
        sinking.law(frozen, frozen, since_ns, Q, NeighbourView((leg, 0.05)))
    found = sinking.law(frozen, frozen, LONG_NS, Q, UNKNOWN)
    assert (found.q_ref[1], found.v_ref[1]) == (pytest.approx(-0.45), 0.0)


def hip_ahead(ankle: float, knee: float) -> float:
    """Return how far ahead of its ankle a leg's hip joint is, m."""
    return ROBOT.geometry.l2 * math.sin(ankle) + ROBOT.geometry.l1 * math.sin(ankle + knee)


@pytest.mark.parametrize("ankle", [0.03, 0.14, 0.3])
@pytest.mark.parametrize("knee", [-0.2, -0.37, -1.0, -2.0])
def test_an_ankle_keeps_the_hip_where_it_was(ankle: float, knee: float) -> None:
    """Held stiffly, it let the robot fall over backwards from nearly straight legs."""
    sinking, frozen = begun(ROBOT, "ankle_left", (0.02, ankle))
    first = sinking.law(frozen, frozen, LONG_NS, (0.02, ankle), NeighbourView((knee, -0.3)))
    assert first.q_ref[1] == pytest.approx(frozen.q_ref[1]), "its spring goes on carrying its load"
    spring = frozen.q_ref[1] - ankle
    for turned in (-0.001, -0.05, -0.2, -0.4):
        near = NeighbourView((knee + turned, -0.3))
        found = sinking.law(frozen, frozen, LONG_NS, (0.02, ankle), near)
        place = found.q_ref[1] - spring
        assert hip_ahead(place, knee + turned) == pytest.approx(hip_ahead(ankle, knee))
        if turned == -0.001:
            assert found.v_ref[1] == pytest.approx(0.3 * (place - ankle) / 0.001, rel=5e-3)
        assert (found.k_p, found.tau_ff) == (first.k_p, first.tau_ff)


def test_an_ankle_that_does_not_see_its_knee_stays_where_it_was_and_within_its_limits() -> None:
    """The hip may be farther ahead than a leg that has folded since can bring it."""
    sinking, frozen = begun(ROBOT, "ankle_left", (0.02, 0.14))
    low, high = ROBOT.limits.ankle.theta
    unseen = sinking.law(frozen, frozen, LONG_NS, (0.02, 0.14), UNKNOWN)
    assert unseen.q_ref == frozen.q_ref
    for knee in (-0.4, -2.9, 50.0, -1e6, math.inf, -math.inf):
        seen = sinking.law(frozen, frozen, LONG_NS, (0.02, 0.14), NeighbourView((knee, 1.0)))
        assert low <= seen.q_ref[1] - frozen.q_ref[1] + 0.14 <= high
        lost = sinking.law(frozen, frozen, LONG_NS, (0.02, 0.14), UNKNOWN)
        assert (lost.q_ref, lost.v_ref[1]) == (seen.q_ref, 0.0)
    sinking, frozen = begun(ROBOT, "ankle_left", (0.02, 0.9))
    sinking.law(frozen, frozen, LONG_NS, (0.02, 0.9), NeighbourView((0.0, 0.0)))
    assert sinking.state.ahead is not None
    assert sinking.state.ahead > 0.8
    found = sinking.law(frozen, frozen, LONG_NS, (0.02, 0.9), NeighbourView((-3.0, 0.0)))
    assert low <= found.q_ref[1] - frozen.q_ref[1] + 0.9 <= max(high, 0.9)


def test_a_leg_of_equal_links_that_folds_onto_itself_divides_by_nothing() -> None:
    alike = msgspec.structs.replace(ROBOT.geometry, l1=ROBOT.geometry.l2)
    sinking, frozen = begun(msgspec.structs.replace(ROBOT, geometry=alike), "ankle_left")
    for knee in (-math.pi, -3.0):
        found = sinking.law(frozen, frozen, LONG_NS, Q, NeighbourView((knee, 1.0)))
        assert all(map(math.isfinite, (*found.q_ref, *found.v_ref)))
        assert (found.v_ref[1] == 0.0) is (knee == -math.pi), "from a hip so low no rate follows"


BELOW_ITS_STOP = -2.6
"""rad, of a knee."""

PLACES = {
    "ankle": ("ankle_right", -0.4, UNKNOWN),
    "an ankle that follows its knee": ("ankle_right", 0.2, NeighbourView((-1.0, -0.2))),
    "a knee that sinks": ("knee_right", -0.4, UNKNOWN),
    "a knee at its stop": ("knee_right", BELOW_ITS_STOP, UNKNOWN),
    "a knee that was caught": ("knee_right", -0.5, UNHEARD),
    "a hip that damps": ("hip_right", -0.4, UNKNOWN),
    "a hip that levels": ("hip_right", -0.45, NeighbourView((0.3, 0.2))),
}
"""A module on its way down: its theta, rad, and what it knows of its leg."""


@pytest.mark.parametrize("when", [0.5, 2.0], ids=["while it fades", "when all has faded"])
@pytest.mark.parametrize("place", PLACES)
def test_for_a_limp_module_it_holds_its_load(place: str, when: float) -> None:
    """From then on, whatever it is told: a robot under load never softens by itself."""
    module, theta, near = PLACES[place]
    sinking, frozen = begun(ROBOT, module)
    now_ns = round(when * ROBOT.joint_service.damp_fade_s * NS_PER_S)
    rise_ns = round(ROBOT.joint_service.stiffen_ms * 1e6)
    q = (0.02, theta)
    before = frozen
    for since_ns, at in ((0, Q), (DOUBT_NS, Q), (now_ns, q)):
        before = sinking.law(frozen, before, since_ns, at, near)
    limp = near._replace(stiffen=True)
    current = sinking.law(frozen, before, now_ns, q, limp)
    load = pd_law.torque(before, q, pd_law.ZERO)
    assert pd_law.torque(current, q, pd_law.ZERO) == pytest.approx(load)
    assert (current.k_p, current.k_d) == (before.k_p, before.k_d)
    k_p, k_d = ROBOT.support_gains(module)
    half_way = sinking.law(frozen, current, now_ns + rise_ns // 2, q, limp)
    assert half_way.k_p[1] == pytest.approx(0.5 * (before.k_p[1] + k_p[1]))
    for later_ns in (rise_ns, LONG_NS):
        found = sinking.law(frozen, half_way, now_ns + later_ns, Q, UNKNOWN)
        holds = module.startswith("ankle")
        assert found.q_ref == (before.q_ref[0], before.q_ref[1] if holds else theta)
        assert found.v_ref == found.tau_coupled == pd_law.ZERO
        assert (found.k_p, found.k_d) == (k_p, k_d)
        if not holds:
            spring = before.k_p[1] * (before.q_ref[1] - theta)
            assert found.tau_ff[1] == pytest.approx(before.tau_ff[1] + spring)


def test_rates_and_coupling_fade_in_a_module_that_stiffens() -> None:
    sinking, frozen = begun(ROBOT, "knee_right")
    limp = NeighbourView(stiffen=True)
    ramp_ns = round(ROBOT.joint_service.coupled_ramp_ms * 1e6)
    rise_ns = round(ROBOT.joint_service.stiffen_ms * 1e6)
    sinking.law(frozen, FULL, 0, Q, limp)
    for part in (0.0, 0.5, 1.0):
        found = sinking.law(frozen, FULL, round(part * ramp_ns), Q, limp)
        left = (1.0 - part) * (1.0 - part * ramp_ns / rise_ns)
        assert found.tau_coupled == pytest.approx((5.0 * left, -6.0 * left))
    assert found.v_ref == pd_law.ZERO


def test_a_reason_that_passes_is_none() -> None:
    sinking, frozen = begun(ROBOT, "knee_right")
    for since_ns, near, caught in (
        (0, UNHEARD, False),
        (DOUBT_NS - 1, UNKNOWN, False),
        (DOUBT_NS, UNHEARD, False),
        (2 * DOUBT_NS - 1, UNHEARD, False),
        (2 * DOUBT_NS, UNHEARD, True),
    ):
        sinking.law(frozen, frozen, since_ns, Q, near)
        assert sinking.state.caught is caught
        assert (sinking.state.doubt_ns == -1) is (near is UNKNOWN)


def test_a_knee_beside_one_that_does_not_sink_is_caught_where_it_is_and_nothing_else_is() -> None:
    sinking, frozen = begun(ROBOT, "knee_left", (0.02, -1.0))
    stand = ROBOT.stand_gains("knee_left")
    assert sinking.law(frozen, frozen, 0, (0.02, -1.1), UNHEARD).k_p[1] == 0.0
    found = sinking.law(frozen, frozen, DOUBT_NS, (0.02, -1.2), UNHEARD)
    assert sinking.state.stop == -1.2
    assert found.k_p[1] == 0.0, "at its stop nothing is sprung yet"
    found = sinking.law(frozen, frozen, LONG_NS, (0.02, -1.25), UNHEARD)
    assert (found.q_ref[1], found.k_p[1], found.k_d[1]) == (-1.2, stand.k_p[1], stand.k_d[1])
    assert sinking.state.stop == -1.2, "where it was caught it stays"
    below, stop = ROBOT.joint_service.damp_knee_stop - 0.1, ROBOT.joint_service.damp_knee_stop
    for module, caught_at in (("knee_left", stop), ("ankle_right", None), ("hip_right", None)):
        sinking, frozen = begun(ROBOT, module, (0.02, -1.0))
        for since_ns in (0, DOUBT_NS):
            sinking.law(frozen, frozen, since_ns, (0.02, below), UNHEARD)
        assert (sinking.state.caught, sinking.state.stop) == (caught_at is not None, caught_at)


def test_a_second_stop_begins_anew() -> None:
    sinking, frozen = begun(ROBOT, "hip_right")
    sinking.law(frozen, frozen, DOUBT_NS, Q, NeighbourView((0.3, 0.2), stiffen=True))
    assert sinking.state.held_ns == DOUBT_NS
    knee, frozen = begun(ROBOT, "knee_right", (0.0, -1.0))
    for since_ns in (0, DOUBT_NS):
        knee.law(frozen, frozen, since_ns, Q, UNHEARD)
    for each in (sinking, knee):
        each.begin(FULL, Q)
        assert msgspec.structs.replace(each.state, stop=None) == SinkingState(doubt_ns=-1)


def test_what_sinks_lets_go_of_its_feedforward_and_holds_the_rest() -> None:
    service = ROBOT.joint_service
    sinking, frozen = begun(ROBOT, "knee_right")
    assert frozen == pd_law.load_to_feedforward(FULL, (False, True), Q)
    half_ns = round(0.5 * service.damp_fade_s * NS_PER_S)
    found = sinking.law(frozen, frozen, half_ns, Q, UNKNOWN)
    stand = ROBOT.stand_gains("knee_right")
    assert found.tau_ff == pytest.approx((3.0, 0.5 * frozen.tau_ff[1]))
    assert found.k_p == pytest.approx((100.0 + 0.5 * (stand.k_p[0] - 100.0), 0.0))
    assert found.k_d[1] == service.damp_k_d
    early = sinking.law(frozen, frozen, round(0.5 * service.blend_ms * NS_PER_MS), Q, UNKNOWN)
    assert early.k_d[1] == pytest.approx(0.5 * (frozen.k_d[1] + service.damp_k_d))
    assert found.v_ref == found.tau_coupled == (0.0, 0.0)
