"""The page's frames and the robot in three dimensions for Foxglove, by its own WebSocket server.

Its well-known messages `foxglove.FrameTransforms` and `foxglove.SceneUpdate` show the robot:
lengths and positions are in m, rotations are quaternions (x, y, z, w).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import foxglove
import msgspec
from foxglove import messages as known
from foxglove.channels import FrameTransformsChannel, SceneUpdateChannel
from foxglove.websocket import ServerListener

from shared.bus.messages import Mode, Vector3
from shared.clock import NS_PER_S
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.robot.frames import ORIGIN, UPRIGHT, Quaternion
from shared.robot.robot_model import MODULE_RADIUS
from tools.judge.reports.robot_pose import FORCE_MIN_N, frames
from tools.view.frame import Frame
from tools.view.source import FOXGLOVE_PORT, FRAMES_S, HOST, ShownBody, Source, bodies_of

LINKS_EVERY: Final = 30
"""Frames between two messages of the robot's bodies, which do not change."""
METRES_PER_NEWTON: Final = 0.005
SHAFT: Final = 0.02
"""Diameter of an arrow's shaft, m."""
Colour = tuple[float, float, float, float]
LINK: Final[Colour] = (0.62, 0.66, 0.70, 1.0)
BODY: Final[Colour] = (0.45, 0.52, 0.60, 0.55)
COM: Final[Colour] = (0.05, 0.37, 0.65, 1.0)
HAND: Final[Colour] = (0.77, 0.31, 0.11, 1.0)
PUSH: Final[Colour] = (0.55, 0.20, 0.60, 1.0)
SILENT: Final[Colour] = (0.4, 0.4, 0.4, 1.0)
MODES: Final[dict[int, Colour]] = {
    Mode.DISARMED: (0.70, 0.74, 0.77, 1.0),
    Mode.HOLD: (0.85, 0.56, 0.12, 1.0),
    Mode.TRACK: (0.18, 0.54, 0.36, 1.0),
    Mode.DAMP: (0.51, 0.33, 0.72, 1.0),
    Mode.FAULT: (0.75, 0.22, 0.17, 1.0),
}

_PRIMITIVES: Final[dict[str, tuple[str, Any, dict[str, float]]]] = {
    "cube": ("cubes", known.CubePrimitive, {}),
    "sphere": ("spheres", known.SpherePrimitive, {}),
    "cylinder": ("cylinders", known.CylinderPrimitive, {"bottom_scale": 1.0, "top_scale": 1.0}),
}
"""Field of an entity, its message, and further fields, by the kind of a body."""


class FoxgloveServer:
    """Serves one source; subscribed to it only while somebody looks."""

    def __init__(self, source: Source, port: int = FOXGLOVE_PORT) -> None:
        self._source = source
        context = self._context = foxglove.Context()  # its channels close with it
        self._listener = _Lookers()
        name = f"xrl {source.robot.name}, {source.title}"
        try:
            self._server = foxglove.start_server(
                name=name, host=HOST, port=port, server_listener=self._listener, context=context
            )
        except (OSError, RuntimeError) as error:
            raise FleetError(f"port {port} of {HOST}: {error}; give another --port") from None
        below = f"xrl/{source.robot.name}"
        self._frame = foxglove.Channel(
            f"{below}/frame", schema=_schema_of_frames(), context=context
        )
        self._poses = FrameTransformsChannel(f"{below}/scene/frames", context=context)
        self._links = SceneUpdateChannel(f"{below}/scene/links", context=context)
        self._state = SceneUpdateChannel(f"{below}/scene/state", context=context)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.port)

    def serve(self, is_over: Callable[[], bool]) -> None:
        """Send frames until it is over."""
        number, connected = 0, False
        try:
            while not is_over():
                time.sleep(1.0 / FRAMES_S)
                if self._listener.count > 0 and not connected:
                    self._source.connect()
                elif self._listener.count == 0 and connected:
                    self._source.disconnect()
                connected = self._listener.count > 0
                frame = self._source.frame(0.0) if connected else None
                if frame is not None:
                    self._send(frame, with_links=number % LINKS_EVERY == 0)
                    number += 1
        finally:
            if connected:
                self._source.disconnect()
            self._server.stop()

    def _send(self, frame: Frame, *, with_links: bool) -> None:
        robot, ns = self._source.robot, time.time_ns()
        stamp = known.Timestamp(*divmod(ns, NS_PER_S))
        transforms = [
            known.FrameTransform(
                timestamp=stamp,
                parent_frame_id=row.parent,
                child_frame_id=row.child,
                translation=_vector(row.position),
                rotation=_quaternion(row.rotation),
            )
            for row in frames(robot, frame.torso, frame.angles, frame.com, frame.q)
        ]
        self._frame.log(msgspec.json.encode(frame), log_time=ns)
        self._poses.log(known.FrameTransforms(transforms=transforms), log_time=ns)
        self._state.log(known.SceneUpdate(entities=state(frame, stamp)), log_time=ns)
        if with_links:
            links = [
                _entity(f"{body.kind}_{body.frame}", body, stamp, BODY if number == 0 else LINK)
                for number, body in enumerate(bodies_of(robot))
            ]
            self._links.log(known.SceneUpdate(entities=links), log_time=ns)


