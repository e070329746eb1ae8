"""What `xrl status` makes of a module's state."""

from __future__ import annotations

import io
import os
import re
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from shared import scheduling
from shared.bus.messages import (
    LOST_DRIVE,
    Cause,
    DriveStatus,
    JointState,
    Message,
    Mode,
    Outside,
    Refusal,
    ToolRoster,
    Wearing,
)
from shared.bus.pubsub import Latest
from shared.bus.session import place_of_tool
from shared.clock import NS_PER_S, now_ns
from shared.joints import MODULES
from shared.robot.trip_table import JOINT_TRIPS, WEARING
from tests.messages import joint_state
from tools.fleet import fleet_status, procfs
from tools.fleet.fleet_status import (
    FleetStatus,
    LeadStatus,
    ModuleStatus,
    RateMonitor,
    RefusedCommands,
    _tools_of,
    module_status,
)
from tools.fleet.status_table import (
    _describe_lead,
    _describe_real_time,
    _describe_refusals,
    _describe_sessions,
    _describe_tools,
    _describe_ways_out,
    tables,
    warn_of_others,
)
from tools.fleet.supervisor_client import ServiceInfo
from tools.terminal import Console


def state(mode: Mode, cause: Cause, drive: DriveStatus, **more: object) -> JointState:
    return joint_state(mode=mode, cause=cause, drive=drive, **more)


tracking = partial(state, Mode.TRACK, Cause.COMMANDS_FRESH, DriveStatus.ARMED)


def shown(status: FleetStatus, **options: Any) -> str:
    printed = io.StringIO()
    Console(file=printed, **options).print(tables(status))
    return printed.getvalue()


@pytest.mark.parametrize("mode", Mode)
def test_a_way_out_is_given_only_where_a_person_must_act(mode: Mode) -> None:
    waits = (DriveStatus.IDLE, DriveStatus.ERROR)
    for cause, drive in product(Cause, DriveStatus):
        status = module_status(state(mode, cause, drive))
        helpless = (
            mode in (Mode.FAULT, Mode.DAMP)
            or drive in (DriveStatus.UNZEROED, DriveStatus.HOLDING, DriveStatus.UNACKNOWLEDGED)
            or (mode is Mode.DISARMED and drive in waits)
            or (mode is Mode.HOLD and cause in JOINT_TRIPS)
        )
        assert bool(status.way_out) is helpless, (cause, drive)
        if mode is Mode.FAULT:
            assert "xrl kill" in status.way_out
            is_zeroed = cause not in (Cause.DRIVE_LOST, Cause.POSITION_LOST)
            assert ("xrl drive zero" in status.way_out) is not is_zeroed, (cause, drive)


@pytest.mark.parametrize("drive", DriveStatus)
def test_angles_are_reported_only_where_the_drive_knows_them(drive: DriveStatus) -> None:
    status = module_status(state(Mode.DISARMED, Cause.NONE, drive))
    assert (status.q is None) is (drive in (*LOST_DRIVE, DriveStatus.UNZEROED))


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


@pytest.mark.parametrize(
    ("lead", "words"),
    [
        (None, "planner silent: each module holds on its own"),
        (LeadStatus("LEADING", 0.0, 1.2), "planner LEADING, margin 1.20, carries 0 N"),
        (LeadStatus("ALIGNING", 12.3, 1.2), "leads again in 12 s"),
        (
            LeadStatus("LEADING", 0.0, 1.2, carried_n=310.0, wearer=WEARING[Wearing.RESTS]),
            "carries 310 N; parked: tug up to unpark it",
        ),
        (
            LeadStatus("MISPLACED", 0.0, 1.2, "a foot is ahead"),
            "carries 0 N; a foot is ahead",
        ),
        (LeadStatus("FALLEN", 0.0, 1.2, "it has fallen (apart)"), "planner FALLEN, margin 1.20"),
    ],
)
def test_whether_the_planner_leads_and_why_not_is_reported(
    lead: LeadStatus | None, words: str
) -> None:
    assert words in _describe_lead(lead)
    fell = lead is not None and lead.mode == "FALLEN"
    assert FleetStatus("/tmp/x", "robot.toml", {}, {}, lead).exit_code == int(fell)


