"""Serving the page on loopback: a token, one origin, bounded bodies, and the stream of pictures.

One port serves all: the page, Rerun's viewer as the installed wheel carries it, and what is logged,
as a websocket of RRD pieces.  Every request needs the token, the first in the address and later
ones in a cookie that is kept from scripts and from other sites.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from workbench.errors import DataError, one_line
from workbench.viewer import LOOPBACK

MAX_BODY_BYTES = 256 << 10
_PACE_SECONDS = 0.25
_UNREAD_PIECES = 2
_UNREAD_BYTES = 96 << 20
_TOKEN_BYTES = 24


class Guard:
    """ASGI middleware that refuses what does not come from the page that was opened here."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app = app
        self._token = token
        self._hosts = {f"{LOOPBACK}:{port}", f"localhost:{port}"}
        self._cookie = f"workbench_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self._refusal(headers, scope)
        if refusal is not None:
            await self._refuse(scope, receive, send, *refusal)
            return
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
        if scope["type"] == "http" and "token" in query:
            await self._enter(scope, query)(scope, receive, send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        exchange = _Exchange(scope, receive, send)
        try:
            await self._app(scope, exchange.receive, exchange.send)
        except _TooLarge:
            return

    def _refusal(self, headers: dict[str, str], scope: Scope) -> tuple[int, str] | None:
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self._hosts:
            return 421, f"host {host!r}: this page is at {sorted(self._hosts)[0]} alone"
        if origin is not None and origin not in {f"http://{name}" for name in self._hosts}:
            return 403, f"origin {origin!r}: only this page itself may ask"
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        given = query.get("token", [""])[0] or self._from_cookie(headers.get("cookie", ""))
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            return 403, "no valid token: open the address that workbench printed when it started"
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MAX_BODY_BYTES:
            return 413, _TOO_LARGE
        return None

    def _from_cookie(self, text: str) -> str:
        try:
            morsel = SimpleCookie(text).get(self._cookie)
        except CookieError:
            return ""
        return morsel.value if morsel is not None else ""

    def _enter(self, scope: Scope, query: dict[str, list[str]]) -> Response:
        """Trade the token in the address for a cookie, so that it is in no address kept or sent."""
        rest = {key: values for key, values in query.items() if key != "token"}
        path = scope["path"] + (f"?{urlencode(rest, doseq=True)}" if rest else "")
        answer = RedirectResponse(path, status_code=303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
        answer.headers["Referrer-Policy"] = "no-referrer"
        return answer

    @staticmethod
    async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, says: str) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 4403, "reason": says[:120]})
            return
        await PlainTextResponse(f"refused: {says}\n", status_code=status)(scope, receive, send)


_TOO_LARGE = f"body too large: at most {MAX_BODY_BYTES} bytes"


class _TooLarge(Exception):  # noqa: N818
    """More came than was announced, or than is taken."""


_POLICY = "; ".join(
    (
        "default-src 'self' data: blob:",
        "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:",
        "style-src 'self' 'unsafe-inline'",
        "frame-ancestors 'none'",
    )
)
"""The page may talk to this server alone: neither the viewer nor a widget calls out."""


class _Exchange:
    """One request and its answer: a bounded body, and an answer that keeps the page confined."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._scope, self._receive, self._send = scope, receive, send
        self._taken = 0
        self._refused = False

    async def receive(self) -> Message:
        message = await self._receive()
        self._taken += len(message.get("body", b""))
        if self._taken > MAX_BODY_BYTES:
            # Answered here: an application takes what is raised below it for its own failure.
            answer = PlainTextResponse(f"refused: {_TOO_LARGE}\n", status_code=413)
            await answer(self._scope, self._receive, self._send)
            self._refused = True
            raise _TooLarge
        return message

    async def send(self, message: Message) -> None:
        if self._refused:
            return
        if message["type"] == "http.response.start":
            message["headers"] = [
                *message.get("headers", ()),
                (b"content-security-policy", _POLICY.encode()),
                (b"referrer-policy", b"no-referrer"),
                (b"x-content-type-options", b"nosniff"),
            ]
        await self._send(message)


class _Client:
    """One open page's stream: what waits to be sent, and what it has not yet taken in."""

    def __init__(self) -> None:
        self.pieces: asyncio.Queue[bytes | None] = asyncio.Queue()
        self.unread = 0
        self.waiting_bytes = 0


