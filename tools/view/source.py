"""Where the page's frames come from: one interface for a record, a live fleet and lockstep."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import msgspec

from services.simulator.physics.operator import PUSH_EXPIRES_S
from shared.bus.messages import HandLead, Mode, Vector3
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, MODULES, SIDES
from shared.robot.frames import ORIGIN, body_frames
from tools.view.frame import Frame

COURSE_FRAMES: Final = 300
"""Frames of a record's course: a point for each pixel of a plot."""
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
"""What a page can cut off from the planner: links by name."""
CUT_S: Final = 2.0


class Mark(msgspec.Struct, frozen=True):
    """An event on the page's timeline."""

    t_s: float
    kind: str
    text: str


class ShownBody(msgspec.Struct, frozen=True):
    """One body of the robot, in the frame of a module or of the torso."""

    frame: str
    kind: str
    """`cube`, `cylinder` along z, or `sphere`."""
    size: Vector3
    """Along x, y and z; the diameter where the body is round."""
    position: Vector3 = ORIGIN
    """Of its centre."""


def bodies_of(robot: RobotConfig) -> tuple[ShownBody, ...]:
    """Return the torso, and on each leg thigh, shin and sole."""
    geometry = robot.geometry
    found = [ShownBody("torso", "cube", geometry.torso_size)]
    sole = (geometry.l_foot, geometry.w_foot, geometry.foot_height / 2)
    for side in SIDES:
        for kind, length in (("hip", geometry.l1), ("knee", geometry.l2)):
            size, middle = (0.06, 0.06, length), (0.0, 0.0, -length / 2)
            found.append(ShownBody(f"{kind}_{side}", "cylinder", size, middle))
        below = (0.0, 0.0, -0.75 * geometry.foot_height)
        found.append(ShownBody(f"ankle_{side}", "cube", sole, below))
    return tuple(found)


class Order(msgspec.Struct, frozen=True):
    """What a person does on the page; which orders a source takes is in `Model.orders`."""

    order: str
    """`kill`, `freeze`, `start`, `cut`, `estop`, `hand` or `push`."""
    service: str = ""
    """Service to `kill`, `freeze` or `start`; for `cut` a name in `CUTS`."""
    height: float = 0.0
    """For `hand`: where to lead the torso, m above the ankles."""
    pitch: float = 0.0
    """For `hand`, rad."""
    force: Vector3 = (0.0, 0.0, 0.0)
    """For `push`, N, world."""


class Model(msgspec.Struct, frozen=True):
    """What does not change while the page is open."""

    robot: str
    source: str
    """`record`, `live` or `lockstep`."""
    title: str
    modules: tuple[str, ...]
    modes: dict[int, str]
    joints: dict[str, tuple[str, Vector3]]
    """By module: the frame that it hangs in, and where, m."""
    bodies: tuple[ShownBody, ...]
    harness: Vector3
    """On the torso, m."""
    foot: Vector3
    """Length, width, and height of the ankle's axis above the floor, m."""
    orders: tuple[str, ...] = ()
    processes: tuple[str, ...] = ()
    """That `kill`, `freeze` and `start` are for."""
    begin_s: float = 0.0
    end_s: float = 0.0
    """A record's end on its timeline; equal to `begin_s`: there is no timeline."""
    marks: tuple[Mark, ...] = ()
    course: tuple[Frame, ...] = ()
    """A record from its beginning to its end, for the plots."""


class Source(ABC):
    """Frames of one robot."""

    kind: str
    title: str
    orders: tuple[str, ...] = ()
    processes: tuple[str, ...] = ()

    def __init__(self, robot: RobotConfig) -> None:
        self.robot = robot

    def model(self) -> Model:
        """Return what does not change."""
        geometry = self.robot.geometry
        still = {row.child: row for row in body_frames(geometry, (0.0,) * len(JOINTS))}
        return Model(
            robot=self.robot.name,
            source=self.kind,
            title=self.title,
            modules=MODULES,
            modes={int(mode): mode.name for mode in Mode},
            joints={name: (still[name].parent, still[name].position) for name in MODULES},
            bodies=bodies_of(self.robot),
            harness=geometry.harness_point,
            foot=(geometry.l_foot, geometry.w_foot, geometry.foot_height),
            orders=self.orders,
            processes=self.processes,
        )

    def connect(self) -> None:
        """Begin to listen: somebody looks. May block for a moment."""
        return

    def disconnect(self) -> None:
        """Stop listening: nobody looks any more."""
        return

    @abstractmethod
    def frame(self, t_s: float) -> Frame | None:
        """Return the newest frame, or of a record that at a time of its timeline; None: not yet."""

    def carry_out(self, order: Order) -> str:
        """Do what a person asks for; return why not, or nothing. May block."""
        return f"{order.order} is not possible here"


SOURCE = "xrl view"


def without_fleet(frame: Frame) -> Frame:
    """Return the frame of a robot without a fleet: without advice that needs one."""
    ways_out = tuple("" if "xrl " in way else way for way in frame.ways_out)
    return msgspec.structs.replace(frame, ways_out=ways_out)


class HandOrders:
    """Puts orders to lead and orders to push together: each message has both."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._led: tuple[float, float] | None = None
        self._force = (0.0, 0.0, 0.0)
        self._pushed_s = -PUSH_EXPIRES_S

    def message(self, order: Order) -> HandLead:
        """Return the message of a `hand` or `push` order; its stamp is for the sender."""
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
