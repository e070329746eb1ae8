"""`xrl demo --view`: a page leads, pushes, freezes, kills and stops a live fleet, recorded."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from shared.bus import topics
from shared.bus.messages import Mode, RunEventKind
from shared.places import CHECKOUT
from tests.system.fleets import command
from tests.system.stalls import stood
from tools.logs.hand_path import hand_path
from tools.logs.run_log import read_run

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

PATIENCE_S = 60.0


class Client:
    """A page without a browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self.complaints: list[str] = []

    async def order(self, order: str, **fields: Any) -> None:
        await self._socket.send_json({"order": order, **fields})

    async def until(
        self, holds: Callable[[dict[str, Any]], bool], again: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """Wait for a frame, repeating an order meanwhile, and return it."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                if again is not None:
                    await self._socket.send_json(again)
                message = await self._socket.receive_json()
                if "error" in message:
                    self.complaints.append(message["error"])
                frame = message.get("frame")
                if frame is not None and holds(frame):
                    return frame  # type: ignore[no-any-return]  # JSON


def all_in(mode: Mode) -> Callable[[dict[str, Any]], bool]:
    return lambda frame: frame["modes"] == [mode] * 6


async def lead(address: str) -> None:
    origin = "/".join(address.split("/")[:3])
    async with (
        aiohttp.ClientSession() as http,
        http.ws_connect(address + "ws", headers={"Origin": origin}) as socket,
    ):
        model = (await socket.receive_json())["model"]
        assert {"hand", "push", "kill", "freeze", "start", "estop"} <= set(model["orders"])
        client = Client(socket)
        await client.until(lambda frame: all_in(Mode.TRACK)(frame) and frame["begun"])
        hand = {"order": "hand", "height": 1.0, "pitch": 0.0}
        await client.until(lambda frame: frame["torso"][2] < 1.02, hand)
        push = {"order": "push", "force": [0.0, 30.0, 0.0]}
        await client.until(lambda frame: frame["push"][1] == 30.0, push)
        await client.until(lambda frame: frame["push"][1] == 0.0)
        await client.order("freeze", service="planner")
        await client.until(all_in(Mode.HOLD))
        await client.order("start", service="planner")
        await client.until(all_in(Mode.TRACK))
        await client.order("kill", service="planner")
        await client.until(all_in(Mode.HOLD))
        await client.until(
            lambda f: any(p["name"] == "planner" and p["restarts"] for p in f["processes"])
        )
        await client.until(all_in(Mode.TRACK))
        assert client.complaints == []
        await client.order("kill", service="cook")
        await client.until(lambda _: client.complaints != [])
        assert "no service 'cook'" in client.complaints[0]
        await client.order("estop")
        await client.until(all_in(Mode.DAMP))


def test_a_page_leads_pushes_freezes_and_kills_and_the_log_has_it_all(tmp_path: Path) -> None:
    words = command("demo", "--view", "--port", "0", "--out", tmp_path)
    with subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            for address in (line.split()[0] for line in lines if line.startswith("http://")):
                # where the cores are full it starts again, slower, with a page of its own
                with contextlib.suppress(aiohttp.WSMessageTypeError):
                    asyncio.run(lead(address))
                    break
            else:
                pytest.fail("it ended before the page had done all")
            os.kill(process.pid, signal.SIGINT)
            said, _ = process.communicate(timeout=90)
        finally:
            process.kill()
    assert stood(process.returncode, tmp_path), said
    assert "STOOD" in said
    log = read_run(tmp_path / "run.mcap")
    several = {key: count.missing for key, count in log.gaps().items() if count.several}
    assert set(several.values()) == {0}, "two tools tell events, each with its own numbers"
    path = hand_path(log)
    assert {row.hand.height for row in path if row.hand.leads} == {1.0}
    assert any(row.hand.push == (0.0, 30.0, 0.0) for row in path)
    done = [(RunEventKind(e.kind).name, e.subject) for e in log.messages(topics.RUN_EVENT)]
    assert [what for what in done if what[1] == "planner"] == [
        ("KILLED", "planner"), ("RESTARTED", "planner"), ("KILLED", "planner"),
    ]  # fmt: skip
