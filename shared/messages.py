"""Every message on the bus (docs/networks.md).

Payloads are JSON by msgspec. SI units; times are integers in ns; enumerations are
integers. No field is optional: a `null` in a payload can then only be a number that
was not finite, and `shared.codec` refuses it at both ends.
"""

from __future__ import annotations

from enum import IntEnum

import msgspec

Pair = tuple[float, float]
"""(phi, theta) of one module."""
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
STRAIGHT: Vector4 = (0.0, 0.0, 0.0, 0.0)
"""No shift of x, y, roll and yaw."""
AS_CONFIGURED: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A stance with the feet where the robot file has them."""
Modules = tuple[int, int, int, int, int, int]
"""One integer for each module, in `shared.joints.MODULES` order."""


class Mode(IntEnum):
    """State of a joint service (docs/architecture.md#age-rule)."""

    DISARMED = 0
    HOLD = 1
    TRACK = 2
    DAMP = 3
    FAULT = 4


class Cause(IntEnum):
    """Why a joint service changed its state."""

    NONE = 0
    DRIVE_ARMED = 1
    COMMANDS_FRESH = 2
    COMMAND_STALE = 3
    HOLD_ALL = 4
    ESTOP = 5
    DRIVE_LOST = 6
    DRIVE_DISARMED = 7
    POSITION_LOST = 8
    """The drive does not know where its joint is: unzeroed, or its samples jump."""
    SHAKING = 9
    """It tripped by itself (`shared.trip_table`), as by the two that follow."""
    TORQUE_LIMIT = 10
    TOO_FAST = 11


class Trip(IntEnum):
    """What the planner does not lead for (`shared.trip_table`)."""

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


class Outside(IntEnum):
    """Which number of a command a joint service does not believe (`services.joint.envelope`)."""

    NOTHING = 0
    K_P = 1
    K_D = 2
    TAU_FF = 3
    DTAU_FF = 4
    TAU_COUPLED = 5
    Q_REF = 6
    """Too far from where the joint is."""
    V_REF = 7
    TORQUE_STEP = 8
    """It would change the torque faster than the law does."""
    MARGIN = 9
    """It tells a margin that no gains may leave with."""


class DriveStatus(IntEnum):
    """What a module's two axes are, together."""

    LOST = 0
    """No frames, or the link is down."""
    IDLE = 1
    """Both axes answer; at least one is not in closed loop, and neither reports an error."""
    ARMED = 2
    """Both axes are in closed loop."""
    ERROR = 3
    """At least one axis reports an error or left closed loop by itself."""
    UNZEROED = 4
    """Both axes answer, but have not been told where they are since they got power."""
    HOLDING = 5
    """Both axes are in closed loop by a service that is no more, and wait to be taken over."""


class PlannerMode(IntEnum):
    """What the planner asks of the six modules."""

    WAITING = 0
    """Not every module's state is fresh: nothing but `hold` can be said."""
    ALIGNING = 1
    """All six states are fresh; commands start from the measured pose, still with `hold`."""
    LEADING = 2
    """All six track."""
    OVERLOADED = 3
    """The harness carries more than it may: `hold` until it has been let go for a while."""
    UNCERTIFIED = 4
    """No local gains stand alone in this pose: `hold`."""
    MISPLACED = 5
    """The feet stand farther from where the robot file has them than `law.stance_max`, or have just
    been moved: `hold`."""
    TRIPPED = 6
    """Something was beyond its limit (`PlannerStatus.trip`): `hold` until all has been calm."""
    MISLOADED = 7
    """Its load is farther from the robot file than `law.load_correction`, or not known yet because
    it hung on a hoist: `hold`."""


class SplitSource(IntEnum):
    """Where the local gains of a tick come from (docs/law.md#gain-split)."""

    DIAGONAL = 0
    """diag(K_q), as configured."""
    SCHEDULE = 1
    """The certified schedule."""
    STIFFENED = 2
    """The certificate was not met by these: stiffer ones that meet it."""
    UNCERTIFIED = 3
    """None met it; `hold`."""


class Tare(IntEnum):
    """Whether the harness sensor knows its zero."""

    RUNNING = 0
    """The zero is being averaged; the harness must be unloaded and still."""
    UNSTEADY = 1
    """So it is, but the forces moved too much for a zero so far: it began anew."""
    DONE = 2


class RunEventKind(IntEnum):
    """What happened to a run from outside."""

    STARTED = 0
    KILLED = 1
    RESTARTED = 2
    PUSHED = 3
    FINISHED = 4
    FAULTED = 5
    """A drive's fault began; the subject is the module, the detail the kind."""


class Message(msgspec.Struct, gc=False, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all messages: the sender's monotonic time and a sequence number."""

    t_ns: int
    """Sender's monotonic clock when the content was true."""
    seq: int
    """Counts up by one for each message of this sender on this key."""


class JointState(Message, frozen=True):
    """One module as its joint service sees it. Published at the state rate.

    `t_ns` is the stamp that the planner echoes in `JointCommand.echo_t_ns`.
    """

    q: Pair
    """Joint angles in rad."""
    v: Pair
    """Joint rates in rad/s."""
    tau: Pair
    """Joint torques sent to the drive in this cycle, in N m, after the gate."""
    mode: int
    """`Mode`."""
    cause: int
    """`Cause` of the last change of mode; 0 before the first."""
    ready: bool
    """True if fresh commands have come for long enough to track, were `hold` lifted."""
    age_ns: int
    """Age of the newest command in use (docs/architecture.md#age-rule); -1 if there is none."""
    session: int
    """Session of the newest command in use; 0 if there is none."""
    command_seq: int
    """Sequence number of the newest command in use; -1 if there is none."""
    cycle: int
    """Control cycles since the start."""
    late: int
    """Cycles that came later than twice the period after the one before."""
    dropouts: int
    """Drop-outs remembered by the re-engagement hysteresis."""
    refused: int
    """Commands refused since the start: old, foreign, out of order or out of limits."""
    drive: int
    """`DriveStatus`."""
    drive_error: int
    """The drives' error bits, both axes or-ed; 0 if none."""
    stiffened: bool = False
    """True while this module holds with all of its stand gains, for another may be limp."""
    outside: int = 0
    """`Outside`: why the newest command was not believed; 0 if it was."""


class JointCommand(Message, frozen=True):
    """References, local gains and torques for one module (docs/law.md#references-and-age)."""

    session: int
    """Drawn at random when the planner starts."""
    echo_t_ns: int
    """The `t_ns` of this module's own newest state: age is told on one clock."""
    hold: bool
    """True asks for HOLD (`hold_all`): no leg is to work against the other."""
    q_ref: Pair
    """rad"""
    v_ref: Pair
    """rad/s"""
    tau_ff: Pair
    """N m"""
    dtau_ff: Pair
    """N m/s"""
    tau_coupled: Pair
    """What the local gains lack of the body's stiffness and damping, low-passed, and the eased
    lead, in N m; dropped in HOLD."""
    k_p: Pair
    """Local stiffness D in N m/rad."""
    k_d: Pair
    """Local damping in N m s/rad."""
    margin: float
    """Failsafe certificate of these gains, all six modules (docs/law.md#certificate): 1 is the
    stiffness required, 0 is a fall."""
    margin_onboard: float
    """The same with the joint services gone and the drives' own loops left."""
    stiffen: bool = False
    """True while another may be limp: this module in HOLD is to rise to all its stand gains."""


class JointEvent(Message, frozen=True):
    """A change of state of a joint service."""

    mode_before: int
    mode_after: int
    cause: int
    """`Cause`."""
    age_ns: int
    """Command age at the change; -1 if there was no command."""
    tau_before: Pair
    """Torque of the last cycle before the change, N m."""
    tau_after: Pair
    """Torque of the first cycle after the change, N m."""


class Wrench(Message, frozen=True):
    """What the operator does to the torso at the harness point.

    In torso axes, for the sensor is fixed to the torso. The robot's assist on the
    operator is the opposite.
    """

    force: Vector3
    """N, torso axes."""
    moment: Vector3
    """N m, torso axes, about the harness point."""
    valid: bool
    """False while the sensor is stale, saturated or without a zero: the numbers are then
    the last good ones."""
    saturated: bool
    tare: int
    """`Tare`."""
    age_ns: int
    """Age of the sensor sample, by the harness service's clock."""


class Attitude(Message, frozen=True):
    """Which way is up, as the IMU on the torso has it."""

    up: Vector3
    """Unit vector against gravity, torso axes."""
    rate: Vector3
    """Angular velocity of the torso, rad/s, torso axes."""
    valid: bool
    """False while the sensor is silent or says that it does not know: the numbers are then the
    last good ones."""
    age_ns: int
    """Age of the sensor's sample, by the IMU service's clock; -1 before the first."""


class TareRequest(Message, frozen=True):
    """Asks the harness service for a new zero: what acts now is to read as nothing."""

    source: str
    """Who asks, in words."""


class PlannerStatus(Message, frozen=True):
    """What the planner saw and decided in one tick."""

    session: int
    mode: int
    """`PlannerMode`."""
    hold: bool
    p: Vector6
    """Measured [COM x y z in m; torso roll, pitch, yaw in rad], world."""
    pdot: Vector6
    p_ref: Vector6
    closure: Vector6
    """Left minus right leg's estimate of the torso pose: m and rad, world."""
    assist_n: float
    """Assist force in the feedforward, N."""
    margin: float
    """Failsafe certificate, as in the commands; 0 before the first tick."""
    margin_onboard: float
    split: int
    """`SplitSource`."""
    ik_iterations: int
    ik_residual: float
    tick_us: float
    """Time this tick took: from reading the inputs to the last command put."""
    state_seq: Modules
    """Sequence number of the state consumed from each module."""
    wrench_seq: int
    assist_requested_n: float
    """Assist that the operator asked for, N, as this tick took it."""
    state_age_ns: Modules
    """Time since each module's newest state arrived, by the planner's clock; -1 if none yet."""
    wait_s: float = 0.0
    """Until it may lead again after drop-outs, s; 0 if nothing is waited for."""
    attitude_seq: int = -1
    """Sequence number of the attitude that this tick knew; -1: none yet."""
    slope: Pair = (0.0, 0.0)
    """Rise of the floor along x and y that the law reckons with, rad."""
    shift_requested: Vector4 = STRAIGHT
    """What the operator asked for, as this tick took it: x, y, m, roll, yaw, rad."""
    stance: Vector6 = AS_CONFIGURED
    """The right foot against the left as the law takes them, beyond the robot file: x, y, z in m
    and a rotation vector in rad, world axes."""
    why: str = ""
    """Why it does not lead, in words, where the mode does not say it all."""
    trip: int = 0
    """`Trip`: what it does not lead for."""
    load: Vector3 = (0.0, 0.0, 0.0)
    """What it carries beyond the robot file: kg, and its moments a and b about pitch, N m
    (`services.planner.load`)."""
    requested_by: str = ""
    """`OperatorIntent.source` of the intent that is given now; "": none, or it has gone stale."""


class OperatorIntent(Message, frozen=True):
    """What the person asks for beyond leading by hand."""

    assist_n: float
    """Upward force wanted at the harness, N."""
    shift: Vector4 = STRAIGHT
    """Where the closed directions are wanted, off a straight stand: COM x and y, m, the torso's
    roll and yaw, rad."""
    source: str = ""
    """Who asks, in words."""


class Estop(Message, frozen=True):
    """The emergency stop: every module goes to DAMP, and leaves it by a restart only."""

    source: str
    """Who stopped, in words."""


class SimTruth(Message, frozen=True):
    """The simulated world as it really is; no controller reads it."""

    scenario_s: float
    """Scenario time; negative until the scenario starts."""
    com: Vector3
    """COM of the whole robot, m, world."""
    torso: Vector3
    """Torso origin, m, world."""
    angles: Vector3
    """Torso roll, pitch, yaw (3-1-2), rad."""
    operator_force: Vector3
    """Spring-damper force of the operator's hand on the torso, N, world."""
    operator_moment: Vector3
    """N m"""
    load_n: float
    """Weight the operator rests on the harness, N."""
    harness_force_z: float
    """Upward force the robot gives the operator: the load less what the hand lifts, N."""
    push: Vector3
    """Push on the torso, N, world."""
    foot_right_tilt: float
    """Angle between the right sole and the floor, rad."""
    foot_left_tilt: float
    feet_slip: float
    """Largest distance of an ankle from where it stood at the start, m."""
    hoist: float
    """Share of the hoist's support: 1 hanging, 0 free."""
    fallen: bool
    real_time_factor: float
    """Simulated time over wall time since the scenario started."""
    late_s: float
    """World time lost so far because the machine was too slow, s."""
    lean: Pair = (0.0, 0.0)
    """How far up leans against the floor's normal along x and y, m/m: on a slope not zero."""

    @property
    def over(self) -> Pair:
        """Where the COM is over by gravity, at the ankles' height: x and y, m, world."""
        x, y, z = self.com
        return x - self.lean[0] * z, y - self.lean[1] * z


class SimControl(Message, frozen=True):
    """A word from a tool to the simulated world."""

    start: bool
    """Start the scenario: its time becomes zero."""


class RunEvent(Message, frozen=True):
    """Something a tool did to the run, for the log and the verdict."""

    kind: int
    """`RunEventKind`."""
    subject: str
    """The service, or the push."""
    detail: str
    """The signal, or the push in words."""
    scenario_s: float
