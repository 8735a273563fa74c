"""The web server: the page's files, one websocket per open page, and who may use it.

The page can press the skin and command the daemon, so no other web page may pose as it. A request
must name this computer in `Host` by an IP address, by `localhost` or by the name it is served under
(a foreign name that was made to point here is refused), and a websocket must come from a page that
was served here (`Origin`). Served beyond this computer, the viewer only shows.
"""

from __future__ import annotations

import asyncio
import errno
import signal
from collections.abc import AsyncIterator, Collection
from pathlib import Path

from aiohttp import WSCloseCode, web
from aiohttp.typedefs import Handler, Middleware
from tactomo_client import DEFAULT_CONTROL, DEFAULT_STREAM, ClientError, Keys, aio
from tactomo_client.connection import is_loopback, names_this_computer
from tactomo_client.schema import FRAME_STALE_AFTER_S, STALE_AFTER_S

from tactomo_viewer.browser import Browser, Feed, json_text, sent_ms

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8750
PORTS_TRIED = 20

TWIN_POLL_S = 1.0
MAX_QUESTION_BYTES = 16 * 1024
PAGE = Path(__file__).with_name("page")
HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class ViewerError(ClientError):
    """The viewer cannot be served as asked."""


class Viewer:
    """One sensor's web page: what all open pages share, one feed, one link to daemon and twin."""

    def __init__(
        self,
        sensor: str,  # the sensor's name in the daemon's configuration
        stream: str = DEFAULT_STREAM,  # the daemon's stream
        control: str = DEFAULT_CONTROL,  # the daemon's control socket
        twin: str | None = None,  # the twin's control socket, where there is a twin
        # the address to listen on; on any but a loopback one the viewer only shows
        host: str = DEFAULT_HOST,
        keys: Keys | None = None,  # for a daemon beyond this computer
        press_itself: bool = False,  # the page presses the twin until somebody does
    ) -> None:
        may_command = is_loopback(host)
        self._about = {
            **{"sensor": sensor, "stream": stream, "read_only": not may_command},
            **{"status_stale_ms": 1e3 * STALE_AFTER_S, "frame_stale_ms": 1e3 * FRAME_STALE_AFTER_S},
            "press_itself": press_itself,
        }
        self._browsers: set[Browser] = set()
        self._sockets: set[web.WebSocketResponse] = set()
        self._daemon = aio.Control(control, keys=keys) if may_command else None
        self._twin = aio.Control(twin) if may_command and twin else None
        self._twin_presses: list[str] | None = None  # their ids; None where no twin answers
        self._sensor, self._stream, self._host, self._keys = sensor, stream, host, keys
        self._feed: Feed

    def serve(
        self, port: int | None = None, until: Collection[int] = (signal.SIGINT, signal.SIGTERM)
    ) -> None:
        """Serve until a signal; print the page's URL on stdout once it can be opened.

        Args:
            port: the port to listen on; 0 takes a free one, None the first free one from
                `DEFAULT_PORT` on.
            until: the signals that end it.

        Raises:
            ViewerError: the address cannot be listened on.
            ClientError: the sensor's name is none, or the stream's address.
        """
        asyncio.run(self._serve(port, until))

    async def _serve(self, port: int | None, until: Collection[int]) -> None:
        stop = asyncio.Event()
        for number in until:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        runner = web.AppRunner(self.app(), access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        try:
            await self._listen(runner, port)
            print(f"viewer: {_url(runner)}", flush=True)
            await stop.wait()
        finally:
            await runner.cleanup()

    async def _listen(self, runner: web.AppRunner, port: int | None) -> None:
        wanted = DEFAULT_PORT if port is None else port
        while True:
            try:
                await web.TCPSite(runner, self._host, wanted).start()
                return
            except (OSError, OverflowError) as error:
                is_taken = getattr(error, "errno", None) == errno.EADDRINUSE
                if port is None and is_taken and wanted < DEFAULT_PORT + PORTS_TRIED:
                    wanted += 1
                    continue
                reason = getattr(error, "strerror", None) or error
                raise ViewerError(
                    f"cannot listen on {self._host} port {wanted}: {reason}",
                    "stop the program that uses it, or choose another with --viewer-port (0: any "
                    "free one)",
                    name="cannot_listen",
                ) from error

    def app(self) -> web.Application:
        """Return the viewer as an aiohttp application."""
        app = web.Application(middlewares=[_only_for(self._host)])
        app.cleanup_ctx.append(self._running)
        app.on_shutdown.append(self._say_goodbye)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/", self._page)
        app.router.add_static("/", PAGE)
        return app

    async def _page(self, _: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _running(self, _: web.Application) -> AsyncIterator[None]:
        self._feed = Feed(self._sensor, self._stream, self._keys, self._wake)
        tasks = [asyncio.create_task(self._feed.run()), asyncio.create_task(self._watch_twin())]
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for link in (self._daemon, self._twin):
            if link is not None:
                link.close()

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(
            heartbeat=10.0, max_msg_size=MAX_QUESTION_BYTES, compress=False
        )
        await socket.prepare(request)
        await socket.send_str(json_text({"type": "hello", "sent_ms": sent_ms(), **self._about}))
        browser = Browser(socket, self._feed, self._daemon, self._twin)
        browser.twin_presses = self._twin_presses
        self._browsers.add(browser)
        self._sockets.add(socket)
        try:
            await browser.run()
        finally:
            self._browsers.discard(browser)
            self._sockets.discard(socket)
            if self._twin_presses is not None:  # the page that is loaded next hears of no others
                self._twin_presses = [p for p in self._twin_presses if p not in browser.presses]
        return socket

    async def _say_goodbye(self, _: web.Application) -> None:
        closing = [s.close(code=WSCloseCode.GOING_AWAY) for s in self._sockets]
        await asyncio.gather(*closing, return_exceptions=True)

    def _wake(self) -> None:
        for browser in self._browsers:
            browser.wake()

    async def _watch_twin(self) -> None:
        while self._twin is not None:
            try:
                scene = await self._twin.request("scene")
                presses = [str(press["id"]) for press in scene.get("presses", [])]
            except ClientError:
                presses = None
            if presses != self._twin_presses:
                self._twin_presses = presses
                for browser in self._browsers:
                    browser.twin_presses = presses
                self._wake()
            await asyncio.sleep(TWIN_POLL_S)


def _url(runner: web.AppRunner) -> str:
    host, port = runner.addresses[0][:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def _only_for(served_host: str) -> Middleware:
    """Return the middleware that turns away whoever poses as the page, and adds the headers."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        if not names_this_computer(request.host, served_host):
            raise web.HTTPForbidden(text=f"not served under the name {request.host!r}\n")
        _, _, origin = request.headers.get("Origin", "").lower().partition("://")
        if request.path == "/socket" and origin != request.host.lower():
            raise web.HTTPForbidden(text="a page from elsewhere may not use this viewer\n")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    return check
