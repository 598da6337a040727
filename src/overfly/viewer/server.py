"""The web server behind every view: viser, bound to this machine, with nothing that reaches beyond it."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import rich
import viser

from overfly.errors import OutputError
from overfly.viewer.gate import Gate, guarding, is_loopback, new_token

DEFAULT_PORT = 8080
LOCAL_HOST = "127.0.0.1"
BRAND = (38, 132, 255)


class _LocalServer(viser.ViserServer):
    """viser can publish a page through a server on the internet when the page asks for it; this one does
    not.
    """

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        return None


@dataclass(frozen=True, slots=True, eq=False)
class WebPage:
    """A page that is being served. url: with the token, where one is needed; threads: that serve it."""

    server: viser.ViserServer
    url: str
    threads: tuple[threading.Thread, ...] = ()

    def close(self) -> None:
        self.server.stop()


def open_page(title: str, host: str = LOCAL_HOST, port: int | None = None) -> WebPage:
    """Serve an empty page. port None: the first free one from 8080 on; 0: any.

    On another host than this machine's own address visitors need a token. Raises OutputError when the port
    cannot be had.
    """
    token = None if is_loopback(host) else new_token()
    before = set(threading.enumerate())
    rich.reconfigure(quiet=True)  # viser prints to stdout, which belongs to the result
    with guarding(Gate(token)) as guarded:
        server = _LocalServer(host, DEFAULT_PORT if port is None else port, label=title, verbose=False)
    if not guarded:
        server.stop()
        raise OutputError("this version of viser starts its server in another way: it cannot be guarded")
    if port and server.get_port() != port:
        server.stop()
        raise OutputError(f"port {port} is in use: choose another with --port")
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, brand_color=BRAND, control_width="medium"
    )
    shown = LOCAL_HOST if host in ("0.0.0.0", "::", "localhost") else host
    address = f"http://{shown}:{server.get_port()}/"
    threads = tuple(set(threading.enumerate()) - before)
    return WebPage(server, address if token is None else f"{address}?token={token}", threads)
