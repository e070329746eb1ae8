"""A bus on which nobody acknowledges: what reaches the drive of what was sent, and how old."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.bus_watch import (
    BLOCKED_MS,
    PROBE_MS,
    PROOF_MS,
    QUIET_MS,
    RESTART_MS,
    STUCK_MS,
    BusWatch,
)
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState, Command, split_id
from shared.can.cansimple_06 import Command06
from shared.can.unix_can import Frame, UnixCanBus, unpack_frames
from shared.clock import NS_PER_MS
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import AXES, TARGET, Line, Shed

OLD_MS = 50
"""No frame that is older reaches a drive."""
CYCLE_MS = 5
"""Longest wait of a service's cycle for a frame."""


def live_watch(*, echoes: bool = True) -> BusWatch:
    """Return a watch of a bus that carries, whose drive was heard at time 0."""
    watch = BusWatch(echoes=echoes)
    for happens in (watch.received, watch.sent, watch.carried):
        happens(0)
    return watch


# ---- the law, at each boundary


@pytest.mark.parametrize("echoes", [False, True])
def test_nothing_is_sent_to_a_drive_that_was_not_heard(echoes: bool) -> None:
    for ms in (0, QUIET_MS, QUIET_MS + 1, 10_000):
        assert live_watch(echoes=echoes).may_send(ms * NS_PER_MS) == (ms <= QUIET_MS)
    assert not BusWatch(echoes=echoes).may_send(0), "nor before it was"


@pytest.mark.parametrize("limit_ms", [PROOF_MS, STUCK_MS, RESTART_MS])
@pytest.mark.parametrize("over_ms", [0, 1])
def test_nothing_is_sent_behind_a_frame_that_is_not_carried_or_armed_on_an_old_one(
    limit_ms: int, over_ms: int
) -> None:
    now = (limit_ms + over_ms) * NS_PER_MS
    for waits in (True, False):
        watch = live_watch()
        if waits:
            watch.sent(0)
        watch.received(now)
        assert not waits or watch.may_send(now) == (now <= STUCK_MS * NS_PER_MS)
        assert not waits or watch.restart_due(now) == (now > RESTART_MS * NS_PER_MS)
        assert waits or watch.may_arm(now) == (now <= PROOF_MS * NS_PER_MS)


def test_after_an_outage_a_probe_is_carried_before_anything_is_sent() -> None:
    watch = live_watch()
    watch.sent(NS_PER_MS)
    watch.restarted(40 * NS_PER_MS, done=True)
    back = 3000 * NS_PER_MS
    assert not watch.probe_due(back), "not before the drive is heard"
    watch.received(back)
    assert not watch.may_send(back)
    assert watch.probe_due(back)
    watch.sent(back)
    assert not watch.probe_due(back), "one at a time"
    watch.carried(back + NS_PER_MS)
    assert watch.may_arm(back + NS_PER_MS)
    assert not watch.carries_nothing(back + NS_PER_MS)


def test_a_bus_that_carries_nothing_though_the_drive_is_heard_counts_as_lost() -> None:
    watch, told_ms, probes = live_watch(), 0, 0
    for ms in range(1, 1000, 2):
        now = ms * NS_PER_MS
        watch.received(now)
        if watch.restart_due(now):
            watch.restarted(now, done=True)
        if watch.may_send(now):
            watch.sent(now)
        if watch.probe_due(now):
            watch.sent(now)
            probes += 1
        told_ms = told_ms or watch.carries_nothing(now) * ms
    assert RESTART_MS + BLOCKED_MS < told_ms < 200
    assert 4 <= probes <= 1000 // PROBE_MS


def test_a_silent_bus_is_probed_once_unless_the_interface_cannot_be_restarted() -> None:
    for done, probes in ((True, 1), (False, 0)):
        watch = BusWatch(echoes=True)
        watch.restarted(0, done=done)
        watch.received(0)
        watch.carried(0)
        due = [watch.probe_due(ms * NS_PER_MS) for ms in range(QUIET_MS + 1, 500)]
        assert sum(due) == probes


def test_lost_echoes_do_not_make_a_live_bus_a_dead_one() -> None:
    watch, dice = live_watch(), random.Random(0)
    for ms in range(0, 20_000, 2):
        now = ms * NS_PER_MS
        watch.received(now)
        if dice.random() > 0.3:
            watch.carried(now)
        watch.sent(now)
        assert not watch.restart_due(now)


# ---- the driver, on a bus whose every answer the test writes; its interface cannot be restarted


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench(monkeypatch, "xrl_unix")
    bench.bus.sent.clear()
    bench.talks = False
    yield bench
    bench.driver.close()


