"""When the planner leads: all six or none, after its wait, at most six drop-outs a minute."""

from __future__ import annotations

import functools
import random
from typing import TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.watch.engagement_fsm import FORGET_NS, GRACE_NS, WAITS_NS, Engagement
from shared.bus.messages import DriveStatus, Mode, PlannerMode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from shared.robot.hold_rules import Dropouts
from tests.joint.helpers import Bench
from tests.planner.states import ROBOT, TICK_NS

T = TypeVar("T")
YES = [True] * 6
HOLD = [int(Mode.HOLD)] * 6
TRACK = [int(Mode.TRACK)] * 6
T0 = 10**12


def but(values: list[T], index: int, value: T) -> list[T]:
    """Return the list with one module's entry changed."""
    return [*values[:index], value, *values[index + 1 :]]


def leading() -> Engagement:
    """Return an engagement that has led for longer than the grace time."""
    return Engagement(PlannerMode.LEADING, T0 - GRACE_NS - 1)


def test_it_waits_aligns_and_leads_in_three_steps() -> None:
    engagement = Engagement()
    ready, aligns = but(YES, 4, False), (PlannerMode.ALIGNING, True)
    for fresh, modules_ready, reported in (
        (but(YES, 2, False), ready, (PlannerMode.WAITING, True)),
        (YES, ready, aligns),
        (YES, ready, aligns),
        (YES, YES, (PlannerMode.LEADING, False)),
    ):
        changed = engagement.advance(T0, fresh, modules_ready, HOLD)
        assert (engagement.mode, engagement.hold) == reported
    assert changed
    at_once = Engagement()
    at_once.advance(T0, YES, YES, HOLD)
    assert at_once.hold, "ready at once, they are aligned before they are led"


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("mode", [PlannerMode.ALIGNING, PlannerMode.LEADING])
def test_one_stale_state_or_one_not_ready_holds_all(mode: PlannerMode, index: int) -> None:
    engagement = Engagement(mode, T0)
    for tick in range(1000):
        engagement.advance(T0 + tick * TICK_NS, YES, but(YES, index, False), TRACK)
        assert engagement.hold is (mode is PlannerMode.ALIGNING), "ready counts before the lead"
    assert engagement.advance(T0, but(YES, index, False), YES, TRACK)
    assert (engagement.mode, engagement.hold) == (PlannerMode.WAITING, True)


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.TRACK])
def test_one_module_that_leaves_track_holds_all(mode: Mode, index: int) -> None:
    engagement = leading()
    assert not any(engagement.advance(T0 + tick, YES, YES, TRACK) for tick in range(100))
    assert engagement.advance(T0, YES, YES, but(TRACK, index, int(mode)))
    assert engagement.hold


@pytest.mark.parametrize(("off_ns", "hold"), [(-1, False), (0, False), (1, True)])
def test_modules_may_take_150_ms_to_report_track(off_ns: int, hold: bool) -> None:
    engagement = Engagement(PlannerMode.LEADING, T0)
    now_ns = T0 + 150 * NS_PER_MS + off_ns
    engagement.advance(now_ns, YES, YES, but(TRACK, 3, int(Mode.HOLD)))
    assert engagement.hold is hold


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DAMP])
@pytest.mark.parametrize("since_ns", [0, 1, GRACE_NS])
def test_a_module_that_can_not_come_to_track_is_not_waited_for(mode: Mode, since_ns: int) -> None:
    """Within the grace time the other five tracked on beside a limp one for up to 150 ms."""
    engagement = Engagement(PlannerMode.LEADING, T0)
    assert engagement.advance(T0 + since_ns, YES, YES, but(HOLD, 3, int(mode)))
    assert engagement.hold
    assert engagement.dropouts.count == 1


class Fleet:
    """Six controllers and one engagement, without a network in between."""

    def __init__(self) -> None:
        self.benches = [Bench(ROBOT, module) for module in MODULES]
        self.engagement = Engagement()

    def run(self, cycles: int) -> list[int]:
        """Run; return how many track after each cycle."""
        tracking = []
        for _ in range(cycles):
            states = [bench.law.state(bench.controller, bench.now_ns) for bench in self.benches]
            self.engagement.advance(
                self.benches[0].now_ns, YES, [s.ready for s in states], [s.mode for s in states]
            )
            for bench in self.benches:
                bench.cycle(bench.fresh(hold=self.engagement.hold, q_ref=bench.q))
            tracking.append([bench.mode for bench in self.benches].count(Mode.TRACK))
        return tracking


