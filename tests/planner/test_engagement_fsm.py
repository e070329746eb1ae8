from __future__ import annotations

from typing import TypeVar

import pytest

from services.joint.drivers.base import DriveStatus
from services.planner.watch.engagement_fsm import FORGET_NS, GRACE_NS, WAITS_NS, Engagement
from shared.bus.messages import JointCommand, Mode, PlannerMode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.robot.hold_rules import Dropouts
from tests.joint.helpers import Bench

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
    ready = but(YES, 4, False)
    reported = []
    for fresh, modules_ready in ((but(YES, 2, False), ready), (YES, ready), (YES, ready)):
        engagement.advance(T0, fresh, modules_ready, HOLD)
        reported.append((engagement.mode, engagement.hold))
    assert reported == [
        (PlannerMode.WAITING, True),
        (PlannerMode.ALIGNING, True),
        (PlannerMode.ALIGNING, True),
    ]
    assert engagement.advance(T0, YES, YES, HOLD)
    assert (engagement.mode, engagement.hold) == (PlannerMode.LEADING, False)


def test_modules_that_are_ready_at_once_are_aligned_before_they_are_led() -> None:
    engagement = Engagement()
    engagement.advance(T0, YES, YES, HOLD)
    assert engagement.hold


@pytest.mark.parametrize("index", range(6))
def test_hold_is_not_lifted_while_one_module_is_not_ready(index: int) -> None:
    engagement = Engagement(PlannerMode.ALIGNING, T0)
    for tick in range(1000):
        now_ns = T0 + tick * 4 * NS_PER_MS
        engagement.advance(now_ns, YES, but(YES, index, False), HOLD)
        assert engagement.hold


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("mode", [PlannerMode.ALIGNING, PlannerMode.LEADING])
def test_one_stale_state_holds_all(mode: PlannerMode, index: int) -> None:
    engagement = Engagement(mode, T0)
    assert engagement.advance(T0, but(YES, index, False), YES, TRACK)
    assert (engagement.mode, engagement.hold) == (PlannerMode.WAITING, True)


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.TRACK])
def test_one_module_that_leaves_track_holds_all(mode: Mode, index: int) -> None:
    engagement = leading()
    assert engagement.advance(T0, YES, YES, but(TRACK, index, int(mode)))
    assert engagement.hold


@pytest.mark.parametrize(("off_ns", "hold"), [(-1, False), (0, False), (1, True)])
def test_modules_may_take_the_grace_time_to_report_track(off_ns: int, hold: bool) -> None:
    engagement = Engagement(PlannerMode.LEADING, T0)
    engagement.advance(T0 + GRACE_NS + off_ns, YES, YES, but(TRACK, 3, int(Mode.HOLD)))
    assert engagement.hold is hold


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DAMP])
@pytest.mark.parametrize("since_ns", [0, 1, GRACE_NS])
def test_a_module_that_can_not_come_to_track_is_not_waited_for(mode: Mode, since_ns: int) -> None:
    """Within the grace time the other five tracked on beside a limp one for up to 150 ms."""
    engagement = Engagement(PlannerMode.LEADING, T0)
    assert engagement.advance(T0 + since_ns, YES, YES, but(HOLD, 3, int(mode)))
    assert engagement.hold
    assert engagement.dropouts.count == 1


def test_it_goes_on_leading_while_all_six_track() -> None:
    engagement = leading()
    assert not any(engagement.advance(T0 + tick, YES, YES, TRACK) for tick in range(100))
    assert not engagement.hold


class Fleet:
    """Six controllers and one engagement, without a network in between."""

    def __init__(self, robot: RobotConfig) -> None:
        self.benches = [Bench(robot, module) for module in MODULES]
        self.engagement = Engagement()

    def run(self, cycles: int) -> list[list[Mode]]:
        """Run; return the six modes after each cycle."""
        rows = []
        for _ in range(cycles):
            states = [bench.controller.state(bench.now_ns) for bench in self.benches]
            self.engagement.advance(
                self.benches[0].now_ns, YES, [s.ready for s in states], [s.mode for s in states]
            )
            for bench in self.benches:
                bench.cycle(self._command(bench))
            rows.append([bench.mode for bench in self.benches])
        return rows

    def _command(self, bench: Bench) -> JointCommand:
        return bench.fresh(hold=self.engagement.hold, q_ref=bench.q)


