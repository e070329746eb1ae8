"""The joint service's loop, clocked by the drive's encoder frames.

Live operation, lockstep and re-execution run this loop, each with its own ports, drive and clock.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

import msgspec

from services.joint.controller import row_of
from services.joint.drive_manager import (
    ARM_TRIES,
    ArmingInhibit,
    DriveAction,
    DriveCommand,
    DriveManager,
)
from services.joint.drivers.base import Drive
from services.joint.heat import HeatFile
from services.joint.neighbours import UNKNOWN, NeighbourRow, NeighbourView
from services.joint.rearm_guard import PENDANT, LastState, PendantWatch, RearmGuard
from services.joint.tracer import Tracer
from shared import log
from shared.bus.messages import (
    Cause,
    DriveStatus,
    Estop,
    JointCommand,
    JointEvent,
    JointState,
    Mode,
)
from shared.bus.ports import CountingInbox, Inbox, Outbox
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_S, now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.process import StopFlag

READ_TIMEOUT_S: Final = 0.005
"""Timeout of a wait for a sample, s (longer over USB); the failsafe also runs without a sample."""

REPORT_EVERY_NS: Final = 10 * NS_PER_S
"""Period at which the reason for not arming is logged again, ns."""
START_NS: Final = 2 * NS_PER_S
"""Time for which missing acknowledgements are no error, ns: the drive may start late."""

_WHY_NOT: Final = {
    ArmingInhibit.UNZEROED: "the drive was never zeroed, or has lost power or its encoder since; "
    "hang the robot from its hoist and run `xrl drive zero`",
    ArmingInhibit.OUTSIDE_LIMITS: "the joint is at phi {q[0]:.3f}, theta {q[1]:.3f} rad, outside "
    "its limits; move it inside them, or correct the joint's zero",
    ArmingInhibit.LOST_TORQUE: "the drive held the robot and lost torque while no service ran: "
    "drive error 0x{error:x}; hang the robot, find the cause, then run `xrl kill MODULE`",
    ArmingInhibit.WAITING: "the drive holds with its own loop; the service takes it over once a "
    "planner runs",
    ArmingInhibit.FAILED: "drive error 0x{error:x}; the service clears it, and arms the drive if "
    "the error does not return",
    ArmingInhibit.UNACKNOWLEDGED: "no node acknowledges a frame on CAN bus {bus}; check the "
    "drive's power and its CAN cable, and run `xrl doctor`",
    ArmingInhibit.REFUSED: f"{ARM_TRIES} attempts to arm failed: drive error 0x{{error:x}}; find "
    "the cause, then run `xrl kill MODULE`",
}


class _OtherModules(Protocol):
    """Shared view of the joint services of a host, without a bus."""

    def view(self, now_ns: int, /) -> NeighbourView:
        """Return this module's view of the others."""

    def write(self, row: NeighbourRow, /) -> None:
        """Write this module's row."""


class _SessionEnds(Protocol):
    """Watch over the planner's process on this host."""

    def ended(self) -> int:
        """Return the session of a planner whose process has ended since the last call, else 0."""


class JointPorts(msgspec.Struct, frozen=True):
    """Inputs and outputs of one joint service."""

    commands: CountingInbox[JointCommand]
    estops: Inbox[Estop]
    states: Outbox[JointState]
    events: Outbox[JointEvent]
    traces: Outbox[JointTrace] | None
    """None if nothing is recorded for re-execution."""
    planner: _SessionEnds | None = None
    """None if the end of the planner's process cannot be detected; only stale commands show it."""


