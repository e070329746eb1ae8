"""What `xrl status` makes of a module's state."""

from __future__ import annotations

from itertools import product

import msgspec
import pytest

from shared.bus.messages import Cause, DriveStatus, JointState, Mode, Outside
from shared.robot.trip_table import JOINT_TRIPS
from tools.fleet.fleet_status import LeadStatus, lead_status, module_status
from tools.verbs.status import describe_lead


def state(mode: Mode, cause: Cause, drive: DriveStatus) -> JointState:
    zero = (0.0, 0.0)
    return JointState(
        t_ns=1, seq=1, q=(0.1, -0.5), v=zero, tau=zero, mode=mode, cause=cause, ready=False,
        age_ns=-1, session=0, command_seq=-1, cycle=1, late=0, dropouts=0, refused=0,
        drive=drive, drive_error=0,
    )  # fmt: skip


@pytest.mark.parametrize(("mode", "cause", "drive"), list(product(Mode, Cause, DriveStatus)))
def test_a_way_out_is_given_only_where_a_person_must_act(
    mode: Mode, cause: Cause, drive: DriveStatus
) -> None:
    status = module_status(state(mode, cause, drive))
    waits = (DriveStatus.IDLE, DriveStatus.ERROR)
    helpless = (
        mode in (Mode.FAULT, Mode.DAMP)
        or drive in (DriveStatus.UNZEROED, DriveStatus.HOLDING)
        or (mode is Mode.DISARMED and drive in waits)
        or (mode is Mode.HOLD and cause in JOINT_TRIPS)
    )
    assert bool(status.way_out) is helpless
    if mode is Mode.FAULT:
        assert "xrl kill" in status.way_out
        assert ("xrl zero" in status.way_out) is (cause in (Cause.DRIVE_LOST, Cause.POSITION_LOST))


@pytest.mark.parametrize("drive", DriveStatus)
def test_angles_are_reported_only_where_the_drive_knows_them(drive: DriveStatus) -> None:
    status = module_status(state(Mode.DISARMED, Cause.NONE, drive))
    assert (status.q is None) is (drive in (DriveStatus.LOST, DriveStatus.UNZEROED))


@pytest.mark.parametrize("outside", [each for each in Outside if each])
def test_what_a_module_does_not_believe_is_named_with_the_way_out(outside: Outside) -> None:
    fine = state(Mode.HOLD, Cause.COMMAND_STALE, DriveStatus.ARMED)
    status = module_status(msgspec.structs.replace(fine, outside=int(outside)))
    assert status.outside == outside.name
    assert outside.name.lower() in status.way_out
    assert "xrl kill planner" in status.way_out
    assert (module_status(fine).outside, module_status(fine).way_out) == ("", "")


def test_a_module_without_states_is_not_guessed_at() -> None:
    status = module_status(None)
    assert (status.mode, status.tier, status.q, status.way_out) == (None, None, None, "")


def test_a_silent_planner_is_reported() -> None:
    assert lead_status(None) is None
    assert "each module holds" in describe_lead(None)


def test_the_reason_why_the_planner_does_not_lead_yet_is_reported() -> None:
    good = LeadStatus("LEADING", wait_s=0.0, margin=1.2)
    assert describe_lead(good) == "planner LEADING, margin 1.20"
    waits = describe_lead(LeadStatus("ALIGNING", wait_s=12.3, margin=1.2))
    assert "leads again in 12 s" in waits
    line = describe_lead(LeadStatus("MISPLACED", wait_s=0.0, margin=1.2, why="a foot is ahead"))
    assert line == "planner MISPLACED, margin 1.20; a foot is ahead"
