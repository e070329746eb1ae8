"""The page's frames for Foxglove, by its own WebSocket server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final

import foxglove
import msgspec
from foxglove.websocket import ServerListener

from shared.exceptions import FleetError
from tools.judge.reports import foxglove as encoding
from tools.judge.reports import scene
from tools.judge.reports.scene import RobotPose
from tools.view.frame import Frame
from tools.view.source import FOXGLOVE_PORT, FRAMES_S, HOST, Source

LINKS_EVERY: Final = 30
"""Frames between two messages of the robot's bodies, which do not change."""


class FoxgloveServer:
    """Serves one source; subscribed to it only while somebody looks."""

    def __init__(self, source: Source, port: int = FOXGLOVE_PORT) -> None:
        self._source = source
        self._context = foxglove.Context()
        self._listener = _Lookers()
        name = f"xrl {source.robot.name}, {source.title}"
        try:
            self._server = foxglove.start_server(
                name=name, host=HOST, port=port, server_listener=self._listener,
                context=self._context,
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            raise FleetError(f"port {port} of {HOST}: {error}; give another --port") from None
        robot = source.robot.name
        self._frame = foxglove.Channel(
            f"xrl/{robot}/frame", schema=_schema_of_frames(), context=self._context
        )
        self._poses, self._links, self._state = (
            foxglove.Channel(
                f"xrl/{robot}/scene/{name}",
                schema=schema,
                message_encoding=encoding.ENCODING,
                context=self._context,
            )
            for name, schema in (
                ("frames", encoding.transforms_schema()),
                ("links", encoding.scene_schema()),
                ("state", encoding.scene_schema()),
            )
        )

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
        pose = RobotPose(
            t_ns=ns, torso=frame.torso, angles=frame.angles, com=frame.com, q=frame.q,
            modes=frame.modes, force=frame.force, push=frame.push,
        )  # fmt: skip
        self._frame.log(msgspec.json.encode(frame), log_time=ns)
        self._poses.log(encoding.transforms(ns, scene.frames(robot, pose)), log_time=ns)
        self._state.log(encoding.scene(ns, scene.state(pose)), log_time=ns)
        if with_links:
            self._links.log(encoding.scene(ns, scene.links(robot)), log_time=ns)


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