def fleet_with(lead_session: int, *modules: ModuleStatus) -> FleetStatus:
    lead = LeadStatus("LEADING", 0.0, 1.1, session=lead_session)
    named = dict(zip(MODULES, modules, strict=False))
    return FleetStatus("/tmp/x", "robot.toml", {}, named, lead)


@pytest.mark.parametrize("refusal", [each for each in Refusal if each])
def test_refused_commands_are_told_with_their_cause_sender_and_what_to_do(refusal: Refusal) -> None:
    rows = [
        module_status(tracking(), (RefusedCommands(refusal.name, 99, hz),)) for hz in (250.0, 120.0)
    ]
    (line,) = _describe_refusals(fleet_with(7, *rows, module_status(tracking())))
    assert f"refused, {refusal.name} of session 99: ankle_right 250/s, knee_right 120/s; " in line
    assert len(line.rpartition("; ")[2]) > 10, "and what to do"
    nobodys = module_status(tracking(), (RefusedCommands(refusal.name, 0, 40.0),))
    (line,) = _describe_refusals(fleet_with(7, nobodys))
    assert line.startswith(f"refused, {refusal.name}: ankle_right 40/s; "), "no command: no session"


def test_each_way_out_is_told_once_with_its_modules_at_any_width() -> None:
    """In a column of the table it was cut off at 80 columns, when it was needed."""
    stopped = module_status(state(Mode.DAMP, Cause.ESTOP, DriveStatus.ARMED))
    lost = module_status(state(Mode.FAULT, Cause.DRIVE_LOST, DriveStatus.LOST))
    status = fleet_with(7, stopped, lost, stopped, module_status(tracking()))
    lines = _describe_ways_out(status)
    assert [line.partition(":")[0] for line in lines] == ["ankle_right, hip_right", "knee_right"]
    assert lines[0].endswith(": xrl rearm")
    assert "xrl kill knee_right" in lines[1]
    words = " ".join(shown(status, width=60).split())
    assert all(line in words for line in lines)


def test_another_fleet_is_named_and_the_own_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procfs, "fleets", lambda: {"/tmp/mine", "/tmp/an #other"})
    printed = io.StringIO()
    warn_of_others(Console(file=printed, width=60), own=Path("/tmp/mine"))
    assert "xrl down --run-dir '/tmp/an #other'" in printed.getvalue()
    assert "mine" not in printed.getvalue()


def test_modules_that_follow_another_planner_are_named() -> None:
    own, other = (module_status(tracking(session=session)) for session in (7, 99))
    words = _describe_sessions(fleet_with(7, own, other))
    assert words == "knee_right: last followed session 99, but the planner's session is 7"
    assert _describe_sessions(fleet_with(7, own, module_status(None))) == ""


def test_the_other_tools_that_are_linked_are_told_with_their_hosts() -> None:
    others = ("lead.pad.17", f"lead.evil.{os.getpid()}", "view.lab-3.9")
    roster = ToolRoster(t_ns=1, seq=1, tools=(*others, f"status.{place_of_tool()}"))
    status = msgspec.structs.replace(fleet_with(7), tools=_tools_of(roster))
    assert _describe_tools(status) == "lead on pad, lead on evil, view on lab-3"
    assert _tools_of(None) == ()


def monitor_of(*states: JointState) -> RateMonitor:
    messages = iter(states)
    latest = SimpleNamespace(take=lambda: next(messages, None))
    return RateMonitor(cast("Latest[Message]", latest))


