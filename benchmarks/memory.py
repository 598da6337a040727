"""What a benchmark holds in memory."""

from __future__ import annotations

import resource
from pathlib import Path


def resident_mb() -> float:
    """Resident memory of this process in megabytes; Linux only."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6
