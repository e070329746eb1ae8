"""Whether turns that an encoder missed are noticed, on axes whose true motion the test draws."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import DriveReading
from services.joint.failsafe import Event
from services.joint.joint_estimate import (
    JUMP_SPEED,
    JUMP_TURNS,
    REJECTED_MAX,
    SPEED_MAX,
    JointEstimate,
)
from services.joint.turn_watch import (
    ACCELERATION,
    AT_ZERO,
    FADES,
    GAP_NS,
    SETTLES_S,
    STICTION,
    STILL,
    STILL_NS,
    TurnWatch,
)
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisError
from shared.clock import NS_PER_MS, NS_PER_S
from shared.rounding import POSITION, rounded

T_NS = NS_PER_S
PERIOD_NS = 2 * NS_PER_MS
N = 17.5
BANDWIDTH = 2000.0


class Axis:
    """A motor, its absolute encoder, and a drive that counts the short way round."""

    def __init__(self, pos: float, speed: float) -> None:
        self.samples = JointEstimate(N)
        self.true = self.count = self.estimate = pos
        self.speed = speed
        self.t_ns = NS_PER_S
        self.vel = speed
        self.sample(armed=True)

    @property
    def turns_missing(self) -> int:
        return round(self.true - self.count)

    def sample(
        self,
        status: DriveStatus = DriveStatus.ARMED,
        *,
        armed: bool,
        error: int = 0,
        zero: Pair | None = None,
    ) -> Event:
        pos, vel = (self.estimate, 0.0), (self.vel, 0.0)
        reading = DriveReading(self.t_ns, pos, vel, status, error, None, zero)
        return self.samples.process(reading, armed=armed)

    def move(self, acceleration: float, word: float | None, *, armed: bool = True) -> Event:
        """Move for a period; the encoder then says a word within the turn, or none."""
        dt_s = PERIOD_NS / NS_PER_S
        self.t_ns += PERIOD_NS
        self.speed += acceleration * dt_s
        self.true += self.speed * dt_s
        before = self.count
        if word is not None:
            self.count += math.remainder(word - self.count, 1.0)
        # A critically damped estimate, from the step's end of the count, at a float's precision.
        fade = math.exp(-BANDWIDTH * dt_s)
        self.vel = (self.count - before) / dt_s + fade * self.vel
        self.estimate = self.count - fade * (self.count - self.estimate)
        if abs(self.count - self.estimate) < 1e-5:
            self.estimate = self.count
        return self.sample(armed=armed)

    def goes(self, acceleration: float, cycles: int) -> list[Event]:
        return [self.move(acceleration, self.word()) for _ in range(cycles)]

    def word(self) -> float:
        return self.true % 1.0


@given(
    pos=st.floats(-3.0, 3.0),
    speed=st.floats(-25.0, 25.0),
    acceleration=st.floats(-0.7 * ACCELERATION, 0.7 * ACCELERATION),
    gap_ms=st.integers(2, 50),
)
def test_turns_missed_in_a_gap_without_an_error_are_noticed(
    pos: float, speed: float, acceleration: float, gap_ms: int
) -> None:
    axis = Axis(pos, speed)
    axis.goes(0.0, 70)  # from its first word on, which rests: bounds of the speed follow by FADES
    for _ in range(gap_ms * NS_PER_MS // PERIOD_NS):
        axis.move(acceleration, None)
    events = axis.goes(0.0, 2 + REJECTED_MAX)
    if axis.turns_missing:
        assert Event.POSITION_LOST in events
        assert axis.samples.turns_lost


@given(st.floats(-3.0, 3.0), st.floats(-8.0, 8.0), st.integers(2, 30))
def test_a_gap_in_which_no_turn_can_be_missing_is_held_through(
    pos: float, speed: float, gap_ms: int
) -> None:
    axis = Axis(pos, speed)
    axis.goes(0.0, 20)
    for _ in range(gap_ms * NS_PER_MS // PERIOD_NS):
        axis.move(0.0, None)
    assert set(axis.goes(0.0, 20)) <= {Event.DRIVE_ARMED, Event.NONE}
    assert not axis.samples.turns_lost
    assert axis.samples.pos[0] == pytest.approx(axis.true, abs=0.05)


@given(st.floats(-3.0, 3.0), st.floats(-15.0, 15.0), st.floats(1.0, FADES), st.integers(1, 200))
def test_an_encoder_that_is_read_all_the_time_raises_no_doubt(
    pos: float, speed: float, acceleration: float, rests: int
) -> None:
    """It stops, rests for any time, and goes on."""
    axis = Axis(pos, speed)
    events = axis.goes(0.0, 5)
    while axis.speed:
        braked = min(acceleration, abs(axis.speed) / 2e-3)
        events.append(axis.move(math.copysign(braked, -axis.speed), axis.word()))
        if abs(axis.speed) < 1e-9:
            axis.speed = 0.0
    events += axis.goes(0.0, rests) + axis.goes(acceleration, 20)
    assert set(events) == {Event.DRIVE_ARMED}


@pytest.mark.parametrize("silent_ms", [10, 60, 95])
def test_samples_that_do_not_come_after_a_short_rest_raise_no_doubt(silent_ms: int) -> None:
    """The drive counts on while its link is silent."""
    axis = Axis(0.0, 0.0)
    axis.goes(0.0, 3)
    axis.t_ns += silent_ms * NS_PER_MS
    axis.true += 0.02
    assert set(axis.goes(0.0, 20)) == {Event.DRIVE_ARMED}
    assert not axis.samples.turns_lost


@pytest.mark.parametrize("in_turn", [0.02, 0.1, 0.3, 0.499, 0.501, 0.95])
@pytest.mark.parametrize("armed", [True, False])
def test_an_encoder_that_reads_0_is_noticed_from_any_angle(in_turn: float, armed: bool) -> None:
    """And one that rests elsewhere than at its 0 does not read 0."""
    for reads_zero in (True, False):
        axis = Axis(2.0 + in_turn, 0.0)
        axis.goes(0.0, 5)
        axis.sample(DriveStatus.IDLE, armed=False, zero=(0.0, 0.5))
        for _ in range(500):
            axis.move(0.0, 0.0 if reads_zero else axis.word(), armed=armed)
        assert axis.samples.turns_lost is reads_zero


@pytest.mark.parametrize(
    ("change", "dead"), [(0.0, False), (STICTION - 1.0, False), (STICTION + 1.0, True)]
)
def test_an_axis_that_rests_at_its_encoders_0_is_dead_only_if_a_torque_does_not_move_it(
    change: float, dead: bool
) -> None:
    """A parked robot rested a live motor there, and the module lost its torque."""
    watch = TurnWatch(encoder_zero=0.3)
    for cycle in range(100):
        torque = 20.0 + change * (cycle > 50)
        pos = 2.3 + 1e-3 * max(0, 10 - cycle)  # it comes to rest slowly
        assert watch.process(T_NS + cycle * PERIOD_NS, pos, 0.0, 0.0, 1.0, torque)
    assert watch.lost is dead
    idle = TurnWatch(encoder_zero=0.3)
    for cycle in range(100):
        idle.process(T_NS + cycle * PERIOD_NS, 2.3, 0.0, 0.0, 1.0, None)
    assert idle.lost, "it does not arm"


def test_a_position_is_at_the_encoders_0_within_three_counts_on_either_side() -> None:
    watch = TurnWatch(encoder_zero=0.3)
    for turns in (0.0, 3.0, -2.0):
        for off in (-2.0, -0.5, 0.5, 2.0, 2500.0):
            assert watch.is_zero(turns + 0.3 + off * AT_ZERO) is (abs(off) < 1.0)
    assert not TurnWatch().is_zero(-1.0), "it is not known where"


@pytest.mark.parametrize("axis", [0, 1])
def test_an_idle_axis_that_jumps_has_moved_until_its_encoders_0_is_told(axis: int) -> None:
    samples, at = JointEstimate(N), [0.0, 0.0]

    def take(t_ns: int, zero: Pair | None = None) -> bool:
        pos = (at[0], at[1])
        reading = DriveReading(t_ns, pos, (0.0, 0.0), DriveStatus.IDLE, 0, None, zero)
        samples.process(reading, armed=False)
        return samples.moved

    assert not take(T_NS, (0.1, 0.1))
    assert not take(T_NS + PERIOD_NS)
    at[axis] = 3.0
    for cycle in (2, 3):
        assert take(T_NS + cycle * PERIOD_NS), "as long as it is not known why"
    assert not take(T_NS + 4 * PERIOD_NS, (0.4, 0.4))


@pytest.mark.parametrize("armed", [True, False])
def test_a_failed_encoder_lacks_turns_until_the_drive_has_no_zero(armed: bool) -> None:
    axis = Axis(0.0, 0.0)
    axis.sample(DriveStatus.ERROR, armed=armed, error=int(AxisError.ENCODER_FAILED))
    axis.sample(DriveStatus.IDLE, armed=armed)
    assert axis.samples.turns_lost
    axis.sample(DriveStatus.UNZEROED, armed=False)
    axis.sample(DriveStatus.IDLE, armed=False)
    assert not axis.samples.turns_lost


# ---- one watch by itself


def rested(slowest: float, fastest: float, rested_ns: int) -> TurnWatch:
    """Return a watch of an axis that has rested at 0, its newest sample a period before T_NS."""
    newest_ns = T_NS - PERIOD_NS
    return TurnWatch(0.0, newest_ns - rested_ns, slowest, fastest, newest_ns)


def goes_on(watch: TurnWatch, jump: float) -> bool:
    """Return True if the watch says that the motor may have gone so far, unseen, in its rest."""
    return watch.process(T_NS, jump, 0.0, jump, -1.0, 0.0)  # seen, it cannot have gone at all


def reach(slowest: float, fastest: float, blind_s: float) -> tuple[float, float]:
    """Return the ends of where a motor may be: no words came for so long, or a settling more.

    Its speed was within the bounds a settling ago, which it may have left by `FADES` meanwhile; by
    `ACCELERATION` it changes evenly, so half of that counts.
    """
    longest_s = blind_s + SETTLES_S
    room = ACCELERATION * longest_s / 2.0 + FADES * SETTLES_S
    ways = [v * s for v in (slowest - room, fastest + room) for s in (blind_s, longest_s)]
    return min(ways), max(ways)


@pytest.mark.parametrize("rested_ms", [4, 10, 24, 50])
@pytest.mark.parametrize("bounds", [(-40.0, -20.0), (-1.0, 1.0), (0.0, 0.0), (20.0, 40.0), "slow"])
def test_a_jump_after_a_rest_is_possible_as_far_as_the_motor_can_have_gone(
    rested_ms: int, bounds: tuple[float, float] | str
) -> None:
    blind_s = 1e-3 * rested_ms + PERIOD_NS / NS_PER_S
    if isinstance(bounds, str):  # half a turn a second at least, or at most: nearly no way at all
        room = ACCELERATION * (blind_s + SETTLES_S) / 2.0 + FADES * SETTLES_S
        several = [(room + 0.5, room + 0.6), (-room - 0.6, 0.5 - room)]
    else:
        several = [bounds]
    for slowest, fastest in several:
        ends = reach(slowest, fastest, blind_s)
        for end, inwards in zip(ends, (1e-4, -1e-4), strict=True):
            for jump, possible in ((end + inwards, True), (end - inwards, False)):
                watch = rested(slowest, fastest, rested_ms * NS_PER_MS)
                assert goes_on(watch, jump) is possible
                others = (jump - 1.0, jump + 1.0)
                assert watch.lost is any(ends[0] <= other <= ends[1] for other in others)


def test_a_rest_is_a_gap_from_two_periods_on_up_to_what_the_drive_reports_itself() -> None:
    rests = {STILL_NS - 1: False, STILL_NS: True, GAP_NS: True, GAP_NS + 1: False}
    for rested_ns, explained in rests.items():
        assert goes_on(rested(-9.0, 9.0, rested_ns), 0.05) is explained


def test_an_axis_that_is_seen_goes_as_far_as_it_is_free_to_and_rests_within_a_third_count() -> None:
    for jump, possible in ((0.25, True), (-0.25, True), (0.26, False)):
        assert TurnWatch().process(T_NS, jump, 0.0, jump, 0.25, 0.0) is possible
    watch = TurnWatch(0.0, 5)
    watch.process(T_NS, STILL, 0.0, STILL, 1.0, 0.0)
    assert (watch.pos, watch.changed_ns) == (0.0, 5)


def test_the_bounds_of_the_speed_follow_it_no_faster_than_a_motor_can() -> None:
    """Outwards by its largest acceleration, inwards by half of it; after a long rest it is 0."""
    watch = TurnWatch(0.0, T_NS, 10.0, 10.0, T_NS)
    watch.process(T_NS + PERIOD_NS, 0.02, -10.0, 0.02, 1.0, 0.0)
    assert (watch.slowest, watch.fastest) == pytest.approx((9.2, 9.6))
    watch.process(T_NS + 2 * GAP_NS, 0.02, 0.0, 0.0, 1.0, 0.0)
    assert (watch.slowest, watch.fastest) == (0.0, 0.0)


# ---- which samples of a drive are believed


def reading(
    t_ns: int,
    pos: Pair = (1.0, -2.0),
    vel: Pair = (0.0, 0.0),
    status: DriveStatus = DriveStatus.ARMED,
) -> DriveReading:
    return DriveReading(t_ns, pos, vel, status, 0)


@pytest.fixture
def samples() -> JointEstimate:
    samples = JointEstimate(N)
    samples.process(reading(T_NS), armed=True)
    return samples


@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize(("beyond", "accepted"), [(-1e-6, True), (1e-6, False)])
def test_a_motor_moves_no_further_than_its_speed_and_a_margin_explain(
    samples: JointEstimate, motor: int, beyond: float, accepted: bool
) -> None:
    before = list(samples.pos)
    moved = list(before)
    moved[motor] += JUMP_TURNS + JUMP_SPEED * 2e-3 + beyond
    event = samples.process(reading(T_NS + PERIOD_NS, (moved[0], moved[1])), armed=True)
    assert event is (Event.DRIVE_ARMED if accepted else Event.NONE)
    assert list(samples.pos) == (moved if accepted else before)
    assert samples.q == rounded(joint_from_motor(samples.pos, N), POSITION)


@pytest.mark.parametrize(
    ("vel", "moved"),
    [((60.0, 0.0), (1.12, -2.0)), ((0.0, 60.0), (1.0, -1.88)), ((0.0, -60.0), (1.0, -2.12))],
)
def test_a_fast_motor_may_go_on_fast(samples: JointEstimate, vel: Pair, moved: Pair) -> None:
    samples.process(reading(T_NS + PERIOD_NS, vel=vel), armed=True)
    assert samples.process(reading(T_NS + 2 * PERIOD_NS, moved), armed=True) is Event.DRIVE_ARMED
    assert samples.pos == moved


@pytest.mark.parametrize("speed", [1.001 * SPEED_MAX, -1e30, float("nan")])
def test_a_speed_beyond_any_motors_excuses_no_jump(samples: JointEstimate, speed: float) -> None:
    before = samples.pos
    for axis in ((speed, 0.0), (0.0, speed)):
        assert samples.process(reading(T_NS + PERIOD_NS, vel=axis), armed=True) is Event.NONE
        assert samples.vel == (0.0, 0.0)
    assert (
        samples.process(reading(T_NS + PERIOD_NS, (9.0, -2.0)), armed=True) is not Event.DRIVE_ARMED
    )
    assert samples.pos == before


@pytest.mark.parametrize("in_a_row", [True, False])
def test_a_few_odd_samples_in_a_row_and_the_position_is_lost(
    samples: JointEstimate, in_a_row: bool
) -> None:
    """Those that are not in a row are only left out."""
    events = []
    for k in range(1, REJECTED_MAX + 1 if in_a_row else 4 * REJECTED_MAX):
        pos = (5.0 if in_a_row or k % REJECTED_MAX else 1.0, -2.0)
        events.append(samples.process(reading(T_NS + k * PERIOD_NS, pos), armed=True))
    assert (Event.POSITION_LOST in events) is in_a_row
    assert events[: REJECTED_MAX - 1] == [Event.NONE] * (REJECTED_MAX - 1)
    assert samples.pos == (1.0, -2.0)


def test_a_module_that_is_not_controlled_may_be_found_anywhere(samples: JointEstimate) -> None:
    """An axis that disarms is reported even by an odd sample."""
    odd = reading(T_NS + PERIOD_NS, (9.0, 9.0), status=DriveStatus.ERROR)
    for armed in (True, False):
        assert samples.process(odd, armed=armed) is Event.DRIVE_DISARMED
        assert samples.pos == ((1.0, -2.0) if armed else (9.0, 9.0))


@pytest.mark.parametrize(
    ("status", "event"),
    [(DriveStatus.LOST, Event.DRIVE_LOST), (DriveStatus.UNZEROED, Event.POSITION_LOST)],
)
def test_a_position_that_is_old_or_means_nothing_is_not_taken(
    samples: JointEstimate, status: DriveStatus, event: Event
) -> None:
    for armed in (True, False):
        assert samples.process(
            reading(T_NS + PERIOD_NS, (-63.0, -62.0), status=status), armed=armed
        ) is (event)
    assert samples.pos == (1.0, -2.0)
    assert samples.status is status


@pytest.mark.parametrize("armed", [True, False])
def test_a_drive_without_a_zero_may_lack_turns_on_both_axes_if_it_was_controlled(
    samples: JointEstimate, armed: bool
) -> None:
    """Only a joint that nobody controls has moved by a jump."""
    jumped = JointEstimate(N)
    jumped.process(reading(T_NS), armed=True)
    jumped.process(reading(T_NS + PERIOD_NS, (9.0, 9.0)), armed=armed)
    assert (jumped.first.moved, jumped.second.moved) == (not armed, not armed)
    samples.process(reading(T_NS + PERIOD_NS, status=DriveStatus.UNZEROED), armed=armed)
    assert (samples.first.lost, samples.second.lost, samples.accepted_ns) == (armed, armed, 0)


@given(speed=st.floats(-40.0, 40.0), gained=st.floats(-8.0, 8.0), gap_ms=st.integers(1, 100))
def test_a_joint_that_moves_as_legs_do_is_right(speed: float, gained: float, gap_ms: int) -> None:
    samples = JointEstimate(N)
    samples.process(reading(T_NS, vel=(speed, 0.0)), armed=True)
    dt = gap_ms * 1e-3
    pos = (1.0 + (speed + gained * dt / 0.1) * dt, -2.0)
    later = reading(T_NS + gap_ms * NS_PER_MS, pos)
    assert samples.process(later, armed=True) is Event.DRIVE_ARMED
