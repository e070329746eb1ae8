"""Frames for the page, each of one moment, and their sources: a record, a fleet, or lockstep."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from services.planner.law.feet import ANKLES, Soles
from services.planner.law.kinematics import Kinematics, Measured
from services.simulator.physics.operator import PUSH_EXPIRES_S
from services.simulator.physics.posture import SoleLoad
from shared.bus import topics
from shared.bus.messages import (
    HandLead,
    JointState,
    Message,
    Mode,
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
from shared.joints import JOINTS, MODULES, SIDES
from shared.robot.frames import ORIGIN, body_frames, capture_point
from shared.robot.robot_model import ankle_positions
from shared.robot.trip_table import WEARING
from tools.fleet.fleet_status import module_status
from tools.fleet.stalls import STALL_SHOWN_NS, stalls_of
from tools.judge.reports.robot_pose import pose_of_legs
from tools.topic_keys import every_key

LEAST_N: Final = 20.0
"""Load below which a sole has no meaningful centre of pressure, N."""


_TOPICS: Final = (
    topics.PLANNER_STATUS, topics.WRENCH, topics.SIM_TRUTH, topics.RUN_EVENT, topics.JOINT_STATE,
)  # fmt: skip
SHOWN: Final = tuple(key for key in every_key() if key.topic in _TOPICS)
"""Keys of the messages that a frame needs."""
STALE_NS: Final = NS_PER_S // 2
"""Age from which a message is stale, ns: its sender is dead, stopped or cut off."""
DIGITS: Final = 5
"""Decimals of every number; 0.01 mm for lengths."""


class _PlannerShown(msgspec.Struct, frozen=True):
    """The planner's values on the page."""

    mode: str
    """Name of its `PlannerMode`."""
    why: str
    """Reason why it does not lead."""
    wait_s: float
    margin: float
    margin_onboard: float
    tick_us: float | None
    """None in virtual time, where it is not measured."""
    assist_n: float
    height_ref: float
    """COM height reference, m."""
    heat_left_s: float = -1.0
    """Seconds left at this load, as in `PlannerStatus`."""
    carried_n: float = 0.0
    """As in `PlannerStatus`."""
    wearer: str = ""
    """The wearer's state in words; empty if they lead."""


class ShownProcess(msgspec.Struct, frozen=True):
    """One process of a live fleet, as seen by its supervisor."""

    name: str
    state: str
    restarts: int


class Frame(msgspec.Struct, frozen=True):
    """One moment of the robot; SI units and world axes unless stated otherwise."""

    t_s: float
    """Scenario time during a scenario, else time since the first frame."""
    begun: bool
    """True during a scenario."""
    torso: Vector3
    """Origin of the torso, m."""
    angles: Vector3
    """Roll, pitch, yaw of the torso (3-1-2), rad."""
    com: Vector3
    q: tuple[float, ...]
    """Joint angles (12,), rad."""
    q_ref: tuple[float, ...]
    """References of the joint angles (12,), rad; empty without a planner."""
    modes: tuple[int, ...]
    """`Mode` of each module; -1 if silent."""
    drives: tuple[int, ...]
    ages_ms: tuple[float, ...]
    """Age of the command that each module uses; -1 if none."""
    tau: tuple[float, ...]
    """Joint torques (12,), N m."""
    force: Vector3
    """Force of the person on the torso, N, torso axes."""
    push: Vector3
    """N."""
    planner: _PlannerShown | None
    """None if silent."""
    is_true: bool
    """True if the pose comes from the simulated world, False if from the legs' kinematics."""
    fallen: bool
    capture: tuple[float, ...]
    """Capture point: COM + its rate / sqrt(g / height), x and y, m; empty without a planner."""
    soles: tuple[SoleLoad, ...]
    """Loads of the right and the left sole; empty if unknown."""
    soles_estimated: bool
    """True if estimated from the legs' torques, False if from the simulated world."""
    ways_out: tuple[str, ...]
    """For each module, the remedy that lets it track again; empty if none is needed."""
    processes: tuple[ShownProcess, ...] = ()
    """Processes of a live fleet on this host; empty for the other sources."""
    network: tuple[str, ...] = ()
    """Active impairments of a live fleet's network, in words."""
    stall: str = ""
    """The last stall of the machine, in words; empty from 2 s after its end."""


