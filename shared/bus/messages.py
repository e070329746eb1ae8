"""Every message on the bus (docs/networks.md).

Payloads are JSON by msgspec. SI units; times are integers in ns; enumerations are integers. No
field is optional, so a `null` in a payload can only be a number that was not finite.
`shared.bus.codec` refuses it at both ends.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Final

import msgspec

Int64 = Annotated[int, msgspec.Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""64-bit integer. Decoding refuses larger ones, which would raise where they first meet a float."""
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
"""Feet where the robot file has them."""
Modules = tuple[Int64, Int64, Int64, Int64, Int64, Int64]
"""One integer per module, in `shared.joints.MODULES` order."""


class Mode(IntEnum):
    """Mode of a joint service (docs/architecture.md#modes)."""

    DISARMED = 0
    """No torque; drive not armed."""
    HOLD = 1
    """References frozen; stands on local gains."""
    TRACK = 2
    """Follows the planner's commands."""
    DAMP = 3
    """Sinks slowly after an emergency stop; only damps after a fall."""
    FAULT = 4
    """Drive or position lost; only a restart leaves it."""


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
    """The planner requests HOLD from all six modules."""
    ESTOP = 5
    DRIVE_LOST = 6
    """No frames from the drive."""
    DRIVE_DISARMED = 7
    """The drive left closed loop on its own."""
    POSITION_LOST = 8
    """The drive is unzeroed, or its samples jump."""
    SHAKING = 9
    """Shaking trip (`shared.robot.trip_table`)."""
    TORQUE_LIMIT = 10
    """Torque trip."""
    TOO_FAST = 11
    """Speed trip."""
    PLANNER_ENDED = 12
    """The planner's process on this host ended."""
    FALLEN = 13
    """The planner reports a fall."""


class Trip(IntEnum):
    """Limit that keeps the planner from leading (`shared.robot.trip_table`)."""

    NONE = 0
    LEGS = 1
    """Legs disagree about the torso's pose."""
    REACH = 2
    """Reference pose out of reach."""
    TRACKING = 3
    """A joint is far from its reference."""
    UNLOADED = 4
    """A leg carries hardly any load."""
    SINKING = 5
    """COM sinks or rises too fast."""
    TURNING = 6
    """Torso turns too fast."""
    HARNESS = 7
    """Harness force far from the requested assist."""
    SAGGING = 8
    """Person sinks with weight on the harness."""
    UNATTENDED = 9
    """Robot drifts with nobody holding it."""
    EDGE = 10
    """Load near a sole's edge: a lean from the side."""
    TIPPING = 11
    """Load at a sole's edge: a shove from the side."""
    OFF_BALANCE = 12
    """COM far ahead of or behind its reference."""


class Outside(IntEnum):
    """Value of a command that lies outside the envelope (`services.joint.envelope`)."""

    NOTHING = 0
    K_P = 1
    K_D = 2
    TAU_FF = 3
    DTAU_FF = 4
    TAU_COUPLED = 5
    Q_REF = 6
    """Too far from the joint's position."""
    V_REF = 7
    TORQUE_STEP = 8
    """Faster than the law changes the torque."""
    MARGIN = 9
    """Below the planner's minimum."""
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
    """Echoes a state that this module has not sent yet."""
    FOREIGN_SESSION = 3
    """From another planner, or one that this module has left."""
    NOT_NEWER = 4
    """Sequence number not above the last accepted."""
    OUT_OF_LIMITS = 5
    """Not finite, or beyond the joint service's limits."""
    OUT_OF_ENVELOPE = 6
    """See `Outside`."""
    TOO_FAR_AHEAD = 7
    """Sequence number that no planner can have reached."""
    MALFORMED = 8
    """No JSON, a wrong field, or a number that is not finite; has no session."""


class DriveStatus(IntEnum):
    """Status of a module's two axes together."""

    LOST = 0
    """No frames, or the link is down."""
    IDLE = 1
    """Both axes answer without error, but not both are in closed loop."""
    ARMED = 2
    """Both axes in closed loop."""
    ERROR = 3
    """An axis reports an error or left closed loop on its own."""
    UNZEROED = 4
    """Both axes answer; the zero was lost with the power."""
    HOLDING = 5
    """Left in closed loop by an earlier service; waits for the take-over."""
    UNACKNOWLEDGED = 6
    """Lost; no node acknowledges frames."""


