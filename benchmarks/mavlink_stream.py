"""A long stream of ODOMETRY into a peer on the loopback: rate, jitter, gaps.

    python -m benchmarks.mavlink_stream --minutes 10

Fixes come ten times a second with up to 20 ms of jitter; every minute half a second of them is lost.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass

import numpy as np
from tests.navigation import rules
from tests.navigation.fake_autopilot import FakeAutopilot
from tests.navigation.stalls import Stalls

from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose
from overfly.navigation.mavlink import Autopilot, AutopilotLink, FixStream, OdometrySender

RATE_HZ = 10.0
LOST_EVERY_S, LOST_S = 60.0, 0.5


@dataclass(frozen=True)
class Result:
    """What became of one frame."""

    t_ns: int
    pose: Pose | None
    covariance: FloatArray | None
    n_inliers: int = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--autopilot", choices=[str(kind) for kind in Autopilot], default=str(Autopilot.PX4))
    arguments = parser.parse_args()
    kind = Autopilot(arguments.autopilot)
    generator = np.random.default_rng(0)
    with Stalls() as stalls, FakeAutopilot(kind) as peer, AutopilotLink.open(peer.url) as link:
        link.wait_for_autopilot()
        cpu_s, begin = time.process_time(), time.monotonic()
        with OdometrySender(link, FixStream(Pose(NADIR_BODY_FROM_CAM, np.zeros(3))), kind) as sender:
            for n in range(int(60.0 * arguments.minutes * RATE_HZ)):
                wake = begin + n / RATE_HZ + generator.uniform(0.0, 0.02)
                time.sleep(max(0.0, wake - time.monotonic()))
                t_ns = time.monotonic_ns()
                place = 0.5 * np.array([np.cos(0.01 * n), np.sin(0.01 * n), 4.0])
                is_lost = (n / RATE_HZ) % LOST_EVERY_S > LOST_EVERY_S - LOST_S
                pose = None if is_lost else Pose(NADIR_BODY_FROM_CAM, place)
                sender.observe(Result(t_ns, pose, np.eye(6) * 1e-4))
        cpu_s = time.process_time() - cpu_s
        arrived = peer.of_type("ODOMETRY")
    gaps_ms = np.diff([t_ns for t_ns, _ in arrived]) * 1e-6
    decoder = rules.ArduPilot() if kind is Autopilot.ARDUPILOT else rules.Px4()
    accepted = sum(decoder.take(message) is not None for _, message in arrived)
    numbers = {
        "autopilot": str(kind),
        "minutes": arguments.minutes,
        "messages": len(arrived),
        "accepted": accepted,
        "refused": sorted(set(decoder.refused)),
        "fixes": sender.report.fixes,
        "guesses": sender.report.guesses,
        "silences": sender.report.silences,
        "rate_hz": len(arrived) / (60.0 * arguments.minutes),
        "gap_ms": {name: float(np.percentile(gaps_ms, at)) for name, at in (("p50", 50), ("p99", 99))}
        | {"max": float(gaps_ms.max())},
        "gaps_over_200_ms": int((gaps_ms > 200.0).sum()),
        "stall_of_the_machine_ms": {"max": 1e3 * stalls.longest_s, "over_80_ms": stalls.n_long},
        "jitter_ms": float(np.std(gaps_ms)),
        "cpu_share": cpu_s / (60.0 * arguments.minutes),
    }
    print(json.dumps(numbers, indent=1), file=sys.stdout)


if __name__ == "__main__":
    main()