COUNTS = [Command.GET_ENCODER_COUNT] * 2
"""Asked for with each heartbeat of an axis that is not armed."""


@pytest.mark.parametrize("carries", [True, False])
def test_an_arming_request_waits_for_a_frame_that_is_carried_and_is_followed_by_one(
    bench: Bench, carries: bool
) -> None:
    """Else none is left on the bus, even where nothing can be thrown away: the drive is gone."""
    bench.driver._link.watch.carried(bench.now_ns)
    bench.wait(1e-3 * (PROOF_MS + 1))
    bench.receive()
    bench.driver.arm(onboard=True)
    probe = [*COUNTS, Command06.GET_VERSION]
    if carries:
        bench.bus.waiting.extend(bench.bus.sent)
        assert bench.commands() == probe, "the probe comes last"
        bench.after(2)
        bench.after(2)
        commands = bench.commands()
        assert commands[-3:] == [*[Command.SET_AXIS_STATE] * 2, Command06.GET_VERSION]
        assert commands[0] == Command.CLEAR_ERRORS
        return
    for _ in range(200):
        bench.after(CYCLE_MS)
        bench.driver.arm(onboard=True)
    assert set(bench.commands()) == set(probe)


def test_where_nothing_can_be_thrown_away_a_dead_bus_gets_a_few_targets_and_no_more(
    bench: Bench,
) -> None:
    bench.driver._link.watch.carried(bench.now_ns)
    bench.receive()
    for _ in range(600):
        bench.driver.write(TARGET)
        bench.after(CYCLE_MS)
    assert 0 < len(bench.commands()) <= 40
    assert bench.seen(CYCLE_MS).status is DriveStatus.UNACKNOWLEDGED


# ---- the driver, on a bus as the kernel has it


