"""overfly view at the command line: an address, an end by Ctrl-C, one clear line where there is no map."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from tests.exports.world import write_map

from overfly.cli import main


def test_it_serves_until_it_is_interrupted(tmp_path: Path) -> None:
    write_map(tmp_path, None)
    program = (  # the handler: tests that run in the background have none, and hand that on
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "from overfly.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", program, "view", str(tmp_path), "--json", "--no-show"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"]
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=20) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert rest == ""  # stdout belongs to the result


@pytest.mark.parametrize("name", ["nothing", "folder", "text.overfly"])
def test_what_is_no_map_is_one_clear_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.overfly").write_text("not a map")
    assert main(["view", str(tmp_path / name), "--no-show"]) in (1, 2)
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert name in told[0]


def test_a_real_vehicle_takes_no_orders_from_a_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "--mavlink", "udpin:127.0.0.1:14550", "--viewer"]) == 2
    assert "--sim" in capsys.readouterr().err
