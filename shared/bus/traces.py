"""Messages for the log: service inputs, the true world, and network impairments.

Re-execution reads them. They are on the bus like all others; only the recorder subscribes.
"""

from __future__ import annotations

import msgspec

from shared.bus.messages import Int64, Message, Pair, Vector3


class CycleTrace(msgspec.Struct, gc=False, frozen=True):
    """Inputs and decision of one cycle of a joint service."""

    now_ns: Int64
    sampled_ns: Int64
    """Arrival of the drive's sample; -1: no sample, the next six fields are void."""
    pos: Pair
    """Motor positions from the joint's zero, turns."""
    vel: Pair
    """Motor rates, turn/s."""
    status: Int64
    error: Int64
    """Drive's error bits."""
    carried: Pair
    """Motor torques of a drive found armed, N m."""
    carries: bool
    """`carried` is valid."""
    session: Int64
    """Session of this cycle's command."""
    command_seq: Int64
    """Its sequence number; -1: no command."""
    estop: bool
    """Emergency stop engaged."""
    drive_command: Int64
    """Command to the drive: 0 nothing, 1 torques, 2 a target, 3 idle, 4 arm, 5 forget the zero,
    6 clear errors."""
    tau: Pair
    """Joint torques after the limiter, N m."""
    below: Pair = (0.0, 0.0)
    """Theta and rate of its leg, rad, rad/s: ankle plus knee for a hip, the knee for an ankle."""
    knows_below: bool = False
    """`below` is valid."""
    sinks: bool = True
    """No neighbour keeps this knee from sinking."""
    stiffen: bool = False
    """Stiffens for a limp module."""
    malformed: Int64 = 0
    """Payloads of this cycle that were not commands."""
    encoder_zero: Pair = (-1.0, -1.0)
    """Where the encoders read 0, turns modulo one; -1: no answer in this cycle."""
    fet_celsius: Pair = (0.0, 0.0)
    """Reported output stages, C; 0: not in this sample."""
    motor_celsius: Pair = (0.0, 0.0)
    """Reported motors, C; 0: not in this sample."""
    supply_v: float = 0.0
    """Drive's supply voltage, V; 0: unknown."""
    ended: Int64 = 0
    """Session of a planner process that ended on this host; 0: none."""


class JointTrace(Message, frozen=True):
    """Consecutive cycles of a joint service, complete enough to re-execute them."""

    snapshot: str
    """At intervals, the state before these cycles, as JSON; else empty."""
    cycles: tuple[CycleTrace, ...]
    """Oldest first."""


class PlannerCheckpoint(Message, frozen=True):
    """State of the planner before a tick, from which re-execution can start."""

    session: Int64
    snapshot: str
    """State, as JSON."""


class SimTruth(Message, frozen=True):
    """True state of the simulated world; no controller reads it."""

    scenario_s: float
    """Scenario time; negative until the scenario starts."""
    com: Vector3
    """COM, m, world."""
    torso: Vector3
    """Torso origin, m, world."""
    angles: Vector3
    """Torso roll, pitch, yaw (3-1-2), rad."""
    operator_force: Vector3
    """Force of the hand on the torso, N, world."""
    operator_moment: Vector3
    """Its moment, N m."""
    load_n: float
    """Weight on the harness, N."""
    harness_force_z: float
    """Upward force on the operator, N: load minus the hand's lift."""
    push: Vector3
    """Push on the torso, N, world."""
    foot_right_tilt: float
    """Angle between sole and floor, rad."""
    foot_left_tilt: float
    """rad"""
    feet_slip: float
    """Largest distance of an ankle from its start, m."""
    hoist: float
    """Hoist's support: 1 hanging, 0 free."""
    fallen: bool
    real_time_factor: float
    """Simulated over wall time."""
    late_s: float
    """World time skipped on a slow machine, s."""
    lean: Pair = (0.0, 0.0)
    """Lean of up against the floor's normal along x and y, m/m."""
    foot_right_force: Vector3 = (0.0, 0.0, 0.0)
    """Force of the floor on the right sole, N, world."""
    foot_left_force: Vector3 = (0.0, 0.0, 0.0)
    """N"""
    foot_right_cop: Pair = (0.0, 0.0)
    """Centre of pressure, x and y, m, world; (0, 0): no load."""
    foot_left_cop: Pair = (0.0, 0.0)
    """m"""
    feet: Pair = (0.0, 0.0)
    """Displacement of the ankles' midpoint since the start, x and y, m, world."""

    @property
    def over(self) -> Pair:
        """COM along gravity on the floor, x and y, m, world, from the midpoint of the ankles."""
        x, y, z = self.com
        return x - self.feet[0] - self.lean[0] * z, y - self.feet[1] - self.lean[1] * z


class SimState(Message, frozen=True):
    """Complete state of the simulated world and its drives, from which a run can continue."""

    scenario_s: float
    """Negative until the scenario starts."""
    qpos: tuple[float, ...]
    """MuJoCo's qpos: m, quaternion, rad."""
    qvel: tuple[float, ...]
    """MuJoCo's qvel: m/s, rad/s."""
    warmstart: tuple[float, ...]
    """MuJoCo's qacc_warmstart."""
    hoist: float
    """Hoist's support: 1 hanging, 0 free."""
    armed: tuple[Int64, ...]
    """1 for each axis in closed loop; 12 values, as in the next fields."""
    input_pos: tuple[float, ...]
    """Position targets, turns, drive's count."""
    input_vel: tuple[float, ...]
    """Velocity targets, turn/s."""
    input_torque: tuple[float, ...]
    """Feedforward torques, N m."""
    pos_gain: tuple[float, ...]
    """Position gains, 1/s."""
    vel_gain: tuple[float, ...]
    """Velocity gains, N m s/turn."""
    counts_from: tuple[float, ...]
    """Encoder count at the true zero."""
    hidden: tuple[float, ...]
    """`World.hidden`: the person, the rotors and delayed torques."""
    hand: tuple[float, ...] = (0.0,) * 11
    """Fields of `LedHand`; all zero: the scenario leads."""
    heat: tuple[float, ...] = ()
    """Windings, housings and output stages, C, 12 each; empty: unknown."""


class Batch(Message, frozen=True):
    """Messages of one service for the recorder, which wakes once for all of them."""

    messages: tuple[tuple[str, msgspec.Raw], ...]
    """Full key and payload of each, in the order sent."""


class LinkEvent(Message, frozen=True):
    """Change of the impairment of one direction of a link."""

    link: str
    """Direction, as named in `shared.links`."""
    requested: str
    """Link as requested: direction or group."""
    number: Int64
    """Number of the impairment, the same in all its events."""
    active: bool
    """True from the begin, unless another hides it; False at its end."""
    delay_ms: float
    jitter_ms: float
    loss: float
    """Fraction of lost messages."""
    partition: bool
    """Nothing passes."""
    detail: str
    """In the words of `--inject`."""
    passed: Int64
    """Messages (live: Zenoh batches) that passed; 0 at the begin."""
    lost: Int64
    """Messages lost to it."""
