"""Writing one recording's file: its entries, what waits for the disk, and how it gets there.

The layout is `recording`'s. What waits for the disk is bounded in bytes. But for the queue of an
`ActiveRecording`, everything here is for one thread, and may wait for the disk as long as the disk
likes: `recorder` has a thread for that.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import threading
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgpack  # type: ignore[import-untyped]
from mcap.writer import Writer
from tactomo_client.messages import array_to_wire
from tactomo_client.recording_file import CHANNELS, PROFILE
from tactomo_models import Reference
from tactomo_protocol import CompanionReading, Hello, Scan, encode

from tactomo.errors import RecordingError
from tactomo.recordings.recording import Origin, is_replayed
from tactomo.recordings.records import DRIFT_ARRAYS, REFERENCE_ARRAYS
from tactomo.scans import FrameRecord
from tactomo.timing import wall_clock_ns

CHUNK_NS: Final = 200_000_000
"""Of a recording's time in one chunk, so in a recovered file, too: damage costs all of a chunk."""
CHUNK_PORT_BYTES: Final = 8192
"""Likewise of a replay, which may take no time: at 20 dual scans a second of 416 voltages 0.2 s."""
MAX_PENDING_BYTES: Final = 4 << 20
HELLO_PERIOD_S: Final = 1.0


class Entry(NamedTuple):
    """One message on its way into a recording."""

    topic: str
    data: bytes
    monotonic_ns: int
    realtime_ns: int


def reference_entry(
    reference: Reference, number: int, monotonic_ns: int, realtime_ns: int
) -> Entry:
    """The reference that holds, the `number`-th of its recording; repeated, it changes nothing."""
    fields: dict[str, Any] = {"number": number, "scans": reference.scans}
    for name in REFERENCE_ARRAYS + DRIFT_ARRAYS:
        array = getattr(reference, name)
        if array is not None or name in REFERENCE_ARRAYS:
            fields[name] = None if array is None else array_to_wire(array)
    if reference.companions:
        fields["companions"] = dict(reference.companions)
    return Entry("reference", msgpack.packb(fields), monotonic_ns, realtime_ns)


def calibration_entry(text: str, number: int, monotonic_ns: int, realtime_ns: int) -> Entry:
    """The pressure calibration that holds from here on, read again for the `number`-th time."""
    data = msgpack.packb({"number": number, "text": text})
    return Entry("calibration", data, monotonic_ns, realtime_ns)


def pack_frame(mark: FrameRecord) -> bytes:
    """Return a mark as it is written; a new reference is an entry of its own, before it."""
    fields = {
        "scans": [(key.channel.number, key.counter, key.device_us) for key in mark.scans],
        "tier": mark.tier,
        "budget_ms": mark.budget_ms,
        "reference": mark.reference_number,
        "calibration": mark.calibration_number,
        "cold": mark.is_cold,
        "disputed": mark.is_disputed,
        "timing": mark.timing,
    }
    packed: bytes = msgpack.packb(fields)
    return packed


class _File:
    """A file as the MCAP writer sees it: `write` collects, `hand_over` writes, wholly or not.

    It is a bare descriptor: a buffered file that hangs in a write would keep the interpreter from
    ending.
    """

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self.descriptor = os.open(path, flags, 0o666)
        self._length = 0
        self._pending = bytearray()

    def write(self, data: bytes) -> int:
        self._pending += data
        if len(self._pending) > MAX_PENDING_BYTES:
            self.hand_over()
        return len(data)

    def tell(self) -> int:
        return self._length + len(self._pending)

    def flush(self) -> None:
        """Do nothing: the MCAP writer asks for it at the end of each chunk."""

    def hand_over(self) -> None:
        begin = self._length
        try:
            while self._pending:
                written = os.write(self.descriptor, self._pending)
                self._length += written
                del self._pending[:written]
        except OSError:  # a disk that is full takes the first half: the file ends before it
            with contextlib.suppress(OSError):
                os.ftruncate(self.descriptor, begin)
            raise

    def close(self) -> None:
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            with contextlib.suppress(OSError):  # of what was written before, and told then
                os.close(descriptor)


