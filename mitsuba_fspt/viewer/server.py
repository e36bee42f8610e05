"""The server of the live view: a page on 127.0.0.1, its WebSocket, and the loop that renders in the calling thread."""

from __future__ import annotations

import asyncio
import errno
import secrets
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files

from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn import Config, Server

from ..runtime.errors import FsptError, ViewerError
from .answers import Answer, Answers, Request, Superseded
from .queue import Page, RequestQueue

ADDRESS = "127.0.0.1"
PAGES = {
    "": ("index.html", "text/html"),
    "view.js": ("view.js", "text/javascript"),
    "view.css": ("view.css", "text/css"),
}
LARGEST_MESSAGE = 1 << 16  # bytes that a page may send at once
PATIENCE = 0.2  # s between checks whether to end
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Outbox:
    """Messages to one page; an image that has not been sent yet is replaced by the next one of the same lens."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._messages: dict[object, Answer] = {}
        self._filled = asyncio.Event()

    def put_from_thread(self, answer: Answer) -> None:
        """Add an answer, from any thread."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._put, answer)

    def _put(self, answer: Answer) -> None:
        key: object = answer.record.get("slot") if answer.record["kind"] == "picture" else object()
        self._messages.pop(key, None)
        self._messages[key] = answer
        self._filled.set()

    async def send_all(self, page: WebSocket) -> None:
        """Send messages as they come, for ever."""
        while True:
            await self._filled.wait()
            if not self._messages:
                self._filled.clear()
                continue
            answer = self._messages.pop(next(iter(self._messages)))
            await page.send_bytes(answer.packed())


class ViewServer:
    """A live view of one scene.

    port : of the page; 0: any free one

    Raises
    ------
    ViewerError : `port` is no port number, or cannot be opened.
    """

    def __init__(self, answers: Callable[[], Answers], port: int) -> None:
        self._socket = _bound(port)
        self.port = self._socket.getsockname()[1]
        self.token = secrets.token_urlsafe(18)
        try:
            self._answers = answers()
        except BaseException:
            self._socket.close()
            raise
        self._queue = RequestQueue()
        self._end = threading.Event()

    @property
    def url(self) -> str:
        """Address of the page, which holds the token."""
        return f"http://{ADDRESS}:{self.port}/{self.token}/"

    def run(self, ready: Callable[[str], object]) -> None:
        """Serve until `end`, Ctrl-C or SIGTERM; `ready` is called with the address."""
        config = Config(
            self._app(), log_level="critical", access_log=False, ws="websockets-sansio", ws_max_size=LARGEST_MESSAGE,
            timeout_graceful_shutdown=1, lifespan="off", server_header=False,
        )  # fmt: skip
        server = Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [self._socket]}, daemon=True)
        with self._signals():
            thread.start()
            try:
                ready(self.url)
                self._render()
            finally:
                server.should_exit = True
                thread.join(5.0)
                self._socket.close()

    def end(self, *_: object) -> None:
        """Make `run` return, from any thread or from a signal."""
        self._end.set()

    def _render(self) -> None:
        """Answer requests until the end."""
        while not self._end.is_set():
            found = self._queue.take(PATIENCE)
            if found is None:
                continue
            page, request = found

            def may_go_on(page: Page = page, request: Request = request) -> None:
                if self._end.is_set():
                    raise Superseded
                if request.kind == "picture":
                    self._queue.check(page, request)

            try:
                page.put_from_thread(self._answers.answer(request, may_go_on))
            except Superseded:
                self._queue.put_back(page, request)
            except KeyboardInterrupt:  # of a render's own check, after `end`
                if not self._end.is_set():
                    raise

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Context manager in which Ctrl-C and SIGTERM call `end`: an exception could stop the renderer within C++."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # ------------------------------------------------------------------ the page

    def _app(self) -> Starlette:
        return Starlette(
            routes=[
                Route("/{token}/{name:path}", self._page),
                Route("/{name:path}", self._page),
                WebSocketRoute("/{token}/socket", self._connect),
            ]
        )

    async def _page(self, request: HttpRequest) -> Response:
        """A file of the page, if the address contains the token; else status 403."""
        token, name = request.path_params.get("token", ""), request.path_params["name"]
        if not (self._is_known(token) and self._is_own_host(request.headers.get("host", ""))):
            line = "fspt: this address has no valid token. Open the one that 'fspt view' printed.\n"
            return PlainTextResponse(line, 403, HEADERS)
        if name not in PAGES:
            return PlainTextResponse("fspt: there is no such file.\n", 404, HEADERS)
        file, media_type = PAGES[name]
        return Response(page_text(file), media_type=media_type, headers=HEADERS)

    def _is_known(self, token: str) -> bool:
        return secrets.compare_digest(token.encode(), self.token.encode())

    def _is_own_host(self, host: str) -> bool:
        return host in self._hosts()

    def _hosts(self) -> tuple[str, ...]:
        return f"{ADDRESS}:{self.port}", f"localhost:{self.port}"

    def _hello(self) -> Answer:
        try:
            return self._answers.hello()
        except FsptError as error:
            return Answer({"kind": "error", "slot": "a", "message": str(error)})

    async def _connect(self, page: WebSocket) -> None:
        """Take the requests of one page and send it the answers."""
        origins = {f"http://{host}" for host in self._hosts()}
        own = self._is_own_host(page.headers.get("host", "")) and page.headers.get("origin") in origins
        if not (own and self._is_known(page.path_params["token"])):
            await page.close(code=1008)  # before it is accepted: HTTP 403
            return
        await page.accept()
        outbox = Outbox()
        outbox.put_from_thread(self._hello())
        sending = asyncio.create_task(outbox.send_all(page))
        try:
            while True:
                try:
                    self._queue.put(outbox, Request.read(await page.receive_json()))
                except (ViewerError, ValueError) as error:
                    outbox.put_from_thread(Answer({"kind": "error", "slot": "a", "message": str(error)}))
        except (WebSocketDisconnect, KeyError):  # KeyError: bytes in place of text
            pass
        finally:
            self._queue.forget(outbox)
            sending.cancel()
            with suppress(asyncio.CancelledError, Exception):
                await sending


def page_text(file: str) -> str:
    """Text of a file of the page."""
    return (files(__package__) / "page" / file).read_text(encoding="utf-8")


def _bound(port: int) -> socket.socket:
    """Socket bound to a port of this machine alone."""
    if not 0 <= port <= 65535:
        raise ViewerError(f"port: must be in 0 … 65535, got {port}. Give for example 8765, or 0 for any free one.")
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((ADDRESS, port))
        bound.listen()
    except OSError as error:
        bound.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be opened ({error.strerror})"
        raise ViewerError(f"port: {port} {reason} on {ADDRESS}. Give another one, or 0 for any free one.") from error
    return bound
