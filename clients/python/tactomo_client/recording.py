"""Recorded frames: what a daemon published, read back as the same `Frame` objects as live.

::

    from tactomo_client.recording import open_recording

    for frame in open_recording("grasp.mcap"):
        print(frame.acquired_realtime_ns, frame.contacts)

Frames are in a recording that was made with them: `tactomo record --maps`, `Daemon.record(...,
maps=True)`, or ``maps = true`` in the daemon's configuration. `tactomo replay` makes them of one
that has the ports' bytes alone. Needs the extra ``recording``: mcap and zstandard.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Literal

from tactomo_client.errors import MessageError, RecordingError, checked_seconds
from tactomo_client.messages import decode_message, frame_from_message
from tactomo_client.recording_file import (
    ENDLESS_NS,
    ROTATED_NAME,
    Span,
    messages,
    messages_beyond,
    read_index,
    read_metadata,
    read_span,
    records,
)
from tactomo_client.schema import FRAME_STALE_AFTER_S, Frame

__all__ = ["Recording", "RecordingWarning", "open_recording"]


class RecordingWarning(UserWarning):
    """A recording is not all there; what can be read of it is read."""


def open_recording(path: str | Path, *, sensor: str | None = None) -> Recording:
    """Open a recording.

    Args:
        path: a ``.mcap`` file; or the folder of a recording that was cut into files, which are read
            in the order in which they were made.
        sensor: which sensor's files, for a folder that holds several sensors'.

    Raises:
        RecordingError: there is no such file, it is no recording of tactomo's, or the folder
            holds none. A file that is cut off or damaged is no error: see `Recording.damage`.
    """
    where = Path(path).expanduser()
    files = _files_in(where, sensor) if where.is_dir() else (where,)
    return Recording(where, files)


class Recording:
    """A recording opened for reading; every iteration reads the files anew, a chunk at a time."""

    def __init__(self, path: Path, files: tuple[Path, ...]) -> None:
        self.path = path  #: the file or the folder
        self.files = files  #: the file, or those of the folder in order
        metadata = read_metadata(files[0])
        self.sensor = metadata.get("sensor", "")  #: the sensor's name
        #: its description: the name of a shipped one, or the path of the file on the computer that
        #: recorded
        self.description = metadata.get("description", "")
        self.description_sha256 = metadata.get("description_sha256", "")  #: that description's hash
        self.version = metadata.get("version", "")  #: the version of the daemon that recorded

    @cached_property
    def start_ns(self) -> int:
        """When it began, nanoseconds since 1970 (UTC); 0 where nothing is in it."""
        return min((span.start_ns for span in self._spans if span.start_ns), default=0)

    @cached_property
    def duration_s(self) -> float:
        """Seconds from its first to its last entry."""
        return (max((span.end_ns for span in self._spans), default=0) - self.start_ns) * 1e-9

    @cached_property
    def damage(self) -> str:
        """What is wrong with it, in words; empty where all of it can be read. Reads all of it."""
        return "; ".join(filter(None, map(_damage, self.files)))

    @cached_property
    def has_frames(self) -> bool:
        """Whether there are maps in it, and contacts; otherwise it has the ports' bytes alone."""
        return any(_has_frames(path) for path in self.files)

    def __iter__(self) -> Iterator[Frame]:
        """Yield all frames, as `frames` does."""
        return self.frames()

    def frames(
        self,
        kind: Literal["map", "contacts"] = "map",
        *,
        start_s: float = 0.0,
        end_s: float = math.inf,
        stale_after_s: float = FRAME_STALE_AFTER_S,
    ) -> Iterator[Frame]:
        """Yield the frames in the order in which they were published.

        Their `Frame.age_s` is the age at which they were published, and `Frame.is_stale` goes by
        that, not by the time now. Where a file is cut off or damaged, the frames beyond follow if
        they are intact, and there is a RecordingWarning; likewise for a folder's file without any.

        Args:
            kind: ``map`` for images and contacts; ``contacts`` for contacts alone, which is faster.
            start_s: the first to be read, seconds from the recording's beginning.
            end_s: where to stop, seconds from the recording's beginning; this one is left out.
            stale_after_s: the age in seconds from which `Frame.is_stale` is true.

        Raises:
            MessageError: `kind` is neither of the two.
            RecordingError: there are no frames in the recording at all (`name` is ``no_frames``),
                or a file has vanished.
            TypeError, ValueError: a time is no number, is negative, or the end is before the start.

        Example::

            recording = open_recording("grasp.mcap")
            for frame in recording.frames("contacts", start_s=2.0, end_s=5.0):
                ...
        """
        if kind not in ("map", "contacts"):
            raise MessageError(f"there are no frames of {kind!r}", "use 'map' or 'contacts'")
        start_s = checked_seconds("start_s", start_s, endless=False)
        end_s = checked_seconds("end_s", end_s)
        stale_after_s = checked_seconds("stale_after_s", stale_after_s)
        if end_s < start_s:
            raise ValueError(f"end_s = {end_s!r} is before start_s = {start_s!r}: give a later one")
        if not self.has_frames:
            raise _no_frames(self.path, self.files[0])
        start_ns = self.start_ns + _nanoseconds(start_s)
        end_ns = self.start_ns + _nanoseconds(end_s)
        return self._frames(kind, start_ns, end_ns, stale_after_s)

    def _frames(
        self, kind: str, start_ns: int, end_ns: int, stale_after_s: float
    ) -> Iterator[Frame]:
        for path, span in zip(self.files, self._spans, strict=True):
            if start_ns <= span.end_ns and span.start_ns < end_ns and not _has_frames(path):
                _warn(str(_no_frames(path, path)))
            for message in messages(path, kind, start_ns, end_ns, _warn):
                try:
                    decoded = decode_message(message.data)
                    yield frame_from_message(decoded, None, stale_after_s)
                except MessageError as error:
                    _warn(f"{path} holds a frame that cannot be read: {error.cause}")

    @cached_property
    def _spans(self) -> list[Span]:
        return [read_span(path) for path in self.files]


