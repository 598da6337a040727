"""overfly view: a finished map in the browser."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer


def command(
    source: Annotated[Path, typer.Argument(metavar="MAP|OUT", help="A map file, or a folder of results.")],
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port on 127.0.0.1; else a free one.")
    ] = None,
    show: Annotated[bool | None, typer.Option("--show/--no-show", help="Open the browser.")] = None,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the address as one JSON object.")
    ] = False,
) -> int:
    """Show a map in the browser: ground, path, constraints; play the flight back, measure with clicks."""
    from overfly.pipeline.viewing import open_view

    view = open_view(source, port)
    url = view.page.url
    print(json.dumps({"url": url}) if json_output else f"{source} is shown at {url}", flush=True)
    print("Ctrl-C ends it.", file=sys.stderr)
    if show or (show is None and sys.stdout.isatty()):
        typer.launch(url)
    try:
        view.wait()
    except KeyboardInterrupt:
        pass
    finally:
        view.close()
    return 0
