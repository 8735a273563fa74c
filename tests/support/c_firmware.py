"""The C side of the wire: built by its own Makefile, and spoken to line by line."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from builds import BUILD_S, SANITIZED, build_folder
from needs import need
from tactomo_protocol import (
    Acknowledge,
    Channel,
    Command,
    CompanionReading,
    Decoder,
    DecoderCounts,
    Hello,
    Packet,
    SampleFormat,
    Samples,
    Scan,
    UnknownPacket,
)

C_FOLDER: Final = Path(__file__).parents[2] / "firmware_protocol" / "c"
CHECKED: Final = f"-O1 {SANITIZED}"


def build(target: str, compiler: str = "cc", **variables: str) -> Path:
    """Build a target of the C folder's Makefile once a run; skip without a compiler or make."""
    need("make", compiler)
    settings = [f"CC={compiler}", *(f"{name}={value}" for name, value in variables.items())]
    with build_folder(*settings) as folder:
        command = ["make", "-s", "-C", str(C_FOLDER), f"BUILD={folder}", *settings]
        done = subprocess.run(
            [*command, f"{folder}/{target}"], capture_output=True, text=True, timeout=BUILD_S
        )
    assert done.returncode == 0, done.stderr
    return folder / target


def f64_bits(value: float) -> str:
    """The 64 bits of a double, as hex."""
    return struct.pack(">d", value).hex()


def text_bytes(text: str) -> str:
    """Hex of a text's UTF-8; surrogates stand for bytes that no UTF-8 has."""
    return text.encode("utf-8", "surrogateescape").hex() or "-"


class Speaker:
    """tests/speak.c: each request, a line, gets a line back."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, *words: object) -> str:
        """Send a request and return the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*words, file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline().strip()
        assert answer, f"the program ended: {self._process.wait()}"
        return answer

    def encode(self, packet: Packet) -> bytes:
        """Return the frame that C makes of a packet; empty where it refuses."""
        return answered(self.ask(*request_for(packet)))

    def parse(self, stream: bytes, run: int | None = None) -> tuple[list[Command], DecoderCounts]:
        """Return the commands and counts of a stream that is fed in runs of so many bytes."""
        answer = self.ask("parse", run or len(stream) + 1, stream.hex() or "-")
        commands, counts = answer.rsplit("|", 1)
        return (
            [read_command(word) for word in commands.split()],
            DecoderCounts(*map(int, counts.split())),
        )


def answered(text: str) -> bytes:
    """Bytes of an answer in hex; none for a dash."""
    return b"" if text == "-" else bytes.fromhex(text)


def read_command(word: str) -> Command:
    """Read "code,request,rate" as tests/speak.c writes it."""
    code, request, bits = word.split(",")
    return Command(int(code), int(request), struct.unpack(">d", bytes.fromhex(bits))[0])


def format_of(samples: Samples) -> int:
    """Return the sample format that holds an array."""
    return next(int(known) for known in SampleFormat if known.dtype == samples.dtype)


def request_for(packet: Packet) -> tuple[object, ...]:
    """Return the request to encode a packet."""
    match packet:
        case Scan():
            samples = packet.samples
            return (
                *("scan", packet.channel.number, int(packet.flags), packet.counter),
                *(packet.device_us, format_of(samples), len(samples), samples.tobytes().hex()),
            )
        case Hello():
            return (
                *("hello", sum(1 << channel.number for channel in packet.channels)),
                *(int(packet.sample_format), packet.samples_per_scan, packet.electrodes),
                *(packet.drive_offset, packet.measure_offset),
                *(f64_bits(packet.volts_per_count), f64_bits(packet.scan_rate_hz)),
                *(text_bytes(packet.device_id), text_bytes(packet.firmware)),
            )
        case Acknowledge():
            return "acknowledge", packet.request, packet.command, int(packet.status)
        case CompanionReading():
            [bits] = struct.unpack("<I", struct.pack("<f", packet.value))
            return "companion", packet.index, int(packet.flags), packet.device_us, bits
        case Command():
            body = struct.pack("<BBd", packet.code, packet.request, packet.rate_hz)
            return "packet", 0x81, body.hex()
        case UnknownPacket():
            return "packet", packet.type, packet.body.hex() or "-"


@contextmanager
def speaking(program: Path, runner: Sequence[str] = ()) -> Iterator[Speaker]:
    """Run tests/speak.c."""
    with subprocess.Popen(
        [*runner, str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Speaker(process)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(BUILD_S) == 0


ALONE, LEADER, FOLLOWER = range(3)


class SimulatedDevice:
    """tactomo_device.c on a board that exists as numbers: its time and room are set from here."""

    def __init__(
        self,
        speaker: Speaker,
        role: int = ALONE,
        rate_hz: float = 20.0,
        shortest_period_us: int = 1000,
        timer_us: int = 0,
    ) -> None:
        self.speaker = speaker
        self.timer_us = timer_us
        self.accepted = self._number("begin", role, f64_bits(rate_hz), shortest_period_us, timer_us)
        self._decoder = Decoder()
        self._decoder.feed(b"\0")
        self.heard: list[Packet] = []  # all that it has said

    def _number(self, *words: object) -> int:
        return int(self.speaker.ask(*words))

    def pass_time(self, us: int) -> None:
        """Let the timer count on, through 32 bits."""
        self.timer_us = (self.timer_us + us) % 2**32
        self._number("at", self.timer_us)

    def room(self, free: int) -> None:
        """Set how many bytes the transmit buffer has room for."""
        self._number("room", free)

    def busy(self, is_busy: bool) -> None:
        """Begin or end a self-test."""
        self._number("busy", int(is_busy))

    def tell(self, *packets: Packet | bytes) -> list[Packet]:
        """Hand packets or bytes to the device, poll it, and return what it said."""
        for packet in packets:
            data = packet if isinstance(packet, bytes) else self.speaker.encode(packet)
            self._number("receive", data.hex())
        return self.poll()

    def poll(self) -> list[Packet]:
        """Poll the device and return what it said."""
        self.speaker.ask("poll")
        return self.said()

    def said(self) -> list[Packet]:
        """Return what was sent since the last time, in whole and sound frames."""
        packets = self._decoder.feed(answered(self.speaker.ask("sent")))
        assert self._decoder.counts.corrupt == 0
        self.heard += packets
        return packets

    @property
    def is_due(self) -> bool:
        """Whether the next dual scan should begin."""
        return bool(self._number("due"))

    def begin_scan(self) -> int:
        """Begin a dual scan and return its counter."""
        return self._number("begin_scan")

    def zero_counter(self) -> int:
        """Say that the sync line's pulse was a long one."""
        return self._number("zero_counter")

    def send(
        self, counter: int, channel: Channel = Channel.MAGNITUDE, started_us: int | None = None
    ) -> Scan | None:
        """Send a scan and return it as the host reads it; None where it was dropped."""
        started_us = self.timer_us if started_us is None else started_us
        was_sent = self._number("send", counter, channel.number, started_us, 0)
        scans = [packet for packet in self.said() if isinstance(packet, Scan)]
        assert len(scans) == was_sent
        return scans[0] if scans else None

    def dual_scan(self) -> tuple[Scan | None, Scan | None]:
        """Take and send both channels at once."""
        counter = self.begin_scan()
        return self.send(counter), self.send(counter, Channel.STRUCTURE)

    @property
    def state(self) -> tuple[bool, int, int]:
        """Whether it scans, scans dropped, and its clock in microseconds."""
        scanning, dropped, clock_us = map(int, self.speaker.ask("state").split())
        return bool(scanning), dropped, clock_us
