"""Every message on the bus (docs/networks.md).

Payloads are JSON by msgspec. SI units; times are integers in ns; enumerations are integers. No
field is optional: a `null` in a payload can then only be a number that was not finite, and
`shared.bus.codec` refuses it at both ends.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Final

import msgspec

Int64 = Annotated[int, msgspec.Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""An integer of 64 bits. JSON has no largest: one of 400 digits would be an exception where it
first meets a float, so it is refused as it is decoded."""
Pair = tuple[float, float]
"""(phi, theta) of one module."""
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
LEFT_MAX_S = 3600.0
"""Seconds left at a load beyond which they are not told apart: an hour or more."""
STRAIGHT: Vector4 = (0.0, 0.0, 0.0, 0.0)
"""No shift of x, y, roll and yaw."""
AS_CONFIGURED: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A stance with the feet where the robot file has them."""
Modules = tuple[Int64, Int64, Int64, Int64, Int64, Int64]
"""One integer for each module, in `shared.joints.MODULES` order."""


class Mode(IntEnum):
    """Mode of a joint service (docs/architecture.md#modes)."""

    DISARMED = 0
    """No torque; the drive is not armed."""
    HOLD = 1
    """References frozen; stands on local gains."""
    TRACK = 2
    """Follows the planner's commands."""
    DAMP = 3
    """After an emergency stop: sinks slowly; after a fall: only damps."""
    FAULT = 4
    """The drive, or its position, is lost; left by a restart only."""


class Cause(IntEnum):
    """Cause of the last change of mode."""

    NONE = 0
    """No change so far."""
    DRIVE_ARMED = 1
    """The drive is armed."""
    COMMANDS_FRESH = 2
    """Commands were fresh for long enough."""
    COMMAND_STALE = 3
    """The newest command is too old."""
    HOLD_ALL = 4
    """The planner asks all six modules to hold."""
    ESTOP = 5
    """Emergency stop."""
    DRIVE_LOST = 6
    """No frames from the drive."""
    DRIVE_DISARMED = 7
    """The drive left closed loop by itself."""
    POSITION_LOST = 8
    """The joint's position is unknown: the drive is unzeroed, or its samples jump."""
    SHAKING = 9
    """A trip of this module (`shared.robot.trip_table`)."""
    TORQUE_LIMIT = 10
    """A trip of this module."""
    TOO_FAST = 11
    """A trip of this module."""
    PLANNER_ENDED = 12
    """The process of its planner, on the same host, has ended."""
    FALLEN = 13
    """The planner says that the robot has fallen."""


class Trip(IntEnum):
    """Trip of the planner: why it does not lead (`shared.robot.trip_table`)."""

    NONE = 0
    LEGS = 1
    """The legs disagree about the torso's pose."""
    REACH = 2
    """The reference pose is out of reach."""
    TRACKING = 3
    """A joint is far from its reference."""
    UNLOADED = 4
    """A leg carries hardly any load."""
    SINKING = 5
    """The torso sinks or rises too fast."""
    TURNING = 6
    """The torso turns too fast."""
    HARNESS = 7
    """The harness force is far from the requested assist."""
    SAGGING = 8
    """The person sinks with weight on the harness."""
    UNATTENDED = 9
    """The robot drifts and nobody holds it."""
    EDGE = 10
    """A sole is loaded near its edge: the robot is leaned on from the side."""
    TIPPING = 11
    """A sole is loaded at its edge: the robot is shoved from the side."""
    OFF_BALANCE = 12
    """The COM is far ahead of or behind where the law holds it."""


class Outside(IntEnum):
    """Part of a command that lies outside the envelope (`services.joint.envelope`)."""

    NOTHING = 0
    """The command is inside."""
    K_P = 1
    K_D = 2
    TAU_FF = 3
    DTAU_FF = 4
    TAU_COUPLED = 5
    Q_REF = 6
    """Too far from the joint's position."""
    V_REF = 7
    TORQUE_STEP = 8
    """The torque would change faster than the law changes it."""
    MARGIN = 9
    """The margin is below the least that the planner may publish."""
    COUPLED_WORK = 10
    """The coupled torque drives the joint away from its reference."""
    Q_REF_ASTRAY = 11
    """The reference goes another way than its rate says."""
    COUPLED_ENERGY = 12
    """The coupled torque drives the joint along."""


class Refusal(IntEnum):
    """Cause for which a joint service refused a command (docs/architecture.md#age-rule)."""

    NONE = 0
    """None was refused lately."""
    TOO_OLD = 1
    """It answers a state that is too old."""
    FROM_THE_FUTURE = 2
    """It answers a state that this module has not sent yet."""
    FOREIGN_SESSION = 3
    """Another planner sends it, or one that this module has left."""
    NOT_NEWER = 4
    """One with its number or a higher one was accepted before."""
    OUT_OF_LIMITS = 5
    """A number is not finite, or beyond what the joint service may be told."""
    OUT_OF_ENVELOPE = 6
    """It lies outside the envelope (`Outside`)."""
    TOO_FAR_AHEAD = 7
    """Its number is higher than any planner can have counted to since the last one."""
    MALFORMED = 8
    """It is no command: no JSON, or with a null or a number that is not finite. Of no session."""


class DriveStatus(IntEnum):
    """Status of a module's two axes together."""

    LOST = 0
    """No frames, or the link is down."""
    IDLE = 1
    """Both axes answer; at least one is not in closed loop, and neither reports an error."""
    ARMED = 2
    """Both axes are in closed loop."""
    ERROR = 3
    """At least one axis reports an error or left closed loop by itself."""
    UNZEROED = 4
    """Both axes answer, but the zero was lost with the power."""
    HOLDING = 5
    """Both axes are in closed loop by an earlier service and wait for the take-over."""
    UNACKNOWLEDGED = 6
    """Lost, and the CAN bus carries no frame: no node acknowledges its frames."""


LOST_DRIVE: Final = (DriveStatus.LOST, DriveStatus.UNACKNOWLEDGED)
"""Statuses of a drive that is not heard, or cannot be told anything."""


class PlannerMode(IntEnum):
    """Mode of the planner: its request to the six modules."""

    WAITING = 0
    """Some module's state is stale: all hold."""
    ALIGNING = 1
    """All six states are fresh; commands start from the measured pose, still with `hold`."""
    LEADING = 2
    """All six track."""
    OVERLOADED = 3
    """The harness is overloaded: all hold until it has been released for a while."""
    UNCERTIFIED = 4
    """No local gains stand alone in this pose: all hold."""
    MISPLACED = 5
    """The feet are farther from their place than `law.stance_max`, or were just moved: all hold."""
    TRIPPED = 6
    """A limit was exceeded (`PlannerStatus.trip`): all hold until all values are calm."""
    MISLOADED = 7
    """The load is farther from the robot file than `law.load_correction`, or not yet weighed after
    hanging on a hoist: all hold."""
    YIELDING = 8
    """Another planner leads: this one sends no command that a module could use until it ends."""
    FALLEN = 9
    """The robot has fallen: all are to go limp, until a person has re-armed them."""


class HeatAction(IntEnum):
    """What the planner does before a motor is too warm (docs/law.md#heat)."""

    NONE = 0
    EASES = 1
    """Assist ramps down to the weight that the wearer rests on the robot; the wearer is warned."""
    STANDS_UP = 2
    """It stands up by itself; height and pitch are not the person's."""
    RESTS = 3
    """It stays straight until it has cooled; height and pitch are not the person's."""


class Park(IntEnum):
    """What is asked of a robot that may park (docs/law.md#park); OPEN is a button."""

    AUTO = 0
    NEVER = 1
    OPEN = 2


class Wearing(IntEnum):
    """What the planner makes of the person (`services.planner.watch.park`)."""

    LEADS = 0
    """Height and pitch are the person's."""
    RESTS = 1
    """Parked: the assist follows what rests on the harness."""
    AWAY = 2
    """Nobody touches the harness: closed."""
    PULLS = 3
    """Somebody pulls along the floor; changes nothing."""
    BUMPED = 4
    """A blow too short to open it."""


class SplitSource(IntEnum):
    """Source of a tick's local gains (docs/law.md#gain-split)."""

    DIAGONAL = 0
    """The paper's split, diag(K_q)."""
    SCHEDULE = 1
    """The certified schedule."""
    STIFFENED = 2
    """Stiffer gains, because the schedule's did not meet the certificate."""
    UNCERTIFIED = 3
    """None met the certificate: all hold."""
    CONTROLLER = 4
    """Those of a controller of your own, certified."""


class Tare(IntEnum):
    """Zero of the harness sensor."""

    RUNNING = 0
    """The zero is being averaged; the harness must be unloaded and still."""
    UNSTEADY = 1
    """As RUNNING, but the forces moved too much: averaging started over."""
    DONE = 2
    """The zero is known."""


class RunEventKind(IntEnum):
    """Kind of an event of a run."""

    STARTED = 0
    """The scenario started."""
    KILLED = 1
    """A service got a signal."""
    RESTARTED = 2
    """A service was started or continued."""
    PUSHED = 3
    """A push began."""
    FINISHED = 4
    """The scenario ended."""
    FAULTED = 5
    """A drive's fault began; the subject is the module, the detail the kind."""
    STALLED = 6
    """The machine stalled until then; the detail says for how long."""


def name_of(kind: type[IntEnum], code: int) -> str:
    """Return the name of a code, for example TRACK, or "unknown (99)": of another version."""
    try:
        return kind(code).name
    except ValueError:
        return f"unknown ({code})"


class Message(msgspec.Struct, gc=False, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all messages: the sender's monotonic time and a sequence number."""

    t_ns: Int64
    """Sender's monotonic time at which the content was true."""
    seq: Int64
    """Sequence number: one more for each message of this sender on this key."""


class JointState(Message, frozen=True):
    """One module as its joint service sees it. Published at the state rate.

    `t_ns` is the stamp that the planner echoes in `JointCommand.echo_t_ns`.
    """

    q: Pair
    """Joint angles (phi, theta), rad."""
    v: Pair
    """Joint rates, rad/s."""
    tau: Pair
    """Joint torques sent to the drive in this cycle, N m, after the limiter."""
    mode: Int64
    """Mode of the service."""
    cause: Int64
    """Cause of the last change of mode; 0 before the first."""
    ready: bool
    """True if commands have been fresh for long enough to track as soon as `hold` is lifted."""
    age_ns: Int64
    """Age of the newest command in use (docs/architecture.md#age-rule); -1 if there is none."""
    session: Int64
    """Session of the newest command in use; 0 if there is none."""
    command_seq: Int64
    """Sequence number of the newest command in use; -1 if there is none."""
    cycle: Int64
    """Control cycles since the start."""
    late: Int64
    """Cycles that came later than twice the period after the one before."""
    dropouts: Int64
    """Recent drop-outs that lengthen the wait before TRACK."""
    refused: Int64
    """Commands refused since the start, for any cause (`Refusal`)."""
    drive: Int64
    """Status of the drive."""
    drive_error: Int64
    """Error bits of both axes, or-ed; 0 if none."""
    stiffened: bool = False
    """True while this module holds with, or rises to, all of its support gains: another may be
    limp."""
    outside: Int64 = 0
    """Part of the newest command that lies outside the envelope; 0 if none."""
    state_phase: Int64 = 0
    """Phase in which this module sends its states, as the planner asked (`JointCommand`)."""
    refusal: Int64 = 0
    """Cause of the newest refusal of a command, for a second; 0 if there was none."""
    refused_session: Int64 = 0
    """Session of that command: of whom it came."""
    celsius: Pair = (0.0, 0.0)
    """Estimated temperature of both windings, C; 0 if it is not estimated."""
    heat_left_s: float = -1.0
    """Seconds left at this load until a winding or an output stage is too warm; 3600: an hour or
    more; -1: not estimated."""
    supply_v: float = 0.0
    """Voltage of the drive's supply, V; 0: not known."""


class JointCommand(Message, frozen=True):
    """References, local gains and torques for one module (docs/law.md#references-and-age)."""

    session: Int64
    """Random number of this planner's life."""
    echo_t_ns: Int64
    """The `t_ns` of this module's newest state: the age is measured on the module's clock."""
    hold: bool
    """True asks for HOLD, so that no leg works against the other."""
    q_ref: Pair
    """Joint reference, rad."""
    v_ref: Pair
    """Rate of the reference, rad/s."""
    tau_ff: Pair
    """Feedforward torque, N m."""
    dtau_ff: Pair
    """Rate of the feedforward torque, N m/s."""
    tau_coupled: Pair
    """Coupled torque, N m: stiffness and damping of the body beyond the local gains, and what bears
    a lasting push, low-passed, plus the eased lead; dropped in HOLD."""
    k_p: Pair
    """Local stiffness D, N m/rad."""
    k_d: Pair
    """Local damping D_B, N m s/rad."""
    margin: float
    """Margin of the failsafe certificate for all six modules' gains: 1 is the stiffness required, 0
    is a fall (docs/law.md#certificate)."""
    margin_onboard: float
    """The same with the drives' own loops only."""
    stiffen: bool = False
    """True while another module may be limp: in HOLD this one raises its gains to the stand
    gains."""
    state_phase: Int64 = 0
    """The module is to send its state in the periods of this number, modulo the periods of a state
    (docs/architecture.md#rates)."""
    fallen: bool = False
    """True once the robot has fallen: this module is to give up all stiffness."""


class JointEvent(Message, frozen=True):
    """A change of mode of a joint service."""

    mode_before: Int64
    """Mode before the change."""
    mode_after: Int64
    """Mode after the change."""
    cause: Int64
    """Cause of the change."""
    age_ns: Int64
    """Age of the newest command at the change; -1 if there was none."""
    tau_before: Pair
    """Torque of the last cycle before the change, N m."""
    tau_after: Pair
    """Torque of the first cycle after the change, N m."""


class Wrench(Message, frozen=True):
    """Wrench of the operator on the torso, at the harness point.

    Torso axes, because the sensor is fixed to the torso. The assist on the operator is the
    opposite.
    """

    force: Vector3
    """Force, N, torso axes."""
    moment: Vector3
    """Moment about the harness point, N m, torso axes."""
    valid: bool
    """False while the sensor is stale, saturated, frozen or without a zero: the numbers are the
    last good ones."""
    saturated: bool
    """True while a leg of the sensor is at its limit."""
    tare: Int64
    """Zero of the sensor."""
    age_ns: Int64
    """Age of the sensor's sample on the harness service's clock."""


class Attitude(Message, frozen=True):
    """Direction of up, from the IMU on the torso."""

    up: Vector3
    """Unit vector against gravity, torso axes."""
    rate: Vector3
    """Angular velocity of the torso, rad/s, torso axes."""
    valid: bool
    """False while the sensor is silent, frozen or reports no fix: the numbers are the last good
    ones."""
    age_ns: Int64
    """Age of the sensor's sample on the IMU service's clock; -1 before the first."""


class TareRequest(Message, frozen=True):
    """Asks the harness service for a new zero: the present wrench shall read as nothing."""

    source: str
    """Name of the sender."""


class ToolRoster(Message, frozen=True):
    """The tools that are linked with the recorder, and what it finds wrong."""

    tools: tuple[str, ...]
    """Each as NAME.HOST.PID, as it names itself."""
    trouble: tuple[str, ...] = ()
    """What keeps it from recording, and what is wrong with its host's disk, a line each."""


class PlannerStatus(Message, frozen=True):
    """Inputs and decisions of one planner tick."""

    session: Int64
    """Random number of this planner's life."""
    mode: Int64
    """Mode of the planner."""
    hold: bool
    """True if the commands of this tick ask for HOLD."""
    p: Vector6
    """Measured pose: COM x y z, m; torso roll, pitch, yaw, rad; world."""
    pdot: Vector6
    """Rate of the pose."""
    p_ref: Vector6
    """Reference of the pose."""
    closure: Vector6
    """Left minus right leg's estimate of the torso's pose, m and rad, world."""
    assist_n: float
    """Assist force in the feedforward, N."""
    margin: float
    """Margin of the failsafe certificate, as in the commands; 0 before the first tick."""
    margin_onboard: float
    """The same with the drives' own loops only."""
    split: Int64
    """Source of the local gains."""
    ik_iterations: Int64
    """Steps of the inverse kinematics."""
    ik_residual: float
    """Largest residual of the inverse kinematics, m or rad."""
    tick_us: float
    """Duration of this tick, from reading the inputs to the last command put."""
    state_seq: Modules
    """Sequence number of the state consumed from each module."""
    wrench_seq: Int64
    """Sequence number of the wrench consumed; -1: none yet."""
    assist_requested_n: float
    """Assist requested by the operator, N."""
    state_age_ns: Modules
    """Time since each module's newest state arrived, on the planner's clock; -1 if none yet."""
    wait_s: float = 0.0
    """Time until it may lead again after drop-outs, s; 0 if it does not wait."""
    attitude_seq: Int64 = -1
    """Sequence number of the attitude consumed; -1: none yet."""
    slope: Pair = (0.0, 0.0)
    """Rise of the floor along x and y in the law, rad."""
    shift_requested: Vector4 = STRAIGHT
    """Shift requested by the operator: x, y, m; roll, yaw, rad."""
    stance: Vector6 = AS_CONFIGURED
    """Place of the right foot relative to the left, as deviation from the robot file: x, y, z, m,
    and a rotation vector, rad, world axes."""
    why: str = ""
    """Why it does not lead, where the mode does not say it all; a supply's fault comes first."""
    trip: Int64 = 0
    """Trip for which it does not lead."""
    load: Vector3 = (0.0, 0.0, 0.0)
    """Load beyond the robot file: kg, and moments a and b about pitch, N m
    (`services.planner.law.load`)."""
    requested_by: str = ""
    """Source of the intent in use; empty: none, or it is stale."""
    refused: Int64 = 0
    """States, wrenches and attitudes refused so far: no sensor can have measured them."""
    sit: bool = False
    """True while it is asked to go down by itself (`OperatorIntent.sit`)."""
    heat: Int64 = 0
    """What is done before a motor is too warm."""
    heat_left_s: float = -1.0
    """Least of the modules' seconds left at this load; 3600: an hour or more; -1: not estimated."""
    supply_v: float = 0.0
    """Lowest voltage of the drives' supplies, V, low-passed; 0: not known."""
    carried_n: float = 0.0
    """Payload and person that it carries, N (docs/law.md#wearer); without a harness the payload."""
    wearer: Int64 = 0
    """What the planner makes of the person; 0 where it may not park."""
    park_requested: Int64 = 0
    """What the person asks of a robot that may park."""


class OperatorIntent(Message, frozen=True):
    """Requests of the person beyond leading by hand."""

    assist_n: float
    """Requested upward force at the harness, N."""
    shift: Vector4 = STRAIGHT
    """Requested offset from a straight stand: COM x and y, m; torso's roll and yaw, rad."""
    source: str = ""
    """Name of the sender."""
    sit: bool = False
    """The robot is to go down by itself to its lowest pose, and hold there (`xrl down`)."""
    park: Int64 = 0
    """What is asked of a robot that may park."""


class HandLead(Message, frozen=True):
    """Where a person leads the simulated hand in place of the scenario, and how they push."""

    leads: bool
    """False: height and pitch are not used; only the push is."""
    height: float
    """Torso origin above the ankles, m."""
    pitch: float
    """Pitch of the torso, rad."""
    push: Vector3
    """Push on the torso, N, world; it ends 0.3 s after the last message."""
    source: str = ""
    """Name of the sender."""


class Estop(Message, frozen=True):
    """Emergency stop: every module goes to DAMP; only a restart leaves it."""

    source: str
    """Name of the sender."""


class SimControl(Message, frozen=True):
    """Command of a tool to the simulated world."""

    start: bool
    """Start the scenario: its time becomes zero."""


class RunEvent(Message, frozen=True):
    """An action of a tool on the run, for the log and the verdict."""

    kind: Int64
    """Kind of the event."""
    subject: str
    """Service or push."""
    detail: str
    """Signal, or push in words."""
    scenario_s: float
    """Scenario time, s."""