def state(frame: Frame, stamp: known.Timestamp) -> list[known.SceneEntity]:
    """Return the changing parts: modules in the colours of their modes, COM, forces."""
    size = (MODULE_RADIUS,) * 3
    found = [
        _entity(f"module_{name}", ShownBody(name, "sphere", size), stamp, MODES.get(mode, SILENT))
        for name, mode in zip(MODULES, frame.modes, strict=True)
    ]
    found.append(_entity("com", ShownBody("com", "sphere", (0.06, 0.06, 0.06)), stamp, COM))
    for name, parent, force, place, colour in (
        ("operator", "harness", frame.force, ORIGIN, HAND),
        ("push", "world", frame.push, frame.torso, PUSH),
    ):
        found.append(
            known.SceneEntity(
                timestamp=stamp, frame_id=parent, id=name, frame_locked=True,
                arrows=arrows(force, place, colour),
            )
        )  # fmt: skip
    return found


def _entity(
    name: str, body: ShownBody, stamp: known.Timestamp, colour: Colour
) -> known.SceneEntity:
    field, primitive, ends = _PRIMITIVES[body.kind]
    pose = known.Pose(position=_vector(body.position), orientation=_quaternion(UPRIGHT))
    solid = primitive(pose=pose, size=_vector(body.size), color=_colour(colour), **ends)
    solids: dict[str, Any] = {field: [solid]}
    return known.SceneEntity(
        timestamp=stamp, frame_id=body.frame, id=name, frame_locked=True, **solids
    )


def arrows(force: Vector3, place: Vector3, colour: Colour) -> list[known.ArrowPrimitive]:
    """Return the arrow of a force, if it is not too small to be shown."""
    length = METRES_PER_NEWTON * math.hypot(*force)
    if length < METRES_PER_NEWTON * FORCE_MIN_N:
        return []
    head = min(length, 3.0 * SHAFT)
    return [
        known.ArrowPrimitive(
            pose=known.Pose(
                position=_vector(place), orientation=_quaternion(rotation_to(force))
            ),
            shaft_length=length - head, shaft_diameter=SHAFT,
            head_length=head, head_diameter=2.0 * SHAFT, color=_colour(colour),
        )
    ]  # fmt: skip


def rotation_to(direction: Vector3) -> Quaternion:
    """Return the rotation that takes the x axis to a direction, which is not zero."""
    x, y, z = (part / math.hypot(*direction) for part in direction)
    across = y * y + z * z
    beyond = across / (1.0 - x) if x < 0.0 else 1.0 + x  # 1 + x, precise near 0
    if beyond < 1e-24:
        return 0.0, 0.0, 1.0, 0.0
    w = math.sqrt(beyond / 2)
    return 0.0, -z / (2 * w), y / (2 * w), w


def _vector(values: Vector3) -> known.Vector3:
    x, y, z = values
    return known.Vector3(x=x, y=y, z=z)


def _quaternion(values: Quaternion) -> known.Quaternion:
    x, y, z, w = values
    return known.Quaternion(x=x, y=y, z=z, w=w)


def _colour(values: Colour) -> known.Color:
    r, g, b, a = values
    return known.Color(r=r, g=g, b=b, a=a)


def _schema_of_frames() -> dict[str, Any]:
    """Return the schema with the frame's own at the top, where Foxglove looks for it."""
    whole = msgspec.json.schema(Frame)
    return whole["$defs"]["Frame"] | {"$defs": whole["$defs"]}  # type: ignore[no-any-return]


class _Lookers(ServerListener):
    """Counts the subscriptions."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.count = 0

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002 - Foxglove's names
        with self._lock:
            self.count += 1

    def on_unsubscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002 - Foxglove's names
        with self._lock:
            self.count -= 1
