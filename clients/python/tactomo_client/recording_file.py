"""A recording's file: what is in it by name, and reading it record by record, damaged or not.

The layout is that of the daemon, which writes and replays recordings through the names here;
docs/files.md says what each topic holds. For frames, see `tactomo_client.recording`. Beyond
damage, `intact_chunks` finds what its checksum confirms.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Final, NamedTuple

try:
    import zstandard
    from mcap.exceptions import InvalidMagic
    from mcap.reader import make_reader
    from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata
    from mcap.stream_reader import StreamReader, breakup_chunk
    from mcap.summary import Summary
except ImportError as error:
    raise ImportError(
        "reading recordings needs mcap and zstandard: pip install 'tactomo-client[recording]'"
    ) from error

from tactomo_client.errors import RecordingError, open_regular

PROFILE: Final = "tactomo"
CHANNELS: Final[Mapping[str, str]] = {
    "reference": "msgpack",
    "frame": "msgpack",
    "map": "tactomo-stream",
    "contacts": "tactomo-stream",
    "scan": "tactomo-stream",
    **{
        f"port/{port}{hello}": "application/octet-stream"
        for port in (0, 1)
        for hello in ("", "/hello")
    },
    "calibration": "msgpack",
}
"""Encoding of each topic, in the order of their MCAP channel numbers from 1."""
ROTATED_NAME: Final = r"(?P<sensor>.+)-(?P<number>\d{6,})-(?P<begin>\d{8}T\d{6}Z)\.mcap"
"""What the files of a folder are called; the number rises by one with each."""
ENDLESS_NS: Final = 2**63


class Span(NamedTuple):
    """When a recording began and ended, on its steady clock; 0 where nothing is in it."""

    start_ns: int
    end_ns: int
    is_complete: bool


def open_file(path: Path) -> IO[bytes]:
    """Open a recording's file as it is; raise RecordingError where that cannot be done."""
    try:
        return open_regular(path)
    except OSError as error:
        raise RecordingError(
            f"cannot open the recording {path}: {error.strerror}", "give the path of a .mcap file"
        ) from error


def records(
    path: Path,
    on_damage: Callable[[int], None] = lambda _: None,
    wants: Callable[[Chunk], bool] = lambda _: True,
) -> Iterator[tuple[str, McapRecord]]:
    """Yield the file's records up to its end or to the first damage; messages with their topic.

    Args:
        path: the file.
        on_damage: told where the last thing that could be read ends.
        wants: whether a chunk is to be unpacked; the first one is in any case, for it names topics.

    Raises:
        RecordingError: the file cannot be opened, or is no MCAP file.
    """
    topics: dict[int, str] = {}
    with open_file(path) as file:
        reader = StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES
        )
        found = iter(reader.records)
        end = 0
        while True:
            try:
                inside = _inside(next(found), lambda chunk: not topics or wants(chunk))
            except StopIteration:
                return
            except InvalidMagic as error:
                if not end:
                    raise _not_a_recording(path, "is not an MCAP file") from error
                on_damage(end)  # it is the closing one that is cut off
                return
            except Exception:  # damage can fail in any layer: disk, struct, zstd, utf-8, CRC
                on_damage(end)
                return
            end = file.tell()
            for each in inside:
                if isinstance(each, Channel):
                    topics[each.id] = each.topic
                yield topics.get(getattr(each, "channel_id", 0), ""), each


def _inside(record: McapRecord, wants: Callable[[Chunk], bool]) -> list[McapRecord]:
    if not isinstance(record, Chunk):
        return [record]
    return unpack_chunk(record) if wants(record) else []


def messages(
    path: Path,
    kind: str,
    start_ns: int = 0,
    end_ns: int = ENDLESS_NS,
    tell: Callable[[str], None] = lambda _: None,
) -> Iterator[Message]:
    """Yield a file's messages of a kind and a time, those beyond damage, too."""

    def overlaps(chunk: Chunk) -> bool:
        return chunk.message_start_time < end_ns and chunk.message_end_time >= start_ns

    damaged_at: list[int] = []
    for topic, record in records(path, damaged_at.append, overlaps):
        if topic == kind and isinstance(record, Message) and start_ns <= record.log_time < end_ns:
            yield record
    if damaged_at:
        tell(f"{path} is cut off or damaged; `tactomo recover` makes it whole for other tools")
        for topic, record in messages_beyond(path, damaged_at[0]):
            if topic == kind and start_ns <= record.log_time < end_ns:
                yield record


def messages_beyond(path: Path, start: int) -> Iterator[tuple[str, Message]]:
    """Yield what intact chunks hold from a place in the file on, each with its topic."""
    topics = dict(enumerate(CHANNELS, 1))
    with open_file(path) as file:
        for chunk in intact_chunks(file, start):
            topics |= {channel.id: channel.topic for channel in chunk.channels}
            for message in chunk.messages:
                yield topics.get(message.channel_id, ""), message


def read_metadata(path: Path) -> Mapping[str, str]:
    """Return what the recording in a file says of itself.

    Raises:
        RecordingError: the file cannot be opened, or is no recording of tactomo's.
    """
    header = None
    for _, record in records(path):
        if isinstance(record, Header):
            header = record
        elif isinstance(record, Metadata) and record.name == PROFILE:
            if header is not None and header.profile == PROFILE:
                return record.metadata
            break
    raise _not_a_recording(path, "is no recording that tactomo made")


