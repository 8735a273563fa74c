"""Writing recordings: while the daemon runs, or at once from scans that came from elsewhere.

The layout of the file is `recording`'s. Every recording has a thread of its own that alone touches
the file; the others only put entries into its queue, so a slow disk delays nobody. A recording
that cannot go on (the disk is full or too slow) ends with an event, and the daemon goes on.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import threading
import time
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import msgpack  # type: ignore[import-untyped]
from mcap.writer import Writer
from tactomo_client.messages import array_to_wire
from tactomo_models import Reference
from tactomo_protocol import Hello, Scan, encode

from tactomo.errors import CommandError, RecordingError
from tactomo.events import OnEvent
from tactomo.recording import PROFILE, REFERENCE_ARRAYS, Mark, Origin

FLUSH_S: Final = 0.2
MAX_QUEUED: Final = 20_000
"""Entries that a stalled disk may hold up before the recording is given up: minutes of them."""
CHUNK_BYTES: Final = 1 << 20
HELLO_PERIOD_S: Final = 1.0
_RAW, _MSGPACK, _STREAM = "application/octet-stream", "msgpack", "tactomo-stream"


class Entry(NamedTuple):
    """One message on its way into a recording."""

    topic: str
    encoding: str
    data: bytes
    monotonic_ns: int
    realtime_ns: int


def port_entry(port: int, data: bytes, monotonic_ns: int, realtime_ns: int) -> Entry:
    """What one read of a port returned, with its times."""
    return Entry(f"port/{port}", _RAW, data, monotonic_ns, realtime_ns)


def hello_entry(port: int, hello: Hello, monotonic_ns: int, realtime_ns: int) -> Entry:
    """The hello in force on a port, as the frame it would come in."""
    return Entry(f"port/{port}/hello", _RAW, encode(hello), monotonic_ns, realtime_ns)


def reference_entry(reference: Reference, monotonic_ns: int, realtime_ns: int) -> Entry:
    """The reference that holds from here on."""
    fields: dict[str, Any] = {"scans": reference.scans}
    for name in REFERENCE_ARRAYS:
        array = getattr(reference, name)
        fields[name] = None if array is None else array_to_wire(array)
    return Entry("reference", _MSGPACK, msgpack.packb(fields), monotonic_ns, realtime_ns)


def mark_entry(mark: Mark, monotonic_ns: int, realtime_ns: int) -> Entry:
    """A dual scan that was reconstructed; a new reference is an entry of its own, before it."""
    fields = {"scans": mark.scans, "tier": mark.tier, "budget_ms": mark.budget_ms}
    return Entry("frame", _MSGPACK, msgpack.packb(fields), monotonic_ns, realtime_ns)


def message_entry(kind: str, data: bytes, monotonic_ns: int, realtime_ns: int) -> Entry:
    """A stream message exactly as published."""
    return Entry(kind, _STREAM, data, monotonic_ns, realtime_ns)


class RecordingWriter:
    """Writes one recording; for use by one thread. Its methods raise OSError as files do."""

    def __init__(self, path: Path, origin: Origin) -> None:
        self._file: IO[bytes] = path.open("xb")
        self._channels: dict[str, int] = {}
        self._clock_offset_ns = time.time_ns() - time.monotonic_ns()
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile=PROFILE, library=f"tactomo {origin.version}")
        metadata = {
            "sensor": origin.sensor,
            "description": origin.description,
            "description_sha256": origin.description_sha256,
            "ports": "\n".join(origin.ports),
            "version": origin.version,
        }
        self._writer.add_metadata(PROFILE, metadata)
        self.flush()

    def add(self, entry: Entry) -> None:
        """Add one message."""
        channel = self._channels.get(entry.topic)
        if channel is None:
            channel = self._writer.register_channel(entry.topic, entry.encoding, schema_id=0)
            self._channels[entry.topic] = channel
        log_time = self._clock_offset_ns + entry.monotonic_ns
        self._writer.add_message(channel, log_time, entry.data, entry.realtime_ns)

    def flush(self) -> int:
        """Hand everything to the operating system, so that this process may be killed.

        Returns the length of the file.
        """
        self._writer.flush()  # type: ignore[no-untyped-call]
        return self._file.tell()

    def close(self) -> int:
        """Finish the file with its index; returns its length."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            return self._file.tell()
        finally:
            self._close_file()

    def abandon(self) -> None:
        """Close the file as it is, after a write has failed."""
        self._close_file()

    def _close_file(self) -> None:
        try:
            self._file.close()
        except OSError:  # what is buffered cannot be written, and that was reported already
            self._file.raw.close()  # type: ignore[attr-defined]


