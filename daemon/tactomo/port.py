"""A serial port and the thread that reads it: bytes to packets to scans, stamped on arrival.

The thread outlives its device. When the cable is pulled it says so, tries the port again several
times a second, and starts the device anew once it is back. Whatever bytes come, they are counted;
none of them raises.

After `open`, only the thread touches the serial object. What others may read (`bytes_read`,
`counts`, `unused`, `hello`, `refusal`, `is_open`, `has_ended`) is written by the thread alone.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import serial
from numpy.typing import NDArray
from tactomo_models import SensorDescription
from tactomo_protocol import (
    MAX_FRAME_BYTES,
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    Decoder,
    DecoderCounts,
    Hello,
    Packet,
    Scan,
    ScanFlag,
    encode,
)

from tactomo.errors import PortError, RecordingError
from tactomo.events import OnEvent, RateLimit
from tactomo.open_serial import open_serial
from tactomo.protocol_replay import ReplayEnded
from tactomo.recorder import Recorder, hello_entry, port_entry

RETRY_S: Final = 0.25
ASK_AGAIN_S: Final = 1.5
"""How long a device may say no hello, or send no scan, before it is asked again."""

# What pyserial raises when a device goes away in the middle of a call: TypeError where its
# descriptor has become None.
_DEVICE_GONE = (OSError, TypeError)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelScan:
    """One channel's scan as it came in."""

    channel: Channel
    counter: int
    device_us: int
    flags: ScanFlag
    volts: NDArray[np.float64]
    realtime_ns: int
    monotonic_ns: int
    """When the read that brought the scan's last byte had returned."""
    clock_ns: int
    """The same on the clock that synchronisation goes by: in a replay, the recording's."""
    recording: int
    """Number of the recording that has the scan's bytes; 0 for none."""


class Delivery(NamedTuple):
    """What one read of a port brought."""

    port: int
    clock_ns: int
    scans: tuple[ChannelScan, ...]
    channels: tuple[Channel, ...] | None = None
    """Those that the device says it sends here; None before its first hello."""
    has_ended: bool = False
    """The replay behind the port is at its end: nothing more will come."""


