"""Messages for the log: inputs of the services, the true world, and impairments of the network.

Re-execution reads them. They are on the bus like all others; only the recorder subscribes.
"""

from __future__ import annotations

import msgspec

from shared.bus.messages import Int64, Message, Pair, Vector3


class CycleTrace(msgspec.Struct, gc=False, frozen=True):
    """Inputs and decision of one cycle of a joint service."""

    now_ns: Int64
    """The cycle's time."""
    sampled_ns: Int64
    """Arrival of the drive's sample; -1: none came, and the next six fields are void."""
    pos: Pair
    """Motor positions from the joint's zero, turns."""
    vel: Pair
    """Motor rates, turn/s."""
    status: Int64
    """Status of the drive."""
    error: Int64
    """Error bits of the drive."""
    carried: Pair
    """Motor torques of a drive that was found armed, N m; valid if `carries`."""
    carries: bool
    """True if `carried` is valid."""
    session: Int64
    """Session of the command that came in this cycle; see `command_seq`."""
    command_seq: Int64
    """Sequence number of the command that came in this cycle; -1: none came."""
    estop: bool
    """True while the emergency stop is engaged."""
    drive_command: Int64
    """Command to the drive: 0 nothing, 1 torques, 2 a target, 3 idle, 4 arm, 5 forget the zero,
    6 clear errors."""
    tau: Pair
    """Joint torques of this cycle, N m, after the limiter."""
    below: Pair = (0.0, 0.0)
    """Theta and rate of its leg, rad, rad/s: for a hip ankle and knee together, for an ankle the
    knee; valid if `knows_below`."""
    knows_below: bool = False
    """True if `below` is valid."""
    sinks: bool = True
    """For a knee: it saw no reason not to sink."""
    stiffen: bool = False
    """It saw a limp module that it stiffens for."""
    malformed: Int64 = 0
    """What came as a command in this cycle and was none."""
    encoder_zero: Pair = (-1.0, -1.0)
    """Where the motors' encoders read 0, turns modulo one; -1: not answered in this cycle."""
    fet_celsius: Pair = (0.0, 0.0)
    """Reported temperatures of the output stages, C; 0: not with this sample."""
    motor_celsius: Pair = (0.0, 0.0)
    """Reported temperatures of the motors, C; 0: not with this sample."""
    supply_v: float = 0.0
    """Voltage of the drive's supply, V; 0: not known."""
    ended: Int64 = 0
    """Session of the planner whose process on this host ended; 0: none in this cycle."""


class JointTrace(Message, frozen=True):
    """Consecutive cycles of a joint service: enough to execute them again."""

    snapshot: str
    """Once in a while the service's state before the first of these cycles, as JSON; else empty."""
    cycles: tuple[CycleTrace, ...]
    """The cycles, oldest first."""


class PlannerCheckpoint(Message, frozen=True):
    """State of the planner before a tick: execution can start here."""

    session: Int64
    """Random number of this planner's life."""
    snapshot: str
    """State, as JSON."""


