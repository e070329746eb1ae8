"""State of a joint service, as data: a service restored from it continues bit for bit."""

from __future__ import annotations

import msgspec

from services.joint.drivers.base import MotorTarget
from services.joint.failsafe import Failsafe
from services.joint.joint_estimate import JointEstimate
from services.joint.pd_law import Setpoint
from services.joint.rearm_guard import LastState
from services.joint.sinking import SinkingState
from services.joint.trips import JointTrips
from shared.messages import Pair


class ControllerState(msgspec.Struct, frozen=True, kw_only=True):
    """State of `JointController`."""

    failsafe: Failsafe
    samples: JointEstimate
    frozen_setpoint: Setpoint
    setpoint: Setpoint
    changed_ns: int
    last_cycle_ns: int
    initial_torque: Pair | None
    cause: int
    tau: Pair
    cycle: int
    late: int
    events: int
    states: int
    takeover_offset: Pair
    resumed_ns: int
    stiffened_ns: int
    trips: JointTrips
    sinking: SinkingState


class DriveManagerState(msgspec.Struct, frozen=True, kw_only=True):
    """State of `DriveManager`."""

    controller: ControllerState
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
