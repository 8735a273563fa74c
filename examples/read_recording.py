"""Read a recording's frames: how long each contact lasted and how hard it pressed at most.

Record: .venv/bin/tactomo record grasp.mcap --maps --seconds 10    (a daemon must be running)
Run:    .venv/bin/python examples/read_recording.py grasp.mcap
Needs:  `tactomo-client[recording]` alone.
"""

import sys
from dataclasses import dataclass

from tactomo_client.recording import open_recording


@dataclass
class Touch:
    """One contact from its first frame to its last."""

    first_s: float
    last_s: float
    peak_kpa: float | None = None  # None: always too light to be measured


recording = open_recording(sys.argv[1] if len(sys.argv) > 1 else sys.exit(__doc__))
print(f"{recording.sensor}: {recording.duration_s:.1f} s, {recording.damage or 'whole'}")

touches: dict[tuple[str, int], Touch] = {}
start_ns = 0
for frame in recording.frames("contacts"):
    start_ns = start_ns or frame.acquired_monotonic_ns
    now_s = (frame.acquired_monotonic_ns - start_ns) * 1e-9
    for contact in frame.contacts:
        touch = touches.setdefault((frame.session, contact.id), Touch(now_s, now_s))
        touch.last_s = now_s
        if contact.pressure_kpa is not None:
            touch.peak_kpa = max(touch.peak_kpa or 0.0, contact.pressure_kpa)

for (_, number), touch in touches.items():
    pressure = "too light" if touch.peak_kpa is None else f"{touch.peak_kpa:.0f} kPa"
    print(f"contact {number}: {touch.first_s:.2f} to {touch.last_s:.2f} s, {pressure}")
