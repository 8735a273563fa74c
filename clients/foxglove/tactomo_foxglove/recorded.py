"""Recorded frames as a file that Foxglove opens: the topics of the live bridge, times and all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import foxglove
from foxglove.channels import FrameTransformsChannel
from foxglove.mcap import MCAPWriteOptions
from tactomo_client import Frame

from tactomo_foxglove.placement import Placement
from tactomo_foxglove.topics import SensorTopics

PROFILE = "tactomo-foxglove"


def write_mcap(
    frames: Iterable[Frame],
    path: Path,
    sensor: str,
    description: Mapping[str, Any],
    placement: Placement | None = None,
) -> int:
    """Write frames to an MCAP file, and return how many there were.

    Each is at the time at which it was acquired. Of the frames only one is in memory at a time.

    Args:
        frames: in the order of their times.
        path: the file; it is written over.
        sensor: the sensor's name.
        description: the sensor, as `status` has it; empty where it is not known.
        placement: where the sensor hangs.

    """
    context = foxglove.Context()
    transforms = FrameTransformsChannel("/tf", context=context)
    topics = SensorTopics(sensor, context, transforms, placement or Placement())
    options = MCAPWriteOptions(profile=PROFILE, compression_threads=0)
    count = 0
    with foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options):
        for count, frame in enumerate(frames, 1):
            if count == 1 and description:
                topics.sheet(description, frame.acquired_realtime_ns)
            topics.frame(frame, frame.acquired_realtime_ns)
    return count
