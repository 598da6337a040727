#!/usr/bin/env python3
"""Set up a virtual environment and run one task in it, on a machine with nothing but Python 3.11+ and git.

python3 dev.py demo     simulate a short flight, map it, show where the results are
python3 dev.py test     the whole test suite (further words go to pytest)
python3 dev.py lint     ruff, format check included
python3 dev.py types    mypy, strict
"""

import hashlib
import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = ROOT / ".venv"
BIN = ENVIRONMENT / ("Scripts" if os.name == "nt" else "bin")

TASKS = {
    "demo": [["overfly", "demo"]],
    "test": [["python", "-m", "pytest"]],
    "lint": [["ruff", "check", "."], ["ruff", "format", "--check", "."]],
    "types": [
        ["mypy"],
        ["mypy", "benchmarks", "--no-strict-optional", "--no-warn-return-any", "--no-warn-unused-ignores"],
    ],
}


def set_up() -> None:
    """Create .venv and install Overfly in it, again only when pyproject.toml has changed."""
    wanted = hashlib.sha256((ROOT / "pyproject.toml").read_bytes()).hexdigest()
    stamp = ENVIRONMENT / "overfly-installed"
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    print(f"Setting up {ENVIRONMENT} (once, a minute or two) ...", file=sys.stderr, flush=True)
    venv.create(ENVIRONMENT, with_pip=True, clear=False)
    python = str(BIN / "python")
    subprocess.run([python, "-m", "pip", "install", "-q", "-e", f"{ROOT}[dev]"], check=True)
    stamp.write_text(wanted)


def main() -> int:
    if sys.version_info < (3, 11):  # noqa: UP036  an old interpreter should read why, not a syntax error
        print("Overfly needs Python 3.11 or newer; this is " + sys.version.split()[0], file=sys.stderr)
        return 2
    if len(sys.argv) < 2 or sys.argv[1] not in TASKS:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        set_up()
    except subprocess.CalledProcessError as error:
        print(
            f"Installing Overfly into {ENVIRONMENT} failed (exit code {error.returncode}).", file=sys.stderr
        )
        return 1
    for program, *arguments in TASKS[sys.argv[1]]:
        outcome = subprocess.run([str(BIN / program), *arguments, *sys.argv[2:]], cwd=ROOT, check=False)
        if outcome.returncode != 0:
            return outcome.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