LOST_DRIVE: Final = (DriveStatus.LOST, DriveStatus.UNACKNOWLEDGED)
"""Statuses of an unreachable drive."""


class PlannerMode(IntEnum):
    """Mode of the planner; all six modules hold unless stated otherwise."""

    WAITING = 0
    """A module's state is stale."""
    ALIGNING = 1
    """All states fresh; commands start from the measured pose, still with `hold`."""
    LEADING = 2
    """All six track."""
    OVERLOADED = 3
    """Harness overloaded within the last `harness.overload_release_s`."""
    UNCERTIFIED = 4
    """No local gains meet the certificate in this pose."""
    MISPLACED = 5
    """Feet beyond `law.stance_max`, or just moved."""
    TRIPPED = 6
    """Tripped (`PlannerStatus.trip`), until every value is back within its limit."""
    MISLOADED = 7
    """Load beyond `law.load_correction`, or not yet weighed after the hoist."""
    YIELDING = 8
    """Another planner leads; this one sends no usable command until that one ends."""
    FALLEN = 9
    """All only damp until a person re-arms them."""


class HeatAction(IntEnum):
    """Planner's action before a motor is too warm (docs/law.md#heat)."""

    NONE = 0
    EASES = 1
    """Assist ramps down to the weight that the wearer rests on the robot; the wearer is warned."""
    STANDS_UP = 2
    """Stands up on its own; the wearer cannot lead height and pitch."""
    RESTS = 3
    """Stays straight until cooled; the wearer cannot lead height and pitch."""


class Park(IntEnum):
    """Request to a robot that may park (docs/law.md#park); OPEN comes from a button."""

    AUTO = 0
    NEVER = 1
    OPEN = 2


class Wearing(IntEnum):
    """Planner's estimate of what the wearer does (`services.planner.watch.park`)."""

    LEADS = 0
    """The wearer leads height and pitch."""
    RESTS = 1
    """Parked: the assist follows the weight on the harness."""
    AWAY = 2
    """Parked; nobody touches the harness."""
    PULLS = 3
    """Pull along the floor; no effect."""
    BUMPED = 4
    """Parked; the bump was too short to open it."""


class SplitSource(IntEnum):
    """Source of a tick's local gains (docs/law.md#gain-split)."""

    DIAGONAL = 0
    """The paper's diag(K_q)."""
    SCHEDULE = 1
    """Certified schedule."""
    STIFFENED = 2
    """Stiffer than the schedule, to meet the certificate."""
    UNCERTIFIED = 3
    """No gains met the certificate: all hold."""
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
    """Scenario started."""
    KILLED = 1
    """A service received a signal."""
    RESTARTED = 2
    """A service was started or continued."""
    PUSHED = 3
    FINISHED = 4
    """Scenario ended."""
    FAULTED = 5
    """Drive fault began; subject: module, detail: kind."""
    STALLED = 6
    """Machine stall ended; detail: duration."""


def name_of(kind: type[IntEnum], code: int) -> str:
    """Return the name of a code, such as TRACK, or "unknown (99)" for another version's code."""
    try:
        return kind(code).name
    except ValueError:
        return f"unknown ({code})"