class StampingHub(UnixCanHub):
    """A bus that notes the command and the age of each frame, ms, when a node takes it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.now_ms = 0.0
        self.ages_ms: list[tuple[int, float]] = []

    def poll(self) -> list[Frame]:
        frames = super().poll()
        for can_id, data in frames:
            sent = STAMPS.pop(0)
            assert sent[0] == (can_id, data)
            self.ages_ms.append((split_id(can_id & 0x7FF)[1], self.now_ms - sent[1]))
        return frames


STAMPS: list[tuple[Frame, float]] = []
"""Frames that were sent and neither taken nor thrown away, with their times, ms."""


class Cut(Line):
    """A line whose bus loses its power, is full, and is restarted by its driver."""

    def __init__(self, shed: Shed, monkeypatch: pytest.MonkeyPatch) -> None:
        STAMPS.clear()
        send_packet, restart = UnixCanBus.send_packet, UnixCanBus.restart

        def stamped(bus: UnixCanBus, packet: bytes) -> int:
            taken = send_packet(bus, packet)
            STAMPS.extend((frame, self.ms) for frame in unpack_frames(packet[:taken]))
            return taken

        def restarted(bus: UnixCanBus) -> None:
            restart(bus)
            self.restarts += 1
            STAMPS.clear()

        monkeypatch.setattr(UnixCanBus, "send_packet", stamped)
        monkeypatch.setattr(UnixCanBus, "restart", restarted)
        self.restarts = 0
        super().__init__(shed, StampingHub)

    @property
    def ms(self) -> float:
        return self.shed.now_s * 1e3

    def power(self, *, on: bool) -> None:
        self.rig.bank.conditions.link(AXES[0] >> 1, up=on)

    def choke(self, *, full: bool) -> None:
        self.rig.bank.conditions.choke(AXES[0] >> 1, full=full)

    def step(self) -> None:
        """Let a millisecond pass."""
        self.hub.now_ms = self.ms
        self.rig.step()

    def cycle(self, target: MotorTarget | None = TARGET, ms: int = 2) -> None:
        """Run a cycle of the service: two milliseconds with the drive, five without."""
        for _ in range(ms if self.rig.bank.is_responding(AXES[0]) else CYCLE_MS):
            self.step()
        super().cycle(target, ms=0)

    def run(self, ms: float, target: MotorTarget | None = TARGET) -> None:
        until = self.ms + ms
        while self.ms < until:
            self.cycle(target)

    def oldest_ms(self) -> float:
        """Return the age of the oldest frame that reached the drive, and forget them."""
        oldest = max((age for _, age in self.hub.ages_ms), default=0.0)
        self.hub.ages_ms.clear()
        return float(oldest)


@pytest.fixture
def cut(shed: Shed, monkeypatch: pytest.MonkeyPatch) -> Cut:
    cut = Cut(shed, monkeypatch)
    cut.run(50, target=None)
    return cut


@pytest.fixture
def armed(cut: Cut) -> Cut:
    cut.driver.arm(onboard=True)
    cut.run(40, target=None)
    assert cut.rig.states == [AxisState.CLOSED_LOOP_CONTROL] * 2
    cut.run(40)
    assert cut.oldest_ms() <= CYCLE_MS
    return cut


@pytest.mark.parametrize("lasts_ms", [7, 22, 35, 48, 60, 90, 130, 300, 3000])
def test_no_old_frame_reaches_a_drive_after_a_power_cut_of_any_length(
    armed: Cut, lasts_ms: int
) -> None:
    armed.power(on=False)
    armed.run(lasts_ms)
    armed.power(on=True)
    armed.run(100)
    assert armed.oldest_ms() < OLD_MS - 5
    assert armed.restarts == (1 if lasts_ms > RESTART_MS + 2 * CYCLE_MS else armed.restarts)
    assert armed.status is DriveStatus.ARMED
    before = armed.driver.write_failures
    armed.run(50)
    assert armed.driver.write_failures == before, "it is written to as before"


@pytest.mark.parametrize("full", [True, False])
def test_a_bus_without_acknowledgements_or_that_stays_full_is_told_within_a_fifth_of_a_second(
    armed: Cut, full: bool
) -> None:
    armed.choke(full=True) if full else armed.power(on=False)
    armed.run(BLOCKED_MS + 20 if full else 200)
    assert armed.status is DriveStatus.UNACKNOWLEDGED


def test_nothing_is_sent_into_a_dead_bus_and_it_is_told_there_too(cut: Cut) -> None:
    """A service that is not armed sends nothing: one probe shows that nobody is there."""
    cut.power(on=False)
    cut.run(190, target=None)
    assert cut.status is DriveStatus.UNACKNOWLEDGED
    assert (cut.restarts, STAMPS) == (1, [])
    cut.driver.arm(onboard=True)
    cut.driver.idle()
    cut.run(3000)
    assert STAMPS == []
    cut.power(on=True)
    cut.run(50, target=None)
    assert cut.oldest_ms() <= CYCLE_MS
    assert cut.rig.states == [AxisState.IDLE] * 2


@pytest.mark.parametrize("offset_ms", range(-3, 12))
def test_no_arming_request_from_before_a_power_cut_reaches_the_drive(
    cut: Cut, offset_ms: int
) -> None:
    """Whichever of its frames the cut meets: afterwards the drive is as it was, or was armed."""
    cut.driver.read(0.0)
    for _ in range(-offset_ms):
        cut.step()
    if offset_ms < 0:
        cut.power(on=False)
    cut.driver.arm(onboard=True)
    for _ in range(offset_ms):
        cut.step()
        cut.driver.read(0.0)
    before = cut.rig.states
    cut.power(on=False)
    cut.run(500, target=None)
    assert STAMPS == [], "nothing is left to be delivered"
    cut.power(on=True)
    cut.run(300, target=None)
    assert cut.rig.states == before
    assert cut.oldest_ms() < OLD_MS


def test_frames_of_a_service_that_died_in_the_cut_are_thrown_away_by_the_next(armed: Cut) -> None:
    armed.power(on=False)
    armed.driver.write(TARGET)
    armed.driver.write(TARGET)
    armed.driver.close()
    assert STAMPS != []
    armed.driver = armed.shed.driver()
    armed.run(200, target=None)
    assert STAMPS == []
    assert armed.status is DriveStatus.UNACKNOWLEDGED


def test_a_bus_that_is_full_in_bursts_is_written_to_between_them(armed: Cut) -> None:
    for _ in range(20):
        for choked in (True, False):
            armed.choke(full=choked)
            armed.run(40)
            assert armed.status is DriveStatus.ARMED
    assert armed.oldest_ms() <= CYCLE_MS
    assert armed.restarts == 0
    assert 300 < armed.driver.write_failures < 500, "two of five were refused"


def test_a_bus_that_flaps_brings_no_old_frame(armed: Cut) -> None:
    dice = random.Random(0)
    for half in range(120):
        armed.power(on=half % 2 == 1)
        armed.run(dice.uniform(1.0, 90.0))
    assert Command.SET_AXIS_STATE not in {command for command, _ in armed.hub.ages_ms}
    assert armed.oldest_ms() < OLD_MS
