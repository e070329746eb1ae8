"""Which samples of a drive are believed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import DriveReading, DriveStatus
from services.joint.failsafe import Event
from services.joint.joint_estimate import (
    JUMP_SPEED,
    JUMP_TURNS,
    REJECTED_MAX,
    SPEED_MAX,
    JointEstimate,
)
from shared.bus.messages import Pair
from shared.clock import NS_PER_MS, NS_PER_S

N = 17.5
T0 = NS_PER_S
PERIOD = 2 * NS_PER_MS


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
    samples.take(reading(T0), armed=True)
    return samples


@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize(("beyond", "accepted"), [(-1e-6, True), (1e-6, False)])
def test_a_motor_moves_no_further_than_its_speed_and_a_margin_explain(
    samples: JointEstimate, motor: int, beyond: float, accepted: bool
) -> None:
    before = list(samples.pos)
    moved = list(before)
    moved[motor] += JUMP_TURNS + JUMP_SPEED * 2e-3 + beyond
    event = samples.take(reading(T0 + PERIOD, (moved[0], moved[1])), armed=True)
    assert event is (Event.DRIVE_ARMED if accepted else Event.NONE)
    assert list(samples.pos) == (moved if accepted else before)
    assert samples.q == joint_from_motor(samples.pos, N)


@pytest.mark.parametrize(
    ("vel", "moved"),
    [((60.0, 0.0), (1.12, -2.0)), ((0.0, 60.0), (1.0, -1.88)), ((0.0, -60.0), (1.0, -2.12))],
)
def test_a_fast_motor_may_go_on_fast(samples: JointEstimate, vel: Pair, moved: Pair) -> None:
    samples.take(reading(T0 + PERIOD, vel=vel), armed=True)
    assert samples.take(reading(T0 + 2 * PERIOD, moved), armed=True) is Event.DRIVE_ARMED
    assert samples.pos == moved


@pytest.mark.parametrize("speed", [1.001 * SPEED_MAX, -1e30, float("nan")])
def test_a_speed_beyond_any_motors_excuses_no_jump(samples: JointEstimate, speed: float) -> None:
    before = samples.pos
    for axis in ((speed, 0.0), (0.0, speed)):
        assert samples.take(reading(T0 + PERIOD, vel=axis), armed=True) is Event.NONE
        assert samples.vel == (0.0, 0.0)
    assert samples.take(reading(T0 + PERIOD, (9.0, -2.0)), armed=True) is not Event.DRIVE_ARMED
    assert samples.pos == before


@pytest.mark.parametrize("in_a_row", [True, False])
def test_a_few_odd_samples_in_a_row_and_the_position_is_lost(
    samples: JointEstimate, in_a_row: bool
) -> None:
    """Those that are not in a row are only left out."""
    events = []
    for k in range(1, REJECTED_MAX + 1 if in_a_row else 4 * REJECTED_MAX):
        pos = (5.0 if in_a_row or k % REJECTED_MAX else 1.0, -2.0)
        events.append(samples.take(reading(T0 + k * PERIOD, pos), armed=True))
    assert (Event.POSITION_LOST in events) is in_a_row
    assert events[: REJECTED_MAX - 1] == [Event.NONE] * (REJECTED_MAX - 1)
    assert samples.pos == (1.0, -2.0)


def test_a_module_that_is_not_controlled_may_be_found_anywhere(samples: JointEstimate) -> None:
    """An axis that disarms is reported even by an odd sample."""
    odd = reading(T0 + PERIOD, (9.0, 9.0), status=DriveStatus.ERROR)
    for armed in (True, False):
        assert samples.take(odd, armed=armed) is Event.DRIVE_DISARMED
        assert samples.pos == ((1.0, -2.0) if armed else (9.0, 9.0))


@pytest.mark.parametrize(
    ("status", "event"),
    [(DriveStatus.LOST, Event.DRIVE_LOST), (DriveStatus.UNZEROED, Event.POSITION_LOST)],
)
def test_a_position_that_is_old_or_means_nothing_is_not_taken(
    samples: JointEstimate, status: DriveStatus, event: Event
) -> None:
    for armed in (True, False):
        assert samples.take(reading(T0 + PERIOD, (-63.0, -62.0), status=status), armed=armed) is (
            event
        )
    assert samples.pos == (1.0, -2.0)
    assert samples.status is status


@pytest.mark.parametrize("armed", [True, False])
def test_a_drive_without_a_zero_may_lack_turns_on_both_axes_if_it_was_controlled(
    samples: JointEstimate, armed: bool
) -> None:
    """Only a joint that nobody controls has moved by a jump."""
    jumped = JointEstimate(N)
    jumped.take(reading(T0), armed=True)
    jumped.take(reading(T0 + PERIOD, (9.0, 9.0)), armed=armed)
    assert (jumped.first.moved, jumped.second.moved) == (not armed, not armed)
    samples.take(reading(T0 + PERIOD, status=DriveStatus.UNZEROED), armed=armed)
    assert (samples.first.lost, samples.second.lost, samples.accepted_ns) == (armed, armed, 0)


@given(speed=st.floats(-40.0, 40.0), gained=st.floats(-8.0, 8.0), gap_ms=st.integers(1, 100))
def test_a_joint_that_moves_as_legs_do_is_right(speed: float, gained: float, gap_ms: int) -> None:
    samples = JointEstimate(N)
    samples.take(reading(T0, vel=(speed, 0.0)), armed=True)
    dt = gap_ms * 1e-3
    pos = (1.0 + (speed + gained * dt / 0.1) * dt, -2.0)
    later = reading(T0 + gap_ms * NS_PER_MS, pos)
    assert samples.take(later, armed=True) is Event.DRIVE_ARMED
