"""Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): bytes without a zero, and back.

Each block is a code and code - 1 bytes that are not zero; a zero follows where the code is below
255 and the block is not the last one.
"""

from __future__ import annotations

_RUN = 254  #: bytes without a zero that a block holds at most


def max_encoded_length(size: int) -> int:
    """Return the most bytes that `size` bytes are encoded to."""
    return size + max(1, -(-size // _RUN))


def encode(data: bytes) -> bytes:
    """Return `data` without zeros."""
    out = bytearray()
    *runs, last = data.split(b"\0")
    for run in runs:
        while len(run) >= _RUN:
            out += b"\xff" + run[:_RUN]
            run = run[_RUN:]
        out.append(len(run) + 1)
        out += run
    while len(last) > _RUN:
        out += b"\xff" + last[:_RUN]
        last = last[_RUN:]
    out.append(len(last) + 1)
    return bytes(out + last)


def decode(encoded: bytes) -> bytes:
    """Return what was encoded; `encoded` holds no zero and is not empty.

    Raises:
        ValueError: a block reaches beyond the end.
    """
    out, at, size = bytearray(encoded), 0, len(encoded)
    full = []  # ends of blocks that no zero follows
    while at < size:
        code = out[at]
        out[at] = 0  # the zero behind the block before
        at += code
        if code > _RUN:
            full.append(at)
    if at > size:
        raise ValueError("a block reaches beyond the end")
    for end in reversed(full):
        del out[end : end + 1]
    return bytes(out[1:])
