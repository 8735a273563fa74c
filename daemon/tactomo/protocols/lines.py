"""Lines of numbers: what the protocols of boards that print their readings have in common.

What comes before the first line end is the rest of a line whose start was missed; it is dropped
and not counted. A line that never ends is dropped once it is longer than any frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np
from tactomo_models.arrays import FloatArray

from tactomo.protocols.interface import ForeignProtocol, Reading, Trouble

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

MAX_LINE_BYTES: Final = 65_536
LONGEST_WORDS: Final = 200  # bytes of a banner's or a menu's line; what is longer was to be numbers
SURE_LINES: Final = 3
"""In a row that do not fit in the same way: no damage, but another board than is described."""
_SEPARATORS: Final = re.compile(rb"[,;\s]+")
_PREFIX: Final = re.compile(rb"[A-Za-z][\w .-]*[:=]")


class LineProtocol(ForeignProtocol):
    """A board that prints; a subclass says what a line means."""

    def __init__(self, description: SensorDescription) -> None:
        super().__init__(description)
        self._line = bytearray()
        self._is_dropping = True  # until the next line end
        self._misfits: tuple[Trouble | None, int] = (None, 0)

    def take(self, line: bytes) -> Reading | None:
        """Return the reading that a line completes, if it does; counts what it makes of it."""
        raise NotImplementedError

    def rows_begun(self) -> list[bytes]:
        """Return the lines of a reading of several that is not complete."""
        return []

    def parse(self, data: bytes) -> Iterator[Reading]:
        """See `ForeignProtocol`."""
        start = 0
        while (end := data.find(b"\n", start)) >= 0:
            self._collect(data[start:end])
            line, self._line = bytes(self._line), bytearray()
            was_dropping, self._is_dropping = self._is_dropping, False
            reading = None if was_dropping else self.take(line.strip())
            if reading is not None:
                yield reading
            start = end + 1
        self._collect(data[start:])

    def begun(self) -> bytes:
        """See `ForeignProtocol`; the first line end keeps the rest from being dropped."""
        if self._is_dropping:
            return b""
        return b"".join(line + b"\n" for line in chain([b""], self.rows_begun())) + self._line

    def restart(self) -> None:
        """See `PortProtocol`."""
        super().restart()
        self._drop()

    def understood(self, volts: FloatArray) -> Reading:
        """Return a reading of what fits."""
        self.counts.packets += 1
        self.trouble, self._misfits = None, (None, 0)
        return Reading(volts * self.description.instrument.volts_per_unit)

    def words(self, line: bytes) -> None:
        """Take note of a line that is no reading: something that is said to people, or damage."""
        if len(line) <= LONGEST_WORDS and line.isascii() and line.decode().isprintable():
            self.counts.packets += 1
        else:
            self.counts.unreadable += 1

    def misfit(self, cause: str, next_step: str) -> None:
        """Take note of a reading that is whole, but not of the sensor described."""
        self.counts.malformed += 1
        trouble = Trouble(cause, next_step)
        last, count = self._misfits
        self._misfits = (trouble, count + 1 if trouble == last else 1)
        if self._misfits[1] >= SURE_LINES:
            self.trouble = trouble

    def _collect(self, data: bytes) -> None:
        if self._is_dropping:
            return
        self._line += data
        if len(self._line) > MAX_LINE_BYTES:
            self.counts.oversize += 1
            self._drop()

    def _drop(self) -> None:
        """Forget the line that has begun, and what is still to come of it."""
        self._line.clear()
        self._is_dropping = True


def numbers(line: bytes) -> FloatArray | None:
    """Return the numbers of a line, after a prefix such as `magnitudes:`; None for other lines.

    They are separated by commas, semicolons or white space, also at the end.
    """
    prefix = _PREFIX.match(line)
    fields = _SEPARATORS.split(line[prefix.end() :] if prefix else line)
    try:
        values = [float(field) for field in fields if field]
    except ValueError:
        return None
    return np.array(values) if values else None


def electrodes_of(count: int) -> str:
    """Say whose frame so many numbers are, likely; empty where they are of no usual one."""
    touching = {"every drive by every pair": 0, "adjacent drive": 3, "opposite drive": 4}
    found = [
        f"{n} electrodes ({words})"
        for words, left_out in touching.items()
        for n in (8, 16, 32)
        if n * (n - left_out) == count
    ]
    return ", as of " + " or ".join(found) if found else ""
