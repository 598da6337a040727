"""What tests of all parts share: how examples are chosen, and where the public data are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# The first call of a compiled function takes seconds. In CI the examples are the same each time.
settings.register_profile("overfly", deadline=None, derandomize=os.environ.get("CI") == "true")
settings.load_profile("overfly")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the public data: OVERFLY_DATA, else shared/data beside the checkout.

    A test that asks for it is skipped where there is none; in CI it fails, lest all be skipped in silence.
    """
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("OVERFLY_DATA", beside))
    if not folder.is_dir():
        message = f"no public data in {folder}; set OVERFLY_DATA"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return folder
