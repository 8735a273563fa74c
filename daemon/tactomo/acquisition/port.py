"""A serial port and the thread that reads it: bytes to packets to scans, stamped on arrival.

The thread outlives its device. When the cable is pulled it says so, tries the port again several
times a second, and starts the device anew once it is back. A device that does not speak is asked
again, then the port is closed and opened in case its adapter hangs. Whatever bytes come, they are
counted; none of them raises.

Once the thread has started, only it touches the connection.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final

from tactomo_models import SensorDescription
from tactomo_models.array_files import bounded
from tactomo_models.arrays import FloatArray
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    CommandCode,
    CompanionReading,
    Hello,
    Packet,
    Scan,
)

from tactomo.acquisition.companion_log import CompanionLog
from tactomo.acquisition.connection import Connection, ReplaySource
from tactomo.acquisition.device_clock import MAX_RATE, ClockState, DeviceClock
from tactomo.acquisition.liveness import DeviceState, Liveness
from tactomo.events import OnEvent, Rises, times
from tactomo.protocols import PortProtocol, Trouble
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.recording_writer import ActiveRecording, Entry
from tactomo.recordings.replay import Playback
from tactomo.scans import ChannelScan, PortRead
from tactomo.timing import wall_clock_ns
from tactomo.worker import Worker

RETRY_S: Final = 0.25
FAULT_LASTS_S: Final = 3.0
"""How long after the last sight of it firmware counts as faulty: three hellos."""
UNANSWERED_S: Final = 3.0
"""How long a device may leave commands unanswered: it is asked again in half that time."""


TROUBLES: Final = {
    DeviceState.SILENT: (
        "device_silent",
        "check the device's power; the daemon asks again and reopens the port",
    ),
    DeviceState.GARBLED: (
        "device_garbled",
        "wrong baud rate, or another device: set `baud` or `protocol` to the device's; "
        "`tactomo ports --ask` tells what is where",
    ),
    DeviceState.IDLE: (
        "device_idle",
        "check the device's trigger, or reset the device; the daemon keeps asking it to start",
    ),
}
"""The event of a device in each state of trouble, and what to do."""


@dataclass(eq=False)
class PortReader(Worker):
    """One port. `open` it, `start` its thread, `stop` it."""

    index: int  # its number among the sensor's ports
    url: str  # a device's path or a pyserial URL
    _baud: int  # of a real UART
    protocol: PortProtocol  # what its device speaks; it belongs to the thread from `start` on
    _description: SensorDescription  # the sensor that the device must fit
    _device_ids: Collection[str]  # those that may speak here; any where it is empty
    _recorder: Recorder  # gets every byte while it records
    _deliver: Callable[[PortRead], None]  # called by the thread with what each read brought
    _on_event: OnEvent  # told what happens
    _playback: Playback | None  # the replay's time, where the port replays
    _carriers: dict[Channel, PortReader]  # which port carries a channel

    def __post_init__(self) -> None:
        super().__init__(f"port-{self.index}")
        self.bytes_read = 0  # since the start, over all connections
        # scans that cannot be used: before the first hello, of a device that does not fit the
        # sensor, of another length or of a channel that the sensor does not have
        self.unused = 0
        self.hello: Hello | None = None  # the newest one; None before the first
        self.refusal = ""  # why this device's scans are not used; empty when they are
        self.reopened = 0  # how often the port was opened again because the device did not speak
        self.clock = DeviceClock()  # the device's, by which its scans are dated
        self._companions = CompanionLog(self._description)
        self.has_ended = False  # whether the replay behind the port is at its end
        self.connection = (
            Connection(self.url, self._baud, self._on_event)
            if self._playback is None
            else ReplaySource(self.url, self._playback)
        )
        self._liveness = Liveness(self.protocol.says_hello, self.protocol.patience_s)
        self._pass = 0  # of the replay
        self._recording = 0  # number of the recording that has the last chunk
        self._preamble_s = 0.0  # when a recording was last given one
        self._is_known = False  # the device that is plugged in has said hello
        self._is_doubled = False  # another port carries its channels
        self._asked_s = 0.0  # when the device was last asked, or last sent a scan
        self._trouble_of_protocol: Trouble | None = None
        self._has_risen = Rises()
        self._is_zeroing = threading.Event()
        self._fault, self._fault_s = "", 0.0  # what was last against the protocol, and when
        self._unanswered_s: float | None = None  # since when no command has been acknowledged

    @property
    def is_open(self) -> bool:
        """Whether the device is there at present."""
        return self.connection.is_open

    @property
    def state(self) -> str:
        """How the port does, in one word of STREAM.md."""
        if self.has_ended:
            return "ended"
        if not self.is_open:
            return "closed"
        if self.refusal:
            return "refused"
        is_faulty = self._liveness.state is DeviceState.IDLE and self._has_fault
        return "faulty" if is_faulty else str(self._liveness.state)

    @property
    def problem(self) -> str:
        """Why the port is closed or of no use, for people; empty where all is well."""
        return self.connection.problem or self.refusal or self._trouble(self._liveness.state)

    def open(self, or_wait: bool = False) -> None:
        """Open the port; raise PortError or RecordingError, unless the thread is to wait for it."""
        if or_wait:
            self.connection.try_open()
        else:
            self.connection.open()

    def zero_counters(self) -> None:
        """Ask the device to count from 0 again and to scan; for any thread."""
        self._is_zeroing.set()

    def _close(self) -> None:
        self.connection.close()

    def _run(self) -> None:
        if self.connection.is_open:
            self._greet_newcomer()
        while not self._stopping.is_set():
            self.turns += 1
            if not self.connection.is_open:
                self._wait_for_device()
                continue
            self._read_once()
        self._send(self.protocol.stop())

    def _read_once(self) -> None:
        source = self.connection
        data = source.read()
        # The clocks are read here, before anything else is done with the bytes.
        realtime_ns, monotonic_ns = wall_clock_ns(), time.monotonic_ns()
        if source.moved != self._pass:
            self._begin_pass(source.moved)
        if data:
            self._take(data, realtime_ns, monotonic_ns, source.clock_ns(monotonic_ns))
        if source.has_ended and not self.has_ended:
            self.has_ended = True
            self._deliver(PortRead(self.index, 0, (), has_ended=True, replay_pass=self._pass))
        if self._playback is None and self.connection.is_open:
            self._attend(monotonic_ns * 1e-9)

    def _wait_for_device(self) -> None:
        """Try the port once more, after a while."""
        if not self._stopping.wait(RETRY_S) and self.connection.try_open():
            self._tell("port_back")
            self._greet_newcomer()

    def _greet_newcomer(self) -> None:
        """Make a new start with whichever device is at the port now."""
        self._is_known = False
        self._unanswered_s = None
        self._companions.forget()
        self.protocol.restart()
        self._liveness.opened(time.monotonic())
        self._introduce()

    def _attend(self, now_s: float) -> None:
        if now_s - self._asked_s > self._ask_after_s:
            self._introduce()
        if self._is_zeroing.is_set():
            self._is_zeroing.clear()
            self._send(self.protocol.zero_counters())
        self._tell_trouble(self._liveness.judge(now_s))
        self._tell_unanswered(now_s)
        if self._liveness.is_reopening_due(now_s):
            self._reopen()

    @property
    def _ask_after_s(self) -> float:
        """Asking begins some foreign devices' scans anew: those that are slow get their time."""
        least_s = self.protocol.patience_s
        return least_s if self.protocol.says_hello else max(least_s, self._liveness.patience_s)

    def _reopen(self) -> None:
        """Close and open the port: what a USB bridge that hangs often needs."""
        self.connection.close()
        self.protocol.restart()
        if self.connection.try_open():
            self.reopened += 1
            self._liveness.reopened(time.monotonic())
            self._introduce()

    def _take(self, data: bytes, realtime_ns: int, monotonic_ns: int, clock_ns: int) -> None:
        self.bytes_read += len(data)
        recording = self._record(data, realtime_ns, monotonic_ns)
        scans = []
        now_s, found = monotonic_ns * 1e-9, 0
        understood = self.protocol.counts.packets + self.protocol.counts.faulty
        packets = self.protocol.feed(data)
        for packet in packets:
            volts = self._handle(packet, now_s)
            found += isinstance(packet, Scan) and self._is_known and self._fault_s != now_s
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
                        self.index,
                        self.clock.date(packet.channel, packet.device_us, clock_ns)
                        if self.protocol.has_clock
                        else None,
                        self._companions.at(packet.device_us),
                    )
                )
        intact = self.protocol.counts.packets + self.protocol.counts.faulty - understood
        self._liveness.heard(now_s, intact, found)
        if packets:
            self._deliver(
                PortRead(self.index, clock_ns, tuple(scans), self.hello, replay_pass=self._pass)
            )
        if self._playback is None:
            self._send(self.protocol.replies())
        self._tell_corrupt()
        if self._has_risen("faulty", self.protocol.counts.faulty) and self.protocol.fault:
            self._note_fault(self.protocol.fault, now_s)
        self._tell_clock()
        self._tell_protocols_trouble()

    def _record(self, data: bytes, realtime_ns: int, monotonic_ns: int) -> int:
        """Give the bytes to the recording that runs, if any; returns its number or 0."""
        times = (monotonic_ns, realtime_ns)
        active = self._recorder.active
        is_taken = active is not None and self._record_to(active, data, times)
        if not is_taken and self._recorder.active is not active:  # it has just given way to it
            active = self._recorder.active
            is_taken = active is not None and self._record_to(active, data, times)
        self._recording = active.number if active is not None and is_taken else 0
        return self._recording

    def _record_to(self, active: ActiveRecording, data: bytes, times: tuple[int, int]) -> bool:
        entries = [Entry(f"port/{self.index}", data, *times)]
        age_s = times[0] * 1e-9 - self._preamble_s
        if active.number != self._recording or age_s >= self.protocol.preamble_period_s:
            # So that its first scan is whole and what it means is known.
            preamble = self.protocol.preamble()
            self._preamble_s = times[0] * 1e-9
            if preamble:
                entries.insert(0, Entry(f"port/{self.index}/hello", preamble, *times))
        previous = None if active.come_over.is_set() else active.previous
        if previous is not None and self._recording in (previous.number, active.number):
            previous.add(entries[-1])
        return active.add(*entries)

    def _handle(self, packet: Packet, now_s: float) -> FloatArray | None:
        """Take note of a packet; returns a scan's volts if they may be used."""
        if isinstance(packet, Hello):
            self._greet(packet)
        elif isinstance(packet, Acknowledge):
            self._unanswered_s = None
            if _is_refusal(packet):
                name = packet.status.name
                self._tell(
                    "command_refused",
                    f"the device answered command {packet.command} with {name}",
                    "if scans come as they should, nothing; else switch the device off and on, and "
                    "see that its firmware takes what firmware_protocol/PROTOCOL.md requires",
                )
        elif isinstance(packet, Scan):
            self._asked_s = time.monotonic()
            hello = self.hello
            is_usable = self._is_known and not self.refusal
            if hello is not None and is_usable:
                fault = unlike_hello(packet, hello)
                if fault:
                    self._note_fault(fault, now_s)
                elif packet.channel in self._description.channels:
                    return bounded(packet.volts(hello.volts_per_count))
            self.unused += 1
        elif isinstance(packet, CompanionReading) and self._is_known and not self.refusal:
            self._take_reading(packet)
        return None

    def _take_reading(self, packet: CompanionReading) -> None:
        if not self._companions.take(packet):
            self._tell(
                "companion_unknown",
                f"readings of companion {packet.index} come, and the sensor description has none "
                "of that index",
                f"add [companion.NAME] with index = {packet.index} to the description",
            )

    def _note_fault(self, fault: str, now_s: float) -> None:
        self._fault, self._fault_s = fault, now_s
        self._tell(
            "firmware_fault",
            f"{fault}; what is so is not used",
            "the line is good: correct the firmware, by firmware_protocol/PROTOCOL.md",
        )

    def _tell(self, name: str, words: str = "", next_step: str = "", reason: str = "") -> None:
        detail = f"{self.url}: {words}" if words else self.url
        self._on_event(name, detail, next_step, self.url, reason)

    def _greet(self, hello: Hello) -> None:
        self._is_known = True
        self._liveness.note_rate(hello.scan_rate_hz)
        before = self.hello
        if hello == before and not self._is_doubled:
            return
        self.hello = hello
        refused, trouble = self.refusal, self._judge(hello)
        if hello == before and self.refusal == refused:
            return
        if trouble is not None:
            why = f"{trouble.cause}; its scans are not used"
            self._tell("device_refused", why, trouble.next_step, trouble.cause)
        elif before is not None and before.device_id != hello.device_id:
            self._tell(
                "device_changed",
                f"{hello.device_id} is where {before.device_id} was",
                "tare, if another skin was plugged in; `device_ids` refuses other devices",
            )

    def _judge(self, hello: Hello) -> Trouble | None:
        """Take note of whether a device's scans are used; return why not."""
        trouble = self._why_refused(hello)
        self.refusal = "" if trouble is None else trouble.cause
        return trouble

    def _why_refused(self, hello: Hello) -> Trouble | None:
        """Why a device's scans are not used; where they are, its channels are this port's now."""
        self._is_doubled = False
        self._give_up_channels()
        if self._device_ids and hello.device_id not in self._device_ids:
            return Trouble(
                f"{hello.device_id} is not one of this sensor's devices, "
                f"{', '.join(self._device_ids)}",
                "plug it in elsewhere, or name its port by /dev/serial/by-id or by-path: see "
                "`tactomo ports`; a device that was replaced belongs into `device_ids`",
            )
        if differs := contradiction(hello, self._description):
            return Trouble(
                f"{hello.device_id} does not fit {self._description.name}: {differs}",
                "give the daemon the description of the sensor that is connected",
            )
        channels = [channel for channel in hello.channels if channel in self._description.channels]
        for channel in channels:
            carrier = self._carriers.setdefault(channel, self)  # one step: ports race for it
            if carrier is not self and carrier.still_carries(hello.device_id):
                self._is_doubled = True
                self._give_up_channels()
                return Trouble(
                    f"{hello.device_id} sends the {channel} channel, which {carrier.url} carries",
                    "two skins are two sensors, each with a daemon of its own; of one skin each "
                    "board names its own channel alone",
                )
        self._carriers.update(dict.fromkeys(channels, self))
        return None

    def _give_up_channels(self) -> None:
        for channel in [c for c, port in list(self._carriers.items()) if port is self]:
            del self._carriers[channel]

    def still_carries(self, device_id: str) -> bool:
        """Whether its channels are its own beside this device: it did not move from here."""
        return self.is_open or self.hello is None or self.hello.device_id != device_id

    def _introduce(self) -> None:
        self._asked_s = time.monotonic()
        self._send(self.protocol.introduction())

    def _send(self, messages: list[bytes]) -> None:
        """Write to the device what it takes; while it is talked to, it is not asked anew."""
        for message in messages:
            self._asked_s = time.monotonic()
            if not self.connection.is_open or not self.connection.write(message):
                return
            if self.protocol.acknowledges and self._unanswered_s is None:
                self._unanswered_s = self._asked_s

    def _trouble(self, state: DeviceState) -> str:
        """Return in words what is the matter with a device in this state; empty if nothing is."""
        hello = self.hello
        if state is DeviceState.SILENT:
            return f"nothing came for {self._liveness.silence_s:.3g} s or longer"
        if state is DeviceState.GARBLED:
            return (
                f"bytes come, but no packet of protocol {self.protocol.name} at {self._baud} baud"
            )
        if state is DeviceState.IDLE and self._has_fault:
            return self._fault
        if state is DeviceState.IDLE and (hello is None or hello.scan_rate_hz > 0):
            return "the device speaks, but sends no scans"
        return ""

    @property
    def _has_fault(self) -> bool:
        return bool(self._fault) and time.monotonic() - self._fault_s < FAULT_LASTS_S

    def _tell_unanswered(self, now_s: float) -> None:
        since_s, speaks = self._unanswered_s, (DeviceState.RUNNING, DeviceState.IDLE)
        is_due = since_s is not None and now_s - since_s > UNANSWERED_S
        if is_due and self._liveness.state in speaks:
            self._tell(
                "command_unanswered",
                "the device speaks, and acknowledges no command",
                "check the line from the computer to the device (its RX), and that the firmware "
                "answers within 100 ms",
            )

    def _tell_trouble(self, state: DeviceState) -> None:
        trouble = self._trouble(state)
        if trouble and not (state is DeviceState.IDLE and self._has_fault):
            name, next_step = TROUBLES[state]
            self._tell(name, trouble, next_step)
        elif not trouble and not self.refusal and state is not DeviceState.STARTING:
            self._tell("device_speaks")

    def _begin_pass(self, number: int) -> None:
        """Go on elsewhere in the recording: what had begun to come is not finished."""
        self._pass, self.has_ended = number, False
        self._companions.forget()
        self.protocol.restart()
        self.clock = DeviceClock()

    def _tell_clock(self) -> None:
        """Tell of a device's clock that jumped or is none; scans are dated by arrival then."""
        clock = self.clock
        if self._has_risen("jumps", clock.jumps):
            self._tell(
                "device_clock_jumped",
                f"the device's clock jumped, or the device was reset; "
                f"{times(clock.jumps)} since the start",
                "if this event repeats, check the device's supply and timer",
            )
        if self._has_risen("unusable", clock.state is ClockState.UNUSABLE):
            self._tell(
                "device_clock_unusable",
                f"the device's clock stands still, or is off by more than "
                f"{MAX_RATE * 1e6:g} ppm, or its channels go by two; what buffers hold "
                "up is not seen in the ages",
                "correct the firmware's clock: one for both channels, in microseconds, read at the "
                "start of the scan",
            )

    def _tell_protocols_trouble(self) -> None:
        """Tell why nothing can be made of what comes, and when it can again."""
        trouble = self.protocol.trouble
        if trouble == self._trouble_of_protocol:
            return
        if trouble is not None:
            self.refusal = trouble.cause
            self._tell("device_refused", trouble.cause, trouble.next_step, trouble.cause)
        elif self.hello is not None:
            self._judge(self.hello)
        else:
            self.refusal = ""
        self._trouble_of_protocol = trouble

    def _tell_corrupt(self) -> None:
        corrupt = self.protocol.counts.damaged
        if self._has_risen("corrupt", corrupt):
            self._tell(
                "corrupt_packets",
                f"{corrupt} damaged since the start",
                "check the cable, its shield and the baud rate",
            )


