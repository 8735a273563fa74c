"""A mock serial port that says again what a recorded one said: ``replay:///path.mcap?port=0``.

The path may also be a folder of recordings that a daemon has cut, see `recording_set`.

Options of the URL:

``port``
    which of the recorded ports, from 0 (the default);
``speed``
    1 (as recorded, the default), another factor, or 0 for as fast as it is taken.

Reading returns the bytes of one recorded read after another, each at its time, then raises
`ReplayEnded`. What is written to the port goes nowhere: a recording does not answer.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, Final

from serial import PortNotOpenError, SerialBase, SerialException

from tactomo.recordings.recording import Chunk
from tactomo.recordings.replay import parse_replay_url

_WAIT_FOR_EVER_S: Final = 1e9


class ReplayEnded(SerialException):
    """Every recorded byte has been read."""


class ReplayPort(SerialBase):
    """The port itself.

    Attributes:
        clock_ns: when the bytes of the last read came, on the recording's steady clock.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.clock_ns = 0
        self._chunks: Iterator[Chunk] = iter(())
        self._next: Chunk | None = None
        self._rest = b""  # of the chunk whose time has come
        self._speed = 1.0
        self._start_ns = 0
        self._first_read_ns: int | None = None
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Open the recording; raise PortError or RecordingError where that cannot be done."""
        recording, port, self._speed = parse_replay_url(self.port or "")
        self._chunks = recording.chunks(port)
        self._next = next(self._chunks, None)
        self._rest, self._first_read_ns = b"", None
        self._start_ns = recording.start_ns
        self.is_open = True

    def close(self) -> None:
        """Close the recording."""
        self._chunks, self._next, self._rest = iter(()), None, b""
        self.is_open = False

    @property
    def in_waiting(self) -> int:
        """Bytes that a read would return at once, as far as the recorded read goes."""
        return len(self._rest)

    def read(self, size: int = 1, /) -> bytes:
        """Return up to `size` bytes of one recorded read; nothing if `timeout` runs out first.

        Raises:
            ReplayEnded: every byte has been read.
            PortNotOpenError: the port is closed.
        """
        if not self.is_open:
            raise PortNotOpenError
        if not self._rest and size > 0:
            self._rest = self._wait_for_chunk()
        data, self._rest = self._rest[:size], self._rest[size:]
        return data

    def write(self, data: Any, /) -> int:
        """Take `data` and do nothing with it."""
        return len(data)

    def reset_input_buffer(self) -> None:
        """Do nothing: what was recorded is to be heard."""

    def reset_output_buffer(self) -> None:
        """Do nothing: nothing is ever sent."""

    def _wait_for_chunk(self) -> bytes:
        """Return the next chunk's bytes once they are due; none if that takes too long."""
        if self._next is None:
            raise ReplayEnded("the recording has ended")
        timeout_s = _WAIT_FOR_EVER_S if self.timeout is None else self.timeout
        wait_s = self._due_in_s(self._next)
        if wait_s > 0:
            time.sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            return b""
        self.clock_ns, data = self._next
        self._next = next(self._chunks, None)
        return data

    def _due_in_s(self, chunk: Chunk) -> float:
        if self._speed == 0:
            return 0.0
        # Counted from the first read on, not from opening, so that two ports of one recording,
        # opened one after the other and then read together, keep time with each other.
        if self._first_read_ns is None:
            self._first_read_ns = time.monotonic_ns()
        due_ns = (chunk.clock_ns - self._start_ns) / self._speed
        return (self._first_read_ns + due_ns - time.monotonic_ns()) * 1e-9

    def _reconfigure_port(self) -> None:
        """Nothing to configure; pyserial calls it when a setting changes on an open port."""