def read_span(path: Path) -> Span:
    """Return when the recording in a file began and ended, without reading what is in it."""
    index = read_index(path)
    if index is not None and index.statistics is not None:
        known = index.statistics
        return Span(known.message_start_time, known.message_end_time, True)
    times: list[tuple[int, int]] = []
    with open_file(path) as file, suppress(Exception):  # up to the damage
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                times.append((record.message_start_time, record.message_end_time))
    return Span(times[0][0] if times else 0, times[-1][1] if times else 0, False)


def read_index(path: Path) -> Summary | None:
    """Return the index at the end of a file, with its statistics; None where it was cut off."""
    with open_file(path) as file, suppress(Exception):  # damage can fail in any layer
        index = make_reader(file).get_summary()
        return index if index is not None and index.statistics is not None else None
    return None


def _not_a_recording(path: Path, reason: str) -> RecordingError:
    return RecordingError(
        f"{path} {reason}",
        "record one with `tactomo record`, or make one of .npz scans with `tactomo import`",
    )


MAX_RECORD_BYTES: Final = 32 << 20  #: of a record, and of what a chunk is unpacked to
_MARK: Final = b"\x04\0\0\0zstd"
_BEFORE_MARK: Final = 37
_HEADER: Final = struct.Struct("<BQQQQI8sQ")
_WINDOW_BYTES: Final = 1 << 20
_RECORD_HEAD: Final = struct.Struct("<BQ")
_MAX_WASTE: Final = 4  #: times the file's size that may be unpacked in vain
_LEAST_WASTE: Final = 4 * MAX_RECORD_BYTES


class IntactChunk(NamedTuple):
    """A chunk, with where it lies in the file."""

    start: int
    end: int
    #: Where its message indexes end and the next chunk begins, if nothing is damaged
    end_of_index: int
    messages: list[Message]
    channels: list[Channel]


def intact_chunks(file: IO[bytes], start: int = 0) -> Iterator[IntactChunk]:
    """Yield every chunk from `start` on that its CRC confirms.

    Raises:
        OSError: the disk cannot read it.
    """
    waste = max(_LEAST_WASTE, _MAX_WASTE * file.seek(0, os.SEEK_END))
    end = 0  # of what was intact
    for mark in _marks(file, start + _BEFORE_MARK):
        chunk = _read_chunk(file, mark - _BEFORE_MARK)
        if chunk is None:
            continue
        is_new = mark >= end
        try:
            found = _intact(mark - _BEFORE_MARK, chunk)
        except Exception:  # damage can fail in any layer: zstd, memory, CRC, struct, utf-8
            is_new = False
        else:
            end = max(end, found.end)
            yield found
        if not is_new:  # such may lie one in the other, and each is unpacked to its end
            waste -= max(len(chunk.data), chunk.uncompressed_size)
            if waste < 0:
                return


def _marks(file: IO[bytes], position: int) -> Iterator[int]:
    """Yield where marks are, each once.

    Those inside an intact chunk, too: zstd does not mind more than its data, so a damaged length
    may reach into the next chunk.
    """
    tail = b""
    while True:
        file.seek(position)
        more = file.read(_WINDOW_BYTES)
        if not more:
            return
        window = tail + more
        at = window.find(_MARK)
        while at >= 0:
            yield position - len(tail) + at
            at = window.find(_MARK, at + 1)
        position += len(more)
        tail = window[-len(_MARK) + 1 :]


def _read_chunk(file: IO[bytes], start: int) -> Chunk | None:
    """Return what looks like a chunk that begins at `start`; None where nothing does."""
    file.seek(start)
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    _, _, start_ns, end_ns, uncompressed, crc, _, size = _HEADER.unpack(header)
    if not crc or max(size, uncompressed) > MAX_RECORD_BYTES:
        return None
    if file.read(len(zstandard.FRAME_HEADER)) != zstandard.FRAME_HEADER:
        return None
    file.seek(start + len(header))
    return Chunk("zstd", file.read(size), end_ns, start_ns, crc, uncompressed)


def _intact(start: int, chunk: Chunk) -> IntactChunk:
    """Return a chunk with what is in it; raises anything at all where it is damaged."""
    records = unpack_chunk(chunk)
    end = start + _HEADER.size + len(chunk.data)
    messages = [record for record in records if isinstance(record, Message)]
    channels = [record for record in records if isinstance(record, Channel)]
    index_bytes = 15 * len({message.channel_id for message in messages}) + 16 * len(messages)
    return IntactChunk(start, end, end + index_bytes, messages, channels)


def unpack_chunk(chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk; raises anything at all where it is damaged.

    A few kilobytes may claim to be gigabytes: what unpacks to more than a record's bound is damage,
    and so is a compression that our recordings do not use. They may hold millions of records, too:
    no record of ours, with a time of its own, is packed into less than a byte.
    """
    size = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else 0
    if (
        chunk.compression not in ("", "zstd")
        or max(size, chunk.uncompressed_size) > MAX_RECORD_BYTES
    ):
        raise ValueError("not a chunk of ours")
    unpacked = chunk.data
    if chunk.compression:
        unpacked = zstandard.decompress(chunk.data, chunk.uncompressed_size)
    position, records = 0, 0
    while position < len(unpacked) and records <= len(chunk.data):
        position += _RECORD_HEAD.size + _RECORD_HEAD.unpack_from(unpacked, position)[1]
        records += 1
    if records > len(chunk.data):
        raise ValueError("more records than a recording of ours packs into so little")
    plain = replace(chunk, compression="", data=unpacked)
    return breakup_chunk(plain, validate_crc=True)
