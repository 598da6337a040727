"""--viewer: a page that shows a run while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from overfly.localizer import Localizer
from overfly.mapstore import Map
from overfly.slam import Slam
from overfly.types import Rig
from overfly.viewer.interface import NullViewer, Viewer

Announce = Callable[[str], None]  # is told the address of the page


@contextmanager
def watching(
    announce: Announce | None, rig: Rig, source: Slam | Localizer, known: Map | None = None
) -> Iterator[Viewer]:
    """The viewer of a run: nobody when announce is None. rig: of the frames, as recorded;
    known: the map that exists already.

    Raises OutputError when the page cannot be served.
    """
    if announce is None:
        yield NullViewer()
        return
    from overfly.viewer.live import LiveViewer
    from overfly.viewer.server import open_page

    page = open_page("Overfly")
    announce(page.url)
    slam = source if isinstance(source, Slam) else None
    viewer = LiveViewer(page, rig.cam0.camera, source.map, slam, known)
    try:
        yield viewer
    finally:
        viewer.close()