class Hub:
    """Passes RRD pieces from the worker's thread on to every open page, at the pages' pace."""

    def __init__(self, on_join: Callable[[], None]) -> None:
        self._on_join = on_join
        self._clients: set[_Client] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._taken = threading.Condition()
        self.sent_bytes = 0

    @property
    def count(self) -> int:
        """How many pages are open."""
        return len(self._clients)

    def send(self, piece: bytes | None) -> None:
        """Pass a piece on; called by the worker.

        Waits a little while a page is still busy with earlier pieces: the worker then takes the
        newest settings next instead of what would be outdated when it is seen.
        """
        loop = self._loop
        if not piece or loop is None or not self._clients:
            return
        self.sent_bytes += len(piece)
        loop.call_soon_threadsafe(self._put, piece)

    def pace(self) -> None:
        """Wait, for a bounded time, until every page has taken in nearly all it was sent."""
        with self._taken:
            self._taken.wait_for(
                lambda: all(c.unread <= _UNREAD_PIECES for c in list(self._clients)), _PACE_SECONDS
            )

    def _put(self, piece: bytes) -> None:
        for client in list(self._clients):
            if client.waiting_bytes + len(piece) > _UNREAD_BYTES:
                # It has stopped reading: it gets everything anew when it comes again.
                self._clients.discard(client)
                client.pieces.put_nowait(None)
                continue
            client.unread += 1
            client.waiting_bytes += len(piece)
            client.pieces.put_nowait(piece)

    async def serve(self, socket: WebSocket) -> None:
        """One page's stream, from its coming to its going."""
        await socket.accept()
        self._loop = asyncio.get_running_loop()
        client = _Client()
        self._clients.add(client)
        self._on_join()
        reading = asyncio.create_task(self._read(socket, client))
        try:
            while (piece := await client.pieces.get()) is not None:
                await socket.send_bytes(piece)
                client.waiting_bytes -= len(piece)
            await socket.close(code=1013)
        except (WebSocketDisconnect, RuntimeError):
            # The page has gone, in the middle of a piece.
            return
        finally:
            self._clients.discard(client)
            reading.cancel()
            with self._taken:
                self._taken.notify_all()

    async def _read(self, socket: WebSocket, client: _Client) -> None:
        try:
            while True:
                await socket.receive_text()
                client.unread -= 1
                with self._taken:
                    self._taken.notify_all()
        except (WebSocketDisconnect, RuntimeError, KeyError):
            self._clients.discard(client)
            client.pieces.put_nowait(None)


def application(hub: Hub, viewer_files: Path) -> FastAPI:
    """The routes beside the page: Rerun's viewer, the page's script, and the stream."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/viewer/{_version}/{name}")
    def viewer_file(_version: str, name: str) -> Response:
        types = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
        if name not in types:
            return PlainTextResponse("no such file\n", status_code=404)
        forever = {"Cache-Control": "private, max-age=31536000, immutable"}
        return FileResponse(viewer_files / name, media_type=types[name], headers=forever)

    @app.get("/tune.js")
    def script() -> Response:
        path = Path(__file__).with_name("tune.js")
        return FileResponse(
            path, media_type="text/javascript", headers={"Cache-Control": "no-cache"}
        )

    @app.websocket("/stream")
    async def stream(socket: WebSocket) -> None:
        await hub.serve(socket)

    return app


def new_token() -> str:
    """A token that cannot be guessed."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def serve(app: Any, token: str, port: int, on_ready: Callable[[], None]) -> None:
    """Serve until Ctrl-C or SIGTERM, on loopback alone.

    Raises :class:`DataError` where the server does not start.
    """
    import uvicorn

    config = uvicorn.Config(
        Guard(app, token, port),
        host=LOOPBACK,
        port=port,
        log_level="critical",
        access_log=False,
        lifespan="on",
        ws_max_size=MAX_BODY_BYTES,
        timeout_graceful_shutdown=1,
        server_header=False,
    )
    server = _Server(config, on_ready)
    try:
        server.run()
    except SystemExit as error:
        why = server.trouble or "its server did not start"
        raise DataError(f"the page cannot be served on port {port}: {why}") from error


class _Told(logging.Handler):
    """Keeps the first error that is logged, in one line."""

    first = ""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        says = record.getMessage().strip().splitlines()[-1] if error is None else one_line(error)
        self.first = self.first or says


def _server_class() -> type:
    import uvicorn

    class Server(uvicorn.Server):
        def __init__(self, config: uvicorn.Config, on_ready: Callable[[], None]) -> None:
            super().__init__(config)
            self._on_ready = on_ready
            self.trouble = ""

        async def startup(self, sockets: Any = None) -> None:
            # The server logs what went wrong, and says it to nobody else.
            told = _Told(logging.ERROR)
            logger = logging.getLogger("uvicorn.error")
            before = logger.level, logger.propagate
            logger.addHandler(told)
            logger.setLevel(logging.ERROR)
            logger.propagate = False
            try:
                await super().startup(sockets)
            finally:
                logger.removeHandler(told)
                logger.setLevel(before[0])
                logger.propagate = before[1]
                self.trouble = told.first
            if self.started:
                self._on_ready()

    return Server


_Server = _server_class()
