"""Who may see the page: this machine alone, or whoever knows the token.

The web server of viser answers everybody who reaches its port. A page of some other site that is open in the
same browser reaches 127.0.0.1 too, so the Host and Origin headers are checked for every request, the
websocket's included; what the page itself may load is bounded by a Content-Security-Policy.
"""

from __future__ import annotations

import hmac
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK = ("127.0.0.1", "localhost", "::1")
COOKIE = "overfly_token"
# Nothing is loaded from, or sent to, any other place than the one the page came from.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
    "connect-src 'self' ws://{host} wss://{host} data: blob:; frame-ancestors 'none'"
)

Answer = Callable[[ServerConnection, Request], Response | None]


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens there."""
    return host in LOOPBACK


def new_token() -> str:
    """A secret for one run of the server."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class Gate:
    """token: what a visitor has to know, None where the server can be reached from this machine alone."""

    token: str | None = None

    def refusal(self, request: Request) -> str | None:
        """Why a request is not answered; None when it may pass."""
        host = request.headers.get("Host", "")
        if self.token is None and (urlsplit(f"//{host}").hostname or "") not in LOOPBACK:
            return "this page is for the machine it runs on"
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "another site's page may not connect"
        if self.token is not None and not self._knows_token(request):
            return "open the address with its token, as it was printed when the server started"
        return None

    def answer(self, connection: ServerConnection, request: Request, page: Answer) -> Response | None:
        """What the server says: the page, or why not; None lets a websocket through."""
        why_not = self.refusal(request)
        if why_not is not None:
            return _plain(HTTPStatus.FORBIDDEN, why_not)
        response = page(connection, request)
        if response is not None:
            host = request.headers.get("Host", "")
            response.headers["Content-Security-Policy"] = POLICY.format(host=host)
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["Cache-Control"] = "no-store"
            if self.token is not None:  # the websocket of the page is known by this cookie
                cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Set-Cookie"] = cookie
        return response

    def _knows_token(self, request: Request) -> bool:
        assert self.token is not None
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        try:
            cookies = SimpleCookie(request.headers.get("Cookie", ""))
        except CookieError:
            cookies = SimpleCookie()
        if COOKIE in cookies:
            given = [*given, cookies[COOKIE].value]
        return any(hmac.compare_digest(word.encode(), self.token.encode()) for word in given)


_starting = threading.Lock()


@contextmanager
def guarding(gate: Gate) -> Iterator[list[bool]]:
    """Servers that are started inside the block ask the gate first.

    Yields a list that is not empty once one was. viser passes no request handler of ours to its websocket
    server, so the function that makes that server is wrapped while viser starts.
    """
    original = websockets.asyncio.server.serve
    guarded: list[bool] = []

    def serve(*arguments: Any, process_request: Answer, **options: Any) -> Any:
        guarded.append(True)

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            return gate.answer(connection, request, process_request)

        return original(*arguments, process_request=answer, **options)

    with _starting:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield guarded
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]


def _plain(status: HTTPStatus, text: str) -> Response:
    body = f"Overfly: {text}\n".encode()
    headers = Headers(
        {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    )
    return Response(int(status), status.phrase, headers, body)
