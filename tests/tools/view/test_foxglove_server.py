"""`xrl view --foxglove`: a client of Foxglove's protocol finds the robot and its frames."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import threading
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from foxglove import Channel, Context, open_mcap
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from shared.bus import codec, topics
from shared.config.robot_config import RobotConfig
from shared.mcap_log import schema
from shared.robot.frames import rotated
from tests.messages import sample
from tests.tools.view.test_view_server import Recorded
from tools.judge.reports.robot_pose import FORCE_MIN_N
from tools.view.foxglove_server import FoxgloveServer, arrows, rotation_to

PROTOCOL = "foxglove.sdk.v1"
FRAMES = 5


async def look(port: int) -> tuple[dict[str, str], list[dict[str, Any]], set[str]]:
    """Return each topic's schema, some frames, and the topics from which something came."""
    async with (
        asyncio.timeout(30.0),
        aiohttp.ClientSession() as http,
        http.ws_connect(f"ws://127.0.0.1:{port}", protocols=[PROTOCOL], max_msg_size=0) as socket,
    ):
        channels: dict[int, dict[str, Any]] = {}
        frames: list[dict[str, Any]] = []
        came: set[str] = set()
        asked = False
        async for message in socket:
            if message.type is aiohttp.WSMsgType.TEXT:
                told = json.loads(message.data)
                channels |= {row["id"]: row for row in told.get("channels", [])}
            elif message.data[0] == 1:  # message data: subscription, time, payload
                number, _ = struct.unpack_from("<IQ", message.data, 1)
                topic = channels[number]["topic"]
                came.add(topic)
                if topic.endswith("/frame"):
                    frames.append(json.loads(message.data[13:]))
            if len(channels) == 4 and not asked:
                asked = True
                subscriptions = [{"id": number, "channelId": number} for number in channels]
                await socket.send_json({"op": "subscribe", "subscriptions": subscriptions})
            if len(frames) >= FRAMES and len(came) == 4:
                break
    return {row["topic"]: row["schemaName"] for row in channels.values()}, frames, came


def test_a_client_finds_the_robots_frames_and_is_served_only_while_it_looks(
    robot: RobotConfig,
) -> None:
    source, ended = Recorded(robot), threading.Event()
    server = FoxgloveServer(source, 0)
    serving = threading.Thread(target=server.serve, args=(ended.is_set,))
    serving.start()
    try:
        assert source.connected == []
        schemas, frames, came = asyncio.run(look(server.port))
        below = f"xrl/{robot.name}/"
        assert schemas == {
            f"{below}frame": "Frame",
            f"{below}scene/frames": "foxglove.FrameTransforms",
            f"{below}scene/links": "foxglove.SceneUpdate",
            f"{below}scene/state": "foxglove.SceneUpdate",
        }
        assert came == set(schemas)
        assert frames[0]["modes"] == [2] * 6
        for _ in range(400):
            if source.connected == [True, False]:
                break
            threading.Event().wait(0.05)
        assert source.connected == [True, False]
    finally:
        ended.set()
        serving.join()


@given(st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda v: math.hypot(*v) > 1e-3))
def test_an_arrow_points_along_its_force(force: tuple[float, float, float]) -> None:
    length = math.hypot(*force)
    tip = rotated(rotation_to(force), (length, 0.0, 0.0))
    assert tip == pytest.approx(force, abs=1e-6)
    assert len(arrows(force, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 1.0))) == (length >= FORCE_MIN_N)


def test_foxgloves_own_library_accepts_every_schema(tmp_path: Path) -> None:
    context = Context()
    path = tmp_path / "theirs.mcap"
    with open_mcap(path, context=context):
        for topic in topics.TOPICS:
            text = json.loads(schema.encoded(topic.type))
            channel = Channel(topic.name, schema=text, context=context)
            channel.log(json.loads(codec.encode(sample(topic.type))))
    with path.open("rb") as file:
        assert make_reader(file).get_summary() is not None