class JointLoop:
    """One cycle for each encoder sample: read, decide, write, publish."""

    def __init__(
        self,
        config: RobotConfig,
        module: DriveManager,
        drive: Drive,
        ports: JointPorts,
        rearm_guard: RearmGuard | None = None,
        neighbours: _OtherModules | None = None,
        clock: Callable[[], int] | None = None,
        heat_file: HeatFile | None = None,
    ) -> None:
        """Connect the parts of the service.

        Args:
            config: the robot.
            module: makes the decisions of a cycle.
            drive: the module's drive.
            ports: publishers and subscribers.
            rearm_guard: shared memory for the next service of this module and for a local stop.
            neighbours: shared memory with the other modules' services on this host.
            clock: replaces this host's monotonic clock, ns.
            heat_file: temperatures, from this module's previous service and for the next one.
        """
        self.module = module
        self._rearm_guard, self._neighbours = rearm_guard, neighbours
        self._pendant = PendantWatch(config.joint_service.pendant_ms)
        self._drive, self._ports, self._clock = drive, ports, clock or now_ns
        self._heat_file = heat_file
        if heat_file is not None:
            heat_file.restore(module.controller.heat, module.state.controller.heat, self._clock())
        self._tracer = None if ports.traces is None else Tracer(module)
        self._reported = ArmingInhibit.NONE
        self._report_at_ns = 0
        self._malformed = 0
        self._has_sent = False
        self._nowhere = (-config.drive.zero_mark_turns,) * 2

    def run(self, stop: StopFlag) -> None:
        """Run until a signal stops the service.

        On SIGTERM only this service ends: a drive that holds with its own loop keeps holding the
        robot, and the next service takes it over. On SIGINT the whole fleet stops, and the drive is
        left idle.
        """
        while not stop:
            self.report(self.cycle())
        if self._tracer is not None and self._ports.traces is not None:
            rest = self._tracer.take()
            if rest is not None:
                self._ports.traces.put(rest)
        if stop.interrupted or not self.module.leaves_holding:
            self._drive.idle()
        if stop.interrupted and self._rearm_guard is not None:
            self._rearm_guard.write(LastState.NOTHING)

    def cycle(self) -> DriveAction:
        """Run one cycle; return the action that was decided and sent to the drive."""
        module, ports, tracer = self.module, self._ports, self._tracer
        reading = self._drive.read(READ_TIMEOUT_S)
        now = self._clock()
        estop = self._is_stopped(now)
        command = ports.commands.take()
        malformed = ports.commands.refused - self._malformed
        if malformed:
            self._malformed += malformed
            module.state.controller.failsafe.count_malformed(malformed, now)
        ended = 0 if ports.planner is None else ports.planner.ended()
        if ended:
            module.state.controller.failsafe.end_session(ended)
        near = UNKNOWN
        if self._neighbours is not None and module.needs_neighbours:
            near = self._neighbours.view(now)
        step = module.step(now, reading, command, estop, near)
        controller, state = module.controller, module.state.controller
        due = controller.is_state_due(state)
        if state.states == 0:  # the module arms only once a state is published
            self._has_sent, due = ports.states.put(controller.state(state, now)), False
        self._write(step)
        if self._neighbours is not None:
            self._neighbours.write(row_of(state, now))
        if step.event is not None:
            ports.events.put(step.event)
        if due and ports.states.put(controller.state(state, now)):
            self._has_sent = True
        if self._rearm_guard is not None:
            self._rearm_guard.write(module.state.last_state)
        if self._heat_file is not None:
            self._heat_file.write(state.heat)
        if tracer is not None and ports.traces is not None:
            trace = tracer.after(now, reading, command, estop, step, near, malformed, ended)
            if trace is not None:
                ports.traces.put(trace)
        return step

    def _is_stopped(self, now: int) -> bool:
        """Return True if a stop was received or is set on this host, or the pendant is silent."""
        stop, guard = self._ports.estops.take(), self._rearm_guard
        if guard is None:
            return stop is not None
        silent = self._pendant.is_lost(now, guard.beats)
        if stop is not None or silent:
            guard.note_stop(PENDANT if stop is None else stop.source)
        return stop is not None or silent or guard.stop_requested

    def _write(self, step: DriveAction) -> None:
        """Send this cycle's command to the drive."""
        drive, order = self._drive, step.command
        if step.target is not None:
            drive.write(step.target)
        elif order is DriveCommand.TORQUE:
            drive.write_torque(step.torque)
        elif order is DriveCommand.ARM:
            if self._has_sent:
                drive.arm(onboard=self.module.onboard)
        elif order is DriveCommand.CLEAR_ERRORS:
            drive.clear_errors()
        elif order is DriveCommand.IDLE:
            drive.idle()
        elif order is DriveCommand.CLEAR_ZERO:
            with suppress(DriveError):  # the drive is lost, and so is its zero
                drive.set_position(self._nowhere)

    def report(self, step: DriveAction) -> None:
        """Log faults and reasons for not arming; the module does not track then, so it may log."""
        if step.event is None and step.inhibit is ArmingInhibit.NONE:
            return
        now, samples = self._clock(), self.module.state.controller.estimate
        if step.event is not None and step.event.cause == Cause.ESTOP and self._pendant.lost:
            log.get("xrl").error("emergency stop: the pendant fell silent")
        if step.event is not None and step.event.mode_after == Mode.FAULT:
            dead_bus = samples.status is DriveStatus.UNACKNOWLEDGED
            log.get("xrl").error(
                "FAULT: %s, drive error 0x%x%s; to leave FAULT, remove the cause, then run "
                "`xrl kill MODULE`",
                Cause(step.event.cause).name,
                samples.error,
                f", no node acknowledges a frame on CAN bus {self.module.bus}" if dead_bus else "",
            )
        reported = step.inhibit is self._reported and now < self._report_at_ns
        if step.inhibit is not ArmingInhibit.NONE and not reported:
            is_new = step.inhibit is not self._reported
            starts = is_new and step.inhibit is ArmingInhibit.UNACKNOWLEDGED
            waits = starts or step.inhibit is ArmingInhibit.WAITING
            self._report_at_ns = now + (START_NS if starts else REPORT_EVERY_NS)
            self._reported = step.inhibit
            why = _WHY_NOT[step.inhibit].format(
                q=samples.q, error=samples.error, bus=self.module.bus
            )
            log.get("xrl").log(logging.INFO if waits else logging.ERROR, "not armed: %s", why)
