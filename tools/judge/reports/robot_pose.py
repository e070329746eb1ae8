"""Pose, modes and forces of the robot over a run, for pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from shared.bus import topics
from shared.bus.messages import JointState, PlannerStatus, Vector3
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES
from shared.robot.frames import ORIGIN, UPRIGHT, FramePose, body_frames, torso_rotation
from tools.logs.run_log import RunLog

FORCE_MIN_N: Final = 2.0
"""Smaller forces have no arrow, because it would show the sensor's noise."""


class RobotPose(NamedTuple):
    """Pose, modes and forces of the robot at one time."""

    t_ns: int
    """Stamp of the monotonic clock."""
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


def poses(log: RunLog, robot: RobotConfig, rate_hz: float) -> Iterator[RobotPose]:
    """Yield poses of the robot at about a given rate, from the newest messages at each time.

    The torso pose comes from the simulated world. In a log without it, the pose comes from the
    legs' kinematics, with the planner's stance.
    """
    states: list[list[JointState]] = [log.messages(topics.JOINT_STATE, name) for name in MODULES]
    if not all(states):
        missing = ", ".join(name for name, rows in zip(MODULES, states, strict=True) if not rows)
        raise RunError(f"{log.path}: no states of {missing}; a pose needs the states of all six")
    truth: list[SimTruth] = log.messages(topics.SIM_TRUTH)
    newest = [log.newest(topics.JOINT_STATE, name) for name in MODULES]
    wrenches, statuses = log.newest(topics.WRENCH), log.newest(topics.PLANNER_STATUS)
    kinematics = None if truth else Kinematics(robot)
    # a service that has no sample from its drive yet publishes a stamp of 0
    first_ns = max(next((row.t_ns for row in rows if row.t_ns > 0), 0) for rows in states)
    for row in _at_rate(truth or states[0], max(first_ns, log.begin_ns), rate_hz):
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


def _at_rate(rows: Iterable[Any], first_ns: int, rate_hz: float) -> Iterator[Any]:
    """Yield rows from a time on at about a given average rate, without changing their stamps."""
    period_ns = round(NS_PER_S / rate_hz)
    due_ns = first_ns
    for row in rows:
        if row.t_ns >= due_ns:
            due_ns += period_ns * (1 + (row.t_ns - due_ns) // period_ns)
            yield row


def pose_of_legs(
    kinematics: Kinematics, q: Sequence[float], status: PlannerStatus | None
) -> tuple[Vector3, Vector3, Vector3]:
    """Return torso, angles and COM by the legs' kinematics, with the planner's stance."""
    if status is not None:
        kinematics.stance[:] = status.stance
    kinematics.update(np.array(q))
    p, (x, y, z) = kinematics.p.tolist(), kinematics.r_torso.tolist()
    return (x, y, z), (p[3], p[4], p[5]), (p[0], p[1], p[2])


def frames(
    robot: RobotConfig, torso: Vector3, angles: Vector3, com: Vector3, q: Sequence[float]
) -> list[FramePose]:
    """Return all frames of a pose: the robot's, and `com` with the axes of the world."""
    return [
        FramePose("world", "torso", torso, torso_rotation(angles)),
        FramePose("world", "com", com, UPRIGHT),
        *body_frames(robot.geometry, q),
    ]
