"""Recovering a recording: whatever is intact in a cut or damaged file becomes a whole new one.

Every chunk that its CRC confirms is kept, also beyond damage in the middle. What a replay of the
new file gives is what the live run gave, with two exceptions that follow from what is lost: after
a gap the reconstruction starts cold, and frames whose reference, calibration or scans lay in the
gap have no marks any more, so that they are absent rather than wrong.
"""

from __future__ import annotations

import io
import os
import struct
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import IO, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Header, Message, Metadata
from mcap.stream_reader import StreamReader
from tactomo_client.recording_file import CHANNELS, PROFILE, intact_chunks
from tactomo_models.archive import part_of
from tactomo_protocol import SCAN_COUNTERS, Channel, Scan

from tactomo.errors import RecordingError
from tactomo.protocols import PortProtocol
from tactomo.recordings.record_fields import read_reference_number
from tactomo.recordings.recording import RECOVERED, Origin, open_file, open_recording, to_origin
from tactomo.recordings.recording_writer import RecordingWriter, pack_frame
from tactomo.recordings.records import read_calibration, read_frame
from tactomo.scans import ScanKey

_REMEMBERED_SCANS: Final = 1024
_NAME: Final = struct.pack("<I", len(PROFILE)) + PROFILE.encode()
_BEGINNING_BYTES: Final = 1 << 16
_RECORD_HEAD: Final = struct.Struct("<BQ")
_MAX_MISSING: Final = 1 << 20
"""A step of a counter beyond this is a restart of the device, not a gap."""


@dataclass(slots=True)
class Gap:
    """A part of the file that is lost, between what was kept before it and after it."""

    seconds: float = 0.0
    scans: dict[Channel, int] = field(default_factory=dict)
    """Those that are missing by their counters; none where a counter began anew."""


@dataclass(slots=True)
class Recovery:
    """What was kept of a damaged recording, and what was lost."""

    path: Path  # the new file
    origin: Origin
    knows_origin: bool = True  # whether the damaged file still said what it is of
    lost_bytes: int = 0  # of the damaged file, counted without what any recording has for its index
    gaps: list[Gap] = field(default_factory=list)
    """Where something is missing between the first and the last that was kept."""
    is_cut: bool = False  # whether the end is missing; nobody can tell how much of it
    frames_lost: int = 0
    """Reconstructed dual scans after a gap whose reference, calibration or scans are lost."""

    @property
    def is_intact(self) -> bool:
        """Whether nothing was lost."""
        return self.knows_origin and not (self.gaps or self.is_cut)


def recover(
    damaged: Path,  # the recording; a whole one is copied
    output: Path,  # the file to write; it appears when it is complete, and nothing is written over
    progress: Callable[[int, int], None] = lambda *_: None,  # called with the bytes done and in all
) -> Recovery:
    """Write what is intact in `damaged` to a new file, with an index; `damaged` stays as it is.

    Raises RecordingError where there is nothing of a recording in `damaged`, it cannot be read, or
    `output` exists or cannot be written.
    """
    part = part_of(output)
    with open_file(damaged) as file:
        _refuse_existing(output)
        origin = _read_origin(damaged, file)
        try:
            salvage = _Salvage(file, part, origin or _guess_origin(file), progress)
            salvage.run()
            output.open("xb").close()  # a rename would write over what has come there meanwhile
            part.replace(output)
        except FileExistsError:
            _refuse_existing(output)
        except OSError as error:
            raise RecordingError(
                f"cannot recover {damaged} to {output}: {error.strerror}",
                "check that the damaged file can be read and that the disk has room for the new "
                "one; if the disk itself fails, copy the file with ddrescue first",
            ) from error
        finally:
            part.unlink(missing_ok=True)
    return replace(salvage.recovery, path=output, knows_origin=origin is not None)


def _refuse_existing(output: Path) -> None:
    if output.exists():
        raise RecordingError(f"{output} exists already", "give another path with -o")


