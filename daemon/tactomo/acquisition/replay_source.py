"""A source that says again what a recorded port said: ``replay:///path.mcap?port=0``.

Options of the URL:

``port``
    which of the recorded ports, from 0 (the default);
``speed``
    1 (as recorded, the default), another factor, or 0 for as fast as it is taken.

Reading returns the bytes of one recorded read after another, each at its time. What is written goes
nowhere: a recording does not answer.
"""

from __future__ import annotations

from collections.abc import Iterator

from tactomo.acquisition.open_serial import READ_TIMEOUT_S
from tactomo.recordings.playback import Playback
from tactomo.recordings.recording import Chunk, Recording
from tactomo.recordings.replay import parse_replay_url


class ReplaySource:
    """A recorded port, to be used as a `Connection` is."""

    def __init__(self, url: str, playback: Playback) -> None:
        self.is_open = self.has_ended = False
        self.problem = ""
        self.moved = 0  # how often what comes next has not gone on from what came before
        self.latency_timer_ms: int | None = None
        self._url = url
        self._playback = playback  # the replay's time
        self._recording: Recording
        self._number = 0
        self._clock_ns = 0
        self._chunks: Iterator[Chunk] = iter(())
        self._next: Chunk | None = None

    def open(self) -> None:
        """Open the recording; raise PortError or RecordingError where that cannot be done."""
        self._recording, self._number, _ = parse_replay_url(self._url)
        self._read_from(0)
        self.is_open = True

    def try_open(self) -> bool:
        """Open the recording, which the daemon has read before."""
        self.open()
        return True

    def close(self) -> None:
        """Close the recording."""
        self._chunks, self._next = iter(()), None
        self.is_open = False

    def read(self) -> bytes:
        """Return the next recorded read once it is due; none if that takes too long."""
        playback, chunk = self._playback, self._next
        if self.moved != playback.passes:
            self.moved = playback.passes
            self._read_from(playback.begin_ns)
            return b""
        if chunk is None and not self.has_ended:
            self.has_ended = True
            return b""
        due_ns = None if chunk is None else chunk.clock_ns
        if not playback.wait_until_due(due_ns, READ_TIMEOUT_S, self.moved) or chunk is None:
            return b""
        self._clock_ns, data = chunk
        self._next = next(self._chunks, None)
        return data

    def clock_ns(self, _: int) -> int:
        """When the bytes just read came, on the recording's steady clock."""
        return self._clock_ns

    def write(self, _: bytes) -> bool:
        """Take data and do nothing with it."""
        return True

    def _read_from(self, clock_ns: int) -> None:
        self._chunks = self._recording.chunks(self._number, clock_ns)
        self._next = next(self._chunks, None)
        self.has_ended = False