class Newest:
    """The newest message of each key that a frame needs."""

    def __init__(self, robot: RobotConfig) -> None:
        self._kinematics, self._measured = Kinematics(robot), Measured(robot)
        self._soles, self._feet = Soles(robot), ankle_positions(robot)
        self.clear()

    def clear(self) -> None:
        """Drop every message."""
        self._rows: dict[tuple[str, str], Any] = {}
        self._first_ns: int | None = None

    def add(self, topic: Topic, module: str, message: Message) -> None:
        """Store a message as the newest of its key; run events other than stalls are ignored."""
        if not isinstance(message, RunEvent) or message.kind == RunEventKind.STALLED:
            self._rows[topic.name, module] = message

    @property
    def scenario_s(self) -> float:
        """Scenario time of the newest truth, s; negative without a scenario."""
        truth: SimTruth | None = self._rows.get((topics.SIM_TRUTH.name, ""))
        return truth.scenario_s if truth is not None else -1.0

    def frame(self, now_ns: int) -> Frame | None:
        """Return the present frame, or None until every module has sent a state."""
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
            torso, angles, com = pose_of_legs(self._kinematics, q, newest)
        commands = () if status is None else status.commands
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
            q_ref=_short(angle for row in commands for angle in row.q_ref),
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
            right = SoleLoad(truth.foot_right_force, truth.foot_right_cop)
            left = SoleLoad(truth.foot_left_force, truth.foot_left_cop)
            return _shown_soles((right, left)), False
        q = [angle for state in states for angle in state.q]
        tau = [torque for state in states for torque in state.tau]
        return _shown_soles(self.estimated_soles(q, tau)), True

    def estimated_soles(self, q: Sequence[float], tau: Sequence[float]) -> tuple[SoleLoad, ...]:
        """Return the loads of both soles from the joints' torques; empty if a leg is too straight.

        The centre of pressure is offset from an ankle by the ankle's torque divided by the load.
        """
        self._measured.update(np.array(q), np.zeros(len(q)))
        loads = self._soles.loads(self._measured.leg_loads(np.array(tau)))
        if any(map(math.isnan, loads)):
            return ()
        found = []
        for load, ankle, (x, y, _) in zip(loads, ANKLES, self._feet, strict=True):
            cop = (x - tau[ankle + 1] / load, y + tau[ankle] / load) if load > LEAST_N else (x, y)
            found.append(SoleLoad((0.0, 0.0, load), cop))
        return tuple(found)


def _shown(status: PlannerStatus) -> _PlannerShown:
    return _PlannerShown(
        mode=name_of(PlannerMode, status.mode),
        why=status.why,
        wait_s=status.wait_s,
        margin=status.margin,
        margin_onboard=status.margin_onboard,
        tick_us=status.tick_us or None,
        assist_n=status.assist_n,
        height_ref=status.p_ref[2],
        heat_left_s=status.heat_left_s,
        carried_n=status.carried_n,
        wearer=WEARING.get(status.wearer, ""),
    )


def _capture_point(status: PlannerStatus) -> tuple[float, ...]:
    """Return the capture point for the picture; empty before the first tick."""
    if status.p[2] <= 0.0:
        return ()
    return _short(capture_point(status.p, status.pdot))


def _shown_soles(loads: Sequence[SoleLoad]) -> tuple[SoleLoad, ...]:
    return tuple(
        SoleLoad(_vector(force), (round(x, DIGITS), round(y, DIGITS))) for force, (x, y) in loads
    )


def _short(values: Iterable[float]) -> tuple[float, ...]:
    """Round numbers for the page; this halves their length on the wire."""
    return tuple(round(value, DIGITS) for value in values)


def _vector(values: Iterable[float]) -> Vector3:
    x, y, z = _short(values)
    return x, y, z


HOST: Final = "127.0.0.1"
PORT: Final = 8417
FRAMES_S: Final = 30.0
PAGE: Final = Path(__file__).parent / "page"
UPLOT: Final = Path(__file__).parents[1] / "judge" / "reports" / "vendor" / "uplot"

CUTS: Final[Mapping[str, tuple[str, ...]]] = {
    "left leg": ("planner->left", "left->planner"),
    "right leg": ("planner->right", "right->planner"),
    "all": ("all",),
}
"""Links to the planner that a page can cut, by the name of the group."""
CUT_S: Final = 2.0


class Mark(msgspec.Struct, frozen=True):
    """An event on the page's timeline."""

    t_s: float
    kind: str
    text: str


class _ShownBody(msgspec.Struct, frozen=True):
    """One body of the robot, in the frame of a module or of the torso."""

    frame: str
    kind: str
    """`cube`, `cylinder` along z, or `sphere`."""
    size: Vector3
    """Along x, y and z; the diameter where the body is round."""
    position: Vector3 = ORIGIN
    """Position of its centre."""