class PortReader:
    """One port. `open` it, `start` its thread, `stop` it.

    Attributes:
        bytes_read: since the start, over all connections.
        counts: the decoder's counts, likewise.
        unused: scans that cannot be used: before the first hello, of a device that does not fit
            the sensor, of another length or of a channel that the sensor does not have.
        hello: the newest one; None before the first.
        refusal: why this device's scans are not used; empty when they are.
        is_open: whether the device is there at present.
        has_ended: whether the replay behind the port is at its end.
        turns: of the loop, device or no device; the watchdog goes by them.

    """

    def __init__(
        self,
        index: int,
        url: str,
        baud: int,
        description: SensorDescription,
        recorder: Recorder,
        deliver: Callable[[Delivery], None],
        on_event: OnEvent,
    ) -> None:
        self.index = index
        self.url = url
        self.bytes_read = 0
        self.unused = 0
        self.hello: Hello | None = None
        self.refusal = ""
        self.is_open = False
        self.has_ended = False
        self.turns = 0
        self._baud = baud
        self._description = description
        self._recorder = recorder
        self._deliver = deliver
        self._on_event = on_event
        self._serial: serial.Serial | None = None
        self._decoder = Decoder()
        self._tail = b""  # bytes from the last delimiter on, where a recording may begin
        self._recording = 0  # number of the recording that has the last chunk
        self._asked_s = 0.0  # when the device was last asked, or last sent a scan
        self._request = 0
        self._corrupt_told = 0
        self._corrupt_limit = RateLimit()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port-{index}")

    @property
    def counts(self) -> DecoderCounts:
        """What the decoder has met so far."""
        return self._decoder.counts

    def open(self) -> None:
        """Open the port; raise PortError, PortBusyError or RecordingError."""
        self._serial = open_serial(self.url, self._baud)
        self.is_open = True

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the port."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._close()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs, or has come to the end that a replay has."""
        return self._thread.is_alive() or self.has_ended

    def _run(self) -> None:
        self._ask()
        while not self._stopping.is_set():
            self.turns += 1
            try:
                self._read_once()
            except ReplayEnded as end:
                self._end(str(end))
                return
            except _DEVICE_GONE as error:
                self._lose(str(error))
                self._reopen()

    def _read_once(self) -> None:
        """Wait for bytes, for a bounded time, and pass on what they hold."""
        port = self._serial
        if port is None:
            raise OSError("the port is closed")
        data = port.read(1)
        if data:
            data += port.read(port.in_waiting)
            # The clocks are read here, before anything else is done with the bytes.
            realtime_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
            clock_ns = getattr(port, "clock_ns", monotonic_ns)
            self._take(data, realtime_ns, monotonic_ns, clock_ns)
        if time.monotonic() - self._asked_s > ASK_AGAIN_S:
            self._ask()

    def _take(self, data: bytes, realtime_ns: int, monotonic_ns: int, clock_ns: int) -> None:
        self.bytes_read += len(data)
        recording = self._record(data, realtime_ns, monotonic_ns)
        scans = []
        packets = self._decoder.feed(data)
        for packet in packets:
            volts = self._handle(packet)
            if volts is not None and isinstance(packet, Scan):
                scans.append(
                    ChannelScan(
                        packet.channel,
                        packet.counter,
                        packet.device_us,
                        packet.flags,
                        volts,
                        realtime_ns,
                        monotonic_ns,
                        clock_ns,
                        recording,
                    )
                )
        if packets:
            channels = None if self.hello is None else self.hello.channels
            self._deliver(Delivery(self.index, clock_ns, tuple(scans), channels))
        self._tell_corrupt()

    def _record(self, data: bytes, realtime_ns: int, monotonic_ns: int) -> int:
        """Give the bytes to the recording that runs, if any; returns its number or 0."""
        active = self._recorder.active
        if active is not None:
            times = (monotonic_ns, realtime_ns)
            if active.number != self._recording:
                # A recording begins with the hello in force and at a delimiter, so that its first
                # packet is whole and what it means is known.
                if self.hello is not None:
                    active.add(hello_entry(self.index, self.hello, *times))
                if self._tail:
                    active.add(port_entry(self.index, self._tail, *times))
            active.add(port_entry(self.index, data, *times))
        self._recording = 0 if active is None else active.number
        delimiter = data.rfind(0)
        self._tail = (self._tail + data)[-MAX_FRAME_BYTES:] if delimiter < 0 else data[delimiter:]
        return self._recording

    def _handle(self, packet: Packet) -> NDArray[np.float64] | None:
        """Take note of a packet; returns a scan's volts if they may be used."""
        if isinstance(packet, Hello):
            self._greet(packet)
        elif isinstance(packet, Acknowledge) and packet.status != AckStatus.OK:
            self._on_event(
                "command_refused",
                "warning",
                f"{self.url}: the device answered command {packet.command} with "
                f"{packet.status.name}",
            )
        elif isinstance(packet, Scan):
            self._asked_s = time.monotonic()
            hello = self.hello
            if hello is not None and not self.refusal and self._fits(packet, hello):
                return packet.volts(hello.volts_per_count)
            self.unused += 1
        return None

    def _fits(self, scan: Scan, hello: Hello) -> bool:
        is_known = scan.channel.name.lower() in self._description.modalities
        return is_known and len(scan.samples) == hello.samples_per_scan

    def _greet(self, hello: Hello) -> None:
        if hello == self.hello:
            return
        self.refusal = contradiction(hello, self._description)
        self.hello = hello
        if self.refusal:
            self._on_event(
                "device_refused",
                "error",
                f"{self.url}: {hello.device_id} does not fit {self._description.name}: "
                f"{self.refusal}; its scans are not used",
                "give the daemon the description of the sensor that is connected",
            )

    def _ask(self) -> None:
        """Ask the device who it is and to start; harmless where it has started already."""
        self._asked_s = time.monotonic()
        for code in (CommandCode.IDENTIFY, CommandCode.START):
            self._request = (self._request + 1) % 256
            try:
                if self._serial is not None:
                    self._serial.write(encode(Command(code, self._request)))
            except serial.SerialTimeoutException:
                return  # it does not listen; it may still speak
            except _DEVICE_GONE:
                return  # the next read finds out and deals with it

    def _lose(self, reason: str) -> None:
        self._close()
        self._tail = b""
        if not self._stopping.is_set():
            self._on_event(
                "port_lost",
                "error",
                f"{self.url}: {reason}",
                "check the cable; the port is tried again until it is back",
            )

    def _reopen(self) -> None:
        while not self._stopping.wait(RETRY_S):
            self.turns += 1
            try:
                self.open()
            except (PortError, RecordingError):
                continue
            self._on_event("port_back", "info", self.url)
            self._ask()
            return

    def _end(self, reason: str) -> None:
        self._close()
        self.has_ended = True
        self._deliver(Delivery(self.index, 0, (), has_ended=True))
        self._on_event("replay_ended", "info", f"{self.url}: {reason}")

    def _close(self) -> None:
        self.is_open = False
        port, self._serial = self._serial, None
        if port is not None:
            with contextlib.suppress(*_DEVICE_GONE):  # it is gone: nothing is left to close
                port.close()

    def _tell_corrupt(self) -> None:
        corrupt = self._decoder.counts.corrupt
        if corrupt > self._corrupt_told and self._corrupt_limit.allows():
            self._on_event(
                "corrupt_packets",
                "warning",
                f"{self.url}: {corrupt - self._corrupt_told} damaged, {corrupt} since the start",
                "check the cable, its shield and the baud rate",
            )
            self._corrupt_told = corrupt


def contradiction(hello: Hello, description: SensorDescription) -> str:
    """Return in what a device differs from the sensor's description; empty when in nothing."""
    pattern = description.pattern
    pairs = {
        "electrodes": (hello.electrodes, description.electrode_count),
        "drive_offset": (hello.drive_offset, pattern.drive_offset),
        "measure_offset": (hello.measure_offset, pattern.measure_offset),
        "samples_per_scan": (hello.samples_per_scan, description.measurements),
    }
    differ = [f"{key} {has}, not {want}" for key, (has, want) in pairs.items() if has != want]
    if not any(channel.name.lower() in description.modalities for channel in hello.channels):
        sent = ", ".join(channel.name.lower() for channel in hello.channels)
        differ.append(f"channels {sent}, not {', '.join(description.modalities)}")
    return "; ".join(differ)
