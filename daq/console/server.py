"""The page on 127.0.0.1: who may read it, and its few addresses.

Every address begins with a random token. A request passes only under the host of this server (a
name that was bound to 127.0.0.1 by DNS rebinding is another host), and with the origin of this page
where a browser names one. The content security policy allows this server's own files alone. No
address carries a path of a file. The only thing that a browser can do is to stop the recorder.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from importlib.resources import files
from typing import Any, cast

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from daq.config.cell import Cell, CellAxis
from daq.console.live import KEPT_POINTS, Live, Reader
from daq.console.results import UNREADABLE, Results
from daq.report.document import json_safe

TICK_S = 0.04  #: Time between two messages to a page: 25 a second
RESULTS_S = 2.0  #: Time between two looks at the files
LARGEST_READERS = 8  #: Pages that are served curves at the same time
CONNECTIONS = 64  #: Without a request at the same time
REQUEST_S = 5.0  #: Time for the first request of a connection
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' "
    "data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
REPORT_POLICY = (
    "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "cache-control": "no-store",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """Refuses requests of other hosts, other origins and without the token,
    before anything else sees them.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str]) -> None:
        self._app = app
        self._token = token.encode()
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with the refusal."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = list(message["headers"])
                present = {name for name, _ in headers}
                for name, value in HEADERS.items():
                    if name.encode() not in present:
                        headers.append((name.encode(), value.encode()))
                message["headers"] = headers
            await send(message)

        refusal = self._refusal(scope)
        if refusal is not None:
            refusal.headers["connection"] = "close"  # one that may not ask holds nothing open
            await refusal(scope, receive, send_guarded)
            return
        # The token is not part of the routes: they are few, and compared as they are.
        scope["path"] = scope["path"][len(self._token) + 1 :]
        await self._app(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        origins = headers.getlist("origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return PlainTextResponse(
                "this server has another name: open the address that was printed", 421
            )
        own = {f"http://{host}" for host in self._hosts}
        site = headers.get("sec-fetch-site", "none")
        is_foreign = not set(origins) <= own or site not in ("none", "same-origin")
        is_anonymous_post = scope["method"] == "POST" and not origins
        if is_foreign or is_anonymous_post:
            return PlainTextResponse("only the console's own page may ask", 403)
        # "*" is a path as well (RFC 9112, OPTIONS)
        token = scope["path"].removeprefix("/").partition("/")[0]
        if hmac.compare_digest(token.encode(), self._token):
            return None
        return PlainTextResponse("not found", 404)


class Page:
    """The answers."""

    def __init__(
        self,
        cell: Cell,
        live: Live,
        results: Results,
        *background: Callable[[], Coroutine[Any, Any, None]],
    ) -> None:
        """Store the arguments; `background` runs together with the server."""
        self._cell = cell
        self._live = live
        self._results = results
        self._parts = (live.follow, self._look, *background)
        self._document: dict[str, Any] = {}
        self.over: Callable[[], bool] = lambda: False  #: Whether the server ends
        self._readers = 0  # pages that have asked for the curves

    def app(self, token: str, hosts: frozenset[str]) -> ASGIApp:
        """Build the application; its routes are all that there is."""
        routes = [
            Route("/", self._file("page.html", "text/html")),
            Route("/page.js", self._file("page.js", "text/javascript")),
            Route("/page.css", self._file("page.css", "text/css")),
            Route("/cell", self._facts),
            Route("/curves", self._curves),
            Route("/results", self._shown_results),
            Route("/report", self._report),
            Route("/stop", self._stop, methods=["POST"]),
        ]
        return Guard(Starlette(routes=routes, lifespan=self._background), token, hosts)

    @asynccontextmanager
    async def _background(self, _: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(part()) for part in self._parts]
        for task in tasks:
            task.add_done_callback(self._note_end)
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _note_end(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled():
            cause = repr(task.exception())
            self._live.failed = (
                f"A part of this console has ended ({cause}), so this page is old: restart the "
                "console"
            )

    async def _look(self) -> None:
        """Look at the files again and again."""
        while True:
            with suppress(*UNREADABLE):  # the document has the reason
                known = await asyncio.to_thread(self._results.calibration)
                self._live.calibration = None
                if known is not None:
                    self._live.calibration = known[1]
            try:
                self._document = await asyncio.to_thread(self._results.document)
            except UNREADABLE as error:
                self._document = {
                    "problems": [f"the results cannot be read: {error}"],
                    "report": False,
                }
            await asyncio.sleep(RESULTS_S)

    @staticmethod
    def _file(name: str, kind: str) -> Any:
        content = files("daq.console").joinpath(name).read_bytes()

        async def answer(_: Request) -> Response:
            return Response(content, media_type=kind)

        return answer

    async def _facts(self, _: Request) -> Response:
        """Facts of the cell that do not change."""
        axes = [_axis_facts(axis) for axis in self._cell.axes]
        facts = {"cell": self._cell.name, "axes": axes, "kept_points": KEPT_POINTS}
        return JSONResponse(facts)

    async def _shown_results(self, _: Request) -> Response:
        document = {**self._document, "stop": self._live.stop_state}
        return Response(_json(document), media_type="application/json")

    async def _report(self, _: Request) -> Response:
        with suppress(*UNREADABLE):
            content = await asyncio.to_thread(self._results.report)
            if content is not None:
                # Its own styles and pictures are inside; a script would not run.
                return Response(
                    content,
                    media_type="text/html",
                    headers={"content-security-policy": REPORT_POLICY},
                )
        return PlainTextResponse("there is no report yet", 404)

    async def _stop(self, _: Request) -> Response:
        return JSONResponse(await self._live.stop())

    async def _curves(self, _: Request) -> Response:
        """Everything that changes, as server-sent events;
        a page that does not read gets less, and delays no other.
        """
        if self._readers >= LARGEST_READERS:
            return PlainTextResponse(f"{LARGEST_READERS} pages are open already: close one", 503)
        return _Curves(self._messages(), self._count)

    def _count(self, change: int) -> None:
        self._readers += change

    async def _messages(self) -> AsyncIterator[bytes]:
        live = self._live
        reader = Reader(self._live)
        before = b""
        while not self.over():
            begun, news = reader.news()
            message: dict[str, Any] = {**news}
            if begun:
                if live.run is None:
                    message["run"] = None
                else:
                    message["run"] = asdict(live.run)
            status = _json(live.status())
            if message or status != before:
                before = status
                yield b'data: {"status": %b, "new": %b}\n\n' % (status, _json(message))
            await asyncio.sleep(TICK_S)


def _axis_facts(axis: CellAxis) -> dict[str, Any]:
    lower, upper = axis.limits.position
    return {
        "name": axis.name,
        "unit": axis.unit.name,
        "lower": lower / axis.unit.si,
        "upper": upper / axis.unit.si,
        "current_unit": axis.gain_unit.partition("/")[2],
    }


class _Curves(StreamingResponse):
    """Messages for one page, which is counted from its request until it has gone."""

    def __init__(self, messages: AsyncIterator[bytes], count: Callable[[int], None]) -> None:
        super().__init__(messages, media_type="text/event-stream")
        self._count = count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._count(1)
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._count(-1)


class _Connection(H11Protocol):
    """A connection that is closed where no request comes:
    any program of this computer may open as many as it likes.

    A limit of all connections would refuse the page's stop while others hold them.
    """

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait; where too many wait, close the one that has waited for longest."""
        super().connection_made(cast("asyncio.Transport", transport))
        self._begun_s = self.loop.time()
        self.loop.call_later(REQUEST_S, self._close_unasked)
        waiting = [
            one for one in self.connections if isinstance(one, _Connection) and not one.headers
        ]
        if len(waiting) > CONNECTIONS:
            longest = min(waiting, key=lambda one: one._begun_s)
            longest._close_unasked()

    def _close_unasked(self) -> None:
        if not self.headers:  # of its first request
            self.transport.close()


def _json(document: Any) -> bytes:
    """Encode a document; numbers that JSON lacks become null."""
    try:
        return json.dumps(document, allow_nan=False).encode()
    except ValueError:
        return json.dumps(json_safe(document)).encode()


def listen(port: int) -> socket.socket:
    """Return a socket that listens on 127.0.0.1.

    Raises:
        OSError: the port is taken.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
        listener.listen(CONNECTIONS)
    except OSError:
        listener.close()
        raise
    return listener


def new_token() -> str:
    """Return a token of 192 bits."""
    return secrets.token_urlsafe(24)


def hosts_of(port: int) -> frozenset[str]:
    """Return the hosts under which a server on a port is asked."""
    return frozenset({f"127.0.0.1:{port}", f"localhost:{port}"})


def server_of(page: Page, token: str, port: int) -> uvicorn.Server:
    """Return a server of plain HTTP/1.1;
    when it ends, it waits a second for pages that do not read.
    """
    config = uvicorn.Config(
        page.app(token, hosts_of(port)),
        log_level="critical",  # a page that was cut off at the end is no error
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        http=_Connection,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    page.over = lambda: server.should_exit
    return server
