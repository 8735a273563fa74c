"""A mock serial port that says again what a recorded one said: ``replay:///path.mcap?port=0``.

The path may also be a folder of recordings that a daemon has cut, see `recording_set`.

Options of the URL:

``port``
    which of the recorded ports, from 0 (the default);
``speed``
    1 (as recorded, the default), another factor, or 0 for as fast as it is taken.

Reading returns the bytes of one recorded read after another, each at its time, then raises
`ReplayEnded`, and `ReplayMoved` where what comes next is from elsewhere. What is written to the
port goes nowhere: a recording does not answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from serial import PortNotOpenError, SerialBase, SerialException

from tactomo.recordings.playback import Playback
from tactomo.recordings.recording import Chunk, Recording
from tactomo.recordings.replay import parse_replay_url

_WAIT_FOR_EVER_S: Final = 1e9


class ReplayEnded(SerialException):
    """Every recorded byte has been read."""


class ReplayMoved(SerialException):
    """The next bytes do not go on from those before; in `args`, the number of the pass."""


class ReplayPort(SerialBase):
    """The port itself."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.clock_ns = 0  # when the bytes of the last read came, on the recording's steady clock
        self._chunks: Iterator[Chunk] = iter(())
        self._next: Chunk | None = None
        self._rest = b""  # of the chunk whose time has come
        self._recording: Recording
        self._number = 0
        self._pass = 0
        self._has_ended = False
        self.playback: Playback  # the replay's time; one of its own unless it is given another
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Open the recording; raise PortError or RecordingError where that cannot be done."""
        self._recording, self._number, speed = parse_replay_url(self.port or "")
        self.playback = Playback(self._recording.start_ns, self._recording.end_ns, speed)
        self._pass = 0
        self._read_from(0)
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
            ReplayEnded: every byte has been read; raised once, then nothing comes.
            ReplayMoved: the replay was moved.
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

    def _read_from(self, clock_ns: int) -> None:
        self._chunks = self._recording.chunks(self._number, clock_ns)
        self._next = next(self._chunks, None)
        self._rest, self._has_ended = b"", False

    def _wait_for_chunk(self) -> bytes:
        """Return the next chunk's bytes once they are due; none if that takes too long."""
        playback, chunk = self.playback, self._next
        if self._pass != playback.passes:
            self._pass = playback.passes
            self._read_from(playback.begin_ns)
            raise ReplayMoved(self._pass)
        if chunk is None and not self._has_ended:
            self._has_ended = True
            raise ReplayEnded("the recording has ended")
        timeout_s = _WAIT_FOR_EVER_S if self.timeout is None else self.timeout
        due_ns = None if chunk is None else chunk.clock_ns
        if not playback.wait_until_due(due_ns, timeout_s, self._pass) or chunk is None:
            return b""
        self.clock_ns, data = chunk
        self._next = next(self._chunks, None)
        return data

    def _reconfigure_port(self) -> None:
        """Nothing to configure; pyserial calls it when a setting changes on an open port."""