def test_all_six_track_in_one_tick_and_none_beside_a_fault() -> None:
    fleet = Fleet()
    tracking = fleet.run(300)
    assert set(tracking) == {0, 6}
    assert tracking == sorted(tracking)
    fleet.benches[1].status = DriveStatus.LOST
    assert max(fleet.run(1000)[2:]) == 0
    assert fleet.benches[1].mode is Mode.FAULT


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DAMP, Mode.DISARMED])
def test_no_module_tracks_while_one_cannot(mode: Mode) -> None:
    """All six track or none does: no leg is to work against the other."""
    fleet = Fleet()
    fleet.benches[1].to(mode)
    assert max(fleet.run(1000)) == 0


FORBIDDEN = [PlannerMode.OVERLOADED, PlannerMode.UNCERTIFIED]


@pytest.mark.parametrize("inhibit", FORBIDDEN)
@pytest.mark.parametrize("mode", list(PlannerMode))
def test_what_is_forbidden_holds_at_once(mode: PlannerMode, inhibit: PlannerMode) -> None:
    """Within the grace time too."""
    engagement = Engagement(mode, T0)
    engagement.advance(T0, YES, YES, TRACK, inhibit)
    assert (engagement.mode, engagement.hold) == (inhibit, True)
    assert engagement.dropouts.count == 0 or inhibit is PlannerMode.UNCERTIFIED
    again = Engagement(inhibit, T0)
    for now_ns, reported in ((T0 + 1, PlannerMode.ALIGNING), (T0 + 2, PlannerMode.LEADING)):
        again.advance(now_ns, YES, YES, TRACK)
        assert again.mode is reported


def test_gains_at_the_edge_of_their_margin_do_not_make_it_flap() -> None:
    """They stand alone in every other tick of 4 ms, for a minute."""
    engagement, led = leading(), 0
    for tick in range(15_000):
        inhibit = PlannerMode.UNCERTIFIED if tick % 2 else None
        before = engagement.mode
        engagement.advance(T0 + tick * 4_000_000, YES, YES, TRACK, inhibit)
        led += engagement.mode is PlannerMode.LEADING is not before
    assert led <= 6


@pytest.mark.parametrize("inhibit", FORBIDDEN)
def test_a_silent_module_counts_before_what_is_forbidden(inhibit: PlannerMode) -> None:
    engagement = leading()
    engagement.advance(T0, but(YES, 3, False), YES, TRACK, inhibit)
    assert engagement.mode is PlannerMode.WAITING


@pytest.mark.parametrize("dropouts", range(len(WAITS_NS)))
def test_it_reports_how_long_it_waits_and_leads_when_that_is_over(dropouts: int) -> None:
    engagement = Engagement(PlannerMode.ALIGNING, T0, dropouts=Dropouts(dropouts, last_ns=T0))
    assert engagement.wait_ns(T0) == WAITS_NS[dropouts]
    for now_ns in (T0 + WAITS_NS[dropouts] - 1, T0 + WAITS_NS[dropouts]):
        left_ns = engagement.wait_ns(now_ns)
        engagement.advance(now_ns, YES, YES, HOLD)
        assert engagement.hold is (left_ns > 0)


# ---- how long it waits


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

    def drop_out(self) -> int:
        """Lose a module and find it again at once; return the time until it leads again."""
        assert self.tick(cut=True) is PlannerMode.WAITING
        return self.until_led()


def test_each_drop_out_makes_the_wait_longer_up_to_half_a_minute() -> None:
    led = Led()
    assert led.until_led() <= 3 * TICK_NS, "what was lost before a planner is not its memory"
    assert WAITS_NS[1] + GRACE_NS < NS_PER_S, "nor has one that was only stopped a wait"
    waits, counts = [], []
    for _ in range(9):
        waits.append(led.drop_out())
        counts.append(led.engagement.dropouts.count)
    wanted = [*WAITS_NS[1:], *[WAITS_NS[-1]] * 3]
    assert all(0 <= took - wait <= TICK_NS for took, wait in zip(waits, wanted, strict=True))
    assert counts == [min(count, len(WAITS_NS) - 1) for count in range(1, 10)]
    assert sorted(wanted) == wanted
    assert wanted[-1] <= 30 * NS_PER_S


def test_time_in_hold_forgets_nothing() -> None:
    led = Led()
    led.until_led()
    led.drop_out()
    for _ in range(2 * FORGET_NS // TICK_NS):
        led.tick(cut=True)
    led.until_led()
    assert led.engagement.dropouts.count == 2


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
