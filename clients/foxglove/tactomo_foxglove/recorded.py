"""Recorded frames as a file that Foxglove opens: the topics of the live bridge, times and all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import IO, Any

import foxglove
from foxglove.channels import FrameTransformsChannel
from foxglove.mcap import MCAPWriteOptions
from tactomo_client import Frame

from tactomo_foxglove.topics import SensorTopics

PROFILE = "tactomo-foxglove"


def write_mcap(
    # in the order of their times: when each was acquired, nanoseconds since 1970; the frame; and
    # how old it was when it was published, seconds, if that is known
    frames: Iterable[tuple[int, Frame, float | None]],
    file: IO[bytes],  # a file opened for writing, which stays open
    sensor: str,  # the sensor's name
    description: Mapping[str, Any],  # the sensor, as `status` has it; empty where it is not known
) -> int:
    """Write frames as an MCAP file, one at a time; return how many. Raises OSError as files do."""
    context = foxglove.Context()
    transforms = FrameTransformsChannel("/tf", context=context)
    topics = SensorTopics(sensor, context, transforms)
    options = MCAPWriteOptions(profile=PROFILE, compression_threads=0)
    count = 0
    writer = foxglove.open_mcap(file, context=context, writer_options=options)
    for count, (time_ns, frame, age_s) in enumerate(frames, 1):
        if count == 1 and description:
            topics.sheet(description, time_ns)
        topics.frame(frame, time_ns, age_s)
    try:
        writer.close()
    except RuntimeError as error:  # so it says that an earlier write had failed
        raise OSError(f"the file could not be written: {error}") from error
    return count
