"""Messages for the log: inputs of services, the simulated world, and network impairments.

Of the services, only the recorder subscribes to them. Re-execution reads the inputs from the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, chain, pairwise
from typing import Final

import msgspec

from shared.bus.messages import Int64, Message, Pair, Vector3
from shared.exceptions import RunError

Ints = tuple[Int64, ...]
Floats = tuple[float, ...]
Bools = tuple[bool, ...]
_values: Final = msgspec.structs.astuple


class CycleTrace(msgspec.Struct, gc=False, frozen=True):
    """Inputs and decision of one cycle: a row of `CycleColumns`."""

    now_ns: Int64
    sampled_ns: Int64
    pos: Pair
    vel: Pair
    status: Int64
    error: Int64
    carried: Pair
    carries: bool
    session: Int64
    command_seq: Int64
    estop: bool
    drive_command: Int64
    below: Pair = (0.0, 0.0)
    knows_below: bool = False
    sinks: bool = True
    stiffen: bool = False
    malformed: Int64 = 0
    encoder_zero: Pair = (-1.0, -1.0)
    fet_celsius: Pair = (0.0, 0.0)
    motor_celsius: Pair = (0.0, 0.0)
    supply_v: float = 0.0
    ended: Int64 = 0


class CycleColumns(msgspec.Struct, gc=False, frozen=True):
    """Inputs and decisions of consecutive cycles, oldest first.

    Columns take two thirds of the space that rows take in a log. A column of pairs is flat.
    """

    now_ns: Ints
    """Time of the first cycle, then the time since the previous one. In a row: the time."""
    sampled_ns: Ints
    """Age of the drive's sample; -1: none, and the next six fields are invalid. In a row: the time
    of its arrival."""
    pos: Floats
    """Motor positions from the joint's zero, turns."""
    vel: Floats
    """Motor rates, turn/s."""
    status: Ints
    """`DriveStatus`."""
    error: Ints
    """Error bits of the drive."""
    carried: Floats
    """Motor torques of a drive that was found armed, N m."""
    carries: Bools
    """`carried` is valid."""
    session: Ints
    """Session of this cycle's command; 0: no command."""
    command_seq: Ints
    """Its sequence number; -1: no command."""
    estop: Bools
    """The emergency stop is engaged."""
    drive_command: Ints
    """Command to the drive: 0 none, 1 torques, 2 target, 3 idle, 4 arm, 5 clear the zero, 6 clear
    errors."""
    below: Floats
    """Theta and rate of ankle plus knee (for a hip) or knee (for an ankle), rad, rad/s."""
    knows_below: Bools
    """`below` is valid."""
    sinks: Bools
    """False: this knee must not sink."""
    stiffen: Bools
    """This module must stiffen: another is limp."""
    malformed: Ints
    """Malformed payloads."""
    encoder_zero: Floats
    """Positions at which the encoders read 0, turns modulo one; -1: not reported."""
    fet_celsius: Floats
    """Output stages' temperatures; 0: not reported."""
    motor_celsius: Floats
    """Motors' temperatures; 0: not reported."""
    supply_v: Floats
    """As in `JointState`."""
    ended: Ints
    """Session of a planner that ended on this host; 0: none."""


_PAIRS: Final = tuple(f.name for f in msgspec.structs.fields(CycleTrace) if f.type == Pair)


class JointTrace(Message, frozen=True):
    """Consecutive cycles of a joint service."""

    snapshot: str
    """State before these cycles, as JSON; empty in most messages."""
    columns: CycleColumns

    @classmethod
    def of(cls, cycles: Sequence[CycleTrace], seq: int, snapshot: str) -> JointTrace:
        """Return a trace of consecutive cycles, oldest first."""
        rows = zip(*map(_values, cycles), strict=True)
        columns = dict(zip(CycleTrace.__struct_fields__, rows, strict=True))
        for name in _PAIRS:
            columns[name] = tuple(chain.from_iterable(columns[name]))
        now_ns, sampled_ns = columns["now_ns"], columns["sampled_ns"]
        columns["now_ns"] = (now_ns[0], *(b - a for a, b in pairwise(now_ns)))
        columns["sampled_ns"] = tuple(
            now - sampled if sampled >= 0 else -1
            for now, sampled in zip(now_ns, sampled_ns, strict=True)
        )
        return cls(t_ns=now_ns[-1], seq=seq, snapshot=snapshot, columns=CycleColumns(**columns))

    @property
    def cycles(self) -> list[CycleTrace]:
        """The cycles, oldest first; raises RunError if the columns differ in length."""
        columns = msgspec.structs.asdict(self.columns)
        try:
            for name in _PAIRS:
                column = columns[name]
                columns[name] = zip(column[::2], column[1::2], strict=True)
            columns["now_ns"] = now_ns = tuple(accumulate(columns["now_ns"]))
            columns["sampled_ns"] = tuple(
                now - age if age != -1 else -1
                for now, age in zip(now_ns, columns["sampled_ns"], strict=True)
            )
            return [CycleTrace(*row) for row in zip(*columns.values(), strict=True)]
        except ValueError:
            raise RunError(
                f"trace {self.seq}, at {self.t_ns} ns: its columns must have one entry for each "
                "cycle, those of pairs two; the record is damaged"
            ) from None


