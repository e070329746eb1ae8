"""Every state against every event, and against docs/architecture.md#age-rule, written once more."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import pytest

from services.joint.failsafe import FALLEN_NS, TRANSITIONS, TRIPS, Event, Failsafe
from shared.bus.messages import Cause, Mode
from tests.joint.helpers import SESSION, T0, TIMING, command

GONE = (Event.DRIVE_LOST, Event.DRIVE_DISARMED, Event.POSITION_LOST)


class Situation(NamedTuple):
    """All that a cycle can find."""

    mode: Mode
    drive: Event
    trip: Event
    """What the module saw of itself."""
    estop: bool
    fresh: bool
    hold: bool
    waited: bool
    """Commands have been fresh for long enough."""
    ended: bool
    """The planner's process has ended since the last cycle."""
    fallen: bool
    """The planner has said for `FALLEN_NS` that the robot has fallen."""


def situations(mode: Mode) -> list[Situation]:
    drives, trips = (Event.NONE, Event.DRIVE_ARMED, *GONE), (Event.NONE, *TRIPS)
    flags = [(False, True)] * 6
    return [Situation(mode, *rest) for rest in product(drives, trips, *flags)]


def by_the_docs(s: Situation) -> tuple[Mode, Cause | None]:
    """Return the state that docs/architecture.md#age-rule asks for, and its cause if it changes.

    DISARMED -> HOLD (at power-up, once armed) <-> TRACK (fresh commands); DAMP (e-stop, a fall):
    stiffness never comes back by itself; FAULT (drive lost), which nothing leaves.
    """
    if s.mode is Mode.FAULT:
        return Mode.FAULT, None
    if s.estop and s.mode is not Mode.DAMP:
        return Mode.DAMP, Cause.ESTOP
    if s.mode is Mode.DISARMED:  # a drive that was never armed cannot be lost
        armed = s.drive is Event.DRIVE_ARMED
        return (Mode.HOLD, Cause.DRIVE_ARMED) if armed else (Mode.DISARMED, None)
    if s.drive in GONE:
        return Mode.FAULT, Cause[s.drive.name]
    if s.fallen and s.fresh:  # and it has been armed for so long
        return Mode.DAMP, Cause.FALLEN
    if s.mode is Mode.TRACK:
        causes = (
            (s.trip is not Event.NONE, s.trip.name), (s.ended, "PLANNER_ENDED"),
            (not s.fresh, "COMMAND_STALE"), (s.hold, "HOLD_ALL"),
        )  # fmt: skip
        names = [name for applies, name in causes if applies]
        return (Mode.HOLD, Cause[names[0]]) if names else (Mode.TRACK, None)
    leads = s.fresh and not s.hold and s.waited and not s.ended
    return (Mode.TRACK, Cause.COMMANDS_FRESH) if leads and s.mode is Mode.HOLD else (s.mode, None)


@pytest.mark.parametrize("mode", Mode)
def test_every_situation_leads_to_its_state_for_its_cause_by_the_age_rule(mode: Mode) -> None:
    found = set()
    for s in situations(mode):
        failsafe = Failsafe(
            mode=s.mode,
            command=command(
                echo_t_ns=T0 - TIMING.max_command_age_ns - (not s.fresh),
                hold=s.hold,
                fallen=s.fallen,
            ),
            session=SESSION,
            fresh_since_ns=T0 - TIMING.engage_after_ns + (not s.waited),
            fallen_since_ns=T0 - FALLEN_NS if s.fallen else -1,
        )
        if s.ended:
            failsafe.end_session(SESSION)
        cause = failsafe.advance(T0, TIMING, s.drive, s.estop, s.trip)
        assert (failsafe.mode, cause) == by_the_docs(s), s
        found |= {(failsafe.mode, cause)} if cause is not None else set()
    assert found == set(TRANSITIONS[mode].values()), "the sweep brings about every transition"


@pytest.mark.parametrize("said_ns", [0, FALLEN_NS - 1, FALLEN_NS])
def test_only_a_planner_that_insists_makes_a_module_limp(said_ns: int) -> None:
    failsafe = Failsafe(mode=Mode.HOLD, session=SESSION)
    for at_ns, fallen in ((0, True), (1, False), (2, True), (2 + said_ns, True)):
        failsafe.command = command(echo_t_ns=T0 + at_ns, hold=True, fallen=fallen)
        failsafe.advance(T0 + at_ns, TIMING, Event.NONE, estop=False)
    assert failsafe.limp == (said_ns >= FALLEN_NS)
    assert failsafe.mode is (Mode.DAMP if failsafe.limp else Mode.HOLD)
