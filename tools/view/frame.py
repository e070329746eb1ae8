"""What the page shows at one moment, wherever it comes from; made from the newest messages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from services.planner.law.kinematics import DETERMINANT_MIN, Kinematics
from services.planner.law.model import LegGeometry, leg_geometry
from services.simulator.physics.posture import SoleLoad
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import (
    JointCommand,
    JointState,
    Message,
    PlannerMode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    Vector3,
    Wrench,
    name_of,
)
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_LEG
from shared.robot.frames import ORIGIN, capture_point
from tools.fleet.fleet_status import module_status
from tools.fleet.stalls import STALL_SHOWN_NS, stalls_of
from tools.judge.reports import scene
from tools.topic_keys import every_key

LEAST_N: Final = 20.0
"""A sole that bears less has no centre of pressure worth showing."""


class SoleEstimate:
    """Both soles, with the feet where the robot file has them."""

    def __init__(self, config: RobotConfig) -> None:
        self._legs = leg_geometry(config)
        self._foot_height = config.geometry.foot_height
        self._leg_weight = config.leg_weight

    def of(self, q: Sequence[float], tau: Sequence[float]) -> tuple[SoleLoad, SoleLoad] | None:
        """Return the loads of the right and the left sole; None where a leg is too straight."""
        found = []
        for index, leg in enumerate(self._legs):
            part = slice(index * N_LEG, (index + 1) * N_LEG)
            load = self._of_leg(leg, np.array(q[part]), np.array(tau[part]))
            if load is None:
                return None
            found.append(load)
        return found[0], found[1]

    def _of_leg(self, leg: LegGeometry, q: Array, tau: Array) -> SoleLoad | None:
        J, r_torso = jacobian(leg, q)
        if abs(np.linalg.det(J)) < DETERMINANT_MIN:
            return None
        wrench = np.linalg.solve(J.T, tau)
        force, moment = wrench[:3], wrench[3:]
        moment = moment + np.cross(r_torso - leg.r_foot, force)  # about the ankle
        f_x, f_y, f_z = force.tolist()
        f_z += self._leg_weight
        if f_z < LEAST_N:
            return SoleLoad((f_x, f_y, f_z), (0.0, 0.0))
        x = leg.r_foot[0] + (-moment[1] - self._foot_height * f_x) / f_z
        y = leg.r_foot[1] + (moment[0] - self._foot_height * f_y) / f_z
        return SoleLoad((f_x, f_y, f_z), (float(x), float(y)))


def jacobian(leg: LegGeometry, q: Array) -> tuple[Array, Array]:
    """Return the torso's velocity per joint rate (6, 6), linear above angular, and its origin (3,).

    By the product of exponentials, from the foot up; m, rad, world.
    """
    R, t = np.eye(3), np.zeros(3)
    axes, points = [], []
    for axis, point, angle in zip(leg.axes, leg.points, q.tolist(), strict=True):
        axes.append(R @ axis)
        points.append(R @ point + t)
        turn = _turn(axis, angle)
        t = R @ (point - turn @ point) + t
        R = R @ turn
    r_torso = R @ leg.r_torso + t
    columns = [
        np.concatenate((np.cross(axis, r_torso - point), axis))
        for axis, point in zip(axes, points, strict=True)
    ]
    return np.array(columns).T, r_torso


def _turn(axis: Array, angle: float) -> Array:
    """Return the rotation matrix about a unit axis (Rodrigues)."""
    x, y, z = axis.tolist()
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K))


_TOPICS: Final = (
    topics.PLANNER_STATUS, topics.WRENCH, topics.SIM_TRUTH, topics.RUN_EVENT, topics.JOINT_STATE,
    topics.JOINT_COMMAND,
)  # fmt: skip
SHOWN: Final = tuple(key for key in every_key() if key.topic in _TOPICS)
"""Keys of the messages that a frame is made of."""
STALE_NS: Final = NS_PER_S // 2
"""An older message is not shown: its sender is dead, stopped or cut off."""
DIGITS: Final = 5
"""Behind the point: 0.01 mm."""


class PlannerShown(msgspec.Struct, frozen=True):
    """What the page shows of the planner."""

    mode: str
    """Name of its `PlannerMode`."""
    why: str
    """Why it does not lead."""
    wait_s: float
    margin: float
    margin_onboard: float
    tick_us: float | None
    """None in virtual time, where it is not measured."""
    assist_n: float
    height_ref: float
    """COM height that it follows, m."""
    heat_left_s: float = -1.0
    """Seconds left at this load, as in `PlannerStatus`."""


class ShownProcess(msgspec.Struct, frozen=True):
    """One process of a live fleet, by its supervisor."""

    name: str
    state: str
    restarts: int


class Frame(msgspec.Struct, frozen=True):
    """One moment of the robot; SI units, world axes unless it says otherwise."""

    t_s: float
    """Scenario time while there is one, else since the first frame."""
    begun: bool
    """True: a scenario runs."""
    torso: Vector3
    """Origin of the torso, m."""
    angles: Vector3
    """Its roll, pitch, yaw (3-1-2), rad."""
    com: Vector3
    q: tuple[float, ...]
    """Joint angles (12,), rad."""
    q_ref: tuple[float, ...]
    """Their references (12,), rad; empty if no planner is heard."""
    modes: tuple[int, ...]
    """`Mode` of each module; -1: silent."""
    drives: tuple[int, ...]
    ages_ms: tuple[float, ...]
    """Age of the command that each module uses; -1: none."""
    tau: tuple[float, ...]
    """Joint torques (12,), N m."""
    force: Vector3
    """The person's force on the torso, N, torso axes."""
    push: Vector3
    """N."""
    planner: PlannerShown | None
    """None: not heard."""
    is_true: bool
    """True: the pose is that of the simulated world; else what the legs' kinematics know."""
    fallen: bool
    capture: tuple[float, ...]
    """Capture point: COM + its rate / sqrt(g / height), x and y, m; empty without a planner."""
    soles: tuple[SoleLoad, ...]
    """Right and left; empty if not known."""
    soles_estimated: bool
    """True: from the legs' torques; False: the simulated world's own."""
    ways_out: tuple[str, ...]
    """For each module what lets it track again; empty if nothing is needed."""
    processes: tuple[ShownProcess, ...] = ()
    """Processes of a live fleet on this host; empty for the other sources."""
    network: tuple[str, ...] = ()
    """Active impairments of a live fleet's network, in words."""
    stall: str = ""
    """The last stall of the machine, in words, for some moments after it."""