def test_all_six_track_in_the_same_tick(robot: RobotConfig) -> None:
    fleet = Fleet(robot)
    rows = fleet.run(200)
    tracking = [row.count(Mode.TRACK) for row in rows]
    assert set(tracking) == {0, 6}
    assert tracking == sorted(tracking)


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DAMP, Mode.DISARMED])
def test_no_module_tracks_while_one_cannot(robot: RobotConfig, mode: Mode) -> None:
    """All six track or none does: no leg is to work against the other."""
    fleet = Fleet(robot)
    fleet.benches[1].to(mode)
    tracking = [row.count(Mode.TRACK) for row in fleet.run(1000)]
    assert max(tracking) == 0


def test_five_modules_hold_for_good_once_the_sixth_has_faulted(robot: RobotConfig) -> None:
    fleet = Fleet(robot)
    assert fleet.run(300)[-1] == [Mode.TRACK] * 6
    fleet.benches[1].status = DriveStatus.LOST
    rows = fleet.run(1000)
    assert rows[-1][1] is Mode.FAULT
    assert max(row.count(Mode.TRACK) for row in rows[2:]) == 0


FORBIDDEN = [PlannerMode.OVERLOADED, PlannerMode.UNCERTIFIED]


@pytest.mark.parametrize("inhibit", FORBIDDEN)
@pytest.mark.parametrize("mode", list(PlannerMode))
def test_what_is_forbidden_holds_from_every_mode_at_once(
    mode: PlannerMode, inhibit: PlannerMode
) -> None:
    """Within the grace time too."""
    engagement = Engagement(mode, T0)
    engagement.advance(T0, YES, YES, TRACK, inhibit)
    assert (engagement.mode, engagement.hold) == (inhibit, True)


@pytest.mark.parametrize("inhibit", FORBIDDEN)
def test_allowed_again_it_aligns_before_it_leads(inhibit: PlannerMode) -> None:
    engagement = Engagement(inhibit, T0)
    engagement.advance(T0 + 1, YES, YES, TRACK)
    assert (engagement.mode, engagement.hold) == (PlannerMode.ALIGNING, True)
    engagement.advance(T0 + 2, YES, YES, TRACK)
    assert (engagement.mode, engagement.hold) == (PlannerMode.LEADING, False)


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


def drop_out(engagement: Engagement, now_ns: int) -> None:
    """Lose a module, and lead again."""
    engagement.advance(now_ns, but(YES, 2, False), YES, TRACK)
    engagement.mode, engagement.since_ns = PlannerMode.LEADING, now_ns - GRACE_NS - 1


def test_drop_outs_are_counted_up_to_the_longest_wait() -> None:
    engagement = leading()
    for count in range(1, len(WAITS_NS) + 3):
        now_ns = T0 + count * NS_PER_S
        drop_out(engagement, now_ns)
        assert engagement.dropouts.count == min(count, len(WAITS_NS) - 1)
        assert engagement.dropouts.last_ns == now_ns


def test_each_good_while_makes_one_drop_out_forgotten() -> None:
    engagement = leading()
    for _ in range(3):
        drop_out(engagement, T0)
    engagement.dropouts.steady_since_ns = T0
    for now_ns, left in (
        (T0 + FORGET_NS - 1, 3),
        (T0 + FORGET_NS, 2),
        (T0 + 2 * FORGET_NS - 1, 2),
        (T0 + 2 * FORGET_NS, 1),
        (T0 + 3 * FORGET_NS, 0),
        (T0 + 4 * FORGET_NS, 0),
    ):
        engagement.advance(now_ns, YES, YES, TRACK)
        assert engagement.dropouts.count == left, now_ns - T0