class Message(msgspec.Struct, gc=False, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all messages: the sender's monotonic time and a sequence number."""

    t_ns: Int64
    """Sender's monotonic time of the content."""
    seq: Int64
    """Sequence number on this key; counts up by 1."""


class JointState(Message, frozen=True):
    """State of one module, published at the state rate.

    The planner echoes `t_ns` in `JointCommand.echo_t_ns`.
    """

    q: Pair
    """Joint angles (phi, theta), rad."""
    v: Pair
    """Joint rates, rad/s."""
    tau: Pair
    """Joint torques sent to the drive, after the limiter, N m."""
    mode: Int64
    cause: Int64
    """Cause of the last mode change."""
    ready: bool
    """True if commands have been fresh long enough to track once `hold` is lifted."""
    age_ns: Int64
    """Age of the command in use (docs/architecture.md#age-rule); -1: no command."""
    session: Int64
    """Its session; 0: no command."""
    command_seq: Int64
    """Its sequence number; -1: no command."""
    cycle: Int64
    """Cycles since the start."""
    late: Int64
    """Cycles over two periods after the previous one."""
    dropouts: Int64
    """Recent drop-outs; they lengthen the wait before TRACK."""
    refused: Int64
    """Commands refused since the start (`Refusal`)."""
    drive: Int64
    drive_error: Int64
    """Error bits of both axes, or-ed."""
    stiffened: bool = False
    """True while gains are at, or rise to, the support gains."""
    outside: Int64 = 0
    """Part of the newest command that is outside the envelope (`Outside`); 0 if none is."""
    state_phase: Int64 = 0
    """Phase of its states (`JointCommand`)."""
    refusal: Int64 = 0
    """Newest refusal within the last second."""
    refused_session: Int64 = 0
    """Session of that command."""
    celsius: Pair = (0.0, 0.0)
    """Estimated winding temperatures, C; 0: not estimated."""
    heat_left_s: float = -1.0
    """Time at this load until a winding or output stage is too warm, s; 3600: at least an hour; -1:
    not estimated."""
    supply_v: float = 0.0
    """Drive's supply voltage, V; 0: unknown."""


class JointCommand(Message, frozen=True):
    """References, local gains and torques for one module (docs/law.md#references-and-age)."""

    session: Int64
    """Random number of this planner session."""
    echo_t_ns: Int64
    """`t_ns` of this module's newest state; gives the age on the module's clock."""
    hold: bool
    """True requests HOLD, so that no leg works against the other."""
    q_ref: Pair
    """Reference, rad."""
    v_ref: Pair
    """Its rate, rad/s."""
    tau_ff: Pair
    """Feedforward torque, N m."""
    dtau_ff: Pair
    """Its rate, N m/s."""
    tau_coupled: Pair
    """Coupled torque, N m: body stiffness and damping beyond the local gains, and the push
    integral, low-passed; plus the eased lead. Dropped in HOLD."""
    k_p: Pair
    """Local stiffness D, N m/rad."""
    k_d: Pair
    """Local damping D_B, N m s/rad."""
    margin: float
    """Static certificate's margin for all six modules: 1 is the required stiffness, 0 a fall
    (docs/law.md#certificate)."""
    margin_onboard: float
    """Same for the drives' own loops."""
    stiffen: bool = False
    """Another module may be limp: in HOLD, rise to the support gains."""
    state_phase: Int64 = 0
    """Period in which to send the state (docs/architecture.md#rates)."""
    fallen: bool = False
    """True once fallen: drop all stiffness."""


class JointEvent(Message, frozen=True):
    """A change of mode of a joint service."""

    mode_before: Int64
    mode_after: Int64
    cause: Int64
    age_ns: Int64
    """Age of the newest command; -1: no command."""
    tau_before: Pair
    """Torque in the last cycle before the change, N m."""
    tau_after: Pair
    """Torque in the first cycle after it, N m."""


class Wrench(Message, frozen=True):
    """Wrench of the operator on the torso, at the harness point.

    In torso axes, because the sensor is fixed to the torso. The assist on the operator has the
    opposite sign.
    """

    force: Vector3
    """N, torso axes."""
    moment: Vector3
    """About the harness point, N m, torso axes."""
    valid: bool
    """False: stale, saturated, frozen or no zero; the values are the last good ones."""
    saturated: bool
    """A sensor leg is at its limit."""
    tare: Int64
    age_ns: Int64
    """Age of the sample, harness service's clock."""


class Attitude(Message, frozen=True):
    """Direction of up, from the IMU on the torso."""

    up: Vector3
    """Unit vector against gravity, torso axes."""
    rate: Vector3
    """Angular velocity, rad/s, torso axes."""
    valid: bool
    """False: silent, frozen or no fix; the values are the last good ones."""
    age_ns: Int64
    """Age of the sample, IMU service's clock; -1 before the first."""


class TareRequest(Message, frozen=True):
    """Request for a new zero: the harness service makes the present wrench read zero."""

    source: str


class ToolRoster(Message, frozen=True):
    """Tools that are linked with the recorder, and problems that it found."""

    tools: tuple[str, ...]
    """Each as NAME.HOST.PID."""
    trouble: tuple[str, ...] = ()
    """Faults of recording and of the host's disk, one line each."""


class PlannerStatus(Message, frozen=True):
    """Inputs and decisions of one planner tick."""

    session: Int64
    """Random number of this planner session."""
    mode: Int64
    hold: bool
    """True if the commands request HOLD."""
    p: Vector6
    """Measured pose: COM x y z, m; torso roll, pitch, yaw, rad; world."""
    pdot: Vector6
    """Its rate."""
    p_ref: Vector6
    """Its reference."""
    closure: Vector6
    """Left minus right leg's estimate of the torso pose, m and rad, world."""
    assist_n: float
    """Assist in the feedforward, N."""
    margin: float
    """As in the commands; 0 before the first tick."""
    margin_onboard: float
    """Same for the drives' own loops."""
    split: Int64
    ik_iterations: Int64
    """Inverse kinematics steps."""
    ik_residual: float
    """Largest residual, m or rad."""
    tick_us: float
    """Tick duration, from reading inputs to sending the last command."""
    state_seq: Modules
    """Sequence number of each module's state used."""
    wrench_seq: Int64
    """Sequence number of the wrench used; -1: none yet."""
    assist_requested_n: float
    """Operator's request, N."""
    state_age_ns: Modules
    """Time since each module's newest state arrived; -1: none yet."""
    wait_s: float = 0.0
    """Remaining wait after drop-outs, s."""
    attitude_seq: Int64 = -1
    """Sequence number of the attitude used; -1: none yet."""
    slope: Pair = (0.0, 0.0)
    """Floor slope along x and y, rad."""
    shift_requested: Vector4 = STRAIGHT
    """Requested shift: x, y, m; roll, yaw, rad."""
    stance: Vector6 = AS_CONFIGURED
    """Right foot relative to the left, as deviation from the robot file: x, y, z, m; rotation
    vector, rad, world."""
    why: str = ""
    """Why it does not lead, beyond the mode; a supply fault comes first."""
    trip: Int64 = 0
    load: Vector3 = (0.0, 0.0, 0.0)
    """Load beyond the robot file: kg; moments a and b about pitch, N m
    (`services.planner.law.load`)."""
    requested_by: str = ""
    """Source of the intent in use; empty: none or stale."""
    refused: Int64 = 0
    """Implausible states, wrenches and attitudes so far."""
    sit: bool = False
    """`OperatorIntent.sit` in use."""
    heat: Int64 = 0
    heat_left_s: float = -1.0
    """Smallest `heat_left_s` of the modules."""
    supply_v: float = 0.0
    """Lowest drive supply, V, low-passed; 0: unknown."""
    carried_n: float = 0.0
    """Payload and person carried, N (docs/law.md#wearer); without a harness, the payload."""
    wearer: Int64 = 0
    """0 if the robot may not park."""
    park_requested: Int64 = 0


class OperatorIntent(Message, frozen=True):
    """Person's requests beyond leading by hand."""

    assist_n: float
    """Requested upward force at the harness, N."""
    shift: Vector4 = STRAIGHT
    """Offset from a straight stand: COM x and y, m; torso roll and yaw, rad."""
    source: str = ""
    sit: bool = False
    """Go down to the lowest pose and hold there (`xrl down`)."""
    park: Int64 = 0


class HandLead(Message, frozen=True):
    """Lead and push of a person in place of the scenario's simulated hand."""

    leads: bool
    """False: only the push counts."""
    height: float
    """Torso origin above the ankles, m."""
    pitch: float
    """Torso pitch, rad."""
    push: Vector3
    """Push on the torso, N, world; ends 0.3 s after the last message."""
    source: str = ""


class Estop(Message, frozen=True):
    """Emergency stop: every module goes to DAMP; only a restart leaves it."""

    source: str


class SimControl(Message, frozen=True):
    """Command of a tool to the simulated world."""

    start: bool
    """Start the scenario at time 0."""


class RunEvent(Message, frozen=True):
    """An action of a tool on the run, for the log and the verdict."""

    kind: Int64
    subject: str
    """Service or push."""
    detail: str
    """Signal, or push in words."""
    scenario_s: float
    """Scenario time, s."""
