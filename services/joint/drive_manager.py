"""One cycle of a module's service without any I/O: runs the controller and manages its drive.

The manager arms the drive, takes over a drive that still holds from an earlier service, idles a
drive that disarmed, and chooses between torques and targets for the onboard loop. The joint loop
sends the manager's command to the drive; lockstep emulates the drive. Pure.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

import msgspec

from services.joint.controller import ControllerState, CycleResult, JointController
from services.joint.differential import motor_torque
from services.joint.drive_setpoint import DriveFallback, DriveGains, DriveSetpointLaw
from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.neighbours import UNKNOWN, NeighbourView
from services.joint.rearm_guard import LastState
from shared.bus.messages import LOST_DRIVE, Cause, DriveStatus, JointCommand, JointEvent, Mode, Pair
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig

ARM_EVERY_NS: Final = 500 * NS_PER_MS
"""Time between two attempts to arm while DISARMED, ns."""
FORGET_EVERY_NS: Final = 150 * NS_PER_MS
"""Time from idling the drive to clearing its zero, and between repeated attempts, ns. A heartbeat
must first show that both axes are idle, because an armed axis would jump."""
IDLE_EVERY_NS: Final = 500 * NS_PER_MS
"""Period of idle commands to the drive of a module in FAULT, ns: if one axis disarms, the other
keeps its torque until it is idled."""
GAP_NS: Final = 20 * NS_PER_MS
"""Time between two cycles above which the service was frozen and its drive got no commands, ns."""
LISTEN_NS: Final = 10 * NS_PER_MS
"""Time after a gap in which the service only reads, ns, because buffered messages are old."""
ARM_TRIES: Final = 10
"""Maximum number of attempts to arm; after that a person must find the cause."""


class DriveCommand(Enum):
    """Command to the drive in a cycle."""

    NOTHING = 0
    TORQUE = 1
    TARGET = 2
    IDLE = 3
    ARM = 4
    CLEAR_ZERO = 5
    CLEAR_ERRORS = 6


class ArmingInhibit(Enum):
    """Reason why a drive is not armed; the loop has the text for the log."""

    NONE = 0
    UNZEROED = 1
    OUTSIDE_LIMITS = 2
    REFUSED = 3
    LOST_TORQUE = 4
    """The drive lost torque after it held the robot; a person must request re-arming."""
    WAITING = 5
    """The drive holds with its own loop; the service takes it over once a planner runs."""
    FAILED = 6
    """The drive has errors: the service clears them, and arms it later if they do not return."""
    UNACKNOWLEDGED = 7
    """No node acknowledges a frame on the drive's CAN bus."""


class DriveAction(msgspec.Struct, gc=False, frozen=True):
    """Outcome of a cycle."""

    event: JointEvent | None
    command: DriveCommand
    torque: Pair
    """Motor torques of `DriveCommand.TORQUE`, N m."""
    target: MotorTarget | None
    """Target of `DriveCommand.TARGET`."""
    inhibit: ArmingInhibit


_AT_ARMING: Final = {
    ArmingInhibit.NONE: DriveCommand.ARM,
    ArmingInhibit.FAILED: DriveCommand.CLEAR_ERRORS,
}
_NO_TORQUE: Pair = (0.0, 0.0)
_NOT_ARMED: Final = (DriveStatus.IDLE, DriveStatus.ERROR, DriveStatus.UNZEROED)
_UNACKNOWLEDGED: Final = DriveStatus.UNACKNOWLEDGED
_MAY_HOLD: Final = (*LOST_DRIVE, DriveStatus.HOLDING, DriveStatus.ARMED)
_UNCONTROLLED: Final = (Mode.DISARMED, Mode.FAULT)

# Compared in each cycle: docs/contributing.md, The control path.
_DISARMED, _HOLD, _DAMP, _FAULT = Mode.DISARMED, Mode.HOLD, Mode.DAMP, Mode.FAULT
_ARMED: Final = DriveStatus.ARMED
_NO_COMMAND, _TORQUE, _TARGET = DriveCommand.NOTHING, DriveCommand.TORQUE, DriveCommand.TARGET
_NO_INHIBIT: Final = ArmingInhibit.NONE


class Phase(Enum):
    """Progress of this service in taking control of its drive."""

    NEW = 0
    """The service has not acted yet: if the drive is armed, another service armed it."""
    HOLDING = 1
    """The drive was found armed, and has not been taken over yet."""
    OURS = 2
    """The service has tried to arm the drive, or has taken it over."""


_HOLDING, _OURS = Phase.HOLDING, Phase.OURS


