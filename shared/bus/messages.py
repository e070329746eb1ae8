"""Every message on the bus (docs/networks.md).

Payloads are JSON, encoded by msgspec, in SI units; times are integers in ns, and enumerations are
integers. No field may be null, so a `null` in a payload is always a number that was not finite;
`shared.bus.codec` refuses it on both sides.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Final

import msgspec

Int64 = Annotated[int, msgspec.Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""64-bit integer. Decoding refuses larger ones, because converting them to float could raise."""
Pair = tuple[float, float]
"""(phi, theta) of one module."""
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
LEFT_MAX_S = 3600.0
"""Maximum reported `heat_left_s`, s."""
STRAIGHT: Vector4 = (0.0, 0.0, 0.0, 0.0)
"""No shift of x, y, roll and yaw."""
AS_CONFIGURED: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""No displacement of the feet from the robot file."""
Modules = tuple[Int64, Int64, Int64, Int64, Int64, Int64]
"""One integer per module, in `shared.joints.MODULES` order."""


class Mode(IntEnum):
    """Mode of a joint service (docs/architecture.md#modes)."""

    DISARMED = 0
    """The service applies no torque."""
    HOLD = 1
    """Stands with local gains and frozen references."""
    TRACK = 2
    """Follows the planner's commands."""
    DAMP = 3
    """Sinks slowly after an emergency stop; only damps after a fall."""
    FAULT = 4
    """Drive disarmed, or drive or position lost; only a restart ends it."""


class Cause(IntEnum):
    """Cause of the last change of mode."""

    NONE = 0
    """No change yet."""
    DRIVE_ARMED = 1
    COMMANDS_FRESH = 2
    """Commands were fresh long enough."""
    COMMAND_STALE = 3
    """The newest command is too old."""
    HOLD_ALL = 4
    """The planner requests HOLD."""
    ESTOP = 5
    DRIVE_LOST = 6
    """No frames from the drive."""
    DRIVE_DISARMED = 7
    """The drive left closed loop on its own."""
    POSITION_LOST = 8
    """The drive has no zero, or its count may be wrong."""
    SHAKING = 9
    """Shaking trip (`xrl faults`)."""
    TORQUE_LIMIT = 10
    """Torque trip."""
    TOO_FAST = 11
    """Speed trip."""
    PLANNER_ENDED = 12
    """The planner's process on this host ended."""
    FALLEN = 13
    """The planner reports a fall."""


class Trip(IntEnum):
    """Trip of the planner; `xrl faults` explains each."""

    NONE = 0
    LEGS = 1
    REACH = 2
    TRACKING = 3
    UNLOADED = 4
    SINKING = 5
    TURNING = 6
    HARNESS = 7
    SAGGING = 8
    UNATTENDED = 9
    EDGE = 10
    TIPPING = 11
    OFF_BALANCE = 12


class Outside(IntEnum):
    """Violated bound of the envelope (`services.joint.envelope`)."""

    NOTHING = 0
    K_P = 1
    K_D = 2
    TAU_FF = 3
    DTAU_FF = 4
    TAU_COUPLED = 5
    Q_REF = 6
    """Too far from the joint's angle."""
    V_REF = 7
    TORQUE_STEP = 8
    """Torque changes too fast."""
    MARGIN = 9
    """Below `certificate.margin_min` or `certificate.onboard_margin_min`."""
    COUPLED_WORK = 10
    """Coupled torque drives the joint away from its reference."""
    Q_REF_ASTRAY = 11
    """Reference does not follow its rate."""
    COUPLED_ENERGY = 12
    """Coupled torque does too much work on the moving joint."""


class Refusal(IntEnum):
    """Reason for a refused command (docs/architecture.md#age-rule)."""

    NONE = 0
    """No recent refusal."""
    TOO_OLD = 1
    """Echoes a state that is too old."""
    FROM_THE_FUTURE = 2
    """Echoes a stamp later than this module's clock."""
    FOREIGN_SESSION = 3
    """Session of another planner, or one that the module has left."""
    NOT_NEWER = 4
    """Sequence number not above the last accepted one."""
    OUT_OF_LIMITS = 5
    """Beyond the joint service's limits."""
    OUT_OF_ENVELOPE = 6
    """See `Outside`."""
    TOO_FAR_AHEAD = 7
    """Implausibly high sequence number."""
    MALFORMED = 8
    """Not the JSON of a command; its session is unknown."""


class DriveStatus(IntEnum):
    """Combined status of both axes."""

    LOST = 0
    """No frames, or the link is down."""
    IDLE = 1
    """No error, but at least one axis is not in closed loop."""
    ARMED = 2
    """Both axes in closed loop."""
    ERROR = 3
    """An axis reports an error or left closed loop on its own."""
    UNZEROED = 4
    """Both axes answer, but the zero is missing."""
    HOLDING = 5
    """Left in closed loop by an earlier service, and not taken over yet."""
    UNACKNOWLEDGED = 6
    """Lost; no node acknowledges frames."""


LOST_DRIVE: Final = (DriveStatus.LOST, DriveStatus.UNACKNOWLEDGED)
"""Statuses of an unreachable drive."""


class PlannerMode(IntEnum):
    """Mode of the planner. All six modules hold unless stated otherwise."""

    WAITING = 0
    """A module's state is missing or stale."""
    ALIGNING = 1
    """Commands start from the measured pose, with `hold` set."""
    LEADING = 2
    """All six track."""
    OVERLOADED = 3
    """The harness is overloaded, or was within the last `harness.overload_release_s`."""
    UNCERTIFIED = 4
    """No local gains meet the certificate."""
    MISPLACED = 5
    """Feet beyond `law.stance_max`, or just moved."""
    TRIPPED = 6
    """Tripped, until every value has been within its limit for 1 s."""
    MISLOADED = 7
    """Load beyond `law.load_correction`, or not yet weighed after hanging on a hoist."""
    YIELDING = 8
    """Another planner leads; this one sends no usable commands."""
    FALLEN = 9
    """All modules only damp until a person re-arms them."""


class HeatAction(IntEnum):
    """Planner's action against heat (docs/law.md#heat)."""

    NONE = 0
    EASES = 1
    """The assist ramps down."""
    STANDS_UP = 2
    RESTS = 3
    """The robot stays straight."""


class Park(IntEnum):
    """Request about parking (docs/law.md#park)."""

    AUTO = 0
    """Park a robot that stands still in a working pose."""
    NEVER = 1
    OPEN = 2
    """Unpark, requested by a button."""


class Wearing(IntEnum):
    """Wearer's action, as the planner estimates it (docs/law.md#park)."""

    LEADS = 0
    """The wearer leads height and pitch."""
    RESTS = 1
    """Parked: the assist follows the weight on the harness."""
    AWAY = 2
    """Parked; nobody touches the harness."""
    PULLS = 3
    """The wearer pulls horizontally; no effect."""
    BUMPED = 4
    """A bump was too short to unpark the robot."""


class SplitSource(IntEnum):
    """Source of a tick's local gains (docs/law.md#gain-split)."""

    DIAGONAL = 0
    """The paper's diag(K_q)."""
    SCHEDULE = 1
    """The certified schedule."""
    STIFFENED = 2
    """Stiffened to meet the certificate."""
    UNCERTIFIED = 3
    """No gains meet the certificate; all modules hold."""
    CONTROLLER = 4
    """Certified gains of your own controller."""


class Tare(IntEnum):
    """Zero of the harness sensor."""

    RUNNING = 0
    """Averaging; keep the harness unloaded and still."""
    UNSTEADY = 1
    """Averaging restarted: the forces moved too much."""
    DONE = 2
    """The zero is known."""


class RunEventKind(IntEnum):
    """Kind of run event."""

    STARTED = 0
    """The scenario started."""
    KILLED = 1
    """A service received a signal."""
    RESTARTED = 2
    """A service was started or continued."""
    PUSHED = 3
    FINISHED = 4
    """The scenario ended."""
    FAULTED = 5
    """A drive fault began; `subject` is the module, `detail` the kind."""
    STALLED = 6
    """A stall of the machine ended; `detail` is its duration."""


def name_of(kind: type[IntEnum], code: int) -> str:
    """Return the name of a code, such as TRACK, or "unknown (99)" for another version's code."""
    try:
        return kind(code).name
    except ValueError:
        return f"unknown ({code})"


class Message(msgspec.Struct, gc=False, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all messages: the sender's monotonic time and a sequence number.

    Fields that change in each message are next to each other, so that a log is shorter.
    """

    t_ns: Int64
    """Time of the content, on the sender's monotonic clock."""
    seq: Int64
    """Sender's sequence number on this key."""


class JointState(Message, frozen=True, kw_only=True):
    """State of one module."""

    cycle: Int64
    """Cycles since the start."""
    command_seq: Int64
    """Sequence number of the newest accepted command; -1: none."""
    age_ns: Int64
    """Its age (docs/architecture.md#age-rule); -1: none."""
    q: Pair
    """Joint angles (phi, theta), rad."""
    v: Pair
    """Joint rates, rad/s."""
    tau: Pair
    """Joint torques after the limiter, N m."""
    mode: Int64
    cause: Int64
    ready: bool
    """The module tracks as soon as `hold` is cleared."""
    session: Int64
    """Its session; 0: none."""
    late: Int64
    """Cycles that began more than two periods after the previous one."""
    dropouts: Int64
    """Recent dropouts."""
    refused: Int64
    """Refused commands since the start."""
    drive: Int64
    drive_error: Int64
    """Error bits of both axes."""
    stiffened: bool = False
    """Gains are at, or rise to, the support gains."""
    outside: Int64 = 0
    """Violation of the envelope by the newest command."""
    state_phase: Int64 = 0
    """`JointCommand.state_phase` in use."""
    refusal: Int64 = 0
    """Newest refusal within the last second."""
    refused_session: Int64 = 0
    """Session of that command."""
    celsius: Pair = (0.0, 0.0)
    """Estimated winding temperatures; 0: not estimated."""
    heat_left_s: float = -1.0
    """Time at this load until a winding or output stage reaches its limit, at most 3600; -1: not
    estimated."""
    supply_v: float = 0.0
    """Supply voltage of the drive; 0: unknown."""


class JointCommand(Message, frozen=True, kw_only=True):
    """Command to a module (docs/law.md#references-and-age)."""

    session: Int64
    """Random number of this planner session."""
    hold: bool
    """True requests HOLD."""
    margin: float
    """Margin of the local gains of all six modules (docs/law.md#certificate)."""
    margin_onboard: float
    """Margin of the drives' own loops."""
    stiffen: bool = False
    """In HOLD, rise to the support gains."""
    fallen: bool = False
    """True: drop all stiffness."""
    state_phase: Int64 = 0
    """Cycle in which to send the next state (docs/architecture.md#rates)."""
    echo_t_ns: Int64
    """`t_ns` of this module's newest state."""
    q_ref: Pair
    """Reference, rad."""
    v_ref: Pair
    """Rate of `q_ref`, rad/s."""
    tau_ff: Pair
    """Feedforward torque, N m."""
    dtau_ff: Pair
    """Rate of `tau_ff`, N m/s."""
    tau_coupled: Pair
    """Coupled torque (docs/law.md#gain-split) and eased lead, N m."""
    k_p: Pair
    """Local stiffness D, N m/rad."""
    k_d: Pair
    """Local damping D_B, N m s/rad."""


class JointEvent(Message, frozen=True):
    """Change of mode."""

    mode_before: Int64
    mode_after: Int64
    cause: Int64
    age_ns: Int64
    """Age of the newest accepted command; -1: none."""
    tau_before: Pair
    """Torque in the cycle before the change, N m."""
    tau_after: Pair
    """Torque in the cycle of the change, N m."""


class Wrench(Message, frozen=True, kw_only=True):
    """Wrench of the operator on the torso, torso axes."""

    force: Vector3
    """Force, N."""
    moment: Vector3
    """Moment about the harness point, N m."""
    valid: bool
    """False: stale, saturated, frozen or not zeroed; force and moment are the last valid ones."""
    saturated: bool
    """A load cell is at its limit."""
    tare: Int64
    age_ns: Int64
    """Age of the sample; -1 before the first."""


class Attitude(Message, frozen=True):
    """Attitude of the torso."""

    up: Vector3
    """Unit vector opposite to gravity, torso axes."""
    rate: Vector3
    """Angular velocity, rad/s, torso axes."""
    valid: bool
    """False: stale, frozen or invalid; up and rate are the last valid ones."""
    age_ns: Int64
    """Age of the sample; -1 before the first."""


class TareRequest(Message, frozen=True):
    """Request to make the present wrench zero."""

    source: str


class ToolRoster(Message, frozen=True):
    """Tools linked to the recorder, and faults."""

    tools: tuple[str, ...]
    """Each as NAME.HOST.PID."""
    trouble: tuple[str, ...] = ()
    """Faults of recording and of the host's disk."""


class PlannerStatus(Message, frozen=True, kw_only=True):
    """Inputs and decisions of one tick."""

    session: Int64
    """As in `JointCommand`."""
    state_seq: Modules
    """Sequence number of each module's state; -1: none."""
    state_age_ns: Modules
    """Time since each module's newest state arrived; -1: none."""
    wrench_seq: Int64
    """Sequence number of the newest wrench; -1: none."""
    attitude_seq: Int64 = -1
    """Sequence number of the newest attitude; -1: none."""
    tick_us: float
    """Duration of the tick."""
    p: Vector6
    """Measured pose: COM x y z, m; torso roll, pitch, yaw, rad; world."""
    pdot: Vector6
    """Rate of `p`."""
    closure: Vector6
    """Left leg's minus right leg's estimate of the torso pose, m and rad, world."""
    p_ref: Vector6
    """Reference of `p`."""
    load: Vector3 = (0.0, 0.0, 0.0)
    """Load beyond that of the robot file, kg; its moments, N m (`services.planner.law.load`)."""
    carried_n: float = 0.0
    """Payload and person carried (docs/law.md#wearer); without a harness, the payload."""
    supply_v: float = 0.0
    """Lowest supply voltage, low-passed; 0: unknown."""
    commands: tuple[JointCommand, ...] = ()
    """The tick's commands, one per module; empty if it sent none. A log has them only here."""
    margin: float
    """As in `JointCommand`; 0 before the first tick."""
    margin_onboard: float
    """As in `JointCommand`."""
    mode: Int64
    hold: bool
    """The commands request HOLD."""
    assist_n: float
    """Assist in the feedforward, plus the lift that stands the robot up."""
    split: Int64
    ik_iterations: Int64
    """Steps of the inverse kinematics."""
    ik_residual: float
    """Its largest residual, m or rad."""
    assist_requested_n: float
    """Operator's request."""
    wait_s: float = 0.0
    """Remaining wait after dropouts."""
    slope: Pair = (0.0, 0.0)
    """Slope of the floor along x and y, rad."""
    shift_requested: Vector4 = STRAIGHT
    """`OperatorIntent.shift` in use."""
    stance: Vector6 = AS_CONFIGURED
    """Stance: x, y, z, m; rotation vector, rad; world."""
    why: str = ""
    """Warnings about supply, harness and heat, and why the planner does not lead."""
    trip: Int64 = 0
    requested_by: str = ""
    """Source of the intent in use; empty: none."""
    refused: Int64 = 0
    """Implausible states, wrenches and attitudes so far."""
    sit: bool = False
    """`OperatorIntent.sit` in use."""
    heat: Int64 = 0
    heat_left_s: float = -1.0
    """Smallest `heat_left_s` of the modules."""
    wearer: Int64 = 0
    """`LEADS` also if `park.enabled` is false."""
    park_requested: Int64 = 0


class OperatorIntent(Message, frozen=True):
    """Requests besides leading by hand."""

    assist_n: float
    """Requested upward force at the harness."""
    shift: Vector4 = STRAIGHT
    """Shift: COM x and y, m; torso roll and yaw, rad."""
    source: str = ""
    sit: bool = False
    """Go down to the lowest pose and hold there (`xrl down`)."""
    park: Int64 = 0


class HandLead(Message, frozen=True):
    """Lead and push that replace the scenario's."""

    leads: bool
    """False: only `push` counts."""
    height: float
    """Torso origin above the ankles, m."""
    pitch: float
    """Torso pitch, rad."""
    push: Vector3
    """Push on the torso, N, world; ends 0.3 s after the last message."""
    source: str = ""


class Estop(Message, frozen=True):
    """Every module goes to DAMP until it restarts."""

    source: str


class SimControl(Message, frozen=True):
    """Command to start the scenario."""

    start: bool


class RunEvent(Message, frozen=True):
    """Event of a run."""

    kind: Int64
    subject: str
    """Service, module or other object."""
    detail: str
    """Signal, push, fault or duration; or empty."""
    scenario_s: float
    """Scenario time."""
