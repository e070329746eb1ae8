"""The envelope: each bound from both sides, and what a service makes of it in its whole cycle."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from services.joint import pd_law
from services.joint.controller import JointController
from services.joint.envelope import ASTRAY_S, ENERGY_S, ROUNDING, Envelope, Lately
from services.joint.failsafe import Event, Failsafe, timing_of
from shared.bus.messages import JointCommand, Mode, Outside, Pair, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import files as config_file
from shared.config.gain_schedule import believing
from shared.config.gain_table import Bounds, ModuleBounds
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of
from tests.conftest import ROBOT_FILE
from tests.joint.helpers import SESSION, T0, Bench, command
from tests.robots import ROBOT

Q: Pair = (0.02, -1.0)
V: Pair = (0.01, -0.2)
MODULE, ANKLE = "knee_right", "ankle_left"
NOTHING = Outside.NOTHING
BLEND_CYCLES = 150
"""300 ms at 500 Hz."""


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    """Return the shipped robot."""
    return config_file.load(ROBOT_FILE)


@pytest.fixture
def knee() -> Envelope:
    return Envelope(ROBOT, MODULE)


def bounds_of(robot: RobotConfig, module: str = MODULE) -> ModuleBounds:
    assert robot.gain_schedule is not None
    assert robot.gain_schedule.bounds is not None
    return robot.gain_schedule.bounds[kind_of(module)]


def tau_ff_at(bounds: ModuleBounds, theta: float) -> Bounds:
    """Return the row of the part in which theta lies, the first or last beyond the ends."""
    edges = np.linspace(*bounds.theta, len(bounds.tau_ff) + 1)
    return bounds.tau_ff[int(np.clip(np.searchsorted(edges, theta) - 1, 0, len(edges) - 2))]


def middle(robot: RobotConfig, module: str = MODULE, **changes: Any) -> JointCommand:
    """Return a command in the middle of what is believed."""
    bounds = bounds_of(robot, module)
    (low_phi, low_theta), (high_phi, high_theta) = tau_ff_at(bounds, Q[1])
    fields: dict[str, Any] = {
        "q_ref": Q, "v_ref": (0.0, 0.0), "k_p": bounds.k_p[0], "k_d": bounds.k_d[0],
        "tau_ff": (0.5 * (low_phi + high_phi), 0.5 * (low_theta + high_theta)),
    }  # fmt: skip
    return command(**(fields | changes))


def with_axis(values: Pair, axis: int, value: float) -> Pair:
    return (value, values[1]) if axis == 0 else (values[0], value)


def changed(told: JointCommand, name: str, axis: int, value: float) -> JointCommand:
    """Return a command with one number changed."""
    return msgspec.structs.replace(told, **{name: with_axis(getattr(told, name), axis, value)})


# ---- one command


@pytest.mark.parametrize("module", ["ankle_left", "knee_right", "hip_left"])
@pytest.mark.parametrize(
    "name", ["k_p", "k_d", "tau_ff", "dtau_ff", "tau_coupled", "q_ref", "v_ref"]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_each_number_is_believed_up_to_its_bound_and_not_beyond(
    module: str, name: str, axis: int
) -> None:
    bounds, own, told = bounds_of(ROBOT, module), ROBOT.envelope, middle(ROBOT, module)
    (k_p, k_p_most), (k_d, k_d_most) = (
        [pair[axis] for pair in x] for x in (bounds.k_p, bounds.k_d)
    )
    least, largest = (pair[axis] for pair in tau_ff_at(bounds, Q[1]))
    distance = min(own.q_ref_distance, own.spring_torque / k_p if k_p > 0.0 else math.inf)
    v_ref = min(own.v_ref, bounds.v_ref[axis])
    low, high = {
        "k_p": ((1.0 - ROUNDING) * k_p, (1.0 + ROUNDING) * k_p_most),
        "k_d": ((1.0 - ROUNDING) * k_d, (1.0 + ROUNDING) * k_d_most),
        "tau_ff": (least - own.tau_ff_margin, largest + own.tau_ff_margin),
        "dtau_ff": (-own.dtau_ff, own.dtau_ff),
        "tau_coupled": (-own.tau_coupled, own.tau_coupled),
        "v_ref": (-v_ref, v_ref),
        "q_ref": (Q[axis] - distance, Q[axis] + distance),
    }[name]
    small, envelope = 1e-6 * max(1.0, abs(low), abs(high)), Envelope(ROBOT, module)
    # a reference's distance is rounded: its very bound is not told
    within = (low + small, high - small, *((low, high) if name != "q_ref" else ()))
    beyond = (low - small, high + small, math.nan, math.inf, -math.inf)
    for values, outside in ((within, NOTHING), (beyond, Outside[name.upper()])):
        for value in values:
            found = envelope.judge(changed(told, name, axis, value), None, Q, V)
            assert found is outside, value


@pytest.mark.parametrize("name", ["margin", "margin_onboard"])
def test_a_margin_below_the_least_is_not_believed(knee: Envelope, name: str) -> None:
    limits = ROBOT.certificate
    least = limits.margin_min if name == "margin" else limits.onboard_margin_min
    believed = (0.981 * least, (1.0 - ROUNDING) * least)
    for value in (*believed, 0.979 * least, 0.0, -1.0, math.nan):
        outside = NOTHING if value in believed else Outside.MARGIN
        assert knee.judge(middle(ROBOT, **{name: value}), None, Q, V) is outside, value


@pytest.mark.parametrize("theta", [-4.0, -2.9, -2.0, -1.0, -0.31, 0.5])
def test_the_feedforward_is_that_of_the_joints_own_angle(knee: Envelope, theta: float) -> None:
    """A knee that is bent to a right angle carries more than one that is straight."""
    (_, low), (_, high) = tau_ff_at(bounds_of(ROBOT), theta)
    room = ROBOT.envelope.tau_ff_margin
    for tau, outside in (
        (low - room - 0.01, Outside.TAU_FF),
        (low - room + 0.01, NOTHING),
        (high + room - 0.01, NOTHING),
        (high + room + 0.01, Outside.TAU_FF),
    ):
        told = middle(ROBOT, q_ref=(0.02, theta), tau_ff=(0.0, tau))
        assert knee.judge(told, None, (0.02, theta), V) is outside


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
@pytest.mark.parametrize("settled", [True, False])
def test_a_coupled_torque_that_drives_the_joint_from_its_reference_is_not_believed(
    knee: Envelope, signs: tuple[int, int], settled: bool
) -> None:
    """One axis may pull the wrong way if the other pulls harder: the work of both counts."""
    away, most = (0.05, 0.04), ROBOT.envelope.coupled_work
    for phi_work, theta_work, outside in (
        (-0.5 * most, -0.49 * most, NOTHING),
        (-0.5 * most, -0.51 * most, Outside.COUPLED_WORK),
        (-1.4 * most, 0.45 * most, NOTHING),
        (2.0 * most, 1.0 * most, NOTHING),
    ):
        told = middle(
            ROBOT, q_ref=tuple(q + s * d for q, s, d in zip(Q, signs, away, strict=True)),
            tau_coupled=(signs[0] * phi_work / away[0], signs[1] * theta_work / away[1]),
        )  # fmt: skip
        assert knee.judge(told, None, Q, V, settled=settled) is outside


def test_the_work_of_a_coupled_torque_is_about_the_aged_reference(knee: Envelope) -> None:
    told = middle(ROBOT, v_ref=(0.0, 1.0), tau_coupled=(0.0, -55.0))
    for age_s, outside in ((0.01, NOTHING), (0.03, Outside.COUPLED_WORK)):
        assert knee.judge(told, None, Q, V, age_s=age_s) is outside


def test_while_track_blends_in_the_reference_may_be_twice_as_far() -> None:
    k_p = bounds_of(ROBOT, ANKLE).k_p[1]
    envelope, farthest = Envelope(ROBOT, ANKLE), ROBOT.envelope.spring_torque / k_p[1]
    for share, settled, blending in (
        (0.99, NOTHING, NOTHING),
        (1.01, Outside.Q_REF, NOTHING),
        (1.99, Outside.Q_REF, NOTHING),
        (2.01, Outside.Q_REF, Outside.Q_REF),
    ):
        told = middle(ROBOT, ANKLE, k_p=k_p, q_ref=(Q[0], Q[1] + share * farthest))
        assert envelope.judge(told, None, Q, V) is settled
        assert envelope.judge(told, None, Q, V, settled=False) is blending


def test_without_bounds_everything_is_believed() -> None:
    wild = command(k_p=(0.0, 0.0), tau_ff=(-90.0, 90.0), margin=-1.0)
    law = msgspec.structs.replace(ROBOT.law, split="diagonal")
    for config in (believing(ROBOT), msgspec.structs.replace(ROBOT, law=law)):
        assert Envelope(config, MODULE).judge(wild, None, Q, V) is NOTHING


# ---- after the commands before it


@pytest.mark.parametrize("name", ["tau_ff", "tau_coupled"])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("apart_ms", [-1000, 0, 4, 16, 48])
def test_a_torque_that_jumps_within_a_planners_lead_is_not_believed(
    knee: Envelope, name: str, axis: int, sign: float, apart_ms: int
) -> None:
    """A stamp that goes back leaves no more room than none."""
    last, own = middle(ROBOT), ROBOT.envelope
    most = own.torque_step + own.torque_rate * max(0, min(apart_ms, 16)) / 1e3
    later = msgspec.structs.replace(last, t_ns=T0 + apart_ms * NS_PER_MS, seq=2)
    others = [msgspec.structs.replace(last, session=SESSION + 1, hold=False)]
    others.append(msgspec.structs.replace(last, hold=True))
    for step, outside in ((0.999 * most, NOTHING), (1.001 * most, Outside.TORQUE_STEP)):
        told = changed(later, name, axis, getattr(last, name)[axis] + sign * step)
        assert knee.judge(told, last, Q, V) is outside
        for other in (None, *others):
            assert knee.judge(told, other, Q, V) is NOTHING, "nothing of it is tracked"


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_work_of_a_coupled_torque_on_a_joint_that_moves_is_what_it_puts_in_within_its_time(
    knee: Envelope, sign: float, axis: int
) -> None:
    """100 W: the limit of 10 J after 122 ms, and 30 J in the end; what it takes out is lost."""
    v, tau = ((sign * 2.0, 0.0), (sign * 50.0, 0.0)) if axis == 0 else ((0.0, 2.0), (0.0, 50.0))
    last = command(tau_coupled=tau)

    def put(
        before: float, v: Pair, dt: float = 4e-3, told: JointCommand = last,
        after: JointCommand | None = last,
    ) -> float:  # fmt: skip
        lately = Lately(energy=before, at_ns=T0)
        return knee.accumulated(told, after, lately, v, T0 + round(dt * NS_PER_S)).energy

    found = [0.0]
    for _ in range(1000):
        found.append(put(found[-1], v))
    most = ROBOT.envelope.coupled_energy
    assert np.searchsorted(found, most) == pytest.approx(0.122 / 4e-3, abs=1.0)
    assert found[-1] == pytest.approx(100.0 * ENERGY_S, rel=1e-3)
    assert put(0.0, (-2.0 * v[0], -2.0 * v[1])) == 0.0
    assert math.isnan(put(0.0, (math.nan, 0.0)))
    assert put(9.0, v, dt=1.0, told=command()) == 0.0, "it is forgotten"
    for other in (None, command(hold=True), command(session=SESSION + 1)):
        assert put(9.0, v, after=other) == 0.0
    assert knee.accumulated(last, last, Lately(), v, T0) == Lately(at_ns=T0), (
        "none before the first"
    )


def going(tick: int, told: Pair, goes: Pair) -> JointCommand:
    """Return a command of a course that says one rate, rad/s, and goes at another."""
    at = tuple(q + rate * 4e-3 * tick for q, rate in zip(Q, goes, strict=True))
    return command(t_ns=T0 + tick * 4_000_000, seq=tick, q_ref=at, v_ref=told)


def astray_after(ticks: int, told: Pair, goes: Pair, every: int = 1, module: str = ANKLE) -> Pair:
    envelope, lately, last = Envelope(ROBOT, module), Lately(), going(0, told, goes)
    for tick in range(every, ticks + 1, every):
        after = going(tick, told, goes)
        lately, last = envelope.accumulated(after, last, lately, V, T0), after
    return lately.astray


@pytest.mark.parametrize("every", [1, 10])
def test_a_reference_that_goes_as_it_says_is_not_astray_however_far_and_seldom(every: int) -> None:
    assert astray_after(1000, (-2.0, 0.7), (-2.0, 0.7), every) == pytest.approx((0.0, 0.0))


@pytest.mark.parametrize(("told", "goes"), [((0.0, 0.0), (0.3, -0.3)), ((1.0, 0.3), (1.3, 0.0))])
def test_an_ankles_that_goes_another_way_is_found_within_a_fifth_of_a_second(
    told: Pair, goes: Pair
) -> None:
    """A knee's and a hip's go astray while the height follows a reference of its own."""
    astray = astray_after(50, told, goes)
    assert min(map(abs, astray)) > ROBOT.envelope.q_ref_astray
    assert np.sign(astray).tolist() == [1.0, -1.0]
    settled = astray_after(2000, told, goes)
    assert np.abs(settled) == pytest.approx([0.3 * ASTRAY_S] * 2, rel=0.02), "it is forgotten"
    assert astray_after(50, told, goes, module=MODULE) == pd_law.ZERO


def test_where_nothing_of_this_planner_is_tracked_nothing_is_astray() -> None:
    after = command(q_ref=(9.0, 9.0), seq=2)
    held = msgspec.structs.replace(after, hold=True)
    pairs = [(after, None), (after, command(hold=True)), (after, command(session=SESSION + 1))]
    for told, last in (*pairs, (held, command())):
        lately = Envelope(ROBOT, ANKLE).accumulated(told, last, Lately(astray=(0.5, 0.5)), V, T0)
        assert lately.astray == pd_law.ZERO


@pytest.mark.parametrize("share", [1.0, 1.001, math.nan])
def test_what_went_before_is_believed_up_to_its_bound(share: float) -> None:
    """The work of a coupled torque; and each way in which a reference may be astray."""
    own, inside = ROBOT.envelope, share == 1.0
    rows = [(Lately(energy=share * own.coupled_energy), MODULE, Outside.COUPLED_ENERGY)]
    far = share * own.q_ref_astray
    for astray in ((far, 0.0), (-far, 0.0), (0.0, far), (0.0, -far)):
        rows += [(Lately(astray=astray), ANKLE, Outside.Q_REF_ASTRAY)]
    for lately, module, outside in rows:
        found = Envelope(ROBOT, module).judge(middle(ROBOT, module), None, Q, V, lately=lately)
        assert found is (NOTHING if inside else outside)


# ---- what a failsafe makes of the judgement


@pytest.mark.parametrize("name", ["k_p", "k_d", "q_ref", "tau_ff"])
def test_hold_is_obeyed_and_wild_numbers_make_none_ready(knee: Envelope, name: str) -> None:
    failsafe, timing = Failsafe(mode=Mode.HOLD), timing_of(ROBOT)
    wild = {"tau_ff": (0.5, -90.0), "q_ref": (0.5, -2.0)}.get(name, (0.0, 0.0))
    for seq in range(400):
        now_ns = T0 + seq * 2_000_000
        told = middle(ROBOT, hold=True, seq=seq, echo_t_ns=now_ns)
        if seq % 2 or seq < 200:
            told = msgspec.structs.replace(told, **{name: wild})
        outside = knee.judge(told, None, Q, V)
        assert failsafe.offer(told, now_ns, timing, outside) is Refusal.NONE
        failsafe.advance(now_ns, timing, Event.NONE, estop=False)
        assert failsafe.mode is Mode.HOLD
        assert failsafe.ready(now_ns, timing) is (seq >= 200 and seq % 2 == 0)


@pytest.mark.parametrize(
    ("changes", "refusal", "told"),
    [
        ({}, Refusal.OUT_OF_ENVELOPE, Outside.K_P),
        ({"k_p": (math.nan, 0.0)}, Refusal.OUT_OF_LIMITS, Outside.K_P),
        ({"echo_t_ns": 0}, Refusal.TOO_OLD, NOTHING),
    ],
    ids=["not believed", "what no service takes", "another reason"],
)
def test_what_is_not_believed_is_refused_counted_and_told_unless_it_is_for_another_reason(
    changes: dict[str, Any], refusal: Refusal, told: Outside
) -> None:
    failsafe, timing = Failsafe(), timing_of(ROBOT)
    assert failsafe.offer(middle(ROBOT, **changes), T0, timing, Outside.K_P) is refusal
    assert (failsafe.command, failsafe.refused, failsafe.outside) == (None, 1, told)
    good = middle(ROBOT)
    assert failsafe.offer(good, T0, timing) is Refusal.NONE
    assert (failsafe.command, failsafe.refused, failsafe.outside) == (good, 1, NOTHING)


# ---- a controller's whole cycle


class Wary(Bench):
    """A bench whose controller has its bounds; the planner leads by what is in their middle."""

    def __init__(self, robot: RobotConfig, module: str = MODULE) -> None:
        super().__init__(robot, module)
        self.law = JointController(robot, module)
        self.controller = self.law.start()
        self.robot, self.name, self.q = robot, module, Q

    def told(self, *, late_ms: float = 0.0, **changes: Any) -> Outside:
        """Send one command, echoing a state from so long before the last; return what is told."""
        self.seq += 1
        echo_t_ns = self.now_ns - round(late_ms * NS_PER_MS)
        stamps = {"seq": self.seq, "t_ns": self.now_ns, "echo_t_ns": echo_t_ns}
        self.cycle(middle(self.robot, self.name, **stamps, **changes))
        return self.controller.failsafe.outside

    def tracks(self, cycles: int = 0, **changes: Any) -> None:
        """Come to TRACK, and stay in it."""
        self.to_hold()
        while self.mode is not Mode.TRACK or cycles:
            cycles -= self.mode is Mode.TRACK
            assert self.told(**changes) is NOTHING


@pytest.fixture
def wary() -> Wary:
    return Wary(ROBOT)


def test_a_torque_that_jumps_is_refused_while_it_tracks_and_only_then(wary: Wary) -> None:
    jumps = {"tau_coupled": (0.0, 20.0)}
    wary.to_hold()
    assert wary.told() is NOTHING
    assert wary.told(**jumps) is NOTHING, "in HOLD nothing has come of the last"
    assert wary.controller.failsafe.refused == 0
    wary.tracks()
    assert wary.told() is NOTHING
    assert wary.told(**jumps) is Outside.TORQUE_STEP
    assert wary.controller.failsafe.refused == 1


def test_a_reference_is_judged_as_old_as_it_is_and_no_older_than_it_is_used(wary: Wary) -> None:
    """It moves at 5 rad/s; ages count up to 30 ms."""
    distance = wary.robot.envelope.q_ref_distance
    cycle_ms = wary.cycle_ns / NS_PER_MS
    wary.to_hold()
    for counted_s, late_ms, outside in (
        (0.021, 20.0 - cycle_ms, NOTHING),
        (0.021, 22.0 - cycle_ms, Outside.Q_REF),
        (0.031, 45.0, NOTHING),
    ):
        q_ref = (Q[0], Q[1] + distance - 5.0 * counted_s)
        assert wary.told(late_ms=late_ms, q_ref=q_ref, v_ref=(0.0, 5.0)) is outside


def test_a_spring_may_pull_harder_while_track_blends_in_and_not_after(wary: Wary) -> None:
    stiff = {"k_p": bounds_of(wary.robot).k_p[1]}
    wary.tracks(**stiff)
    pulled = 1.2 * wary.robot.envelope.spring_torque / stiff["k_p"][1]
    wary.q = (Q[0], Q[1] + pulled)  # the joint gives; what is told stays the same
    found = [wary.told(**stiff) for _ in range(BLEND_CYCLES + 10)]
    assert set(found[: BLEND_CYCLES - 2]) == {NOTHING}
    assert found[-1] is Outside.Q_REF


@pytest.mark.parametrize("goes", [0.0, 0.3])
def test_a_controller_remembers_how_far_astray_its_reference_is(goes: float) -> None:
    """A third of a second: at 0.3 rad/s that the commands do not tell, twice the bound."""
    wary = Wary(ROBOT, ANKLE)
    wary.tracks(400)
    steps = goes * wary.cycle_ns / NS_PER_S * np.arange(166)
    refused = {wary.told(q_ref=(Q[0], Q[1] + along)) for along in steps.tolist()}
    assert (Outside.Q_REF_ASTRAY in refused) is (goes > 0.0)


@pytest.mark.parametrize("rate", [0.0, 2.0, -2.0])
def test_a_controller_remembers_what_the_coupled_torque_has_put_into_its_joint(
    wary: Wary, rate: float
) -> None:
    """110 W for 160 ms: 14 J, which no command alone shows."""
    wary.tracks(400, tau_coupled=(0.0, 55.0))
    wary.v, refused = (0.0, rate), set()
    for _ in range(80):
        wary.q = (wary.q[0], wary.q[1] + rate * wary.cycle_ns / NS_PER_S)
        refused.add(wary.told(q_ref=wary.q, v_ref=wary.v, tau_coupled=(0.0, 55.0)))
    assert (Outside.COUPLED_ENERGY in refused) is (rate > 0.0)


def test_a_state_reports_what_is_not_believed() -> None:
    """Until 50 ms have passed in which nothing came: the planner that said it is gone."""
    law = JointController(ROBOT, MODULE)
    controller = law.start()
    law.step(controller, T0, None, middle(ROBOT, k_p=(0.0, 0.0)), estop=False)
    limit_ns = law.timing.max_command_age_ns
    assert law.state(controller, T0 + limit_ns).outside == Outside.K_P
    assert law.state(controller, T0 + limit_ns + 1).outside == NOTHING


def test_hold_stiffens_about_the_joint_and_track_about_the_reference() -> None:
    """A knee 0.2 rad off its reference, with a tenth of HOLD's stiffness."""
    bench = Bench(ROBOT)
    soft = {"k_p": (300.0, 300.0), "q_ref": (bench.q[0], bench.q[1] + 0.2)}
    bench.to_track(**soft)
    assert bench.controller.law.current.q_ref[1] == pytest.approx(bench.q[1] + 0.2)
    before = bench.controller.tau
    bench.run(400, hold=True, fresh=True, **soft)
    assert bench.mode is Mode.HOLD
    assert bench.controller.law.current.q_ref[1] == pytest.approx(bench.q[1])
    assert bench.controller.tau == pytest.approx(before, abs=1.0)
