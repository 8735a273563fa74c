"""A recording in progress: what waits for the disk, bounded in bytes, and the file it goes into."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tactomo.recordings.recording_writer import Entry, RecordingWriter

MAX_QUEUED_BYTES: Final = 64 << 20
"""What may wait for a stuck disk: half an hour of raw bytes, two minutes with maps."""
ENTRY_BYTES: Final = 300  # what an entry takes beside its data


@dataclass(eq=False)
class ActiveRecording:
    """A recording in progress: any thread may fill its queue, the recorder's thread empties it."""

    number: int  # tells it from the daemon's other recordings; rises from 1
    path: Path
    _writer: RecordingWriter
    with_maps: bool
    calibration: str  # the pressure calibration that the file's metadata tell, as text
    # the file before it, until the recorder's thread has closed that; it gets the ports' bytes,
    # too, as long as the pipeline's thread has not `come_over` to this one
    previous: ActiveRecording | None

    def __post_init__(self) -> None:
        self.come_over = threading.Event()
        self.references = 0  # how many references were added; the pipeline's thread counts
        self.calibrations = 0  # how many pressure calibrations were added, likewise
        # length of the file at the last flush; written by the recorder's thread
        self.bytes_written = 0
        self.is_overflowed = False  # the queue was full once, and nothing is taken any more
        self.is_empty = True  # nothing was written yet; written by the recorder's thread
        self._begin_s = time.monotonic()
        self._lock = threading.Lock()
        self._entries: list[Entry] = []  # this and the next three under the lock
        self._queued_bytes = 0
        self._has_ended = False
        self._is_told = False
        self._synced_s = self._begin_s
        self._syncing: threading.Thread | None = None
        self._sync_error: OSError | None = None

    @property
    def age_s(self) -> float:
        """How long ago the first of it was written, or the file begun."""
        return time.monotonic() - self._begin_s

    @property
    def queued_bytes(self) -> int:
        """What waits for the disk."""
        return self._queued_bytes

    def add(self, *entries: Entry) -> bool:
        """Add entries in order, all or none; never waits. False: it takes no more."""
        size = sum(len(entry.data) + ENTRY_BYTES for entry in entries)
        with self._lock:
            if self._has_ended or self.is_overflowed:
                return False
            if self._queued_bytes + size > MAX_QUEUED_BYTES:
                self.is_overflowed = True
                return False
            self._entries += entries
            self._queued_bytes += size
        return True

    def tell_once(self) -> bool:
        """Whether nobody has told yet that it failed; then the caller does."""
        with self._lock:
            is_first, self._is_told = not self._is_told, True
        return is_first

    def write(self) -> None:
        """Write what was added, and hand it to the operating system."""
        with self._lock:
            entries, self._entries = self._entries, []
        if entries and self.is_empty:
            self.is_empty, self._begin_s = False, time.monotonic()
        for entry in entries:
            self._writer.add(entry)
        self.bytes_written = self._writer.flush()
        with self._lock:
            self._queued_bytes -= sum(len(entry.data) + ENTRY_BYTES for entry in entries)

    def sync(self, period_s: float) -> None:
        """Have what was written outlive a loss of power, once a period; 0 leaves that to chance.

        Another thread waits for the disk, which may take a second: what comes meanwhile is written,
        or a process killed then would lose it. Raises OSError where the last one has failed.
        """
        if self._sync_error is not None:
            raise self._sync_error
        is_on = self._syncing is not None and self._syncing.is_alive()
        if period_s and not is_on and time.monotonic() - self._synced_s >= period_s:
            self._synced_s = time.monotonic()
            self._syncing = threading.Thread(target=self._sync, name="sync", daemon=True)
            self._syncing.start()

    def _sync(self) -> None:
        try:
            self._writer.sync()
        except OSError as error:
            self._sync_error = error

    def finish(self, sync: bool) -> None:
        """Write what was added so far and close the file with its index."""
        with self._lock:
            self._has_ended = True
        self.write()
        if self._syncing is not None:
            self._syncing.join()
        if sync:
            self._writer.sync()
        self.bytes_written = self._writer.close()

    def abandon(self) -> None:
        """Close the file as it is, and forget what was not written."""
        with self._lock:
            self._has_ended = True
            self._entries, self._queued_bytes = [], 0
        self._writer.abandon()

    @property
    def is_deleted(self) -> bool:
        """Whether somebody has deleted the file."""
        return self._writer.is_deleted