def _bodies_of(robot: RobotConfig) -> tuple[_ShownBody, ...]:
    """Return the torso, and thigh, shin and sole of each leg."""
    geometry = robot.geometry
    found = [_ShownBody("torso", "cube", geometry.torso_size)]
    sole = (geometry.l_foot, geometry.w_foot, geometry.foot_height / 2)
    for side in SIDES:
        for kind, length in (("hip", geometry.l1), ("knee", geometry.l2)):
            size, middle = (0.06, 0.06, length), (0.0, 0.0, -length / 2)
            found.append(_ShownBody(f"{kind}_{side}", "cylinder", size, middle))
        below = (0.0, 0.0, -0.75 * geometry.foot_height)
        found.append(_ShownBody(f"ankle_{side}", "cube", sole, below))
    return tuple(found)


class Order(msgspec.Struct, frozen=True):
    """A person's action on the page; `Model.orders` lists those that a source accepts."""

    order: str
    """`kill`, `freeze`, `start`, `cut`, `estop`, `hand` or `push`."""
    service: str = ""
    """Service to `kill`, `freeze` or `start`; for `cut` a name in `CUTS`."""
    height: float = 0.0
    """For `hand`: torso height to lead to, m above the ankles."""
    pitch: float = 0.0
    """For `hand`, rad."""
    force: Vector3 = (0.0, 0.0, 0.0)
    """For `push`, N, world."""


class Model(msgspec.Struct, frozen=True):
    """The data that stay constant while the page is open."""

    robot: str
    source: str
    """`record`, `live` or `lockstep`."""
    title: str
    modules: tuple[str, ...]
    modes: dict[int, str]
    joints: dict[str, tuple[str, Vector3]]
    """By module: its parent frame, and its position there, m."""
    bodies: tuple[_ShownBody, ...]
    harness: Vector3
    """Position on the torso, m."""
    foot: Vector3
    """Length, width, and height of the ankle's axis above the floor, m."""
    orders: tuple[str, ...] = ()
    processes: tuple[str, ...] = ()
    """Processes that `kill`, `freeze` and `start` accept."""
    begin_s: float = 0.0
    end_s: float = 0.0
    """End of a record on its timeline; equal to `begin_s` without a timeline."""
    marks: tuple[Mark, ...] = ()


def model_of(robot: RobotConfig, kind: str, title: str) -> Model:
    """Return the constant data of a robot."""
    geometry = robot.geometry
    still = {row.child: row for row in body_frames(geometry, (0.0,) * len(JOINTS))}
    return Model(
        robot=robot.name,
        source=kind,
        title=title,
        modules=MODULES,
        modes={int(mode): mode.name for mode in Mode},
        joints={name: (still[name].parent, still[name].position) for name in MODULES},
        bodies=_bodies_of(robot),
        harness=geometry.harness_point,
        foot=(geometry.l_foot, geometry.w_foot, geometry.foot_height),
    )


class Source(ABC):
    """Frames of one robot in motion."""

    kind: str
    title: str
    orders: tuple[str, ...] = ()
    processes: tuple[str, ...] = ()

    def __init__(self, robot: RobotConfig) -> None:
        self.robot = robot

    def model(self) -> Model:
        """Return the constant data."""
        model = model_of(self.robot, self.kind, self.title)
        return msgspec.structs.replace(model, orders=self.orders, processes=self.processes)

    def connect(self) -> None:
        """Subscribe, when a page opens. May block for a moment."""
        return

    def disconnect(self) -> None:
        """Unsubscribe, when the last page has closed."""
        return

    @abstractmethod
    def frame(self) -> Frame | None:
        """Return the newest frame, or None before the first."""

    @abstractmethod
    def carry_out(self, order: Order) -> str:
        """Carry out a person's order; return an error or an empty string. May block."""


SOURCE = "xrl view"


def without_fleet(frame: Frame) -> Frame:
    """Return a frame without the advice that needs a fleet."""
    ways_out = tuple("" if "xrl " in way else way for way in frame.ways_out)
    return msgspec.structs.replace(frame, ways_out=ways_out)


class HandOrders:
    """Combines orders to lead and orders to push, because each message contains both."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._led: tuple[float, float] | None = None
        self._force = (0.0, 0.0, 0.0)
        self._pushed_s = -PUSH_EXPIRES_S

    def message(self, order: Order) -> HandLead:
        """Return the message of a `hand` or `push` order; the sender sets its stamp."""
        now_s = self._clock()
        if order.order == "push":
            self._force, self._pushed_s = order.force, now_s
        else:
            self._led = (order.height, order.pitch)
        lasts = now_s - self._pushed_s < PUSH_EXPIRES_S
        height, pitch = self._led or (0.0, 0.0)
        return HandLead(
            t_ns=0,
            seq=0,
            leads=self._led is not None,
            height=height,
            pitch=pitch,
            push=self._force if lasts else (0.0, 0.0, 0.0),
            source=SOURCE,
        )
