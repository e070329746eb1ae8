"""The page's server: one asyncio loop, reachable only from this computer and with the token.

Every request needs the token in its path and this server's own name as Host; a WebSocket also needs
this server as Origin. A page from another site in the same browser lacks the token and the Origin.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import msgspec
from aiohttp import WSMsgType, web

from shared.exceptions import FleetError, XrlError
from tools.view.frame import FRAMES_S, HOST, PAGE, PORT, UPLOT, Order, Source

MESSAGE_MAX: Final = 4096
"""Maximum size of a message from a page, bytes."""
CLIENTS_MAX: Final = 8
ORDERS_MAX: Final = 64
"""Maximum number of waiting orders of a page; dragging the torso sends about 60 a second."""
CLOSE_S: Final = 1.0
"""Timeout for a page to receive the remaining messages and close, s."""
STOPS_MAX: Final = 4
"""Maximum number of concurrent emergency stops; each repeats for up to three seconds."""
_TYPES: Final = {
    ".html": "text/html", ".js": "text/javascript", ".css": "text/css",
}  # fmt: skip
_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ViewServer:
    """Serves one source to several pages."""

    def __init__(self, source: Source, port: int = PORT, token: str = "") -> None:
        self._source = source
        self._port = port
        self._token = token or secrets.token_urlsafe(16)
        self._model = msgspec.json.encode({"model": source.model()}).decode()
        self._files = _files()
        self._clients = 0
        self._sockets: dict[web.WebSocketResponse, asyncio.Transport | None] = {}
        self._lock = asyncio.Lock()
        self._stopper = ThreadPoolExecutor(STOPS_MAX, "stop")
        """Lets an emergency stop bypass other orders."""

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        return f"http://{HOST}:{self._port}/{self._token}/"

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Serve while the context is open."""
        app = web.Application(middlewares=[self._guard], client_max_size=MESSAGE_MAX)
        app.router.add_get("/{token}/ws", self._socket)
        app.router.add_get("/{token}/{file:.*}", self._file)
        runner = web.AppRunner(app, access_log=None, handle_signals=False)
        await runner.setup()
        try:
            await web.TCPSite(runner, HOST, self._port, reuse_address=True).start()
        except OSError as error:
            await runner.cleanup()
            text = f"port {self._port} of {HOST}: {error.strerror}; choose another --port"
            raise FleetError(text) from None
        self._port = runner.addresses[0][1]
        try:
            yield
        finally:
            await asyncio.gather(*(_end(*page) for page in self._sockets.items()))
            await runner.cleanup()
            self._stopper.shutdown(wait=False)

    @web.middleware
    async def _guard(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        own = {f"{HOST}:{self._port}", f"localhost:{self._port}"}
        origin = request.headers.get("Origin")
        token = request.match_info.get("token", "")
        if (
            request.headers.get("Host") not in own
            or (origin is not None and origin not in {f"http://{name}" for name in own})
            or not secrets.compare_digest(token.encode(), self._token.encode())
        ):
            return web.Response(status=403, text="open the address that `xrl view` printed\n")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    async def _file(self, request: web.Request) -> web.Response:
        found = self._files.get(request.match_info["file"] or "index.html")
        if found is None:
            return web.Response(status=404, text="no such file\n")
        content, kind = found
        return web.Response(body=content, content_type=kind, charset="utf-8")

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Origin") is None:
            return web.Response(status=403, text="the request must have the page's own Origin\n")
        if self._clients >= CLIENTS_MAX:
            return web.Response(status=503, text=f"{CLIENTS_MAX} pages are already open\n")
        socket = web.WebSocketResponse(max_msg_size=MESSAGE_MAX, heartbeat=20.0)
        await socket.prepare(request)
        self._clients += 1
        self._sockets[socket] = request.transport
        try:
            async with self._lock:
                await asyncio.to_thread(self._source.connect)
            await socket.send_str(self._model)
            sender = asyncio.create_task(self._send(socket))
            try:
                await self._receive(socket)
            finally:
                sender.cancel()
                with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                    await sender
        except XrlError as error:
            with contextlib.suppress(ConnectionError):
                await socket.send_json({"error": str(error)})
        finally:
            self._clients -= 1
            del self._sockets[socket]
            async with self._lock:
                if not self._clients:
                    await asyncio.to_thread(self._source.disconnect)
        return socket

    async def _send(self, socket: web.WebSocketResponse) -> None:
        """Send changed frames, at most 30 a second; skip frames while a page does not read."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        sent = b""
        while not socket.closed:
            try:
                frame = self._source.frame()
            except XrlError as error:
                await socket.send_json({"error": str(error)})
                return
            text = msgspec.json.encode({"frame": frame})
            if text != sent:
                await socket.send_str(text.decode())
                sent = text
            due = max(due + 1.0 / FRAMES_S, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _receive(self, socket: web.WebSocketResponse) -> None:
        """Receive the page's orders until it closes."""
        waiting: asyncio.Queue[Order] = asyncio.Queue(ORDERS_MAX)
        worker = asyncio.create_task(self._work(socket, waiting))
        stops = set[asyncio.Task[None]]()
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    continue
                try:
                    order = msgspec.json.decode(message.data, type=Order)
                    if order.order == "estop":
                        stops.add(asyncio.create_task(self._stop(socket, order)))
                    else:
                        waiting.put_nowait(order)
                except (msgspec.DecodeError, msgspec.ValidationError) as error:
                    await socket.send_json({"error": f"not a valid order: {error}"})
                except asyncio.QueueFull:
                    await socket.send_json({"error": "too many orders at once: some were dropped"})
        finally:
            worker.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await worker
            if stops:
                await asyncio.wait(stops)

    async def _work(self, socket: web.WebSocketResponse, waiting: asyncio.Queue[Order]) -> None:
        """Carry out a page's orders, one after the other."""
        while True:
            order = await waiting.get()
            await _told(socket, await asyncio.to_thread(self._source.carry_out, order))

    async def _stop(self, socket: web.WebSocketResponse, order: Order) -> None:
        """Carry out an emergency stop at once."""
        loop = asyncio.get_running_loop()
        why = await loop.run_in_executor(self._stopper, self._source.carry_out, order)
        await _told(socket, why)


async def _end(socket: web.WebSocketResponse, transport: asyncio.Transport | None) -> None:
    """Close a page's connection, and cut it if the page does not read."""
    try:
        async with asyncio.timeout(CLOSE_S):
            await socket.close()
    except TimeoutError:
        if transport is not None:
            transport.abort()


async def _told(socket: web.WebSocketResponse, why: str) -> None:
    """Send a page the error of an order, if there is one and the page is open."""
    if why and not socket.closed:
        with contextlib.suppress(ConnectionError):
            await socket.send_json({"error": why})


def _files() -> dict[str, tuple[bytes, str]]:
    """Return every file of the page by its name in the URL."""
    found = {}
    for folder, prefix in ((PAGE, ""), (UPLOT, "vendor/uplot/")):
        for path in sorted(folder.rglob("*")):
            if path.suffix in _TYPES and path.name != "entry.js":
                name = prefix + path.relative_to(folder).as_posix()
                found[name] = path.read_bytes(), _TYPES[path.suffix]
    return found
