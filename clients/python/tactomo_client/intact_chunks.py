"""The intact chunks of an MCAP file that may be damaged anywhere.

MCAP's own reader goes from record to record by their lengths, so it ends at the first damage.
Here, chunks are found by what they look like, and each is checked by its own CRC-32. One that was
compressed by zstd, as all of ours are, looks like this (lengths in bytes)::

    06 | length 8 | start 8 | end 8 | full size 8 | crc 4 | 04 00 00 00 "zstd" | size 8 | data

After it come its message indexes, one for each channel in it, which nothing here needs.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import IO, Final, NamedTuple

import zstandard
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import breakup_chunk

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
    return IntactChunk(start, end, end + _index_bytes(messages), messages, channels)


def _index_bytes(messages: list[Message]) -> int:
    """Return the length of a chunk's message indexes."""
    return 15 * len({message.channel_id for message in messages}) + 16 * len(messages)


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