class Newest:
    """The newest message of each key that a frame is made of."""

    def __init__(self, robot: RobotConfig) -> None:
        self._kinematics, self._soles = Kinematics(robot), SoleEstimate(robot)
        self.clear()

    def clear(self) -> None:
        """Forget every message."""
        self._rows: dict[tuple[str, str], Any] = {}
        self._first_ns: int | None = None

    def add(self, topic: Topic, module: str, message: Message) -> None:
        """Add a message; those that no frame shows are ignored."""
        if not isinstance(message, RunEvent) or message.kind == RunEventKind.STALLED:
            self._rows[topic.name, module] = message

    @property
    def scenario_s(self) -> float:
        """Scenario time of the newest truth, s; negative: no scenario runs."""
        truth: SimTruth | None = self._rows.get((topics.SIM_TRUTH.name, ""))
        return truth.scenario_s if truth is not None else -1.0

    def frame(self, now_ns: int) -> Frame | None:
        """Return what is known now; None until each module was heard once."""
        states: list[JointState] = [
            row for row in self._of_modules(topics.JOINT_STATE) if row.t_ns > 0
        ]
        if len(states) < len(MODULES):
            return None
        if self._first_ns is None:
            self._first_ns = now_ns
        status: PlannerStatus | None = self._fresh(topics.PLANNER_STATUS, now_ns)
        wrench: Wrench | None = self._fresh(topics.WRENCH, now_ns)
        truth: SimTruth | None = self._fresh(topics.SIM_TRUTH, now_ns)
        heard = [now_ns - state.t_ns < STALE_NS for state in states]
        q = tuple(angle for state in states for angle in state.q)
        if truth is not None:
            torso, angles, com = truth.torso, truth.angles, truth.com
        else:
            newest = self._rows.get((topics.PLANNER_STATUS.name, ""))
            torso, angles, com = scene.pose_of_legs(self._kinematics, q, newest)
        commands: list[JointCommand] = self._of_modules(topics.JOINT_COMMAND)
        led = status is not None and len(commands) == len(MODULES)
        soles, estimated = self._soles_of(truth, states)
        begun = truth is not None and truth.scenario_s >= 0.0
        t_s = self.scenario_s if begun else (now_ns - self._first_ns) / NS_PER_S
        return Frame(
            t_s=t_s,
            begun=begun,
            torso=_vector(torso),
            angles=_vector(angles),
            com=_vector(com),
            q=_short(q),
            q_ref=_short(angle for row in commands for angle in row.q_ref) if led else (),
            modes=tuple(s.mode if here else -1 for s, here in zip(states, heard, strict=True)),
            drives=tuple(state.drive for state in states),
            ages_ms=_short(
                state.age_ns / NS_PER_MS if here and state.age_ns >= 0 else -1.0
                for state, here in zip(states, heard, strict=True)
            ),
            tau=_short(torque for state in states for torque in state.tau),
            force=_vector(wrench.force) if wrench is not None and wrench.valid else ORIGIN,
            push=truth.push if truth is not None else ORIGIN,
            is_true=truth is not None,
            fallen=truth is not None and truth.fallen,
            capture=_capture_point(status) if status is not None else (),
            soles=soles,
            soles_estimated=estimated,
            ways_out=tuple(
                module_status(state if here else None).way_out.replace("MODULE", name)
                for state, here, name in zip(states, heard, MODULES, strict=True)
            ),
            planner=_shown(status) if status is not None else None,
            stall=self._stall_words(now_ns),
        )

    def _of_modules(self, topic: Topic) -> list[Any]:
        rows = (self._rows.get((topic.name, module)) for module in MODULES)
        return [row for row in rows if row is not None]

    def _fresh(self, topic: Topic, now_ns: int) -> Any | None:
        row = self._rows.get((topic.name, ""))
        return row if row is not None and now_ns - row.t_ns < STALE_NS else None

    def _stall_words(self, now_ns: int) -> str:
        stall: RunEvent | None = self._rows.get((topics.RUN_EVENT.name, ""))
        if stall is None or not 0 <= now_ns - stall.t_ns < STALL_SHOWN_NS:
            return ""
        return "".join(found.words for found in stalls_of([stall]))

    def _soles_of(
        self, truth: SimTruth | None, states: list[JointState]
    ) -> tuple[tuple[SoleLoad, ...], bool]:
        """Return the soles' loads, and whether they are estimated."""
        if truth is not None:
            loads: Sequence[SoleLoad] = (
                SoleLoad(truth.foot_right_force, truth.foot_right_cop),
                SoleLoad(truth.foot_left_force, truth.foot_left_cop),
            )
            return _shown_soles(loads), False
        q = [angle for state in states for angle in state.q]
        tau = [torque for state in states for torque in state.tau]
        return _shown_soles(self._soles.of(q, tau) or ()), True


def _shown(status: PlannerStatus) -> PlannerShown:
    return PlannerShown(
        mode=name_of(PlannerMode, status.mode),
        why=status.why,
        wait_s=status.wait_s,
        margin=status.margin,
        margin_onboard=status.margin_onboard,
        tick_us=status.tick_us or None,
        assist_n=status.assist_n,
        height_ref=status.p_ref[2],
        heat_left_s=status.heat_left_s,
    )


def _capture_point(status: PlannerStatus) -> tuple[float, ...]:
    """Return the capture point as it is drawn; nothing before the first tick."""
    if status.p[2] <= 0.0:
        return ()
    return _short(capture_point(status.p, status.pdot))


def _shown_soles(loads: Sequence[SoleLoad]) -> tuple[SoleLoad, ...]:
    return tuple(
        SoleLoad(_vector(force), (round(x, DIGITS), round(y, DIGITS))) for force, (x, y) in loads
    )


def _short(values: Iterable[float]) -> tuple[float, ...]:
    """Return numbers as a picture needs them: half as long on their way as with all digits."""
    return tuple(round(value, DIGITS) for value in values)


def _vector(values: Iterable[float]) -> Vector3:
    x, y, z = _short(values)
    return x, y, z