class DriveManagerState(msgspec.Struct, kw_only=True):
    """State of `DriveManager` that changes from cycle to cycle."""

    controller: ControllerState
    gains: DriveGains = msgspec.field(default_factory=DriveGains)
    """The drive's present gains."""
    phase: Phase = Phase.NEW
    estop: bool = False
    arm_at_ns: int = 0
    idle_at_ns: int = 0
    tries: int = 0
    """Attempts to arm the drive; a take-over counts as one."""
    forgets: bool = False
    """True if the drive's zero must be cleared when its position is lost."""
    forget_at_ns: int = 0
    """Time of the next command to clear the zero, ns; 0 until the drive is idled."""
    forgot: bool = False
    target: MotorTarget | None = None
    """The last target sent to the drive."""
    last_cycle_ns: int = 0
    listen_until_ns: int = 0
    """End of flushing the link after a gap, ns; 0 without a gap."""
    last_state: LastState = LastState.NOTHING
    """Last state of this service, for the next one, in case this one dies now."""


class DriveManager:
    """One module's service between its drive and the bus.

    Attributes:
        controller: the control law.
        state: everything that changes from cycle to cycle. A snapshot is a copy of it
            (`shared.state.copied`); a manager that starts from it continues bit for bit.
        bus: name of the module's CAN bus.
        onboard: True if the motors' own loops hold the module.
    """

    def __init__(
        self, config: RobotConfig, name: str, last_state: LastState = LastState.NOTHING
    ) -> None:
        """Start DISARMED, with the last state of the previous service."""
        self.controller = JointController(config, name)
        self.bus = config.module_named(name).bus
        self._fallback = DriveFallback(config, name)
        self.onboard = config.joint_service.loop == "onboard"
        drive = config.drive
        self._law = DriveSetpointLaw(
            config.joint.gear_ratio, drive.vel_limit, drive.current_lim * drive.torque_constant
        )
        self._gear_ratio = config.joint.gear_ratio
        self.state = DriveManagerState(
            controller=self.controller.start(),
            estop=last_state is LastState.DAMP,
            forgets=drive.zero_mark_turns > 0.0,
            last_state=last_state,
        )

    @property
    def needs_neighbours(self) -> bool:
        """True while the neighbours' states are used: in HOLD and DAMP."""
        mode = self.state.controller.failsafe.mode
        return mode is _HOLD or mode is _DAMP

    @property
    def leaves_holding(self) -> bool:
        """True if the drive would keep holding with its own loop if the service ended now."""
        s = self.state
        mode, lost = s.controller.failsafe.mode, s.controller.cause == Cause.DRIVE_LOST
        holds = mode in (Mode.HOLD, Mode.TRACK, Mode.DAMP) or (mode is Mode.FAULT and lost)
        return self.onboard and (holds or s.phase is _HOLDING)

    def step(
        self,
        now_ns: int,
        reading: DriveReading | None,
        command: JointCommand | None,
        estop: bool,
        near: NeighbourView = UNKNOWN,
    ) -> DriveAction:
        """Run one cycle. Arguments are as in `JointController.step`; `estop` latches."""
        s, controller = self.state, self.controller
        s.estop = s.estop or estop
        if s.phase is not _OURS and reading is not None and reading.status is _ARMED:
            reading = self._found_armed(now_ns, reading)
        if s.last_cycle_ns and now_ns - s.last_cycle_ns > GAP_NS:
            s.listen_until_ns = now_ns + LISTEN_NS
        s.last_cycle_ns = now_ns
        tau_before = s.controller.tau
        estop = s.estop and not self._is_to_be_taken_over(reading)
        flushes = s.listen_until_ns > 0
        result = controller.step(
            s.controller, now_ns, reading, command, estop, flushing=flushes, near=near
        )
        mode = s.controller.failsafe.mode
        if result.event is not None:
            s.last_state = self._new_last_state(mode)
        listens = False
        if flushes and mode not in _UNCONTROLLED:
            result = self._resumed(now_ns, result, tau_before)
            listens = now_ns < s.listen_until_ns or reading is None
        if not listens:
            s.listen_until_ns = 0
        out, torque, target, inhibit = _NO_COMMAND, _NO_TORQUE, None, None
        if listens:
            inhibit = _NO_INHIBIT
        elif s.forgets and mode in _UNCONTROLLED and self._must_forget(now_ns):
            out, inhibit = DriveCommand.CLEAR_ZERO, _NO_INHIBIT
        elif mode is _DISARMED and now_ns >= s.arm_at_ns:
            inhibit = self._inhibit(now_ns, reading)
            if inhibit is not None:
                out = _AT_ARMING.get(inhibit, _NO_COMMAND)
        if inhibit is not None:
            pass
        elif mode is _FAULT:
            out = self._in_fault(now_ns)
        elif not self.onboard:
            out, torque = _TORQUE, motor_torque(result.tau, self._gear_ratio)
        elif mode is not _DISARMED:
            out, estimate = _TARGET, s.controller.estimate
            setpoint = self._fallback.law(s.controller.law.current, mode)
            s.target = target = self._law.target(
                s.gains, now_ns, setpoint, result.tau, estimate.pos, estimate.vel
            )
        return DriveAction(result.event, out, torque, target, inhibit or _NO_INHIBIT)

    def _resumed(self, now_ns: int, result: CycleResult, tau_before: Pair) -> CycleResult:
        """Return the cycle's result, continued from the torque that the drive gave in the gap."""
        s = self.state
        estimate, carried = s.controller.estimate, tau_before
        if s.target is not None:
            carried = self._law.carried(s.target, estimate.pos, estimate.vel)
        tau = self.controller.resume(s.controller, now_ns, carried)
        event = result.event
        if event is not None:
            event = msgspec.structs.replace(event, tau_before=carried, tau_after=tau)
        return CycleResult(tau, event)

    def _in_fault(self, now_ns: int) -> DriveCommand:
        """Return the command to the drive of a module in FAULT.

        A lost drive that may hold with its own loop gets no command. Once the link is back it still
        holds, unless one of its axes has lost torque. Any other drive is idled.
        """
        s = self.state
        lost = s.controller.cause == Cause.DRIVE_LOST
        if lost and self.onboard and s.controller.estimate.status in _MAY_HOLD:
            return DriveCommand.NOTHING
        if now_ns >= s.idle_at_ns:
            s.forget_at_ns = s.forget_at_ns or now_ns + FORGET_EVERY_NS
            s.idle_at_ns = now_ns + IDLE_EVERY_NS
            return DriveCommand.IDLE
        return DriveCommand.NOTHING

    def _must_forget(self, now_ns: int) -> bool:
        """Return True if an idle drive's zero must be cleared now, because turns may be missing."""
        s, estimate = self.state, self.state.controller.estimate
        if not estimate.turns_lost or estimate.status not in _NOT_ARMED or now_ns < s.forget_at_ns:
            return False
        if s.forget_at_ns == 0 and s.controller.failsafe.mode is _FAULT:
            return False  # the drive is not idle yet
        if s.forgot and estimate.status is DriveStatus.UNZEROED:
            return False
        s.forget_at_ns, s.forgot = now_ns + FORGET_EVERY_NS, True
        return True

    def _found_armed(self, now_ns: int, reading: DriveReading) -> DriveReading:
        """Return the reading of a drive that was found armed.

        A drive that holds with its own loop after its service died is taken over once its torques
        are known and a planner sends the gains on which the other five hold. Until then it gets no
        command: a knee taken over with stand gains, beside a knee on soft gains, rolled the torso,
        and the robot tipped while the hand led. Without the onboard loop, an armed drive belongs to
        another controller and reads as IDLE.
        """
        s = self.state
        if not self.onboard:
            return msgspec.structs.replace(reading, status=DriveStatus.IDLE)
        led = s.estop or s.controller.failsafe.is_fresh(now_ns, self.controller.timing)
        if reading.torque is None or not led:
            s.phase = _HOLDING
            return msgspec.structs.replace(reading, status=DriveStatus.HOLDING)
        s.phase, s.tries = _OURS, 1
        return reading

    def _is_to_be_taken_over(self, reading: DriveReading | None) -> bool:
        """Return True if the drive may hold with its own loop, so it is taken over before a stop.

        The emergency stop then starts from the drive's torque.
        """
        if not self.onboard or self.state.controller.failsafe.mode is not _DISARMED:
            return False
        return reading is None or reading.status in _MAY_HOLD

    def _new_last_state(self, mode: Mode) -> LastState:
        """Return the last state for the next service, in case this one dies now."""
        s = self.state
        if mode is Mode.DISARMED:
            return s.last_state
        return LastState.DAMP if mode is Mode.DAMP or s.estop else LastState.HELD

    def _inhibit(self, now_ns: int, reading: DriveReading | None) -> ArmingInhibit | None:
        """Return the reason not to arm, `NONE` to arm now, or None to wait without a report."""
        s = self.state
        if reading is None or reading.status is DriveStatus.LOST:
            return None
        s.arm_at_ns = now_ns + ARM_EVERY_NS
        if reading.status is _UNACKNOWLEDGED:
            return ArmingInhibit.UNACKNOWLEDGED
        if reading.status is DriveStatus.HOLDING:
            return ArmingInhibit.WAITING if reading.torque is not None else None
        if s.phase is _HOLDING:
            s.phase = Phase.NEW
        if reading.status is DriveStatus.UNZEROED:
            s.last_state = LastState.NOTHING  # zeroing it is a request to arm it
            return ArmingInhibit.UNZEROED
        if s.last_state is not LastState.NOTHING:
            return ArmingInhibit.LOST_TORQUE
        if not self.controller.inside_limits(s.controller):
            return ArmingInhibit.OUTSIDE_LIMITS
        if s.controller.estimate.turns_lost:
            return ArmingInhibit.UNZEROED
        if s.controller.estimate.moved:
            return None
        s.phase, s.tries = _OURS, s.tries + 1
        if s.tries <= ARM_TRIES:
            failed = reading.status is DriveStatus.ERROR
            return ArmingInhibit.FAILED if failed else ArmingInhibit.NONE
        return ArmingInhibit.REFUSED if s.tries == ARM_TRIES + 1 else None
