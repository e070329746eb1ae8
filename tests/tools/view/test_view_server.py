"""The page's server: who gets in, what goes through, and what a page may ask for."""

from __future__ import annotations

import asyncio
import inspect
import socket
import time
from collections.abc import Awaitable, Callable
from typing import Any

import aiohttp
import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tools.view.frame import FRAMES_S, Frame, Order, Source
from tools.view.server import (
    CLIENTS_MAX,
    MESSAGE_MAX,
    ORDERS_MAX,
    ViewServer,
)

TOKEN = "known-to-this-test"  # noqa: S105 - of a server that ends with its test


SLOW_S = 1.0


def frame_at(t_s: float) -> Frame:
    zero = (0.0, 0.0, 0.0)
    return Frame(
        t_s=t_s, begun=True, torso=zero, angles=zero, com=zero, q=(0.0,) * 12, q_ref=(),
        modes=(2,) * 6,
        drives=(0,) * 6, ages_ms=(1.0,) * 6, tau=(0.0,) * 12, force=zero, push=zero,
        planner=None, is_true=True, fallen=False, capture=(), soles=(), soles_estimated=False,
        ways_out=("",) * 6,
    )  # fmt: skip


class Recorded(Source):
    """A source that writes down what is asked of it."""

    kind = "lockstep"
    title = "test"

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(robot)
        self.connected: list[bool] = []
        self.orders_taken: list[Order] = []
        self.looks = 0

    def connect(self) -> None:
        self.connected.append(True)

    def disconnect(self) -> None:
        self.connected.append(False)

    def frame(self) -> Frame | None:
        self.looks += 1
        return frame_at(self.looks / FRAMES_S)

    def carry_out(self, order: Order) -> str:
        if order.service == "slow":
            time.sleep(SLOW_S)
        self.orders_taken.append(order)
        return "" if order.order == "push" else "not here"


def origin_of(server: ViewServer) -> str:
    return "/".join(server.address.split("/")[:3])


async def silent_page(server: ViewServer) -> asyncio.StreamWriter:
    """Open a WebSocket that reads nothing."""
    origin = origin_of(server)
    host = origin.removeprefix("http://")
    _, writer = await asyncio.open_connection(*host.split(":"), limit=1)
    writer.write(
        f"GET /{TOKEN}/ws HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
    )
    await writer.drain()
    return writer


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(20.0):
        while not holds():
            await asyncio.sleep(0.01)


class Bench:
    def __init__(self, source: Recorded, server: ViewServer, http: aiohttp.ClientSession) -> None:
        self.source, self.server, self.http = source, server, http

    @property
    def origin(self) -> str:
        return origin_of(self.server)

    async def page(self) -> aiohttp.ClientWebSocketResponse:
        address = self.server.address + "ws"
        return await self.http.ws_connect(address, headers={"Origin": self.origin})

    async def status(self, path: str = "", **headers: str) -> int:
        async with self.http.get(self.server.address + path, headers=headers) as answer:
            return answer.status


async def message_with(
    page: aiohttp.ClientWebSocketResponse, key: str, holds: Callable[[Any], bool] = bool
) -> Any:
    """Return the first message that has a key whose value is as it should be."""
    async with asyncio.timeout(20.0):
        while True:
            value = (await page.receive_json()).get(key)
            if value is not None and holds(value):
                return value


def served(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """Make a test of a coroutine that takes a bench: a page's server, and who asks it."""

    def run(robot: RobotConfig, **given: Any) -> None:
        async def main() -> None:
            source = Recorded(robot)
            server = ViewServer(source, 0, TOKEN)
            async with server.running(), aiohttp.ClientSession() as http:
                await test(Bench(source, server, http), **given)

        asyncio.run(main())

    _, *more = inspect.signature(test).parameters.values()
    robot = inspect.Parameter("robot", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    run.__signature__ = inspect.Signature([robot, *more])  # type: ignore[attr-defined]
    return run


@served
async def test_the_page_and_all_it_loads_are_served_here_and_nothing_from_elsewhere(
    bench: Bench,
) -> None:
    loaded = [
        "", "main.js", "scene.js", "plots.js", "style.css",
        "vendor/three/three.module.min.js", "vendor/uplot/uPlot.iife.min.js",
        "vendor/uplot/uPlot.min.css",
    ]  # fmt: skip
    size = 0
    for path in loaded:
        async with bench.http.get(bench.server.address + path) as answer:
            assert answer.status == 200, path
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            text = await answer.text()
            size += len(text)
            if "vendor" not in path:
                assert "http://" not in text
                assert "https://" not in text
    assert size < 700_000
    assert await bench.status("no-such-file") == 404
    assert await bench.status("..%2f..%2fserver.py") == 404


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": "evil.example:8417"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "https://127.0.0.1"}, 403),
    ],
)
@served
async def test_another_host_or_origin_is_refused(
    bench: Bench, headers: dict[str, str], status: int
) -> None:
    assert await bench.status(**headers) == status
    address = bench.server.address + "ws"
    if status != 200:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await bench.http.ws_connect(address, headers={"Origin": bench.origin} | headers)
        assert refused.value.status == 403
    assert bench.source.connected == []