class RecordingWriter:
    """Writes one recording. Its methods raise OSError as files do.

    Raises FileExistsError where the file exists: nothing is ever written over.
    """

    def __init__(self, path: Path, origin: Origin) -> None:
        self._path = path
        self._name_is_safe = False
        self._file = _File(path)
        self._clock_offset_ns = wall_clock_ns() - time.monotonic_ns()
        self._writer = Writer(self._file)  # type: ignore[arg-type]
        self._chunk_begun_ns: int | None = None
        self._chunk_port_bytes = 0
        is_replay = is_replayed(origin.ports)
        self._most_port_bytes = CHUNK_PORT_BYTES if is_replay else MAX_PENDING_BYTES
        try:
            self._begin(origin)
        except BaseException:
            self.abandon()
            raise

    def _begin(self, origin: Origin) -> None:
        self._writer.start(profile=PROFILE, library=f"tactomo {origin.version}")
        metadata = {**asdict(origin), "ports": "\n".join(origin.ports)}
        self._writer.add_metadata(PROFILE, _as_text(metadata))
        # Always the same ones in the same order: should the chunk that names them be lost, what
        # the others hold is known by number.
        self._channels = {
            topic: self._writer.register_channel(topic, encoding, schema_id=0)
            for topic, encoding in CHANNELS.items()
        }
        self.flush()

    def add(self, entry: Entry) -> None:
        """Add one message."""
        log_time_ns = max(0, self._clock_offset_ns + entry.monotonic_ns)
        self.write(entry.topic, entry.data, log_time_ns, entry.realtime_ns)

    def write(self, topic: str, data: bytes, log_time_ns: int, realtime_ns: int) -> None:
        """Add one message with its time on the steady clock and on the wall clock."""
        begun_ns = self._chunk_begun_ns
        is_long = begun_ns is not None and log_time_ns - begun_ns >= CHUNK_NS
        if is_long or self._chunk_port_bytes >= self._most_port_bytes:
            self._end_chunk()
        if self._chunk_begun_ns is None:
            self._chunk_begun_ns = log_time_ns
        if topic.startswith("port/"):
            self._chunk_port_bytes += len(data)
        self._writer.add_message(self._channels[topic], log_time_ns, data, realtime_ns)

    def _end_chunk(self) -> None:
        self._chunk_begun_ns, self._chunk_port_bytes = None, 0
        self._writer.flush()  # type: ignore[no-untyped-call]

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Add a metadata record, after the chunks: between them it would pass for a gap."""
        self._end_chunk()
        self._writer.add_metadata(name, _as_text(facts))

    def flush(self) -> int:
        """Hand everything to the operating system, which outlives this process; return the size."""
        self._end_chunk()
        self._file.hand_over()
        return self._file.tell()

    def sync(self) -> None:
        """Have what was flushed, and the file's name, outlive a loss of power."""
        os.fdatasync(self._file.descriptor)
        if self._name_is_safe:
            return
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
        self._name_is_safe = True

    @property
    def is_deleted(self) -> bool:
        """Whether the file has lost its last name, so that nobody will ever read it."""
        return os.fstat(self._file.descriptor).st_nlink == 0

    def close(self) -> int:
        """Finish the file with its index; returns its length."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.hand_over()
            return self._file.tell()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is, after a write has failed."""
        self._file.close()


def create(path: Path, origin: Origin) -> RecordingWriter:
    """Begin a file in a folder that is there; raise RecordingError where that cannot be done."""
    try:
        return RecordingWriter(path, origin)
    except FileExistsError as error:
        raise RecordingError(
            f"{path} exists already", "give another path", "cannot_write"
        ) from error
    except FileNotFoundError as error:
        raise RecordingError(
            f"cannot create {path}: there is no folder {path.parent}",
            f"make it first: `mkdir -p {shlex.quote(str(path.parent))}`",
            "cannot_write",
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        raise RecordingError(
            f"cannot create {path}: {getattr(error, 'strerror', None) or error}",
            "give a path in a folder that you may write to",
            "cannot_write",
        ) from error


def write_recording(
    path: str | Path,  # the file to write; it must not exist
    hello: Hello,  # what the device would have said it is; repeated every second
    # each with its time in seconds since the first, ascending
    packets: Iterable[tuple[float, Scan | CompanionReading]],
    *,
    sensor: str,  # the sensor's name
    description: str,  # the sensor description's name or path
    description_sha256: str,  # that description's hash
    description_text: str = "",  # that description, see `carried_text`
    # the reference to be used on replay; None leaves that to the replay's tare
    reference: Reference | None = None,
) -> int:
    """Write scans that came from elsewhere, as one port would have said them; return its bytes.

    Raises RecordingError where the file exists or cannot be written.
    """
    origin = Origin(
        sensor=sensor,
        description=description,
        description_sha256=description_sha256,
        ports=("import",),
        version=version("tactomo"),
        description_text=description_text,
    )
    path = Path(path).absolute()
    writer = create(path, origin)
    monotonic_ns, realtime_ns = time.monotonic_ns(), wall_clock_ns()
    hello_at_s = -HELLO_PERIOD_S
    try:
        if reference is not None:
            writer.add(reference_entry(reference, 1, monotonic_ns, realtime_ns))
        for time_s, packet in packets:
            data = encode(packet)
            if time_s - hello_at_s >= HELLO_PERIOD_S:
                data, hello_at_s = encode(hello) + data, time_s
            after_ns = round(time_s * 1e9)
            writer.add(Entry("port/0", data, monotonic_ns + after_ns, realtime_ns + after_ns))
        return writer.close()
    except OSError as error:
        writer.abandon()
        raise RecordingError(
            f"cannot write {path}: {error.strerror}", "make room on the disk", "cannot_write"
        ) from error


def _as_text(facts: dict[str, str]) -> dict[str, str]:
    """Facts whose values have bytes of a file's name that are no text: each becomes a question."""
    return {name: value.encode("utf-8", "replace").decode() for name, value in facts.items()}


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
        self.queued_bytes = 0  # what waits for the disk
        self._has_ended = False
        self._is_told = False
        self._synced_s = self._begin_s
        self._syncing: threading.Thread | None = None
        self._sync_error: OSError | None = None

    @property
    def age_s(self) -> float:
        """How long ago the first of it was written, or the file begun."""
        return time.monotonic() - self._begin_s

    def add(self, *entries: Entry) -> bool:
        """Add entries in order, all or none; never waits. False: it takes no more."""
        size = sum(len(entry.data) + ENTRY_BYTES for entry in entries)
        with self._lock:
            if self._has_ended or self.is_overflowed:
                return False
            if self.queued_bytes + size > MAX_QUEUED_BYTES:
                self.is_overflowed = True
                return False
            self._entries += entries
            self.queued_bytes += size
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
            self.queued_bytes -= sum(len(entry.data) + ENTRY_BYTES for entry in entries)

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
            self._entries, self.queued_bytes = [], 0
        self._writer.abandon()

    @property
    def is_deleted(self) -> bool:
        """Whether somebody has deleted the file."""
        return self._writer.is_deleted
