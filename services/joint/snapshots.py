"""State of a joint service, as data: a service restored from it continues bit for bit."""

from __future__ import annotations

import msgspec

from services.joint.drivers.base import MotorTarget
from services.joint.failsafe import Failsafe
from services.joint.joint_estimate import JointEstimate
from services.joint.rearm_guard import LastState
from services.joint.sample_clock import SampleClock
from services.joint.setpoint_law import SetpointState
from services.joint.trips import JointTrips
from shared.bus.messages import Pair


class ControllerState(msgspec.Struct, kw_only=True):
    """What changes from cycle to cycle in `JointController`."""

    estimate: JointEstimate
    failsafe: Failsafe = msgspec.field(default_factory=Failsafe)
    trips: JointTrips = msgspec.field(default_factory=JointTrips)
    initial_torque: Pair | None = None
    """Torque of a drive that was found armed, N m: it is taken over without a step."""
    takeover_offset: Pair = (0.0, 0.0)
    """Torque of the drive beyond the law's when the service resumed after a gap, N m."""
    resumed_ns: int = 0
    last_cycle_ns: int = 0
    cause: int = 0
    """`Cause` of the last change of mode."""
    tau: Pair = (0.0, 0.0)
    """Joint torque of the last cycle (phi, theta), N m."""
    cycle: int = 0
    late: int = 0
    clock: SampleClock = msgspec.field(default_factory=SampleClock)
    events: int = 0
    states: int = 0

    def copied(self) -> ControllerState:
        """Return a copy that shares nothing that changes."""
        replace = msgspec.structs.replace
        return replace(
            self,
            estimate=replace(self.estimate),
            failsafe=self.failsafe.copied(),
            trips=replace(self.trips),
            clock=replace(self.clock),
        )


class ControllerSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """State of `JointController`, with its setpoint law's."""

    state: ControllerState
    law: SetpointState


class DriveManagerState(msgspec.Struct, frozen=True, kw_only=True):
    """State of `DriveManager`."""

    controller: ControllerSnapshot
    gains: Pair
    """`DriveSetpointLaw.gains`."""
    estop: bool
    arm_at_ns: int
    idle_at_ns: int
    tries: int
    forgets: bool
    target: MotorTarget | None
    last_cycle_ns: int
    listen_until_ns: int
    last_state: LastState
    holding: bool
    gains_changed_ns: int
