"""A link that comes and goes: no more than six drop-outs a minute, and nothing shaken down.

A study found 39 drop-outs in 11 s (docs/results.md). Hysteresis of each module by itself was not
enough: six links that took turns gave 14 to 24 a minute. With ages of 4 to 46 ms, all within the
rule, the robot fell in TRACK (by 12 s with 20 ms of jitter on streams).
"""

from __future__ import annotations

import functools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.watch.engagement_fsm import FORGET_NS, GRACE_NS, WAITS_NS, Engagement
from shared.bus.messages import Cause, Mode, PlannerMode, SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Scenario
from tests.joint.helpers import T0
from tools.sim.lockstep import Lockstep

TICK_NS = 4 * NS_PER_MS
YES = [True] * 6
HOLD = [int(Mode.HOLD)] * 6
TRACK = [int(Mode.TRACK)] * 6


# ---- how the planner waits before it leads again


class Led:
    """An engagement with six modules that are always ready, and do as they are told."""

    def __init__(self) -> None:
        self.engagement = Engagement()
        self.now_ns = T0

    def tick(self, *, cut: bool = False) -> PlannerMode:
        self.now_ns += TICK_NS
        fresh = [not cut, *YES[1:]]
        modes = HOLD if self.engagement.hold else TRACK
        self.engagement.advance(self.now_ns, fresh, YES, modes)
        return self.engagement.mode

    def until_led(self) -> int:
        """Tick until it leads; return the time that took."""
        start_ns = self.now_ns
        while self.tick() is not PlannerMode.LEADING:
            assert self.now_ns - start_ns < 120 * NS_PER_S
        return self.now_ns - start_ns

    def lead_for(self, time_ns: int) -> None:
        for _ in range(time_ns // TICK_NS):
            assert self.tick() is PlannerMode.LEADING

    def drop_out(self) -> int:
        """Lose a module and find it again at once; return the time until it leads again."""
        assert self.tick(cut=True) is PlannerMode.WAITING
        return self.until_led()


def test_the_first_engagement_does_not_wait() -> None:
    assert Led().until_led() <= 3 * TICK_NS


def test_each_drop_out_makes_the_wait_longer_up_to_half_a_minute() -> None:
    led = Led()
    led.until_led()
    waits = [led.drop_out() for _ in range(9)]
    wanted = [*WAITS_NS[1:], *[WAITS_NS[-1]] * 3]
    assert all(0 <= took - wait <= TICK_NS for took, wait in zip(waits, wanted, strict=True))
    assert sorted(wanted) == wanted
    assert wanted[-1] <= 30 * NS_PER_S


def test_after_long_good_times_the_wait_is_short_again() -> None:
    led = Led()
    led.until_led()
    for _ in range(4):
        led.drop_out()
    led.lead_for(3 * FORGET_NS + 4 * TICK_NS)
    assert led.engagement.dropouts.count == 1
    assert led.drop_out() == pytest.approx(WAITS_NS[2], abs=TICK_NS)


def test_time_in_hold_forgets_nothing() -> None:
    led = Led()
    led.until_led()
    led.drop_out()
    for _ in range(2 * FORGET_NS // TICK_NS):
        led.tick(cut=True)
    led.until_led()
    assert led.engagement.dropouts.count == 2


def test_a_module_that_drops_out_by_itself_counts_and_what_is_forbidden_does_not() -> None:
    since = T0 - GRACE_NS - 1
    one_holds = [int(Mode.HOLD), *TRACK[1:]]
    lost, kept = (Engagement(PlannerMode.LEADING, since) for _ in range(2))
    lost.advance(T0, YES, YES, one_holds)
    kept.advance(T0, YES, YES, TRACK, PlannerMode.OVERLOADED)
    assert (lost.dropouts.count, kept.dropouts.count) == (1, 0)


def test_a_new_planner_has_no_wait() -> None:
    """It is to lead within 1.5 s of its start: what was lost before it is not its memory."""
    assert WAITS_NS[0] == 0
    assert WAITS_NS[1] + GRACE_NS < NS_PER_S  # nor has one that was only stopped for a while


def test_no_network_whatever_makes_seven_drop_outs_in_a_minute() -> None:
    """All ways to lead just long enough to have one forgotten, or to lose it at once."""
    top = len(WAITS_NS) - 1

    @functools.cache
    def most(remembered: int, left_ns: int) -> int:
        """Return the most drop-outs in a time that begins with one."""
        if left_ns <= 0:
            return 0
        now = min(remembered + 1, top)
        left_ns -= WAITS_NS[now]
        return 1 + max(most(now - k, left_ns - k * FORGET_NS) for k in range(now + 1))

    assert max(most(remembered, 60 * NS_PER_S) for remembered in range(top + 1)) == 6


@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 0.2))
def test_random_cuts_make_at_most_six_drop_outs_in_any_minute(seed: int, share: float) -> None:
    dice, engagement = random.Random(seed), Engagement()
    now_ns, drops = T0, list[int]()
    for _ in range(1500):
        now_ns += 100 * NS_PER_MS
        led = engagement.mode is PlannerMode.LEADING
        fresh = [dice.random() >= share, *YES[1:]]
        engagement.advance(now_ns, fresh, YES, HOLD if engagement.hold else TRACK)
        if led and engagement.hold:
            drops.append(now_ns)
    for first, seventh in zip(drops, drops[6:], strict=False):
        assert seventh - first >= 60 * NS_PER_S


