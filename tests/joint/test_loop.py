"""The joint service's loop against a drive and a bus that the test holds."""

from __future__ import annotations

import logging
from collections import deque
from pathlib import Path
from typing import Any, Generic, cast

import pytest

from services.joint.differential import motor_from_joint
from services.joint.drive_manager import ARM_EVERY_NS, IDLE_EVERY_NS, DriveManager
from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.loop import JointLoop, JointPorts
from services.joint.rearm_guard import LastState, RearmGuard
from shared.bus.messages import (
    Cause,
    DriveStatus,
    Estop,
    JointCommand,
    JointEvent,
    JointState,
    Mode,
    Pair,
    Refusal,
)  # fmt: skip
from shared.bus.ports import M
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import ROBOT, SESSION, T0, command, with_service


class Inbox(Generic[M]):
    def __init__(self) -> None:
        self.waiting: deque[M] = deque()
        self.refused = 0

    def take(self) -> M | None:
        return self.waiting.popleft() if self.waiting else None


class Outbox(Generic[M]):
    def __init__(self) -> None:
        self.sent: list[M] = []

    def put(self, message: M) -> bool:
        self.sent.append(message)
        return True


class FakeDrive:
    """Answers with the status and the pose that the test gives it; arms if it is to."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.status = DriveStatus.IDLE
        self.q: Pair = (0.0, -1.0)
        self.silent, self.obeys = False, True
        self.comes_back = False
        """Errors are there again as soon as they are cleared."""
        self.armed = self.idled = self.cleared = 0
        self.told: list[Pair] = []
        """Where the motors were told that they are."""
        self.torques: list[Pair] = []
        self.targets: list[MotorTarget] = []
        self.set_position = self.told.append
        self.write_torque, self.write = self.torques.append, self.targets.append

    def read(self, _timeout_s: float) -> DriveReading | None:
        if self.silent:
            return None
        pos = motor_from_joint(self.q, self.rig.gear_ratio)
        return DriveReading(self.rig.now_ns, pos, (0.0, 0.0), self.status, 0)

    def arm(self, *, onboard: bool) -> None:
        assert onboard is self.rig.onboard
        self.armed += 1
        self.status = DriveStatus.ARMED if self.obeys else self.status

    def clear_errors(self) -> None:
        self.cleared += 1
        self.status = self.status if self.comes_back else DriveStatus.IDLE

    def idle(self) -> None:
        self.idled += 1


class Rig:
    """A service's loop over one drive, and the file that outlives it, if there is one."""

    ended_session = seq = 0

    def __init__(self, robot: RobotConfig, file: RearmGuard | None = None) -> None:
        self.now_ns = T0
        self.onboard = robot.joint_service.loop == "onboard"
        self.gear_ratio = robot.joint.gear_ratio
        self.zero_mark_turns = robot.drive.zero_mark_turns
        self.period_ns = round(1e9 / robot.joint_service.rate_hz)
        self.drive = FakeDrive(self)
        module = DriveManager(robot, "knee_right", file.read() if file else LastState.NOTHING)
        self.law, self.controller = module.controller, module.state.controller
        self.commands, self.estops = Inbox[JointCommand](), Inbox[Estop]()
        self.states, self.events = Outbox[JointState](), Outbox[JointEvent]()
        self.traces = Outbox[JointTrace]()
        ports = JointPorts(
            self.commands, self.estops, self.states, self.events, self.traces, planner=self
        )
        self.loop = JointLoop(robot, module, self.drive, ports, file, clock=lambda: self.now_ns)

    @property
    def mode(self) -> Mode:
        return self.controller.failsafe.mode

    def ended(self) -> int:
        """Return the session whose planner's process has ended, once."""
        session, self.ended_session = self.ended_session, 0
        return session

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.now_ns += self.period_ns
            self.loop.report(self.loop.cycle())

    def run_ns(self, time_ns: int) -> None:
        self.run(2 + time_ns // self.period_ns)

    def end(self, after: int = 5, *, interrupted: bool) -> None:
        """Stop the service after some cycles, alone or with the fleet."""
        self.loop.run(cast("Any", Stop(after, interrupted=interrupted)))

    def lead(self, commands: int) -> None:
        """Send commands, each echoing the newest state; two cycles for each."""
        for _ in range(commands):
            self.seq += 1
            stamp = self.states.sent[-1].t_ns
            self.commands.waiting.append(command(seq=self.seq, echo_t_ns=stamp))
            self.run(2)


@pytest.fixture(params=["onboard", "service"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(with_service(ROBOT, loop=request.param))


class Stop:
    """Told to stop after so many looks."""

    def __init__(self, after: int, *, interrupted: bool) -> None:
        self.left = after
        self.interrupted = interrupted

    def __bool__(self) -> bool:
        self.left -= 1
        return self.left < 0


@pytest.mark.parametrize(
    "why", ["nothing", "lost", "outside its limits", "its errors come back", "no state is sent"]
)
def test_a_drive_is_armed_once_and_only_when_nothing_speaks_against_it(rig: Rig, why: str) -> None:
    """A knee that has not been zeroed reads 0: its soft stop would kick it with 80 N m.

    A failed encoder shows again 51 ms after it was cleared; armed meanwhile, it is blind.
    """
    drive, q, put = rig.drive, rig.drive.q, rig.states.put
    drive.comes_back = why == "its errors come back"
    if why == "lost":
        drive.status = DriveStatus.LOST
    elif drive.comes_back:
        drive.status = DriveStatus.ERROR
    elif why == "outside its limits":
        drive.q = (0.0, 0.0)
    elif why == "no state is sent":
        rig.states.put = lambda _message: False  # type: ignore[method-assign]
    if why != "nothing":
        rig.run_ns(4 * ARM_EVERY_NS)
        assert (drive.armed, drive.targets) == (0, [])
        assert set(drive.torques) <= {(0.0, 0.0)}
    assert (drive.cleared > 2) is drive.comes_back
    drive.comes_back, drive.q, rig.states.put = False, q, put  # type: ignore[method-assign]
    drive.status = DriveStatus.IDLE if drive.status is DriveStatus.LOST else drive.status
    rig.run(2) if why == "nothing" else rig.run_ns(2 * ARM_EVERY_NS)
    assert (drive.armed, rig.mode) == (1, Mode.HOLD)


def test_a_torque_drive_armed_by_another_is_armed_by_us_before_it_is_held() -> None:
    rig = Rig(with_service(ROBOT, loop="service"))
    rig.drive.status = DriveStatus.ARMED
    for mode in (Mode.DISARMED, Mode.HOLD):
        rig.run(1)
        assert (rig.mode, rig.drive.armed) == (mode, 1)


@pytest.mark.parametrize("loop", ["onboard", "service"])
@pytest.mark.parametrize("interrupted", [True, False])
@pytest.mark.parametrize(
    ("mode", "left"), [(Mode.DISARMED, "NOTHING"), (Mode.HOLD, "HELD"), (Mode.DAMP, "DAMP")]
)
def test_a_fleet_that_goes_down_leaves_idle_drives_and_a_service_ended_alone_one_that_holds(
    tmp_path: Path, mode: Mode, left: str, interrupted: bool, loop: str
) -> None:
    """A fleet that goes down leaves nothing, a service that ends alone that it held or sank."""
    guard = RearmGuard(tmp_path, "knee_right")
    rig = Rig(with_service(ROBOT, loop=loop), guard)
    rig.drive.obeys = mode is not Mode.DISARMED
    rig.run(20)
    if mode is Mode.DAMP:
        rig.estops.waiting.append(Estop(t_ns=0, seq=1, source="test"))
        rig.run(5)
    assert (rig.mode, guard.read()) == (mode, LastState[left])
    rig.end(interrupted=interrupted)
    goes_on = loop == "onboard" and mode is not Mode.DISARMED and not interrupted
    assert rig.drive.idled == int(not goes_on)
    assert guard.read() is (LastState.NOTHING if interrupted else LastState[left])


def test_states_carry_the_stamp_of_the_drives_sample(rig: Rig) -> None:
    """Commands made from old samples are old: a silent drive ends in HOLD, not in TRACK."""
    rig.run(5)
    rig.lead(200)
    assert rig.mode is Mode.TRACK
    rig.drive.silent = True
    sampled = rig.states.sent[-1].t_ns
    rig.lead(30)  # 120 ms: a planner that goes on with what it hears
    assert rig.states.sent[-1].t_ns - sampled <= 2 * rig.period_ns
    assert rig.mode is Mode.HOLD


def test_a_lost_position_idles_the_drive_and_then_makes_it_forget_its_zero(rig: Rig) -> None:
    rig.run(20)
    rig.drive.status = DriveStatus.UNZEROED
    rig.run(1)
    assert (rig.mode, rig.drive.idled, rig.drive.told) == (Mode.FAULT, 1, [])
    rig.run_ns(3 * IDLE_EVERY_NS)
    assert rig.drive.told == [(-rig.zero_mark_turns,) * 2]
    assert rig.drive.armed == 1, "never again by itself"
    assert rig.states.sent[-1].q == pytest.approx(rig.drive.q)


def test_every_cycle_is_traced_and_the_rest_when_the_service_ends(rig: Rig) -> None:
    rig.run(25)
    assert [len(trace.cycles) for trace in rig.traces.sent] == [10, 10]
    rig.end(3, interrupted=False)
    assert [len(trace.cycles) for trace in rig.traces.sent] == [10, 10, 8]
    assert [bool(trace.snapshot) for trace in rig.traces.sent] == [True, False, False]
    assert [trace.seq for trace in rig.traces.sent] == [1, 2, 3]


@pytest.mark.parametrize(("after_s", "errors"), [(1, 0), (4, 1)])
def test_a_drive_that_starts_after_its_service_is_an_error_only_if_it_lasts(
    rig: Rig, caplog: pytest.LogCaptureFixture, after_s: int, errors: int
) -> None:
    """Each healthy start logged an error in three services."""
    caplog.set_level(logging.INFO, "xrl")
    rig.drive.status = DriveStatus.UNACKNOWLEDGED
    rig.run_ns(after_s * NS_PER_S)
    rig.drive.status = DriveStatus.IDLE
    rig.run_ns(NS_PER_S)
    assert rig.mode is Mode.HOLD
    levels = [row.levelno for row in caplog.records]
    assert levels == [logging.INFO] + [logging.ERROR] * errors


def test_what_is_no_command_is_counted_and_traced_with_its_cycle(rig: Rig) -> None:
    rig.run(5)
    rig.commands.refused = 3
    rig.run(20)
    state = rig.states.sent[-1]
    assert (state.refused, state.refusal, state.refused_session) == (3, Refusal.MALFORMED, 0)
    cycles = [cycle for trace in rig.traces.sent for cycle in trace.cycles]
    assert [cycle.malformed for cycle in cycles[:8]] == [0, 0, 0, 0, 0, 3, 0, 0]


def test_the_end_of_the_planners_process_is_hold_in_that_cycle_and_traced(rig: Rig) -> None:
    rig.run(5)
    rig.lead(200)
    rig.ended_session = SESSION + 1
    rig.lead(20)
    assert rig.mode is Mode.TRACK, "somebody else's"
    cycle = rig.controller.cycle
    rig.ended_session = SESSION
    rig.run(1)
    event = rig.events.sent[-1]
    assert (rig.mode, event.cause) == (Mode.HOLD, Cause.PLANNER_ENDED)
    assert event.age_ns < rig.law.timing.max_command_age_ns, "it was not the age rule"
    rig.run(20)
    cycles = [each for trace in rig.traces.sent for each in trace.cycles]
    ended = {at: each.ended for at, each in enumerate(cycles, 1) if each.ended}
    assert ended == {cycle - 39: SESSION + 1, cycle + 1: SESSION}