@pytest.mark.parametrize("apart_s", [-7200, 7200])
def test_a_module_on_a_host_with_another_clock_is_as_old_as_its_last_message_came(
    apart_s: int,
) -> None:
    monitor = monitor_of(tracking(t_ns=now_ns() + apart_s * NS_PER_S))
    assert not monitor.is_fresh()
    monitor.listen()
    assert monitor.is_fresh()
    age_s = monitor.age_s()
    assert age_s is not None
    assert 0.0 <= age_s < 1.0
    monitor._heard_ns -= 2 * NS_PER_S  # two seconds later
    assert not monitor.is_fresh(), "it has been silent since"


def refusals_of(*states: JointState) -> tuple[RefusedCommands, ...]:
    """Return what is refused in a window that began with the first of these states."""
    monitor = monitor_of(*states)
    monitor.listen()
    monitor.new_window()
    for _ in states[1:]:
        monitor.listen()
    return monitor.refusals()


def test_refusals_are_counted_by_cause_and_sender_over_the_window() -> None:
    def later(ms: int, refused: int, refusal: Refusal, session: int) -> JointState:
        return tracking(
            t_ns=1 + ms * 1_000_000, seq=1 + ms, refused=refused, refusal=int(refusal),
            refused_session=session,
        )  # fmt: skip

    assert refusals_of(
        tracking(refused=10),
        later(4, 12, Refusal.MALFORMED, 0),
        later(8, 13, Refusal.NOT_NEWER, 99),
        later(12, 13, Refusal.NOT_NEWER, 99),
        later(100, 16, Refusal.MALFORMED, 0),
    ) == (
        RefusedCommands("MALFORMED", 0, 50.0),
        RefusedCommands("NOT_NEWER", 99, 10.0),
    )


@pytest.mark.parametrize(("first", "last"), [(10, 10), (90, 5)])
def test_no_refusal_is_told_where_none_came_or_the_service_restarted(first: int, last: int) -> None:
    begin = tracking(refused=first, refusal=int(Refusal.TOO_OLD), refused_session=9)
    end = msgspec.structs.replace(begin, t_ns=begin.t_ns + 100_000_000, seq=26, refused=last)
    assert refusals_of(begin, end) == ()


def test_what_others_say_is_data_in_the_status() -> None:
    hostile = "[/b]\x1b[2J\x1b]0;owned\x07\n planner LEADING, margin 9.00"
    stopped = msgspec.structs.replace(
        module_status(state(Mode.DAMP, Cause.ESTOP, DriveStatus.ARMED)),
        mode=hostile, drive=hostile, stopped_by=hostile, way_out=hostile,
    )  # fmt: skip
    status = msgspec.structs.replace(
        fleet_with(7, stopped), lead=LeadStatus(hostile, 0.0, 1.0, why=hostile), tools=(hostile,)
    )
    printed = shown(status)
    assert "[/b]" in printed
    assert not re.search("[\x00-\x09\x0b-\x1f]", printed)


def test_codes_that_this_version_does_not_know_are_told() -> None:
    strange = joint_state(mode=99, cause=98, drive=97, refusal=96, outside=95)
    status = module_status(strange)
    said = (status.mode, status.cause, status.drive)
    assert said == ("unknown (99)", "unknown (98)", "unknown (97)")
    assert "another version" in status.way_out


@pytest.mark.parametrize(
    ("name", "state", "real_time"),
    [
        ("hip_left", "running", False),
        ("planner", "running", False),
        ("planner", "suspended", None),
        ("ros2_gateway", "running", None),
    ],
)
def test_running_services_that_the_table_gives_real_time_and_lack_it_are_told(
    monkeypatch: pytest.MonkeyPatch, name: str, state: str, real_time: bool | None
) -> None:
    monkeypatch.setattr(scheduling, "has_real_time", lambda _pid: False)
    row = fleet_status._service_status(ServiceInfo(name, 7, state, 1.0))
    assert row.real_time is real_time
    words = _describe_real_time(msgspec.structs.replace(fleet_with(7), services={name: row}))
    assert words.endswith(f": {name}") if real_time is False else words == ""
