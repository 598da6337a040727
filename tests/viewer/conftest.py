"""A browser without a window, and pages in it that say what they asked for and from whom."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright
from viser import ViserServer

from overfly.geometry.poses import rotation_from_quaternion

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL on the processor
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # nobody else can be reached
]
SIZE = (1000, 420)  # the panel covers the rightmost 320
PATIENCE_S = 60.0


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium as it is installed. Without one tests are skipped; in CI they fail, lest all be skipped."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        message = "no Chromium is installed: the pages of the viewer cannot be tested"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=SWITCHES)
        yield chromium
        chromium.close()


@dataclass
class Visit:
    """A page that is open. asked: hosts of everything it asked for, its websocket included."""

    page: Page
    asked: set[str] = field(default_factory=set)
    failures: list[str] = field(default_factory=list)

    def picture(self) -> np.ndarray:
        """(H, W, 3) RGB of what is to be seen."""
        data = np.frombuffer(self.page.screenshot(timeout=1e3 * PATIENCE_S), np.uint8)
        return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def wait_until_ready(self, server: ViserServer, last: str) -> None:
        """Until the page is connected and shows what it is told last."""
        self.wait_until(lambda: len(server.get_clients()) == 1, "the page is connected")
        self.page.get_by_text(last).first.wait_for(timeout=1e3 * PATIENCE_S)
        self.page.wait_for_timeout(1000)

    def text(self) -> str:
        """What a person reads in the panel."""
        return str(self.page.evaluate("document.body.innerText"))

    def wait_until(self, is_so: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
        """Let the page work until something is so."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            if is_so():
                return
            self.page.wait_for_timeout(200)
        pytest.fail(f"after {patience_s:.0f} s still not so: {what}")


@contextmanager
def visiting(browser: Browser) -> Iterator[Callable[[str], Visit]]:
    """Opens pages by their addresses."""
    context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})

    def open_page(url: str) -> Visit:
        page = context.new_page()
        seen = Visit(page)

        def note(address: str) -> None:
            if not address.startswith(("data:", "blob:")):
                seen.asked.add(urlsplit(address).hostname or address)

        page.on("request", lambda request: note(request.url))
        page.on("websocket", lambda socket: note(socket.url))
        page.on("pageerror", lambda error: seen.failures.append(str(error)))
        page.goto(url)
        return seen

    yield open_page
    context.close()


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[[str], Visit]]:
    """Opens a page by its address."""
    with visiting(browser) as open_page:
        yield open_page


def on_screen(server: ViserServer, place: tuple[float, float, float]) -> tuple[float, float]:
    """Pixel at which the only visitor sees a place of the world."""
    (client,) = server.get_clients().values()
    camera = client.camera
    w, x, y, z = camera.wxyz
    rotation = rotation_from_quaternion(np.array([x, y, z, w]))
    right, down, forward = rotation.T @ (np.array(place) - camera.position)
    focal = 0.5 * SIZE[1] / np.tan(0.5 * camera.fov)
    return 0.5 * SIZE[0] + focal * float(right / forward), 0.5 * SIZE[1] + focal * float(down / forward)
