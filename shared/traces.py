"""Messages for the log: what a service was given, and what was done to the network.

From the first each cycle is executed again. On the bus like all others; nobody but the
recorder listens.
"""

from __future__ import annotations

import msgspec

from shared.messages import Message, Pair


class CycleTrace(msgspec.Struct, gc=False, frozen=True):
    """All that one cycle of a joint service was given, and what it decided."""

    now_ns: int
    sampled_ns: int
    """When the drive's sample came; -1: none came, and the next six fields say nothing."""
    pos: Pair
    """Motor positions from the joint's zero, turns."""
    vel: Pair
    """turn/s"""
    status: int
    """`DriveStatus`."""
    error: int
    carried: Pair
    """Motor torques that a drive told which was found armed, N m,"""
    carries: bool
    """if this says so."""
    session: int
    """Of the command that came in this cycle,"""
    command_seq: int
    """and its number; -1: none came."""
    estop: bool
    drive_command: int
    """What the drive was told: 0 nothing, 1 torques, 2 a target, 3 idle, 4 to arm, 5 no zero."""
    tau: Pair
    """Joint torques of this cycle, N m, after the gate."""
    below: Pair = (0.0, 0.0)
    """Theta and rate of ankle and knee together, as a hip knew them, rad, rad/s,"""
    knows_below: bool = False
    """if this says so."""
    sinks: bool = True
    """For a knee: it knew of no reason not to sink."""
    stiffen: bool = False
    """It knew of a limp module that it stiffens for."""


class JointTrace(Message, frozen=True):
    """Cycles of a joint service, one after the other: from these it is executed again."""

    snapshot: str
    """Once in a while, what the service knew before the first of these cycles, as JSON; else
    empty."""
    cycles: tuple[CycleTrace, ...]


class PlannerCheckpoint(Message, frozen=True):
    """What the planner knew before a tick: from here it is executed again."""

    session: int
    snapshot: str
    """JSON."""


class SimState(Message, frozen=True):
    """The simulated world and its drives, complete: a run can be gone on with from here."""

    scenario_s: float
    """Scenario time; negative until the scenario starts."""
    qpos: tuple[float, ...]
    """MuJoCo's position, m, quaternion, rad."""
    qvel: tuple[float, ...]
    """m/s, rad/s"""
    warmstart: tuple[float, ...]
    """MuJoCo's qacc_warmstart."""
    hoist: float
    """Share of the hoist's support: 1 hanging, 0 free."""
    armed: tuple[int, ...]
    """1 for each axis in closed loop; 12 of each from here on."""
    input_pos: tuple[float, ...]
    """Turns, as the drive counts them."""
    input_vel: tuple[float, ...]
    """turn/s"""
    input_torque: tuple[float, ...]
    """N m"""
    pos_gain: tuple[float, ...]
    """1/s"""
    vel_gain: tuple[float, ...]
    """N m s/turn"""
    counts_from: tuple[float, ...]
    """What each encoder counts at the true zero."""
    hidden: tuple[float, ...]
    """Of the plant: the person, the rotors and torques on their way, as `World.hidden`."""


class LinkEvent(Message, frozen=True):
    """What is done to one direction of a link has changed."""

    link: str
    """One direction, of `shared.links`."""
    requested: str
    """As it was asked for: that direction, or a group of them."""
    number: int
    """The same for all directions of one impairment, and for its beginning and its end."""
    active: bool
    """True: from now on, unless a partition or what begins later hides it; False: it is over."""
    delay_ms: float
    jitter_ms: float
    loss: float
    partition: bool
    detail: str
    """All of it in words, as `--inject` takes it."""
    passed: int
    """Messages (live: batches of Zenoh's) that went through while it was in force; 0 when it
    begins."""
    lost: int
    """Messages that it took away."""
