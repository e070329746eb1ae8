"""Drop-outs: who may track, after how long, and what is remembered."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.joint.failsafe import Event, Failsafe, Timing, timing_of
from shared.bus.messages import Cause, Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.robot.hold_rules import Dropouts
from tests.joint.helpers import T0, command

CYCLE_NS = 2 * NS_PER_MS


class Module:
    """A failsafe in HOLD, cycled; a command in any cycle may echo the cycle before."""

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.failsafe = Failsafe(mode=Mode.HOLD)
        self.now_ns = T0
        self.seq = 0

    def cycle(self, *, fresh: bool, hold: bool = False) -> Cause | None:
        echo_ns, self.now_ns = self.now_ns, self.now_ns + CYCLE_NS
        if fresh:
            self.seq += 1
            sent = command(seq=self.seq, echo_t_ns=echo_ns, hold=hold)
            self.failsafe.offer(sent, self.now_ns, self.timing)
        return self.failsafe.advance(self.now_ns, self.timing, Event.DRIVE_ARMED, estop=False)

    def until(self, mode: Mode, *, fresh: bool) -> int:
        """Cycle until the mode is reached; return the time that took."""
        start_ns = self.now_ns
        while self.failsafe.mode is not mode:
            self.cycle(fresh=fresh)
            assert self.now_ns - start_ns < 60 * NS_PER_S
        return self.now_ns - start_ns

    def drop_out(self) -> None:
        self.until(Mode.TRACK, fresh=True)
        self.until(Mode.HOLD, fresh=False)

    def track_for(self, time_ns: int) -> None:
        for _ in range(time_ns // CYCLE_NS):
            self.cycle(fresh=True)
            assert self.failsafe.mode is Mode.TRACK


def test_track_comes_after_engage_after_of_fresh_commands(timing: Timing) -> None:
    module = Module(timing)
    took_ns = module.until(Mode.TRACK, fresh=True)
    assert took_ns - CYCLE_NS == timing.engage_after_ns == 100 * NS_PER_MS


def test_each_drop_out_doubles_the_wait_up_to_its_maximum(timing: Timing) -> None:
    module = Module(timing)
    waits = []
    for _ in range(8):
        waits.append(module.until(Mode.TRACK, fresh=True) - CYCLE_NS)
        module.until(Mode.HOLD, fresh=False)
    assert [wait // NS_PER_MS for wait in waits] == [100, 200, 400, 800, 1600, 3200, 3200, 3200]


def test_no_number_of_drop_outs_makes_the_wait_overflow_or_shrink(timing: Timing) -> None:
    for dropouts in (5, 16, 17, 63, 64, 10_000):
        failsafe = Failsafe(dropouts=Dropouts(count=dropouts))
        assert failsafe.engage_after_ns(timing) == timing.engage_after_max_ns


def test_a_drop_out_is_forgotten_after_steady_tracking(timing: Timing) -> None:
    module = Module(timing)
    module.drop_out()
    module.until(Mode.TRACK, fresh=True)
    module.track_for(timing.dropout_forget_ns - CYCLE_NS)
    assert module.failsafe.dropouts.count == 1
    module.track_for(CYCLE_NS)
    assert module.failsafe.dropouts.count == 0
    assert module.failsafe.engage_after_ns(timing) == timing.engage_after_ns


def test_drop_outs_are_forgotten_one_at_a_time(timing: Timing) -> None:
    module = Module(timing)
    for _ in range(3):
        module.drop_out()
    module.until(Mode.TRACK, fresh=True)
    left = []
    for _ in range(4):
        module.track_for(timing.dropout_forget_ns)
        left.append(module.failsafe.dropouts.count)
    assert left == [2, 1, 0, 0]


def test_steady_tracking_halves_the_wait_however_many_drop_outs_there_were(timing: Timing) -> None:
    """robot.toml: dropout_forget_s of TRACK without a drop-out halves it again."""
    module = Module(timing)
    for _ in range(8):
        module.drop_out()
    module.until(Mode.TRACK, fresh=True)
    assert module.failsafe.engage_after_ns(timing) == timing.engage_after_max_ns
    module.track_for(timing.dropout_forget_ns)
    assert module.failsafe.engage_after_ns(timing) == timing.engage_after_max_ns // 2


def test_time_outside_track_forgets_nothing(timing: Timing) -> None:
    module = Module(timing)
    module.drop_out()
    for _ in range(2 * timing.dropout_forget_ns // CYCLE_NS):
        module.cycle(fresh=False)
    assert module.failsafe.dropouts.count == 1


def test_hold_asked_by_the_planner_is_no_drop_out(timing: Timing) -> None:
    module = Module(timing)
    module.until(Mode.TRACK, fresh=True)
    assert module.cycle(fresh=True, hold=True) is Cause.HOLD_ALL
    assert module.failsafe.dropouts.count == 0


def test_ready_is_reported_in_hold_so_that_all_six_can_start_together(timing: Timing) -> None:
    module = Module(timing)
    for _ in range(2 * timing.engage_after_ns // CYCLE_NS):
        module.cycle(fresh=True, hold=True)
    assert module.failsafe.mode is Mode.HOLD
    assert module.failsafe.ready(module.now_ns, timing)
    assert module.cycle(fresh=True, hold=False) is Cause.COMMANDS_FRESH


@pytest.mark.parametrize("gap_at", [0, 1, 10, 24])
def test_a_gap_in_the_wait_starts_the_wait_again(gap_at: int, timing: Timing) -> None:
    module = Module(timing)
    for _ in range(gap_at):
        module.cycle(fresh=True)
    for _ in range(timing.max_command_age_ns // CYCLE_NS + 1):
        module.cycle(fresh=False)
    assert module.until(Mode.TRACK, fresh=True) - CYCLE_NS == timing.engage_after_ns


class Arrival(msgspec.Struct, frozen=True):
    """A command that comes in a cycle."""

    cycle: int
    age: int
    """Cycles since the state that it echoes."""
    hold: bool


def brute_force(arrivals: dict[int, Arrival], cycles: int, timing: Timing) -> list[Mode]:
    """Return the mode of every cycle, computed from the whole past in each.

    No state is carried but the list of modes itself; nothing drops out for long enough to
    be forgotten.
    """
    modes = [Mode.HOLD]
    age_max = timing.max_command_age_ns // CYCLE_NS
    in_use: list[Arrival | None] = [None]
    for now in range(1, cycles):
        came = arrivals.get(now)
        ok = came is not None and came.age <= age_max
        in_use.append(came if ok else in_use[-1])
        fresh = [
            use is not None and cycle - (use.cycle - use.age) <= age_max
            for cycle, use in enumerate(in_use)
        ]
        before = modes[-1]
        newest = in_use[-1]
        dropped = sum(
            modes[c - 1] is Mode.TRACK and modes[c] is Mode.HOLD and not fresh[c]
            for c in range(1, now)
        )
        wait = min(timing.engage_after_ns << dropped, timing.engage_after_max_ns) // CYCLE_NS
        unbroken = now >= wait and all(fresh[now - wait :])
        leads = fresh[-1] and newest is not None and not newest.hold
        stays = before is Mode.TRACK
        modes.append(Mode.TRACK if leads and (stays or unbroken) else Mode.HOLD)
    return modes


# mostly fresh commands, sometimes an old one or a gap that is too long
ages = st.one_of(st.integers(0, 3), st.integers(0, 3), st.integers(0, 8))

gaps = st.one_of(*[st.integers(1, 3)] * 8, st.integers(1, 9))

streams = st.lists(st.tuples(gaps, ages, st.sampled_from([False] * 19 + [True])), max_size=80)


@given(stream=streams)
@example(stream=[(1, 0, False)] * 30)
@example(stream=[(1, 0, False)] * 15 + [(9, 0, False)] + [(1, 0, False)] * 40)
@settings(max_examples=200)
def test_track_is_entered_and_left_as_in_a_slow_model(
    robot: RobotConfig, stream: list[tuple[int, int, bool]]
) -> None:
    timing = msgspec.structs.replace(
        timing_of(robot),
        max_command_age_ns=5 * CYCLE_NS,
        engage_after_ns=10 * CYCLE_NS,
        engage_after_max_ns=40 * CYCLE_NS,
    )
    arrivals, cycle = {}, 0
    for gap, age, hold in stream:
        cycle += gap
        arrivals[cycle] = Arrival(cycle, min(age, cycle), hold)
    cycles = cycle + 10
    failsafe, modes = Failsafe(mode=Mode.HOLD), [Mode.HOLD]
    for now in range(1, cycles):
        came, now_ns = arrivals.get(now), T0 + now * CYCLE_NS
        if came is not None:
            echo_ns = now_ns - came.age * CYCLE_NS
            sent = command(seq=now, echo_t_ns=echo_ns, hold=came.hold)
            failsafe.offer(sent, now_ns, timing)
        failsafe.advance(now_ns, timing, Event.DRIVE_ARMED, estop=False)
        modes.append(failsafe.mode)
    assert modes == brute_force(arrivals, cycles, timing)


def test_the_slow_model_itself_tracks_drops_out_and_waits_twice_as_long(timing: Timing) -> None:
    timing = msgspec.structs.replace(
        timing, max_command_age_ns=5 * CYCLE_NS, engage_after_ns=10 * CYCLE_NS
    )
    steady = [*range(1, 16), *range(30, 60)]
    modes = brute_force({c: Arrival(c, 0, hold=False) for c in steady}, 60, timing)
    assert modes.index(Mode.TRACK) == 11
    assert modes[20:22] == [Mode.TRACK, Mode.HOLD]
    assert modes.index(Mode.TRACK, 21) == 30 + 20
