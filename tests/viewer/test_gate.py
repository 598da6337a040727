"""Nobody else's page, no other machine, and nobody without the token gets in."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from urllib.parse import parse_qs, urlsplit

import pytest
import viser
import websockets.asyncio.server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from overfly.errors import OutputError
from overfly.viewer import server as server_module
from overfly.viewer.gate import COOKIE
from overfly.viewer.server import WebPage, open_page

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def page() -> Iterator[WebPage]:
    """For this machine alone."""
    served = open_page("test", port=0)
    yield served
    served.close()


@pytest.fixture(scope="module")
def public() -> Iterator[WebPage]:
    """For other machines: visitors need the token."""
    served = open_page("test", "0.0.0.0", 0)
    yield served
    served.close()


def port_of(page: WebPage) -> int:
    return page.server.get_port()


def get(page: WebPage, path: str = "/", **headers: str) -> tuple[int, dict[str, str]]:
    """Status and headers of the answer."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    request = urllib.request.Request(f"http://127.0.0.1:{port_of(page)}{path}", headers=named)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, dict(answer.headers)
    except urllib.error.HTTPError as refusal:
        with refusal:
            return refusal.code, dict(refusal.headers)


def may_connect(page: WebPage, path: str = "/", **headers: str) -> bool:
    """Whether a websocket is opened, as the page itself opens one."""
    url = f"ws://127.0.0.1:{port_of(page)}{path}"
    try:
        with connect(url, subprotocols=[PROTOCOL], additional_headers=headers, proxy=None, open_timeout=20):
            return True
    except InvalidStatus as refusal:
        assert refusal.response.status_code == 403
        return False


def test_this_machine_gets_the_page_which_may_load_nothing_from_elsewhere(page: WebPage) -> None:
    status, headers = get(page)
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "http:" not in policy
    assert "https:" not in policy
    assert may_connect(page)
    assert may_connect(page, Origin=f"http://127.0.0.1:{port_of(page)}")


def test_another_sites_page_in_the_same_browser_is_refused(page: WebPage) -> None:
    assert get(page, Origin="http://example.org")[0] == 403
    assert not may_connect(page, Origin="http://example.org")
    assert not may_connect(page, Origin="null")


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1.example.org", ""])
def test_a_foreign_name_for_this_machine_is_refused(page: WebPage, host: str) -> None:
    assert get(page, Host=host)[0] in (400, 403)


def test_from_other_machines_the_token_is_needed(public: WebPage) -> None:
    token = parse_qs(urlsplit(public.url).query)["token"][0]
    assert len(token) >= 20
    assert get(public)[0] == 403
    assert get(public, "/?token=wrong")[0] == 403
    assert get(public, "/?token=")[0] == 403
    status, headers = get(public, f"/?token={token}")
    assert status == 200
    assert "HttpOnly" in headers["Set-Cookie"]
    assert "SameSite=Strict" in headers["Set-Cookie"]
    assert not may_connect(public)
    assert not may_connect(public, Cookie=f"{COOKIE}=wrong")
    assert may_connect(public, Cookie=headers["Set-Cookie"].split(";")[0])
    assert not may_connect(public, Cookie=f"{COOKIE}={token}", Origin="http://example.org")


def test_the_page_cannot_be_published_through_the_internet(page: WebPage) -> None:
    assert page.server.request_share_url() is None


def test_a_server_that_does_not_ask_the_gate_is_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a later viser started its server in another way."""
    unguarded = websockets.asyncio.server.serve

    class Elsewhere(server_module._LocalServer):
        def __init__(self, *arguments: object, **options: object) -> None:
            monkeypatch.setattr(websockets.asyncio.server, "serve", unguarded)
            super().__init__(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(server_module, "_LocalServer", Elsewhere)
    with pytest.raises(OutputError, match="cannot be guarded"):
        open_page("test", port=0)
