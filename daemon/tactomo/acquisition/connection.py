"""What a port reads from: a serial port that is kept open, or a recording of one.

A serial port is lost with its device, and tried again until it is back. A recorded port is
``replay:///path.mcap?port=0``; `speed` is 1 (as recorded, the default), another factor, or 0 for as
fast as it is taken. Reading returns the bytes of one recorded read after another, each at its time;
what is written goes nowhere, since a recording does not answer.

All of it is used by one thread, but what others may read (`is_open`, `problem`,
`latency_timer_ms`), which that thread alone writes.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import serial
from tactomo_protocol import Command, CommandCode, Decoder, Hello, encode

from tactomo.acquisition.adapters import LOW_LATENCY_MS, ROOT, device_of
from tactomo.acquisition.open_serial import (
    DEVICE_GONE,
    READ_TIMEOUT_S,
    is_path,
    lower_latency,
    open_serial,
)
from tactomo.errors import PortAbsentError, TactomoError
from tactomo.events import OnEvent
from tactomo.protocols import recognised
from tactomo.recordings.recording import Chunk, Recording
from tactomo.recordings.replay import Playback, parse_replay_url

MAX_READ_BYTES: Final = 65_536
"""Taken at once at most, so that a flood of noise cannot keep the thread from its other duties."""


@dataclass(eq=False)
class Connection:
    """One port, open or waited for."""

    url: str
    _baud: int
    _on_event: OnEvent
    _root: Path = ROOT

    def __post_init__(self) -> None:
        self.is_open = False  # whether the device is there at present
        self.problem = ""  # why it is not open, for people; empty while it is
        # an FTDI adapter's, as of the last opening; None for others
        self.latency_timer_ms: int | None = None
        self.has_ended, self.moved = False, 0  # a device's stream neither ends nor moves
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Open the port; raise PortError or RecordingError where that cannot be done."""
        self._serial = open_serial(self.url, self._baud)
        self.latency_timer_ms = lower_latency(self._serial, self._root)
        self.problem, self.is_open = "", True
        self._tell_slow_adapter()

    def try_open(self) -> bool:
        """Open the port, if that can be done; otherwise say why not, once for each reason."""
        try:
            self.open()
        except TactomoError as error:
            self._note(error)
        return self.is_open

    def read(self) -> bytes:
        """Wait for bytes for a bounded time; none come of a device that has gone."""
        try:
            port = self._port
            data = port.read(1)
            if data:
                data += port.read(min(port.in_waiting, MAX_READ_BYTES))
            return data
        except DEVICE_GONE as error:
            self._lose(error)
            return b""

    def clock_ns(self, monotonic_ns: int) -> int:
        """Return when the bytes just read came: `monotonic_ns`."""
        return monotonic_ns

    def write(self, data: bytes) -> bool:
        """Send bytes, if the device takes them within a short time; returns whether it did."""
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            return False  # it does not listen; it may still speak
        except DEVICE_GONE as error:
            self._lose(error)
            return False
        return True

    def close(self) -> None:
        """Close the port; may be called twice."""
        self.is_open = False
        port, self._serial = self._serial, None
        if port is not None:
            with contextlib.suppress(*DEVICE_GONE):  # it is gone: nothing is left to close
                port.close()

    @property
    def _port(self) -> serial.Serial:
        if self._serial is None:
            raise serial.PortNotOpenError
        return self._serial

    def _lose(self, error: Exception) -> None:
        self.close()
        # pyserial's words for it are a guess, and the same for several causes.
        has_gone = is_path(self.url) and not os.path.exists(self.url)
        self.problem = "the device has gone" if has_gone else str(error)
        self._tell_closed("check the cable; the daemon reopens the port when it is back")

    def _note(self, error: TactomoError) -> None:
        """Take note of why the port cannot be opened, and tell it."""
        self.problem = error.cause
        # That it is not there says no more than that it was lost.
        reason = "" if isinstance(error, PortAbsentError) else error.cause
        self._tell_closed(error.next_step, reason)

    def _tell_closed(self, next_step: str, reason: str = "") -> None:
        detail = self.problem if self.url in self.problem else f"{self.url}: {self.problem}"
        self._on_event("port_lost", detail, next_step, self.url, reason)

    def _tell_slow_adapter(self) -> None:
        timer_ms, name = self.latency_timer_ms, os.path.basename(device_of(self.url))
        if timer_ms is not None and timer_ms > LOW_LATENCY_MS:
            self._on_event(
                "latency_timer",
                f"{self.url}: the adapter holds bytes back for up to {timer_ms} ms",
                "install tactomo's udev rules, or as root: "
                f"`echo 1 > /sys/bus/usb-serial/devices/{name}/latency_timer`",
            )


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


PATIENCE_S: Final = 2.5
"""A device says hello every second, and within one of the reset that opening a port may cause."""
ASK_AGAIN_S: Final = 0.5
_REMEMBERED: Final = 65_536  # bytes; several frames of any protocol


def identify(path: str, baud: int, patience_s: float = PATIENCE_S) -> Hello | str:
    """Open a port, ask for a hello for a bounded time, and close the port; raises nothing.

    Returns the hello, or in words why there is none.
    """
    connection = Connection(path, baud, lambda *_: None)
    if not connection.try_open():
        return connection.problem
    try:
        return _converse(connection, baud, patience_s)
    finally:
        connection.close()


def _converse(connection: Connection, baud: int, patience_s: float) -> Hello | str:
    decoder, received = Decoder(), b""
    end_s, ask_s = time.monotonic() + patience_s, 0.0
    while connection.is_open and (now_s := time.monotonic()) < end_s:
        if now_s >= ask_s:
            connection.write(encode(Command(CommandCode.IDENTIFY, 1)))
            ask_s = now_s + ASK_AGAIN_S
        data = connection.read()
        received = (received + data)[-_REMEMBERED:]
        for packet in decoder.feed(data):
            if isinstance(packet, Hello):
                return packet
    return connection.problem or _silence(received, decoder.counts.packets, baud)


def _silence(received: bytes, packets: int, baud: int) -> str:
    if packets:
        return "the device sends packets, but no hello"
    protocol = recognised(received)
    if protocol is not None:
        return f"no hello, but what it sends looks like --protocol {protocol}"
    if received:
        return f"bytes and no packet at {baud} baud: no skin, or another baud rate"
    return "no answer; a device of another --protocol may wait for a start command"