class _Salvage:
    """One pass over a damaged file into a new one."""

    def __init__(
        self, file: IO[bytes], part: Path, origin: Origin, progress: Callable[[int, int], None]
    ) -> None:
        self.recovery = Recovery(part, origin)
        self._file = file
        self._progress = progress
        self._writer = RecordingWriter(part, origin)
        self._topics = dict(enumerate(CHANNELS, 1))
        self._decoders: defaultdict[int, PortProtocol] = defaultdict(origin.new_protocol)
        self._scans: deque[ScanKey] = deque(maxlen=_REMEMBERED_SCANS)
        self._counters: dict[Channel, int] = {}
        self._time_ns: int | None = None  # of the newest bytes of a port
        self._reference: int | None = None
        self._calibration = 0
        self._open_gap: Gap | None = None  # whose other side in time has not been reached
        self._open_gap_of: dict[Channel, Gap] = {}  # likewise by each channel's counter
        self._starts_cold = False

    def run(self) -> None:
        try:
            self._keep_chunks()
            gaps = len(self.recovery.gaps) + self.recovery.is_cut
            self._writer.note(RECOVERED, {"gaps": str(gaps), "from": self._file.name})
            self._writer.close()
        finally:
            self._writer.abandon()

    def _keep_chunks(self) -> None:
        size = os.fstat(self._file.fileno()).st_size
        end: int | None = None
        for chunk in intact_chunks(self._file):
            if end is None and not chunk.channels:  # the first chunk of all has them
                self._begin_gap(chunk.start)
            elif end is not None and chunk.start != end:
                self._begin_gap(chunk.start - end)
            self._topics |= {channel.id: channel.topic for channel in chunk.channels}
            for message in chunk.messages:
                self._keep(message)
            end = chunk.end_of_index
            self._progress(end, size)
        if end is None:
            raise RecordingError(
                f"there is nothing of a recording in {self._file.name}",
                "give the path of a recording that tactomo made",
            )
        self.recovery.is_cut = not _ends_well(self._file, end)
        if self.recovery.is_cut:
            self.recovery.lost_bytes += max(0, size - end)

    def _begin_gap(self, lost_bytes: int) -> None:
        self.recovery.lost_bytes += max(0, lost_bytes)
        if lost_bytes <= 0:
            return
        gap = Gap()
        self.recovery.gaps.append(gap)
        self._open_gap = gap
        self._open_gap_of = dict.fromkeys(self._counters, gap)
        self._starts_cold = True

    def _keep(self, message: Message) -> None:
        topic = self._topics.get(message.channel_id, "")
        if topic not in CHANNELS:
            return
        data: bytes | None = message.data
        kind, _, rest = topic.partition("/")
        if kind == "port":
            self._follow(int(rest.partition("/")[0]), message)
        elif kind == "reference":
            self._reference = read_reference_number(message.data)
        elif kind == "calibration":
            self._calibration = read_calibration(message.data).number
        elif kind == "frame" and self.recovery.gaps:
            data = self._mend(message.data)
        if data is not None:
            self._writer.write(topic, data, message.log_time, message.publish_time)

    def _follow(self, port: int, message: Message) -> None:
        """Note times and scans, and how much of them a gap took."""
        if self._open_gap is not None and self._time_ns is not None:
            self._open_gap.seconds = max(0.0, (message.log_time - self._time_ns) * 1e-9)
        self._open_gap = None
        self._time_ns = message.log_time
        for packet in self._decoders[port].feed(message.data):
            if isinstance(packet, Scan):
                self._note_scan(packet)

    def _note_scan(self, scan: Scan) -> None:
        self._scans.append(ScanKey(scan.channel, scan.counter, scan.device_us))
        gap = self._open_gap_of.pop(scan.channel, None)
        if gap is not None:
            missing = (scan.counter - self._counters[scan.channel] - 1) % SCAN_COUNTERS
            if missing < _MAX_MISSING:
                gap.scans[scan.channel] = missing
        self._counters[scan.channel] = scan.counter

    def _mend(self, data: bytes) -> bytes | None:
        """Return what a mark after a gap says now; None where a replay could not follow it."""
        mark = read_frame(data)
        in_force = (mark.reference_number, mark.calibration_number)
        is_known = in_force == (self._reference, self._calibration)
        if not is_known or not all(key in self._scans for key in mark.scans):
            self.recovery.frames_lost += 1
            return None
        if self._starts_cold:
            mark, self._starts_cold = replace(mark, is_cold=True), False
        return pack_frame(mark)


def _ends_well(file: IO[bytes], end: int) -> bool:
    """Whether the data section is closed after its last chunk, as by a writer that finished."""
    file.seek(end)
    while len(head := file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode != Opcode.METADATA:
            return bool(opcode == Opcode.DATA_END)
        file.seek(length, os.SEEK_CUR)
    return False


def _read_origin(path: Path, file: IO[bytes]) -> Origin | None:
    """Return what a damaged file still says that it is of; None where it does not any more.

    Raises RecordingError where it says that another program made it.
    """
    try:
        return open_recording(path).origin
    except RecordingError:
        origin = _find_origin(file)
        if origin is None and _read_profile(file) not in (None, PROFILE):
            raise
        return origin


def _find_origin(file: IO[bytes]) -> Origin | None:
    """Look for the record that says it, whatever stands around it."""
    file.seek(0)
    beginning = file.read(_BEGINNING_BYTES)
    at = beginning.find(_NAME)
    if at < 0:
        return None
    try:
        record = Metadata.read(ReadDataStream(io.BytesIO(beginning[at:])))
    except Exception:  # damage can fail in any layer
        return None
    return to_origin(record.metadata)


def _read_profile(file: IO[bytes]) -> str | None:
    """Return who a file's header says that it is for; None where there is no header."""
    file.seek(0)
    try:
        header = next(iter(StreamReader(file).records), None)
    except Exception:  # damage can fail in any layer
        return None
    return header.profile if isinstance(header, Header) else None


def _guess_origin(file: IO[bytes]) -> Origin:
    """Return what can be said of a recording that has lost its beginning: its ports."""
    topics = dict(enumerate(CHANNELS, 1))
    has_second = False
    for chunk in intact_chunks(file):
        topics |= {channel.id: channel.topic for channel in chunk.channels}
        has_second |= any(topics.get(m.channel_id) == "port/1" for m in chunk.messages)
        if has_second:
            break
    ports = ("unknown", "unknown") if has_second else ("unknown",)
    return Origin(ports=ports, version=version("tactomo"))
