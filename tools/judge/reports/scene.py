"""3-D scene of the robot: a frame for each module, a body for each link, COM and forces.

The frames are those of `shared.robot.frames`, and `com` with the axes of the world. The links are
those of `shared.robot.robot_model`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from shared.bus import topics
from shared.bus.messages import JointState, Mode, PlannerStatus, Vector3
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES, SIDES
from shared.robot.frames import ORIGIN, UPRIGHT, FramePose, Quaternion, body_frames, torso_rotation
from shared.robot.robot_model import MODULE_RADIUS
from tools.judge.reports.foxglove import Arrow, Colour, Entity, Solid
from tools.logs.run_log import RunLog

RATE_HZ: Final = 30.0
METRES_PER_NEWTON: Final = 0.005
FORCE_MIN_N: Final = 2.0
"""Smaller forces have no arrow, since it would show the sensor's noise."""

LINK: Final[Colour] = (0.62, 0.66, 0.70, 1.0)
BODY: Final[Colour] = (0.45, 0.52, 0.60, 0.55)
COM: Final[Colour] = (0.05, 0.37, 0.65, 1.0)
HAND: Final[Colour] = (0.77, 0.31, 0.11, 1.0)
PUSH: Final[Colour] = (0.55, 0.20, 0.60, 1.0)
UNKNOWN: Final[Colour] = (0.4, 0.4, 0.4, 1.0)
MODES: Final[dict[int, Colour]] = {
    Mode.DISARMED: (0.70, 0.74, 0.77, 1.0),
    Mode.HOLD: (0.85, 0.56, 0.12, 1.0),
    Mode.TRACK: (0.18, 0.54, 0.36, 1.0),
    Mode.DAMP: (0.51, 0.33, 0.72, 1.0),
    Mode.FAULT: (0.75, 0.22, 0.17, 1.0),
}


class RobotPose(NamedTuple):
    """Pose, modes and forces of the robot at one time."""

    t_ns: int
    """Monotonic clock."""
    torso: Vector3
    """Origin of the torso frame, m, world axes."""
    angles: Vector3
    """Roll, pitch, yaw (3-1-2), rad."""
    com: Vector3
    """m, world axes."""
    q: tuple[float, ...]
    """Joint angles (12,), rad."""
    modes: tuple[int, ...]
    force: Vector3
    """Force of the operator on the torso, N, torso axes."""
    push: Vector3
    """N, world axes."""


def poses(log: RunLog, robot: RobotConfig) -> Iterator[RobotPose]:
    """Yield the poses of the robot at the scene's rate, from the newest messages at each time.

    The pose of the torso comes from the simulated world. In a log without one it comes from the
    legs' kinematics, with the planner's stance.
    """
    states: list[list[JointState]] = [log.messages(topics.JOINT_STATE, name) for name in MODULES]
    if not all(states):
        missing = ", ".join(name for name, rows in zip(MODULES, states, strict=True) if not rows)
        raise RunError(f"{log.path}: no states of {missing}; a scene needs the states of all six")
    truth: list[SimTruth] = log.messages(topics.SIM_TRUTH)
    newest = [log.newest(topics.JOINT_STATE, name) for name in MODULES]
    wrenches, statuses = log.newest(topics.WRENCH), log.newest(topics.PLANNER_STATUS)
    kinematics = None if truth else Kinematics(robot)
    # a service without a sample from its drive yet publishes a stamp of 0
    first_ns = max(next((row.t_ns for row in rows if row.t_ns > 0), 0) for rows in states)
    if not log.is_first:
        first_ns = max(first_ns, log.begin_ns)
    for row in thinned(truth or states[0], first_ns, RATE_HZ):
        if row.t_ns >= log.end_ns and not log.is_last:
            break
        states_now: list[Any] = [one.at(row.t_ns) for one in newest]
        q = tuple(angle for state_now in states_now for angle in state_now.q)
        sensed = wrenches.at(row.t_ns)
        if kinematics is None:
            torso, angles, com, push = row.torso, row.angles, row.com, row.push
        else:
            torso, angles, com = pose_of_legs(kinematics, q, statuses.at(row.t_ns))
            push = ORIGIN
        yield RobotPose(
            t_ns=row.t_ns,
            torso=torso,
            angles=angles,
            com=com,
            q=q,
            modes=tuple(state_now.mode for state_now in states_now),
            force=sensed.force if sensed is not None and sensed.valid else ORIGIN,
            push=push,
        )