# ---- in a robot


def squats(seconds: float) -> tuple[Keyframe, ...]:
    heights = (1.188, 0.948)
    return tuple(Keyframe(at=2.5 * n, height=heights[n % 2]) for n in range(2 + int(seconds / 2.5)))


@pytest.mark.timeout(600)  # a minute of virtual time, on a machine that may be busy
@pytest.mark.parametrize(
    ("ordered", "seconds", "tracked"),
    [
        pytest.param(True, 60.0, 0.06, id="a minute of a stream", marks=pytest.mark.wide),
        pytest.param(True, 15.0, 0.06, id="a stream"),
        pytest.param(False, 15.0, 0.9, id="datagrams"),
    ],
)
def test_20_ms_jitter_and_10_percent_loss(
    ordered: bool, seconds: float, tracked: float, robot: RobotConfig
) -> None:
    """Before ages were watched and the planner waited, the robot fell in 12 s on streams.

    Jitter is about the delay, and none is given: what it would take off is clipped at 0, so half
    of the messages have no delay and the others up to 20 ms more.

    It is no network to TRACK on for a minute: on streams six drop-outs, each with a longer wait,
    leave 11 % of the time (two seeds: 0.108 and 0.113); as datagrams, where what is overtaken is
    left out, 99 % with one drop-out, and the coupled torques faded to a quarter.
    """
    link = Inject(link="all", at=0.0, jitter_ms=20.0, loss=0.1, ordered=ordered)
    frames = squats(seconds)
    scenario = Scenario(name="flap", about="", duration=seconds, keyframe=frames, inject=(link,))
    fleet = Lockstep(robot, scenario)
    rows, tracking = list[SimTruth](), list[bool]()
    for row in fleet.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
            tracking.append(all(c.failsafe.mode == Mode.TRACK for c in fleet.controllers))
    assert rows[-1].scenario_s >= seconds - 0.1
    assert not any(row.fallen for row in rows)
    assert sum(tracking) > tracked * len(tracking), "it comes back, and does not only HOLD"
    began_ns = rows[0].t_ns
    events = [(name, event) for name, event in fleet.events if event.t_ns >= began_ns]
    entries = {name: 0 for name, _ in events}
    for name, event in events:
        entries[name] += event.mode_after == Mode.HOLD
    assert max(entries.values(), default=0) <= 6
    if ordered:
        assert any(event.cause == Cause.COMMAND_STALE for _, event in events), "it is a bad link"
    steps = [
        abs(b - a)
        for _, event in events
        for a, b in zip(event.tau_before, event.tau_after, strict=True)
    ]
    assert max(steps, default=0.0) <= 5.0
    assert max(abs(row.com[0]) for row in rows) < 0.06
    assert max(abs(row.com[1]) for row in rows) < 0.02
    assert max(abs(row.angles[0]) for row in rows) < 0.05
