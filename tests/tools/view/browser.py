"""A real Chromium, driven by its own protocol (CDP) over a WebSocket; no package beside aiohttp."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import shutil
import tempfile
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, Final

import aiohttp

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
BROWSER: Final = next((found for name in NAMES if (found := shutil.which(name))), None)
FLAGS: Final = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--remote-debugging-port=0",
)  # fmt: skip
WEBGL: Final = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
FLAT: Final = ("--disable-gpu",)
START_S: Final = 30.0


class Page:
    """One page of the browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.complaints: list[str] = []
        self._reader = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self._socket:
            data = message.json()
            if "id" in data:
                self._answers.pop(data["id"]).set_result(data)
            elif data["method"] == "Runtime.exceptionThrown":
                self.complaints.append(str(data["params"]["exceptionDetails"]))
            elif data["method"] == "Log.entryAdded" and data["params"]["entry"]["level"] == "error":
                self.complaints.append(data["params"]["entry"]["text"])

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._numbers)
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": params})
        data = await asyncio.wait_for(answer, START_S)
        assert "error" not in data, data
        result: dict[str, Any] = data["result"]
        return result

    async def open(self, address: str, width: int = 1400, height: int = 800) -> None:
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        await self.call("Page.navigate", url=address)

    async def value(self, expression: str) -> Any:
        result = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return None if "exceptionDetails" in result else result["result"].get("value")

    async def until(
        self, expression: str, holds: Callable[[Any], bool] = bool, limit_s: float = 30.0
    ) -> Any:
        """Wait until an expression's value is as it should be, and return it.

        What cannot be evaluated yet, for the page is not there, is None.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + limit_s
        while not holds(value := await self.value(expression)):
            assert loop.time() < deadline, f"{expression}: {value}"
            await asyncio.sleep(0.05)
        return value

    async def mouse(self, kind: str, x: float, y: float, *, shift: bool = False) -> None:
        """Move, press or release the left button at a place of the window, px."""
        await self.call(
            "Input.dispatchMouseEvent",
            type={"move": "mouseMoved", "down": "mousePressed", "up": "mouseReleased"}[kind],
            x=x, y=y, button="left", buttons=1, clickCount=1, modifiers=8 if shift else 0,
        )  # fmt: skip

    async def key(self, name: str) -> None:
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)

    async def picture(self, path: Path) -> None:
        result = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(result["data"]))


@contextlib.asynccontextmanager
async def browser(graphics: Sequence[str] = WEBGL) -> AsyncIterator[Page]:
    """Start a browser with one empty page, without a display."""
    assert BROWSER is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = await asyncio.create_subprocess_exec(
            BROWSER, *FLAGS, *graphics, f"--user-data-dir={folder}", "about:blank",
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            port = await _port(Path(folder) / "DevToolsActivePort")
            async with aiohttp.ClientSession() as http:
                async with http.get(f"http://127.0.0.1:{port}/json") as response:
                    pages = await response.json()
                address = next(row for row in pages if row["type"] == "page")
                async with http.ws_connect(
                    address["webSocketDebuggerUrl"], max_msg_size=0
                ) as socket:
                    yield Page(socket)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


async def _port(file: Path) -> int:
    loop = asyncio.get_running_loop()
    deadline = loop.time() + START_S
    while not (file.exists() and file.read_text().count("\n")):
        assert loop.time() < deadline, "the browser does not start"
        await asyncio.sleep(0.05)
    return int(file.read_text().splitlines()[0])
