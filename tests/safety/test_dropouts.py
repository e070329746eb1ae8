"""Drop-outs: who may track, after how long, and what is remembered."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.joint.failsafe import Event, Failsafe, Timing
from shared.bus.messages import Cause, Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.robot.hold_rules import Dropouts
from tests.joint.helpers import T0, TIMING, command

CYCLE_NS = 2 * NS_PER_MS


class Module:
    """A failsafe in HOLD, cycled; a command in any cycle may echo an earlier one."""

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.failsafe = Failsafe(mode=Mode.HOLD)
        self.now_ns = T0
        self.seq = 0

    def cycle(self, *, fresh: bool, hold: bool = False, age: int = 1) -> Cause | None:
        """Run a cycle, with a command that is `age` cycles old or with none."""
        self.now_ns += CYCLE_NS
        if fresh:
            self.seq += 1
            sent = command(seq=self.seq, echo_t_ns=self.now_ns - age * CYCLE_NS, hold=hold)
            self.failsafe.offer(sent, self.now_ns, self.timing)
        return self.failsafe.advance(self.now_ns, self.timing, Event.DRIVE_ARMED, estop=False)

    def until(self, mode: Mode, *, fresh: bool) -> int:
        """Cycle until the mode is reached; return the time that took."""
        start_ns = self.now_ns
        while self.failsafe.mode is not mode:
            self.cycle(fresh=fresh)
            assert self.now_ns - start_ns < 60 * NS_PER_S
        return self.now_ns - start_ns

    def track_for(self, time_ns: int) -> int:
        """Track for a while; return the number of drop-outs that are remembered."""
        for _ in range(time_ns // CYCLE_NS):
            self.cycle(fresh=True)
            assert self.failsafe.mode is Mode.TRACK
        return self.failsafe.dropouts.count


@pytest.fixture
def module() -> Module:
    return Module(TIMING)


def test_each_drop_out_doubles_the_wait_of_100_ms_up_to_its_maximum(module: Module) -> None:
    waits = []
    for _ in range(8):
        waits.append(module.until(Mode.TRACK, fresh=True) - CYCLE_NS)
        module.until(Mode.HOLD, fresh=False)
    assert [wait // NS_PER_MS for wait in waits] == [100, 200, 400, 800, 1600, 3200, 3200, 3200]


def test_no_number_of_drop_outs_makes_the_wait_overflow_or_shrink() -> None:
    for dropouts in (5, 16, 17, 63, 64, 10_000):
        failsafe = Failsafe(dropouts=Dropouts(count=dropouts))
        assert failsafe.engage_after_ns(TIMING) == TIMING.engage_after_max_ns


@pytest.mark.parametrize("drop_outs", [1, 3, 8])
def test_steady_tracking_forgets_drop_outs_one_at_a_time_and_halves_the_wait(
    module: Module, drop_outs: int
) -> None:
    """However many there were: more than the longest wait takes are not counted."""
    timing = module.timing
    for _ in range(drop_outs):
        module.until(Mode.TRACK, fresh=True)
        module.until(Mode.HOLD, fresh=False)
    counted = min(drop_outs, timing.dropouts_max)
    for _ in range(2 * timing.dropout_forget_ns // CYCLE_NS):
        module.cycle(fresh=False)
    assert module.failsafe.dropouts.count == counted, "time outside TRACK forgets nothing"
    module.until(Mode.TRACK, fresh=True)
    assert module.track_for(timing.dropout_forget_ns - CYCLE_NS) == counted
    assert module.track_for(CYCLE_NS) == counted - 1
    for left in range(counted - 2, -2, -1):
        wait_ns = module.failsafe.engage_after_ns(timing)
        assert wait_ns == timing.engage_after_ns << (left + 1)
        assert module.track_for(timing.dropout_forget_ns) == max(0, left)


def test_hold_asked_by_the_planner_is_no_drop_out_and_ready_is_reported_in_it(
    module: Module,
) -> None:
    """So that all six can start together."""
    for _ in range(2 * module.timing.engage_after_ns // CYCLE_NS):
        module.cycle(fresh=True, hold=True)
    assert module.failsafe.mode is Mode.HOLD
    assert module.failsafe.ready(module.now_ns, module.timing)
    assert module.cycle(fresh=True) is Cause.COMMANDS_FRESH
    assert module.cycle(fresh=True, hold=True) is Cause.HOLD_ALL
    assert module.failsafe.dropouts.count == 0


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
STEADY = [(1, 0, False)]


@given(stream=streams)
@example(stream=STEADY * 30)
@example(stream=STEADY * 15 + [(9, 0, False)] + STEADY * 40)
@settings(max_examples=200)
def test_track_is_entered_and_left_as_in_a_slow_model(stream: list[tuple[int, int, bool]]) -> None:
    timing = msgspec.structs.replace(
        TIMING,
        max_command_age_ns=5 * CYCLE_NS,
        engage_after_ns=10 * CYCLE_NS,
        engage_after_max_ns=40 * CYCLE_NS,
    )
    arrivals, cycle = {}, 0
    for gap, age, hold in stream:
        cycle += gap
        arrivals[cycle] = Arrival(cycle, min(age, cycle), hold)
    module, modes = Module(timing), [Mode.HOLD]
    for now in range(1, cycle + 10):
        came = arrivals.get(now, Arrival(0, 0, hold=False))
        module.cycle(fresh=now in arrivals, age=came.age, hold=came.hold)
        modes.append(module.failsafe.mode)
    assert modes == brute_force(arrivals, cycle + 10, timing)
    if stream == STEADY * 15 + [(9, 0, False)] + STEADY * 40:  # it waits twice as long
        assert modes.index(Mode.TRACK) == 11
        assert modes.index(Mode.TRACK, modes.index(Mode.HOLD, 11)) == 24 + 20
