"""The live page's server: what it refuses, where it listens, how it ends.  No browser is needed."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from conftest import Command
from fastapi import FastAPI, Request, WebSocket
from waiting import PATIENCE_S, until_running

from workbench.tune.server import MAX_BODY_BYTES, Guard, new_token

TOKEN = "the-token"
PORT = 4321
HOST = f"127.0.0.1:{PORT}"


@pytest.fixture
def guarded() -> Any:
    """An application behind the guard."""
    app = FastAPI()

    @app.get("/")
    def page() -> str:
        return "the page"

    @app.post("/take")
    async def take(request: Request) -> int:
        return len(await request.body())

    @app.websocket("/stream")
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_text("pictures")

    return Guard(app, TOKEN, PORT)


class Client:
    """Asks an ASGI application as a browser would, with a jar for its cookies."""

    def __init__(self, app: Any) -> None:
        self.app = app
        self.cookies = httpx.Cookies()

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.ask("GET", path, **options)

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        async def asked() -> httpx.Response:
            transport = httpx.ASGITransport(self.app)
            async with httpx.AsyncClient(
                transport=transport,
                base_url=f"http://{HOST}",
                follow_redirects=True,
                cookies=self.cookies,
            ) as client:
                answer = await client.request(method, path, **options)
                self.cookies = client.cookies
                return answer

        return asyncio.run(asked())

    def socket(self, query: str = "", **headers: str) -> list[dict[str, Any]]:
        """What the application sends to a websocket that asks to be let in."""
        given = {"host": HOST, **headers}
        cookies = "; ".join(f"{c.name}={c.value}" for c in self.cookies.jar)
        if cookies:
            given["cookie"] = cookies
        scope = {
            "type": "websocket",
            "path": "/stream",
            "query_string": query.encode(),
            "headers": [(k.encode(), v.encode()) for k, v in given.items()],
            "subprotocols": [],
        }
        sent: list[dict[str, Any]] = []

        async def send(message: Any) -> None:
            sent.append(dict(message))

        async def receive() -> Any:
            return {"type": "websocket.connect"}

        asyncio.run(self.app(scope, receive, send))
        return sent


@pytest.fixture
def client(guarded: Any) -> Client:
    return Client(guarded)


@pytest.fixture
def inside(client: Client) -> Client:
    """A client that has shown the token."""
    assert client.get(f"/?token={TOKEN}").status_code == 200
    return client


def test_the_token_opens_the_page_and_leaves_the_address(client: Client) -> None:
    assert client.get("/").status_code == 403
    answer = client.get(f"/?token={TOKEN}&frame=3")
    assert answer.text == '"the page"' and str(answer.url) == f"http://{HOST}/?frame=3"
    value, *attributes = answer.history[0].headers["set-cookie"].split("; ")
    assert value == f"workbench_{PORT}={TOKEN}"
    assert sorted(attributes) == ["HttpOnly", "Path=/", "SameSite=strict"]
    assert client.get("/").status_code == 200


@pytest.mark.parametrize("path", ["/", "/nothing"])
def test_what_is_answered_may_talk_to_this_server_alone(inside: Client, path: str) -> None:
    headers = inside.get(path).headers
    policy = {}
    for directive in headers["content-security-policy"].split("; "):
        name, *sources = directive.split(" ")
        policy[name] = set(sources)
    # No source is a host, a scheme of the network or all; what is not named falls to the default.
    inline, made_here = "'unsafe-inline'", {"data:", "blob:"}
    assert policy == {
        "default-src": {"'self'", *made_here},
        "script-src": {"'self'", inline, "'unsafe-eval'", "blob:"},
        "style-src": {"'self'", inline},
        "frame-ancestors": {"'none'"},
    }
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("token", ["", "x", TOKEN[:-1], TOKEN + "x", "%C3%A4"])
def test_a_wrong_token_is_refused(client: Client, token: str) -> None:
    answer = client.get(f"/?token={token}")
    assert answer.status_code == 403 and "open the address" in answer.text
    (refused,) = client.socket(f"token={token}")
    assert (refused["type"], refused["code"]) == ("websocket.close", 4403)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": f"http://127.0.0.1:{PORT + 1}"}, 403),
        ({"host": "evil.example"}, 421),
        ({"host": f"127.0.0.1:{PORT + 1}"}, 421),
        ({"content-length": str(MAX_BODY_BYTES + 1)}, 413),
        ({"content-length": "-1"}, 413),
    ],
)
def test_what_comes_from_elsewhere_is_refused(
    inside: Client, headers: dict[str, str], status: int
) -> None:
    answer = inside.get("/", headers=headers)
    assert (answer.status_code, answer.text[:8]) == (status, "refused:")
    (refused,) = inside.socket(**headers)
    assert refused["code"] == 4403


def test_its_own_origin_is_let_in(inside: Client) -> None:
    assert inside.get("/", headers={"origin": f"http://{HOST}"}).status_code == 200
    let_in = inside.socket(origin=f"http://{HOST}")
    assert [m["type"] for m in let_in] == ["websocket.accept", "websocket.send"]


def test_a_body_is_bounded_also_where_its_length_is_not_told(inside: Client) -> None:
    answer = inside.ask("POST", "/take", content=b"x" * MAX_BODY_BYTES)
    assert answer.json() == MAX_BODY_BYTES

    async def endless() -> AsyncIterator[bytes]:
        for _ in range(8):
            yield b"x" * (MAX_BODY_BYTES // 4)

    answer = inside.ask("POST", "/take", content=endless())
    assert answer.status_code == 413 and "too large" in answer.text


def test_tokens_differ() -> None:
    assert len({new_token() for _ in range(50)}) == 50 and len(new_token()) >= 32


Start = Callable[..., "subprocess.Popen[str]"]


def address_of(child: subprocess.Popen[str], folder: Path) -> str:
    """What the started command prints when it is ready."""

    def said() -> str:
        return (folder / "stdout").read_text()

    until_running(child, lambda: said().rstrip().endswith("}"), folder / "stderr")
    return str(json.loads(said())["url"])


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_it_listens_on_loopback_alone_and_ends_with_its_children(
    started: Start, tmp_path: Path, twins: dict[str, Path], which: signal.Signals
) -> None:
    child = started("tune", twins["protobuf"], "--no-browser", "--json")
    url = address_of(child, tmp_path)
    family = [psutil.Process(child.pid), *psutil.Process(child.pid).children(recursive=True)]
    listening = {
        connection.laddr.ip
        for process in family
        for connection in process.net_connections()
        if connection.status == psutil.CONN_LISTEN
    }
    assert listening == {"127.0.0.1"}
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(url.partition("?")[0], timeout=PATIENCE_S)
    assert refused.value.code == 403
    refused.value.close()
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
    with opener.open(url, timeout=PATIENCE_S) as answer:
        page = answer.read().decode()
    assert "linked_edges" in page and "token" not in answer.url
    child.send_signal(which)
    assert child.wait(PATIENCE_S) == 0
    assert "Traceback" not in (tmp_path / "stderr").read_text()
    assert not [process for process in family if process.is_running()]


def test_mistakes_are_one_line(bench: Command, scene: Path, tmp_path: Path) -> None:
    ended = bench("tune", scene, "--port", "70000")
    assert ended.code == 2 and "--port 70000" in ended.mistake
    ended = bench("tune", tmp_path / "none.mcap")
    assert ended.code == 1 and "none.mcap" in ended.mistake
    ended = bench("tune", scene, "--set", "linked_edges.cone_deg=700")
    assert ended.code == 2 and "linked_edges.cone_deg" in ended.mistake
    ended = bench("tune", scene, "--frames", "90:99")
    assert ended.code == 1 and "no frame" in ended.mistake


def test_a_port_that_is_taken_is_told(bench: Command, scene: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ended = bench("tune", scene, "--port", port)
    assert ended.code == 1 and f"--port {port}" in ended.mistake
