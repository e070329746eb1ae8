"""Every state against every event, and against docs/architecture.md#age-rule, written once more."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import pytest

from services.joint.failsafe import TRANSITIONS, TRIPS, Event, Failsafe, Timing
from shared.bus.messages import Cause, Mode
from tests.joint.helpers import SESSION, T0, command


class Situation(NamedTuple):
    """All that a cycle can find."""

    mode: Mode
    drive: Event
    estop: bool
    fresh: bool
    hold: bool
    waited: bool
    """Commands have been fresh for long enough."""
    trip: Event = Event.NONE
    """What the module saw of itself."""


DRIVE_EVENTS = (
    Event.NONE,
    Event.DRIVE_ARMED,
    Event.DRIVE_DISARMED,
    Event.DRIVE_LOST,
    Event.POSITION_LOST,
)

TRIP_EVENTS = (Event.NONE, *TRIPS)

FLAGS = (False, True)

SITUATIONS = [
    Situation(mode, drive, *flags, trip)
    for mode, drive, trip in product(Mode, DRIVE_EVENTS, TRIP_EVENTS)
    for flags in product(FLAGS, FLAGS, FLAGS, FLAGS)
]


def mode_by_the_docs(s: Situation) -> Mode:
    """Return the state that docs/architecture.md#age-rule asks for.

    DISARMED -> HOLD (at power-up, once armed) <-> TRACK (fresh commands); DAMP (e-stop):
    stiffness never comes back by itself; FAULT (drive lost), which nothing leaves.
    """
    if s.mode is Mode.FAULT:
        return Mode.FAULT
    if s.estop and s.mode is not Mode.DAMP:
        return Mode.DAMP
    gone = s.drive in (Event.DRIVE_LOST, Event.DRIVE_DISARMED, Event.POSITION_LOST)
    if s.mode is Mode.DISARMED:  # a drive that was never armed cannot be lost
        return Mode.HOLD if s.drive is Event.DRIVE_ARMED else Mode.DISARMED
    if gone:
        return Mode.FAULT
    if s.mode is Mode.DAMP:
        return Mode.DAMP
    wanted = s.fresh and not s.hold
    if s.mode is Mode.TRACK:
        return Mode.TRACK if wanted and s.trip is Event.NONE else Mode.HOLD
    return Mode.TRACK if wanted and s.waited else Mode.HOLD


def placed(s: Situation, timing: Timing) -> Failsafe:
    """Return a failsafe in this situation at T0."""
    age_ns = timing.max_command_age_ns + (0 if s.fresh else 1)
    since_ns = T0 - timing.engage_after_ns + (0 if s.waited else 1)
    return Failsafe(
        mode=s.mode,
        command=command(echo_t_ns=T0 - age_ns, hold=s.hold),
        session=SESSION,
        fresh_since_ns=since_ns,
    )


def test_the_sweep_knows_every_state_and_every_event() -> None:
    assert set(TRANSITIONS) == set(Mode)
    assert {*DRIVE_EVENTS, *TRIPS} | {
        Event.ESTOP,
        Event.PLANNER_ENDED,
        Event.COMMAND_STALE,
        Event.HOLD_REQUESTED,
        Event.READY,
    } == set(Event)
    assert len(SITUATIONS) == 5 * 5 * 4 * 2**4


@pytest.mark.parametrize("mode", Mode)
def test_every_situation_leads_to_its_state_by_the_age_rule(mode: Mode, timing: Timing) -> None:
    for situation in (s for s in SITUATIONS if s.mode is mode):
        failsafe = placed(situation, timing)
        cause = failsafe.advance(T0, timing, situation.drive, situation.estop, situation.trip)
        assert failsafe.mode is mode_by_the_docs(situation), situation
        assert (cause is None) == (failsafe.mode is mode), situation


@pytest.mark.parametrize(("mode", "event"), list(product(Mode, Event)))
def test_advance_follows_the_table_throughout(mode: Mode, event: Event, timing: Timing) -> None:
    situation = Situation(
        mode,
        drive=event if event in DRIVE_EVENTS else Event.NONE,
        estop=event is Event.ESTOP,
        fresh=event is not Event.COMMAND_STALE,
        hold=event is Event.HOLD_REQUESTED,
        waited=event is Event.READY,
        trip=event if event in TRIPS else Event.NONE,
    )
    failsafe = placed(situation, timing)
    if event is Event.PLANNER_ENDED:
        failsafe.end_session(SESSION)
    cause = failsafe.advance(T0, timing, situation.drive, situation.estop, situation.trip)
    assert (failsafe.mode, cause) == TRANSITIONS[mode].get(event, (mode, None))


CAUSES = {
    (Mode.DISARMED, Mode.HOLD): {Cause.DRIVE_ARMED},
    (Mode.HOLD, Mode.TRACK): {Cause.COMMANDS_FRESH},
    (Mode.TRACK, Mode.HOLD): {
        Cause.PLANNER_ENDED,
        Cause.COMMAND_STALE,
        Cause.HOLD_ALL,
        Cause.SHAKING,
        Cause.TORQUE_LIMIT,
        Cause.TOO_FAST,
    },
}


def test_every_change_has_a_cause_that_fits_it() -> None:
    for before, row in TRANSITIONS.items():
        for after, cause in row.values():
            if after is Mode.DAMP:
                assert cause is Cause.ESTOP
            elif after is Mode.FAULT:
                assert cause in (Cause.DRIVE_LOST, Cause.DRIVE_DISARMED, Cause.POSITION_LOST)
            else:
                assert cause in CAUSES[before, after]


@pytest.mark.parametrize("estop", FLAGS)
@pytest.mark.parametrize("drive", DRIVE_EVENTS)
def test_nothing_leaves_fault(drive: Event, estop: bool, timing: Timing) -> None:
    for situation in (s for s in SITUATIONS if s.mode is Mode.FAULT):
        failsafe = placed(situation, timing)
        for _ in range(3):
            failsafe.advance(T0, timing, drive, estop)
        assert failsafe.mode is Mode.FAULT


def test_only_a_lost_drive_leaves_damp(timing: Timing) -> None:
    left = set()
    for situation in (s for s in SITUATIONS if s.mode is Mode.DAMP):
        failsafe = placed(situation, timing)
        if failsafe.advance(T0, timing, situation.drive, situation.estop) is not None:
            assert failsafe.mode is Mode.FAULT
            left.add(situation.drive)
    assert left == {Event.DRIVE_LOST, Event.DRIVE_DISARMED, Event.POSITION_LOST}


def test_an_emergency_stop_that_is_released_again_stays_in_damp(timing: Timing) -> None:
    failsafe = placed(Situation(Mode.TRACK, Event.NONE, True, True, False, True), timing)
    failsafe.advance(T0, timing, Event.DRIVE_ARMED, estop=True)
    failsafe.advance(T0, timing, Event.DRIVE_ARMED, estop=False)
    assert failsafe.mode is Mode.DAMP


def test_emergency_stop_and_lost_drive_in_one_cycle_end_in_fault(timing: Timing) -> None:
    for mode in (Mode.HOLD, Mode.TRACK, Mode.DAMP):
        failsafe = placed(Situation(mode, Event.NONE, True, True, False, True), timing)
        failsafe.advance(T0, timing, Event.DRIVE_LOST, estop=True)
        failsafe.advance(T0, timing, Event.DRIVE_LOST, estop=True)
        assert failsafe.mode is Mode.FAULT
