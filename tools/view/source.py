"""Where the page's frames come from: one interface for a record, a live fleet and lockstep."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Final

import msgspec

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.judge.reports import scene
from tools.judge.reports.scene import RobotPose
from tools.view.frame import Frame

_STILL: Final = RobotPose(
    0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 12, (-1,) * 6, (0.0,) * 3, (0.0,) * 3
)


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
    size: tuple[float, float, float]
    position: tuple[float, float, float]


class Order(msgspec.Struct, frozen=True):
    """What a person does on the page; which orders a source takes is in `Model.orders`."""

    order: str
    """`kill`, `freeze`, `start`, `cut`, `estop`, `hand` or `push`."""
    service: str = ""
    """Service to `kill`, `freeze` or `start`; for `cut` a name in `CUTS`."""
    height: float = 0.0
    """Of `hand`: where to lead the torso, m above the ankles."""
    pitch: float = 0.0
    """Of `hand`, rad."""
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of `push`, N, world."""


class Model(msgspec.Struct, frozen=True):
    """What does not change while the page is open."""

    robot: str
    source: str
    """`record`, `live` or `lockstep`."""
    title: str
    modules: tuple[str, ...]
    modes: dict[int, str]
    joints: dict[str, tuple[str, tuple[float, float, float]]]
    """By module: the frame that it hangs in, and where, m."""
    bodies: tuple[ShownBody, ...]
    harness: tuple[float, float, float]
    """On the torso, m."""
    foot: tuple[float, float, float]
    """Length, width, and height of the ankle's axis above the floor, m."""
    orders: tuple[str, ...] = ()
    processes: tuple[str, ...] = ()
    """That `kill`, `freeze` and `start` are for."""
    begin_s: float = 0.0
    end_s: float = 0.0
    """Of a record, on its timeline; equal to `begin_s`: there is no timeline."""
    marks: tuple[Mark, ...] = ()


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
        still = {row.child: row for row in scene.frames(self.robot, _STILL)}
        return Model(
            robot=self.robot.name,
            source=self.kind,
            title=self.title,
            modules=MODULES,
            modes={int(mode): mode.name for mode in Mode},
            joints={name: (still[name].parent, still[name].position) for name in MODULES},
            bodies=tuple(
                ShownBody(entity.frame, solid.shape, solid.size, solid.position)
                for entity in scene.links(self.robot)
                for solid in entity.solids
            ),
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
