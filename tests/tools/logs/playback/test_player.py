"""The player in virtual time: its clock is passed by its own waiting."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.clock import NS_PER_MS, NS_PER_S
from tests.tools.logs.playback.test_schedule import schedule_of
from tools.logs.playback.player import BURST, STEP_NS, ClockMessage, Player, Press, summary
from tools.logs.playback.schedule import Entry, Playhead, window

BEGAN = 4_000_000_000_000


class World:
    """A clock that goes on while somebody waits, keys pressed at moments, and what was put."""

    def __init__(
        self,
        presses: Sequence[tuple[float, Press]] = (),
        *,
        oversleep_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        self.now = BEGAN
        self.put: list[tuple[int, bytes]] = []
        self.shown = 0
        self._presses = sorted(presses, key=lambda row: row[0])
        self._oversleep_ns = oversleep_ns

    def wait(self, timeout_s: float) -> list[Press]:
        self.now += round(timeout_s * NS_PER_S) + self._oversleep_ns()
        found = []
        while self._presses and BEGAN + self._presses[0][0] * NS_PER_S <= self.now:
            found.append(self._presses.pop(0)[1])
        return found

    def show(self) -> None:
        self.shown += 1

    @property
    def times_s(self) -> list[float]:
        return [(at - BEGAN) / NS_PER_S for at, _ in self.put]


class Port:
    def __init__(self, world: World, *, works: bool = True, stalls_ns: int = 0) -> None:
        self.world, self.works, self.stalls_ns = world, works, stalls_ns

    def put(self, payload: bytes) -> bool:
        self.world.now += self.stalls_ns
        if self.works:
            self.world.put.append((self.world.now, payload))
        return self.works


def entries(times_s: Sequence[float]) -> list[Entry]:
    return [Entry(BEGAN + round(t * NS_PER_S), 0, b"%d" % n) for n, t in enumerate(times_s)]


def player(
    world: World,
    times_s: Sequence[float],
    rate: float = 1.0,
    *,
    loop: bool = False,
    paused: bool = False,
    clock: Port | None = None,
    works: bool = True,
    listens_after_s: float = 0.0,
    stalls_ns: int = 0,
) -> Player:
    rows = entries(times_s)
    schedule = schedule_of(rows, window(rows[0].time_ns, rows[-1].time_ns, 0, None), loop=loop)
    return Player(
        schedule,
        Playhead(world.now, rate, paused=paused),
        [Port(world, works=works, stalls_ns=stalls_ns)],
        world,
        now_ns=lambda: world.now,
        show=world.show,
        listening=lambda: world.now >= BEGAN + round(listens_after_s * NS_PER_S),
        clock=clock,
        clock_hz=100.0 if clock else 0.0,
    )


TIMES = st.lists(st.integers(0, 3_000), min_size=1, max_size=60).map(
    lambda times: [t / 1000 for t in sorted(times)]
)


@given(TIMES, st.sampled_from((0.1, 0.5, 1.0, 3.0, 100.0)), st.integers(0, 2**32))
def test_messages_go_in_order_none_early_and_late_by_no_more_than_the_machine_is(
    times_s: list[float], rate: float, seed: int
) -> None:
    rng = random.Random(seed)
    slowest_ns = 30 * NS_PER_MS
    world = World(oversleep_ns=lambda: rng.randrange(slowest_ns))
    play = player(world, times_s, rate)
    play.run()
    assert [payload for _, payload in world.put] == [b"%d" % n for n in range(len(times_s))]
    for at_s, recorded_s in zip(world.times_s, times_s, strict=True):
        due_s = (recorded_s - times_s[0]) / rate
        assert due_s - 1e-6 <= at_s <= due_s + slowest_ns / NS_PER_S + 1e-6
    assert play.stats.put == len(times_s)
    assert play.stats.late_max_ns <= slowest_ns + 1_000


def test_after_a_stall_what_is_late_goes_at_once_and_the_rest_on_time() -> None:
    times_s = [n / 1000 for n in range(2 * BURST)]
    stalls = iter([0, 300 * NS_PER_MS])
    world = World(oversleep_ns=lambda: next(stalls, 0))
    play = player(world, times_s)
    play.run()
    late = [
        n for n, (at, due) in enumerate(zip(world.times_s, times_s, strict=True)) if at > due + 1e-6
    ]
    assert len(late) == pytest.approx(300, abs=3)
    assert play.stats.late_max_ns == pytest.approx(300 * NS_PER_MS, abs=3 * NS_PER_MS)
    assert world.times_s[-1] == pytest.approx(times_s[-1], abs=1e-6), "no drift"


def test_space_pauses_and_goes_on() -> None:
    world = World([(0.15, Press.PAUSE), (2.15, Press.PAUSE)])
    player(world, [0.0, 0.1, 0.2, 0.3]).run()
    assert world.times_s[:2] == pytest.approx([0.0, 0.1], abs=1e-6)
    waited = world.times_s[2] - 0.2
    assert 1.6 <= waited <= 2.4  # keys are looked at as often as the line is shown
    assert world.times_s[3] == pytest.approx(0.3 + waited, abs=1e-6)


def test_started_paused_nothing_goes_until_space_is_pressed() -> None:
    world = World([(5.0, Press.PAUSE)])
    player(world, [0.0, 0.1], paused=True).run()
    assert world.times_s[0] >= 5.0


def test_right_puts_the_next_message_of_a_paused_play_or_goes_on_by_a_step() -> None:
    world = World([(1.0, Press.STEP), (2.0, Press.STEP), (3.0, Press.STEP), (9.0, Press.QUIT)])
    play = player(world, [0.0, 0.05, 1.0], paused=True)
    play.run()
    assert [payload for _, payload in world.put] == [b"0", b"1"]
    assert play.position_ns() == 50 * NS_PER_MS + STEP_NS


def test_right_does_nothing_while_it_plays() -> None:
    world = World([(0.01, Press.STEP)])
    player(world, [0.0, 0.5]).run()
    assert world.times_s == pytest.approx([0.0, 0.5], abs=1e-6)


def test_q_ends_a_loop_and_up_makes_it_faster() -> None:
    world = World([(1.0, Press.FASTER), (3.0, Press.QUIT)])
    play = player(world, [0.0, 0.2, 0.4], loop=True)
    play.run()
    assert play.schedule.passes >= 6
    assert play.head.rate == pytest.approx(1.1)
    assert 3.0 <= (world.now - BEGAN) / NS_PER_S <= 3.3


def test_the_clock_gives_the_recorded_time_also_while_paused_and_misses_no_step() -> None:
    world = World([(0.5, Press.PAUSE), (1.5, Press.PAUSE)])
    published: list[tuple[int, ClockMessage]] = []

    class Clock(Port):
        def put(self, payload: bytes) -> bool:
            published.append((world.now, msgspec.json.decode(payload, type=ClockMessage)))
            return True

    player(world, [0.0, 1.0], rate=2.0, clock=Clock(world)).run()
    assert [message.seq for _, message in published] == list(range(len(published)))
    stamps = [message.t_ns for _, message in published]
    assert stamps == sorted(stamps)
    assert stamps[0] == BEGAN
    assert len(published) == pytest.approx(100 * (world.now - BEGAN) / NS_PER_S, abs=2)
    for at, message in published:
        if at - BEGAN < 0.4 * NS_PER_S:
            assert message.t_ns - BEGAN == pytest.approx(2 * (at - BEGAN), abs=10)
    assert all(stamp <= BEGAN + NS_PER_S + 1 for stamp in stamps)


def test_what_cannot_be_sent_is_counted() -> None:
    world = World()
    play = player(world, [0.0, 0.1], works=False)
    play.run()
    assert (play.stats.put, play.stats.failed) == (0, 2)


def test_what_the_display_raises_ends_the_play() -> None:
    world = World()
    play = player(world, [0.0, 60.0])

    def alarm() -> None:
        if world.now > BEGAN + NS_PER_S:
            raise InterruptedError

    play._show = alarm
    with pytest.raises(InterruptedError):
        play.run()
    assert world.now < BEGAN + 2 * NS_PER_S


@pytest.mark.parametrize(
    ("listens_after_s", "words"),
    [(0.0, "all sent"), (0.45, "nobody listened to the first 5:"), (9.0, "nobody listened")],
)
def test_what_went_out_before_anybody_listened_is_told(listens_after_s: float, words: str) -> None:
    play = player(World(), [0.1 * n for n in range(10)], listens_after_s=listens_after_s)
    play.run()
    said = summary(play, 1.0)
    assert words in said
    assert ("nobody" in said) == ("nobody" in words)
    assert said.endswith("nobody listened") == (words == "nobody listened")


@pytest.mark.parametrize(("stall_s", "dropped"), [(0.5, 0), (5.0, 2)])
def test_a_subscriber_that_takes_nothing_for_five_seconds_is_told(
    stall_s: float, dropped: int
) -> None:
    play = player(World(), [0.0, 0.1], stalls_ns=round(stall_s * NS_PER_S))
    play.run()
    assert play.stats.dropped == dropped
    assert ("NOT ALL ARRIVED" in summary(play, 1.0)) == bool(dropped)