def _no_frames(path: Path, file: Path) -> RecordingError:
    return RecordingError(
        f"there are no maps and no contacts in {path}, only what the ports said",
        f"record them, too (`tactomo record --maps`), or make them of it: "
        f"`tactomo replay {file} --speed max --record FRAMES.mcap`",
        "no_frames",
    )


def _files_in(folder: Path, sensor: str | None) -> tuple[Path, ...]:
    """Return the files of a folder's one sensor, in the order in which they were made."""
    found = [(re.fullmatch(ROTATED_NAME, path.name, re.ASCII), path) for path in folder.iterdir()]
    named = [(match, path) for match, path in found if match]
    sensors = sorted({match["sensor"] for match, _ in named})
    if sensor is None and len(sensors) > 1:
        raise RecordingError(
            f"{folder} holds recordings of several sensors: {', '.join(sensors)}",
            f"say which: sensor={sensors[0]!r}; for a command, move each into its own folder",
        )
    wanted = sensor or next(iter(sensors), None)
    files = {int(match["number"]): path for match, path in named if match["sensor"] == wanted}
    if not files:
        raise RecordingError(
            f"there are no recordings{f' of {sensor}' if sensor else ''} in the folder {folder}",
            "give a folder of recordings that the daemon named, or the path of a .mcap file",
        )
    return tuple(files[number] for number in sorted(files))


def _has_frames(path: Path) -> bool:
    index = read_index(path)
    if index is not None and index.statistics is not None:
        counts = index.statistics.channel_message_counts
        return any(counts.get(n) for n, channel in index.channels.items() if channel.topic == "map")
    return any(True for _ in messages(path, "map"))


def _damage(path: Path) -> str:
    damaged_at: list[int] = []
    for _ in records(path, damaged_at.append):
        pass
    if not damaged_at:
        return ""
    if any(True for _ in messages_beyond(path, damaged_at[0])):
        return f"{path.name} is damaged, with intact data beyond"
    return f"{path.name} is " + ("cut off" if read_index(path) is None else "damaged")


def _nanoseconds(seconds: float) -> int:
    return round(min(seconds * 1e9, ENDLESS_NS))


def _warn(what: str) -> None:
    warnings.warn(what, RecordingWarning, stacklevel=2)
