"""What a joint service knows beyond its configuration, as data: it goes on from there bit for bit.

What was added later has a default, for logs from before it.
"""

from __future__ import annotations

import msgspec

from services.joint import law
from services.joint.drivers.base import MotorTarget
from services.joint.failsafe import Failsafe
from services.joint.law import Setpoint
from services.joint.samples import Samples
from services.joint.sinking import SinkingMemory
from services.joint.trips import Trips
from services.joint.will import Will
from shared.messages import Pair


class ControllerMemory(msgspec.Struct, frozen=True):
    """Of `JointController`."""

    failsafe: Failsafe
    samples: Samples
    anchor: Setpoint
    setpoint: Setpoint
    changed_ns: int
    last_cycle_ns: int
    found_tau: Pair | None
    damp_stop: float | None
    """The knee's stop in DAMP, rad, also in logs from before `sinking`; None: there is none."""
    cause: int
    tau: Pair
    cycle: int
    late: int
    events: int
    states: int
    residual: Pair = law.ZERO
    resumed_ns: int = 0
    braced_ns: int = 0
    trips: Trips = msgspec.field(default_factory=Trips)
    sinking: SinkingMemory = SinkingMemory()


class ModuleMemory(msgspec.Struct, frozen=True):
    """Of `Module`."""

    controller: ControllerMemory
    gains: Pair
    """Of the onboard law, `OnboardLaw.gains`."""
    estop: bool
    arm_at_ns: int
    idle_at_ns: int
    tries: int
    forgets: bool
    target: MotorTarget | None = None
    last_cycle_ns: int = 0
    listen_until_ns: int = 0
    will: Will = Will.NOTHING
    holding: bool = False
    gains_changed_ns: int = 0