class ActiveRecording:
    """A recording in progress: a queue that any thread may fill, a thread that empties it.

    Attributes:
        number: tells it from the daemon's other recordings; above 0.
        bytes_written: length of the file at the last flush.
        failure: why it had to be given up; empty while all is well.

    """

    def __init__(self, number: int, path: Path, writer: RecordingWriter, with_maps: bool) -> None:
        self.number = number
        self.path = path
        self.with_maps = with_maps
        self.bytes_written = 0  # written by the recorder thread, like the next one
        self.failure = ""
        self._writer = writer
        self._queue: queue.SimpleQueue[Entry | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=f"recorder-{number}")
        self._thread.start()

    def add(self, *entries: Entry) -> None:
        """Add entries in order; never waits, and does nothing once the recording has ended."""
        for entry in entries:
            self._queue.put(entry)

    def finish(self) -> None:
        """Write what was added so far and close the file."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._write_until_finished()
            self.bytes_written = self._writer.close()
        except Exception as error:  # a recording may fail, but never without a word
            self.failure = getattr(error, "strerror", None) or str(error) or repr(error)
            self._writer.abandon()

    def _write_until_finished(self) -> None:
        flush_at = time.monotonic() + FLUSH_S
        while True:
            wait_s = flush_at - time.monotonic()
            if wait_s <= 0:
                self.bytes_written = self._writer.flush()
                flush_at = time.monotonic() + FLUSH_S
                continue
            try:
                entry = self._queue.get(timeout=wait_s)
            except queue.Empty:
                continue
            if entry is None:
                return
            if self._queue.qsize() > MAX_QUEUED:
                raise OSError(errno.EIO, "the disk is too slow")
            self._writer.add(entry)


class Recorder:
    """Starts and stops recordings, one at a time.

    `active` is the recording that runs. The control thread writes it; every other thread reads it
    once and uses what it got, which stays harmless after the recording has ended.
    """

    def __init__(self, origin: Origin, on_event: OnEvent) -> None:
        self.active: ActiveRecording | None = None
        self._origin = origin
        self._on_event = on_event
        self._number = 0

    def start(self, path: Path, with_maps: bool = False) -> Path:
        """Begin a recording and return its absolute path.

        Raises:
            CommandError: one runs already.
            RecordingError: the file exists, or cannot be created.

        """
        self.check()
        if self.active is not None:
            raise CommandError(
                f"a recording runs already: {self.active.path}",
                "stop it with record_stop first",
                "already_recording",
            )
        path = path.absolute()
        writer = _create(path, self._origin)
        self._number += 1
        self.active = ActiveRecording(self._number, path, writer, with_maps)
        self._on_event("recording_started", "info", str(path))
        return path

    def stop(self) -> tuple[Path, int]:
        """End the recording; return its path and its length in bytes.

        Raises:
            CommandError: none runs.
            RecordingError: it could not be written to its end.

        """
        active, self.active = self.active, None
        if active is None:
            raise CommandError(
                "nothing is being recorded", "start with record_start", "not_recording"
            )
        active.finish()
        if active.failure:
            self._tell_failure(active)
            raise RecordingError(
                f"{active.path}: {active.failure}", _HOW_TO_READ_THE_REST, "cannot_write"
            )
        self._on_event("recording_stopped", "info", f"{active.path}: {active.bytes_written} bytes")
        return active.path, active.bytes_written

    def close(self) -> None:
        """End the recording, if one runs; a failure is told as an event."""
        if self.active is not None:
            with contextlib.suppress(RecordingError):
                self.stop()

    def check(self) -> None:
        """Notice a recording that had to be given up; called now and then by the control thread."""
        active = self.active
        if active is not None and active.failure:
            self.active = None
            active.finish()
            self._tell_failure(active)

    def _tell_failure(self, active: ActiveRecording) -> None:
        self._on_event(
            "recording_failed",
            "error",
            f"{active.path}: {active.failure} after {active.bytes_written} bytes",
            _HOW_TO_READ_THE_REST,
        )


_HOW_TO_READ_THE_REST = "make room on the disk; what was written until then can be replayed"


def _create(path: Path, origin: Origin) -> RecordingWriter:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return RecordingWriter(path, origin)
    except FileExistsError as error:
        raise RecordingError(
            f"{path} exists already", "give another path", "cannot_write"
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        raise RecordingError(
            f"cannot create {path}: {getattr(error, 'strerror', None) or error}",
            "give a path in a folder that you may write to",
            "cannot_write",
        ) from error


def write_recording(
    path: str | Path,
    hello: Hello,
    scans: Iterable[tuple[float, Scan]],
    *,
    sensor: str,
    description: str,
    description_sha256: str,
    reference: Reference | None = None,
) -> int:
    """Write a recording of scans that came from elsewhere, as one port would have said them.

    Args:
        path: the file to write; it must not exist.
        hello: what the device would have said it is; repeated every second.
        scans: each with its time in seconds since the first, ascending.
        sensor: the sensor's name.
        description: the sensor description's name or path.
        description_sha256: that description's hash.
        reference: the reference to be used on replay; None leaves that to the replay's tare.

    Returns the length of the file in bytes.

    Raises:
        RecordingError: the file exists or cannot be written.

    """
    origin = Origin(sensor, description, description_sha256, ("import",), version("tactomo"))
    path = Path(path).absolute()
    writer = _create(path, origin)
    monotonic_ns, realtime_ns = time.monotonic_ns(), time.time_ns()
    hello_at_s = -HELLO_PERIOD_S
    try:
        if reference is not None:
            writer.add(reference_entry(reference, monotonic_ns, realtime_ns))
        for time_s, scan in scans:
            data = encode(scan)
            if time_s - hello_at_s >= HELLO_PERIOD_S:
                data, hello_at_s = encode(hello) + data, time_s
            after_ns = round(time_s * 1e9)
            writer.add(port_entry(0, data, monotonic_ns + after_ns, realtime_ns + after_ns))
        return writer.close()
    except OSError as error:
        writer.abandon()
        raise RecordingError(
            f"cannot write {path}: {error.strerror}", "make room on the disk", "cannot_write"
        ) from error