def unlike_hello(scan: Scan, hello: Hello) -> str:
    """Return in what a scan is not as its device's hello says; empty where it is."""
    if scan.channel not in hello.channels:
        return f"scans of the {scan.channel} channel come, which its hello does not name"
    if len(scan.samples) != hello.samples_per_scan:
        return f"scans of {len(scan.samples)} samples come; its hello says {hello.samples_per_scan}"
    if scan.samples.dtype != hello.sample_format.dtype:
        return f"scans of {scan.samples.dtype} come; its hello says {hello.sample_format.dtype}"
    return ""


def _is_refusal(answer: Acknowledge) -> bool:
    """Whether a device did not do what it should; a follower leaves the counters to its leader."""
    is_leaders = answer.command == CommandCode.ZERO_COUNTERS
    return answer.status != AckStatus.OK and not (
        is_leaders and answer.status == AckStatus.UNKNOWN_COMMAND
    )


def contradiction(hello: Hello, description: SensorDescription) -> str:
    """Return in what a device differs from the sensor's description; empty when in nothing."""
    drive_offset, measure_offset = description.offsets
    pairs = {
        "electrodes": (hello.electrodes, description.electrode_count),
        "drive_offset": (hello.drive_offset, drive_offset),
        "measure_offset": (hello.measure_offset, measure_offset),
        "samples_per_scan": (hello.samples_per_scan, description.measurements),
    }
    differ = [f"{key} {has}, not {want}" for key, (has, want) in pairs.items() if has != want]
    if not any(channel in description.channels for channel in hello.channels):
        sent = ", ".join(channel for channel in hello.channels)
        differ.append(f"channels {sent}, not {', '.join(description.channels)}")
    return "; ".join(differ)