class SimTruth(Message, frozen=True):
    """True state of the simulated world; no controller reads it."""

    scenario_s: float
    """Scenario time; negative until the scenario starts."""
    com: Vector3
    """COM of the whole robot, m, world."""
    torso: Vector3
    """Torso origin, m, world."""
    angles: Vector3
    """Torso roll, pitch, yaw (3-1-2), rad."""
    operator_force: Vector3
    """Force of the operator's hand on the torso, N, world."""
    operator_moment: Vector3
    """Moment of the operator's hand on the torso, N m."""
    load_n: float
    """Weight that the operator rests on the harness, N."""
    harness_force_z: float
    """Upward force of the robot on the operator: the load minus the hand's lift, N."""
    push: Vector3
    """Push on the torso, N, world."""
    foot_right_tilt: float
    """Angle between the right sole and the floor, rad."""
    foot_left_tilt: float
    """Angle between the left sole and the floor, rad."""
    feet_slip: float
    """Largest distance of an ankle from where it stood at the start, m."""
    hoist: float
    """Fraction of the hoist's support: 1 hanging, 0 free."""
    fallen: bool
    """True once the robot has fallen."""
    real_time_factor: float
    """Simulated time over wall time since the scenario started."""
    late_s: float
    """World time lost so far because the machine was too slow, s."""
    lean: Pair = (0.0, 0.0)
    """Lean of up against the floor's normal along x and y, m/m; not zero on a slope."""
    foot_right_force: Vector3 = (0.0, 0.0, 0.0)
    """Force of the floor on the right sole, N, world."""
    foot_left_force: Vector3 = (0.0, 0.0, 0.0)
    """N"""
    foot_right_cop: Pair = (0.0, 0.0)
    """Centre of pressure on the right sole, x and y, m, world; (0, 0) if it bears nothing."""
    foot_left_cop: Pair = (0.0, 0.0)
    """m"""
    feet: Pair = (0.0, 0.0)
    """How far the midpoint of the ankles has moved since the start, x and y, m, world."""

    @property
    def over(self) -> Pair:
        """Where the COM is over by gravity, x and y, m, world, from the midpoint of the ankles."""
        x, y, z = self.com
        return x - self.feet[0] - self.lean[0] * z, y - self.feet[1] - self.lean[1] * z


class SimState(Message, frozen=True):
    """Complete state of the simulated world and its drives: a run can continue from here."""

    scenario_s: float
    """Scenario time; negative until the scenario starts."""
    qpos: tuple[float, ...]
    """MuJoCo's positions, m, quaternion, rad."""
    qvel: tuple[float, ...]
    """MuJoCo's velocities, m/s, rad/s."""
    warmstart: tuple[float, ...]
    """MuJoCo's qacc_warmstart."""
    hoist: float
    """Fraction of the hoist's support: 1 hanging, 0 free."""
    armed: tuple[Int64, ...]
    """1 for each axis in closed loop; 12 values, as in all that follow."""
    input_pos: tuple[float, ...]
    """Position targets, turns as the drive counts them."""
    input_vel: tuple[float, ...]
    """Velocity targets, turn/s."""
    input_torque: tuple[float, ...]
    """Feedforward torques, N m."""
    pos_gain: tuple[float, ...]
    """Position gains, 1/s."""
    vel_gain: tuple[float, ...]
    """Velocity gains, N m s/turn."""
    counts_from: tuple[float, ...]
    """Count of each encoder at the true zero."""
    hidden: tuple[float, ...]
    """Hidden state of the plant: the person, the rotors and torques on their way, as
    `World.hidden`."""
    hand: tuple[float, ...] = (0.0,) * 11
    """State of the hand that somebody leads in place of the scenario, as the fields of `LedHand`;
    all zero: nobody does."""
    heat: tuple[float, ...] = ()
    """Temperatures of windings, housings and output stages, C, 12 each; empty: not known."""


class Batch(Message, frozen=True):
    """Messages of one service for the recorder, which is woken once for all of them."""

    messages: tuple[tuple[str, msgspec.Raw], ...]
    """Full key and payload of each, in the order in which they were put."""


class LinkEvent(Message, frozen=True):
    """A change of the impairment of one direction of a link."""

    link: str
    """One direction, as named in `shared.links`."""
    requested: str
    """The link as requested: this direction, or a group of directions."""
    number: Int64
    """Number of the impairment: the same for all its directions, and for its begin and end."""
    active: bool
    """True from the begin on, unless a partition or a later impairment hides it; False at its
    end."""
    delay_ms: float
    """Delay."""
    jitter_ms: float
    """Jitter."""
    loss: float
    """Fraction of lost messages."""
    partition: bool
    """True if nothing passes."""
    detail: str
    """The impairment in the words of `--inject`."""
    passed: Int64
    """Messages (live: Zenoh batches) that passed while it was active; 0 at the begin."""
    lost: Int64
    """Messages lost to it."""