class PlannerCheckpoint(Message, frozen=True):
    """State of the planner after a tick."""

    session: Int64
    snapshot: str
    """State, as JSON."""


class SimTruth(Message, frozen=True, kw_only=True):
    """True state, world axes."""

    scenario_s: float
    """Scenario time; negative before its start."""
    com: Vector3
    """COM, m."""
    torso: Vector3
    """Torso origin, m."""
    angles: Vector3
    """Torso roll, pitch, yaw (3-1-2), rad."""
    operator_force: Vector3
    """Force of the hand on the torso, N."""
    operator_moment: Vector3
    """Its moment, N m."""
    load_n: float
    """Weight on the harness, N."""
    harness_force_z: float
    """Upward force on the operator, N: `load_n` minus the hand's lift."""
    push: Vector3
    """Push on the torso, N."""
    foot_right_tilt: float
    """Angle between sole and floor, rad."""
    foot_left_tilt: float
    feet_slip: float
    """Distance of the farther ankle from its initial position, m."""
    hoist: float
    """Support by the hoist: 1 hanging, 0 free."""
    fallen: bool
    real_time_factor: float
    """Simulated time divided by the fleet's clock time, which `--pace` slows."""
    late_s: float
    """Clock time that the simulation has skipped."""
    lean: Pair = (0.0, 0.0)
    """Slope of the vertical relative to the floor's normal along x and y, m/m."""
    foot_right_force: Vector3 = (0.0, 0.0, 0.0)
    """Force of the floor on the sole, N."""
    foot_left_force: Vector3 = (0.0, 0.0, 0.0)
    foot_right_cop: Pair = (0.0, 0.0)
    """Centre of pressure, x and y, m; (0, 0): no load."""
    foot_left_cop: Pair = (0.0, 0.0)
    feet: Pair = (0.0, 0.0)
    """The ankles' mean displacement, x and y, m."""

    @property
    def over(self) -> Pair:
        """Vertical projection of the COM, x and y, m, world, from the midpoint of the ankles."""
        x, y, z = self.com
        return x - self.feet[0] - self.lean[0] * z, y - self.feet[1] - self.lean[1] * z


class SimState(Message, frozen=True):
    """State of the simulated world and its drives."""

    scenario_s: float
    """Scenario time."""
    qpos: tuple[float, ...]
    """MuJoCo's qpos."""
    qvel: tuple[float, ...]
    """MuJoCo's qvel."""
    warmstart: tuple[float, ...]
    """MuJoCo's qacc_warmstart."""
    hoist: float
    """As in `SimTruth`."""
    armed: tuple[Int64, ...]
    """1: in closed loop; one value per motor, as in the next fields."""
    input_pos: tuple[float, ...]
    """Position targets in the drive's count, turns."""
    input_vel: tuple[float, ...]
    """Velocity targets, turn/s."""
    input_torque: tuple[float, ...]
    """Feedforward torques, N m."""
    pos_gain: tuple[float, ...]
    """Position gains, 1/s."""
    vel_gain: tuple[float, ...]
    """Velocity gains, N m s/turn."""
    counts_from: tuple[float, ...]
    """Count of each drive at the true zero, a whole number."""
    hidden: tuple[float, ...]
    """`World.hidden`: the person, the rotors and delayed torques."""
    hand: tuple[float, ...] = (0.0,) * 11
    """Fields of `LedHand`."""
    heat: tuple[float, ...] = ()
    """Temperatures of windings, housings and output stages, C."""


class Batch(Message, frozen=True):
    """Messages of one service, sent together."""

    messages: tuple[tuple[str, msgspec.Raw], ...]
    """Full key and payload of each, in the order sent."""


class LinkEvent(Message, frozen=True):
    """Start or end of an impairment on one direction of a link."""

    link: str
    """Direction, as in `shared.links`."""
    requested: str
    """Requested direction or group."""
    number: Int64
    """The impairment's number."""
    active: bool
    """False at the end."""
    delay_ms: float
    jitter_ms: float
    loss: float
    """Fraction of lost messages."""
    partition: bool
    """Nothing passes."""
    detail: str
    """Impairment, in the syntax of `--inject`."""
    passed: Int64
    """Passed messages (live: Zenoh batches); 0 at the start."""
    lost: Int64
    """Lost messages."""