@served
async def test_without_the_token_or_an_origin_there_is_nothing(bench: Bench) -> None:
    for token in ("", "x", TOKEN[:-1], TOKEN + "x", "%00"):
        async with bench.http.get(f"{bench.origin}/{token}/") as answer:
            assert answer.status in (403, 404), token
            assert TOKEN not in await answer.text()
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        await bench.http.ws_connect(bench.server.address + "ws")
    assert refused.value.status == 403
    assert bench.source.connected == []


@served
async def test_a_source_listens_while_a_page_is_open(bench: Bench) -> None:
    assert bench.source.connected == []
    one, two = await bench.page(), await bench.page()
    assert (await message_with(one, "model"))["robot"] == "xrl"
    await one.close()
    await message_with(two, "frame")
    assert False not in bench.source.connected
    await two.close()
    await until(lambda: not bench.source.connected[-1])


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", "{}", '{"order": 3}',
     '{"order": "push", "force": [1, 2]}', '{"order": "push", "force": [1, 2, "x"]}',
     '{"order": "push", "force": null}'],
)  # fmt: skip
@served
async def test_what_is_not_understood_is_told_and_the_page_stays_open(
    bench: Bench, text: str
) -> None:
    page = await bench.page()
    await page.send_str(text)
    assert "not a valid order" in await message_with(page, "error")
    assert bench.source.orders_taken == []
    await page.send_json({"order": "push"})
    await until(lambda: len(bench.source.orders_taken) == 1)
    await page.close()


@served
async def test_orders_go_to_the_source_and_an_emergency_stop_waits_for_none(bench: Bench) -> None:
    page = await bench.page()
    await page.send_json({"order": "push", "force": [1.0, 2.0, 3.0]})
    await page.send_json({"order": "dance"})
    assert await message_with(page, "error") == "not here"
    await page.send_json({"order": "cut", "service": "slow"})
    await page.send_json({"order": "estop"})
    await until(lambda: len(bench.source.orders_taken) == 4)
    await page.close()
    push, *others = bench.source.orders_taken
    assert push == Order(order="push", force=(1.0, 2.0, 3.0))
    assert [order.order for order in others] == ["dance", "estop", "cut"]


@served
async def test_of_too_many_orders_some_are_left_out_and_that_is_said(bench: Bench) -> None:
    page = await bench.page()
    await page.send_json({"order": "cut", "service": "slow"})
    for _ in range(ORDERS_MAX + 2):
        await page.send_json({"order": "push"})
    assert "too many orders" in await message_with(page, "error")
    await page.close()
    await until(lambda: not bench.source.connected[-1])
    assert len(bench.source.orders_taken) <= ORDERS_MAX + 2


@served
async def test_a_message_that_is_too_long_ends_the_page_and_no_other(bench: Bench) -> None:
    one, two = await bench.page(), await bench.page()
    await one.send_str("x" * (MESSAGE_MAX + 1))
    async with asyncio.timeout(20.0):
        while (await one.receive()).type is not aiohttp.WSMsgType.CLOSE:
            pass
    await message_with(two, "frame")
    await two.close()


@served
async def test_a_page_too_many_is_refused_and_one_that_does_not_drain_holds_up_no_other(
    bench: Bench,
) -> None:
    writer = await silent_page(bench.server)
    pages = [await bench.page() for _ in range(CLIENTS_MAX - 1)]
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        await bench.page()
    assert refused.value.status == 503
    began = bench.source.looks
    await until(lambda: bench.source.looks > began + 30)
    await message_with(pages[0], "frame", lambda frame: frame["t_s"] > began / FRAMES_S)
    for page in pages:
        await page.close()
    writer.close()


def test_a_port_in_use_is_told(robot: RobotConfig) -> None:
    async def main(port: int) -> None:
        async with ViewServer(Recorded(robot), port, TOKEN).running():
            raise AssertionError("it is in use")

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(FleetError, match="choose another --port"):
            asyncio.run(main(other.getsockname()[1]))


class Wordy(Recorded):
    """A source whose frames are longer than all buffers on their way."""

    def frame(self) -> Frame | None:
        return msgspec.structs.replace(frame_at(0.0), ways_out=("x" * 20_000_000,) * 6)


def test_a_page_that_reads_nothing_does_not_hold_up_the_end(robot: RobotConfig) -> None:
    async def main() -> None:
        server = ViewServer(Wordy(robot), 0, TOKEN)
        running = server.running()
        await running.__aenter__()
        writer = await silent_page(server)
        await until(lambda: any(page.prepared for page in server._sockets))
        async with asyncio.timeout(20.0):
            await asyncio.sleep(0.5)  # a frame is on its way
            await running.__aexit__(None, None, None)
        writer.close()

    asyncio.run(main())
