"""The command line: one verb per file; each parses, imports what it needs, calls.

Heavy imports stand inside the commands, so that ``overfly --help`` answers at once.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import typer

from overfly.errors import OverflyError
from overfly.threads import limit_blas_threads

limit_blas_threads()  # before anything imports numpy

INTERRUPTED = 130

app = typer.Typer(
    name="overfly",
    help="Visual SLAM for everything that flies and looks down: map, find yourself, steer, without GPS.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# In the order of a user's first day.
VERBS = (
    "demo",
    "map",
    "view",
    "locate",
    "fly",
    "info",
    "export",
    "evaluate",
    "simulate",
    "optimise",
    "bench",
    "experiments",
    "doctor",
)

for verb in VERBS:
    module = importlib.import_module(f"overfly.cli.{verb}_command")
    app.command(verb)(module.command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; exit codes as in the README: 0 done, 1 failed, 2 wrong usage, 130 interrupted."""
    try:
        outcome = app(args=list(arguments) if arguments is not None else None, standalone_mode=False)
    except OverflyError as error:
        print(f"overfly: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("overfly: interrupted", file=sys.stderr)
        return INTERRUPTED
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:  # click's own usage errors know how to show themselves
        show = getattr(error, "show", None)
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", 1))
    return int(outcome or 0)
