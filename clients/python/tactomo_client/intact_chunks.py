"""The intact chunks of an MCAP file that may be damaged anywhere.

MCAP's own reader goes from record to record by their lengths, so it ends at the first damage.
Here, chunks are found by what they look like, and each is checked by its own CRC-32. One that was
compressed by zstd, as all of ours are, looks like this (lengths in bytes)::

    06 | length 8 | start 8 | end 8 | full size 8 | crc 4 | 04 00 00 00 "zstd" | size 8 | data

After it come its message indexes, one for each channel in it, which nothing here needs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO, Final, NamedTuple

import zstandard
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import breakup_chunk

MAX_RECORD_BYTES: Final = 64 << 20  #: of a record, and of what a chunk is unpacked to
_MARK: Final = b"\x04\0\0\0zstd"
_BEFORE_MARK: Final = 37
_HEADER: Final = struct.Struct("<BQQQQI8sQ")
_WINDOW_BYTES: Final = 1 << 20


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
    while (mark := _find_mark(file, start)) is not None:
        found = _read_chunk(file, mark - _BEFORE_MARK)
        if found is not None:
            yield found
        # Not from its end on: zstd does not mind more than its data, so a damaged length may reach
        # into the next chunk.
        start = mark + 1 - _BEFORE_MARK


def _find_mark(file: IO[bytes], start: int) -> int | None:
    """Return where the next mark is, with room for what comes before it."""
    position = start + _BEFORE_MARK
    file.seek(position)
    window = b""
    while more := file.read(_WINDOW_BYTES):
        window = window[-len(_MARK) + 1 :] + more
        position += len(more)
        at = window.find(_MARK)
        if at >= 0:
            return position - len(window) + at
    return None


def _read_chunk(file: IO[bytes], start: int) -> IntactChunk | None:
    """Return the chunk that begins at `start`; None where there is none, or a damaged one."""
    file.seek(start)
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    _, _, start_ns, end_ns, uncompressed, crc, _, size = _HEADER.unpack(header)
    if not crc or max(size, uncompressed) > MAX_RECORD_BYTES:
        return None
    data = file.read(size)
    chunk = Chunk("zstd", data, end_ns, start_ns, crc, uncompressed)
    try:
        records = unpack_chunk(chunk)
    except Exception:  # damage can fail in any layer: zstd, memory, CRC, struct, utf-8
        return None
    end = start + len(header) + len(data)
    messages = [record for record in records if isinstance(record, Message)]
    channels = [record for record in records if isinstance(record, Channel)]
    return IntactChunk(start, end, end + _index_bytes(messages), messages, channels)


def _index_bytes(messages: list[Message]) -> int:
    """Return the length of a chunk's message indexes."""
    return 15 * len({message.channel_id for message in messages}) + 16 * len(messages)


def unpack_chunk(chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk; raises anything at all where it is damaged.

    A few kilobytes may claim to be gigabytes: what unpacks to more than a record's bound is damage,
    and so is a compression that our recordings do not use.
    """
    size = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else 0
    if (
        chunk.compression not in ("", "zstd")
        or max(size, chunk.uncompressed_size) > MAX_RECORD_BYTES
    ):
        raise ValueError("not a chunk of ours")
    return breakup_chunk(chunk, validate_crc=True)
