"""Recorded frames as a bag that `ros2 bag` and every reader of rosbag2 open: a folder, MCAP."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from tactomo_client import Frame
from tactomo_client.schema import Mount

from tactomo_ros2.messages import TYPES, ros_messages, topic_types

VERSION: Final = 8
"""Of metadata.yaml: 9, Jazzy's, writes profiles in a way that Humble and Iron cannot read."""


def write_bag(
    frames: Iterable[tuple[int, Frame, float | None]],
    folder: Path,
    sensor: str,
    mount: Mount | None = None,
) -> int:
    """Write frames as a bag, and return how many there were; a chunk at a time is in memory.

    A message's time in the bag is when its frame was published, its stamp when the frame was
    acquired: the difference is the age. Where the age is not known, both are the same.

    Args:
        frames: when each was acquired, nanoseconds since 1970; the frame; and how old it was when
            it was published, seconds, if that is known.
        folder: the bag, which must not be there yet; its files have its name.
        sensor: the sensor's name.
        mount: the link that carries the sheet; None: the map is flat, in the sensor's own frame.

    Raises:
        OSError: the bag cannot be written.
        rosbags.rosbag2.WriterError: it is there already.
    """
    count = 0
    bag = Writer(folder, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        topics = {
            topic: bag.add_connection(topic, kind, typestore=TYPES)
            for topic, kind in topic_types(sensor).items()
        }
        for time_ns, frame, age_s in frames:
            count += 1
            published_ns = time_ns + round((age_s or 0.0) * 1e9)
            for message in ros_messages(frame, time_ns, age_s, mount):
                bag.write(topics[message.topic], published_ns, message.cdr)
    return count