def pose_of_legs(
    kinematics: Kinematics, q: Sequence[float], status: PlannerStatus | None
) -> tuple[Vector3, Vector3, Vector3]:
    """Return torso, angles and COM as the legs know them, with the planner's stance."""
    if status is not None:
        kinematics.stance[:] = status.stance
    kinematics.update(np.array(q))
    p, (x, y, z) = kinematics.p.tolist(), kinematics.r_torso.tolist()
    return (x, y, z), (p[3], p[4], p[5]), (p[0], p[1], p[2])


def thinned(rows: Iterable[Any], first_ns: int, rate_hz: float) -> Iterator[Any]:
    """Yield rows from a time on, at about a rate on average, without changing their stamps."""
    period_ns = round(NS_PER_S / rate_hz)
    due_ns = first_ns
    for row in rows:
        if row.t_ns >= due_ns:
            due_ns += period_ns * (1 + (row.t_ns - due_ns) // period_ns)
            yield row


def frames(robot: RobotConfig, pose: RobotPose) -> list[FramePose]:
    """Return all frames of a pose."""
    return [
        FramePose("world", "torso", pose.torso, torso_rotation(pose.angles)),
        FramePose("world", "com", pose.com, UPRIGHT),
        *body_frames(robot.geometry, pose.q),
    ]


def rotation_to(direction: Vector3) -> Quaternion:
    """Return the rotation that takes the x axis to a direction, which is not zero."""
    x, y, z = (part / math.hypot(*direction) for part in direction)
    across = y * y + z * z
    beyond = across / (1.0 - x) if x < 0.0 else 1.0 + x  # 1 + x, precise near 0
    if beyond < 1e-24:
        return 0.0, 0.0, 1.0, 0.0
    w = math.sqrt(beyond / 2)
    return 0.0, -z / (2 * w), y / (2 * w), w


def links(robot: RobotConfig) -> list[Entity]:
    """Return the bodies, each in the frame of its module."""
    geometry = robot.geometry
    found = [Entity("torso", "torso", (Solid("cube", geometry.torso_size, BODY),))]
    for side in SIDES:
        for kind, name, length in (("hip", "thigh", geometry.l1), ("knee", "shin", geometry.l2)):
            bone = Solid("cylinder", (0.06, 0.06, length), LINK, (0.0, 0.0, -length / 2))
            found.append(Entity(f"{kind}_{side}", f"{name}_{side}", (bone,)))
        size = (geometry.l_foot, geometry.w_foot, geometry.foot_height / 2)
        sole = Solid("cube", size, LINK, (0.0, 0.0, -0.75 * geometry.foot_height))
        found.append(Entity(f"ankle_{side}", f"sole_{side}", (sole,)))
    return found


def state(pose: RobotPose) -> list[Entity]:
    """Return the changing parts: the modules in the colours of their modes, the COM, the forces."""
    size = (MODULE_RADIUS,) * 3
    found = []
    for module, mode in zip(MODULES, pose.modes, strict=True):
        ball = Solid("sphere", size, MODES.get(mode, UNKNOWN))
        found.append(Entity(module, f"module_{module}", (ball,)))
    ball = Solid("sphere", (0.06, 0.06, 0.06), COM)
    found.append(Entity("com", "com", (ball,)))
    found.append(Entity("harness", "operator", arrows=_arrows(pose.force, HAND)))
    found.append(Entity("world", "push", arrows=_arrows(pose.push, PUSH, pose.torso)))
    return found


def _arrows(force: Vector3, colour: Colour, position: Vector3 = ORIGIN) -> tuple[Arrow, ...]:
    size = math.hypot(*force)
    if size < FORCE_MIN_N:
        return ()
    return (Arrow(position, rotation_to(force), METRES_PER_NEWTON * size, 0.02, colour),)
