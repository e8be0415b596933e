"""The server: the page by HTTP and a session by a WebSocket, for this machine alone and whoever has the token."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from nmpm.play.session import MOST_BYTES, Session
from nmpm.viz.page import make_page

HOST = "127.0.0.1"
TICK = 1 / 60
"""Seconds between two pictures."""
_WAITING = 16
"""Messages that wait for the next picture; more are read after it."""
_TAKEN_OVER = 4001
"""Code with which a page is closed when another one is opened."""


class PlayServer:
    """Serves one page at a time; another one that is opened goes on where the first is.

    Args:
        session: What is played.
        port: 0 for any free one.

    Attributes:
        listening_at: Addresses and ports, once it has started.
    """

    def __init__(self, session: Session, port: int = 0) -> None:
        self.session, self.port, self.token = session, port, secrets.token_urlsafe(16)
        self.listening_at: list[tuple[str, int]] = []
        self._page: ServerConnection | None = None
        self._opening = asyncio.Lock()
        self._inbox: asyncio.Queue[str | bytes] = asyncio.Queue(_WAITING)

    @property
    def address(self) -> str:
        """Of the page, with its token."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    async def start(self) -> Server:
        """Listen, and go on with the session; the port is known then."""
        listening = await serve(
            self._connect,
            HOST,
            self.port,
            process_request=self._answer,
            compression=None,
            max_size=4 * MOST_BYTES,
            max_queue=_WAITING,
            server_header=None,
        )
        self.listening_at = [socket.getsockname() for socket in listening.sockets]
        self.port = self.listening_at[0][1]
        return listening

    async def run(self) -> None:
        """Go on with the session, a picture at each tick, until it is cancelled."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + TICK, loop.time())
            await asyncio.sleep(due - loop.time())
            if self._page is None:
                continue
            for _ in range(self._inbox.qsize()):
                self.session.receive(self._inbox.get_nowait())
            await self._send(self._page, self.session.tick())

    async def _connect(self, page: ServerConnection) -> None:
        """Read what a page sends until it is closed."""
        async with self._opening:  # one after the other: each closes the one before
            if self._page is not None:
                await self._page.close(_TAKEN_OVER, "the scene is played in another window")
            await self._send(page, self.session.greet())
            self._page = page
        with suppress(ConnectionClosed):
            async for message in page:
                await self._inbox.put(message)
        if self._page is page:
            self._page = None

    async def _send(self, page: ServerConnection, messages: list[str | bytes]) -> None:
        with suppress(ConnectionClosed):
            for message in messages:
                await page.send(message)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, or a refusal; None for a WebSocket that may be opened."""
        here = f"{HOST}:{self.port}"
        path, hosts, origins = request.path.encode(), *map(request.headers.get_all, ("Host", "Origin"))
        if max(len(hosts), len(origins)) > 1:
            return connection.respond(HTTPStatus.BAD_REQUEST, "Host and Origin may be stated once.\n")
        if (hosts or [""])[0] not in (here, f"localhost:{self.port}"):  # names that others have pointed at this machine
            return connection.respond(HTTPStatus.FORBIDDEN, "This server is reached by the address that it printed.\n")
        if secrets.compare_digest(path, f"/{self.token}/socket".encode()):
            known = (origins or [""])[0] in (f"http://{here}", f"http://localhost:{self.port}")
            return None if known else connection.respond(HTTPStatus.FORBIDDEN, "Another page may not play here.\n")
        if secrets.compare_digest(path, f"/{self.token}/".encode()):
            return _html(make_page("socket", {"title": "nmpm play"}))
        return connection.respond(HTTPStatus.NOT_FOUND, "There is no such page: the address needs its token.\n")


def _html(text: str) -> Response:
    body = text.encode()
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": policy(),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
    )
    return Response(HTTPStatus.OK, HTTPStatus.OK.phrase, headers, body)


def policy() -> str:
    """The page's content security policy: nothing from elsewhere, and no connection but to where it came from."""
    rules = ("default-src 'none'", "script-src 'unsafe-inline'", "style-src 'unsafe-inline'", "img-src data:")
    closed = ("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'")
    return "; ".join((*rules, "connect-src 'self'", *closed))


async def play(server: PlayServer, announce: Callable[[str], object]) -> None:
    """Serve until interrupted; `announce` is called with the address."""
    async with await server.start():
        announce(server.address)
        await server.run()
