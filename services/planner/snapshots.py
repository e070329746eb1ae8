"""State of the planner beyond its configuration, as data: it resumes from it bit for bit."""

from __future__ import annotations

import msgspec

from services.planner.intents import OperatorRequest
from services.planner.law.probe import ProbeState
from services.planner.watch.engagement_fsm import Engagement
from services.planner.watch.limp_leg_watch import LimpLegWatch
from services.planner.watch.rival_watch import RivalWatch
from shared.bus.messages import (
    AS_CONFIGURED,
    STRAIGHT,
    Attitude,
    JointState,
    Pair,
    SplitSource,
    Trip,
    Vector4,
    Vector6,
    Wrench,
)
from shared.joints import N_JOINTS
from shared.robot.trip_table import PLANNER_TRIPS


class AssistState(msgspec.Struct, frozen=True):
    """State of `AssistLaw`."""

    ramp: float | None
    wanted: float
    still_s: float
    integral: float


class EasingState(msgspec.Struct, frozen=True):
    """State of `LeadEasing`."""

    lead: Pair
    left: float


class OverloadState(msgspec.Struct, frozen=True):
    """State of `Overload`."""

    beyond_since_ns: int | None
    below_since_ns: int | None
    hold: bool


class ShiftState(msgspec.Struct, frozen=True):
    """State of `ShiftReference`: x, y in m, roll, yaw in rad, and their rates."""

    at: Vector4 = STRAIGHT
    rate: Vector4 = STRAIGHT


class TripsState(msgspec.Struct, frozen=True):
    """State of `PlannerTrips`."""

    since_ns: tuple[int, ...] = (0,) * len(PLANNER_TRIPS)
    """Time since which each value is beyond its limit; 0 if it is not."""
    calm_ns: int = 0
    """Time since which no value is beyond its limit."""
    tripped: Trip = Trip.NONE
    why: str = ""
    stands: bool = False
    """Both legs have carried the torso since the planner engaged."""
    light: bool = False
    """The person has stopped pressing on the robot since the planner engaged."""


class UnattendedState(msgspec.Struct, frozen=True):
    """State of `Unattended`."""

    felt_ns: int = 0
    """Time at which a hand was last felt."""
    left: Pair | None = None
    """Pose in which it left the robot: height of the COM, m, and the torso's pitch, rad."""


class PhasesState(msgspec.Struct, frozen=True):
    """State of `StatePhases`."""

    phases: tuple[int, ...] = ()
    tick: int = 0
    """Ticks since the last comparison began."""
    every: int = 256
    """Ticks from its begin to that of the next."""
    sums: tuple[Pair, ...] = ()
    """Sum of (cos, sin) of 2 pi d / n for each module, whose states arrive d periods behind the
    first module's."""


class LoadState(msgspec.Struct, frozen=True):
    """State of `Load`."""

    kg: float = 0.0
    a: float = 0.0
    b: float = 0.0
    rates: Pair | None = None
    refused: bool = False
    weighing_s: float = 0.0
    looked: bool = True


class LawState(msgspec.Struct, frozen=True):
    """State of `Hocca`."""

    p_C0: tuple[float, ...]
    since_align_s: float
    aligned: bool
    q: tuple[float, ...]
    """Start of the inverse kinematics, rad."""
    assist: AssistState
    easing: EasingState
    has_led: bool = False
    coupling: tuple[float, ...] = (0.0,) * (2 * N_JOINTS)
    """State of `CouplingFilter`, N m."""
    levelling: tuple[bool, float, float] = (False, 0.0, 0.0)
    """State of `Levelling`: True if a slope is known, and the slope, rad."""
    shift: ShiftState = ShiftState()
    stance: tuple[Vector6, bool] = (AS_CONFIGURED, False)
    """State of `Stance`: the adopted stance, m and rad, and True if it is refused."""
    load: LoadState = LoadState()
    probe: ProbeState = ProbeState()


class GuardState(msgspec.Struct):
    """State of `ControllerGuard`."""

    failed: bool = False
    """It is not asked again."""
    why: str = ""
    """Why its last action was not used."""
    rest_s: float = 0.0
    """Time for which all still hold."""
    wait_s: float = 0.0
    """The newest such time."""
    time_s: float = 0.0
    """Since it was last reset."""


class TickState(msgspec.Struct, frozen=True):
    """State of `Planner`, before a tick."""

    states: tuple[JointState | None, ...]
    arrived_ns: tuple[int, ...]
    wrench: Wrench | None
    wrench_ns: int
    wrench_seq: int
    last_ns: int
    seq: int
    source: SplitSource | None
    engagement: Engagement
    overload: OverloadState
    law: LawState
    limp_legs: LimpLegWatch = msgspec.field(default_factory=LimpLegWatch)
    attitude: Attitude | None = None
    attitude_ns: int = 0
    attitude_seq: int = -1
    trips: TripsState = TripsState()
    request: OperatorRequest = OperatorRequest()
    unattended: UnattendedState = UnattendedState()
    phases: PhasesState = PhasesState()
    rival: RivalWatch = msgspec.field(default_factory=RivalWatch)
    guard: GuardState | None = None
    """None without a controller of somebody's own."""
    refused: int = 0
    """Implausible measurements so far."""
