"""Writes the test vectors of wire protocol v1, which any other implementation can check itself by.

    python tests/support/protocol_vectors.py firmware_protocol/vectors

`packets.json` holds valid frames and their fields, `streams.json` streams with damage and what a
decoder makes of them. What is expected is stated here by hand and never taken from the decoder.
"""

from __future__ import annotations

import argparse
import json
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from cobs import cobs
from tactomo_protocol import (
    MAX_DEVICE_US,
    MAX_FRAME_BYTES,
    MAX_RATE_HZ,
    MAX_SAMPLES,
    MIN_RATE_HZ,
    PROTOCOL_VERSION,
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    DecoderCounts,
    Hello,
    Packet,
    SampleFormat,
    Samples,
    Scan,
    ScanFlag,
    UnknownPacket,
    encode,
)

JsonMap = dict[str, Any]


def fields(packet: Packet) -> JsonMap:
    """A packet's fields as the vector files hold them.

    Enumerations are numbers. What JSON cannot hold exactly everywhere is a string: the u64 clock
    in decimal, a float32 sample as its bits in hex, a NaN rate as "nan".
    """
    match packet:
        case Scan():
            return {
                "packet": "scan",
                "channel": packet.channel.number,
                "flags": int(packet.flags),
                "counter": packet.counter,
                "device_us": str(packet.device_us),
                **_samples_fields(packet.samples),
            }
        case Hello():
            channels = [channel.number for channel in packet.channels]
            return {"packet": "hello", **asdict(packet), "channels": channels}
        case CompanionReading():
            return {
                "packet": "companion",
                "index": packet.index,
                "flags": int(packet.flags),
                "device_us": str(packet.device_us),
                "value": f"0x{np.float32(packet.value).view(np.uint32):08x}",
            }
        case UnknownPacket():
            return {"packet": "unknown", "type": packet.type, "body": packet.body.hex()}
        case Command(rate_hz=rate_hz) if math.isnan(rate_hz):
            return {"packet": "command", **asdict(packet), "rate_hz": "nan"}
    return {"packet": type(packet).__name__.lower(), **asdict(packet)}


def _samples_fields(samples: Samples) -> JsonMap:
    if samples.dtype == np.float32:
        bits = [f"0x{value:08x}" for value in samples.view(np.uint32)]
        return {"sample_format": int(SampleFormat.FLOAT32), "samples": bits}
    sample_format = SampleFormat.INT16 if samples.dtype == np.int16 else SampleFormat.INT32
    return {"sample_format": int(sample_format), "samples": samples.tolist()}


ONE_PORT_HELLO = Hello(
    device_id="skin-0001",
    firmware="1.4.0",
    channels=(Channel.MAGNITUDE, Channel.STRUCTURE),
    electrodes=16,
    drive_offset=1,
    measure_offset=1,
    samples_per_scan=208,
    sample_format=SampleFormat.INT32,
    volts_per_count=2.0**-24,
    scan_rate_hz=20.0,
)
START = Command(CommandCode.START, request=7)


def _scan(channel: Channel, counter: int, samples: Samples, flags: int = 0) -> Scan:
    return Scan(channel, counter, 1_000_000 + 50_000 * counter, ScanFlag(flags), samples)


def _short_scan(counter: int) -> Scan:
    samples = np.array([-1, 0, 1, 1000 + counter], dtype=np.int16)
    return _scan(Channel.MAGNITUDE, counter, samples)


def _full_scan(channel: Channel, counter: int) -> Scan:
    k = np.arange(208, dtype=np.int32) + 208 * channel.number
    return _scan(channel, counter, k * k * 31 % 2_000_003 - 1_000_001)


def _packets() -> Iterator[tuple[str, str, Packet]]:
    """Name, purpose and packet of each vector."""
    yield "identify", "the smallest request number", Command(CommandCode.IDENTIFY, 0)
    yield "start", "worked byte by byte in PROTOCOL.md", START
    yield "stop", "the largest request number", Command(CommandCode.STOP, 255)
    yield "set_rate", "the one command with an argument", Command(CommandCode.SET_RATE, 8, 20.0)
    yield "set_rate_fraction", "a rate without a finite binary form", Command(4, 9, 0.1)
    yield "zero_counters", "the next scan has counter 0", Command(CommandCode.ZERO_COUNTERS, 10)
    yield "unknown_command", "a device acknowledges it with status 1", Command(200, 11)
    for status in AckStatus:
        name = f"acknowledge_{status.name.lower()}"
        yield name, f"status {status.value}", Acknowledge(8, CommandCode.SET_RATE, status)
    yield (
        "acknowledge_of_unknown",
        "the command's code is copied",
        Acknowledge(11, 200, AckStatus.UNKNOWN_COMMAND),
    )
    yield "hello", "one port, both channels: the paper's sensor", ONE_PORT_HELLO
    yield (
        "hello_second_port",
        "one of two ports; opposite drive; paced by an external trigger",
        Hello("skin-0001/b", "µ", (Channel.STRUCTURE,), 8, 4, 1, 32, SampleFormat.INT16, 1e-6, 0.0),
    )
    yield (
        "hello_largest",
        "strings of 64 bytes, the widest ranges",
        Hello(
            "d" * 64, "µ" * 32, (Channel.MAGNITUDE,), 255, 254, 254, MAX_SAMPLES,
            SampleFormat.FLOAT32, 1.0, MAX_RATE_HZ,
        ),
    )  # fmt: skip
    yield "hello_slowest", "a scan in 1000 s", replace(ONE_PORT_HELLO, scan_rate_hz=MIN_RATE_HZ)
    yield "scan_magnitude", "a whole scan", _full_scan(Channel.MAGNITUDE, 12)
    yield "scan_structure", "its other half: the same counter", _full_scan(Channel.STRUCTURE, 12)
    yield (
        "scan_int16_extremes",
        "saturated",
        _scan(Channel.MAGNITUDE, 1, np.array([-32768, -1, 0, 1, 32767], np.int16), flags=1),
    )
    yield (
        "scan_int32_extremes",
        "saturated, late, simulated",
        _scan(Channel.STRUCTURE, 2, np.array([-(2**31), -1, 0, 2**31 - 1], np.int32), flags=7),
    )
    special = [0x00000000, 0x80000000, 0x00000001, 0x7F7FFFFF, 0x7F800000, 0xFF800000]
    nans = [0x7FC00000, 0x7F800001, 0xFFFFFFFF]
    yield (
        "scan_float32_special",
        "zeros, denormal, largest, infinities, NaNs of which every bit is kept",
        _scan(Channel.MAGNITUDE, 3, np.array(special + nans, np.uint32).view(np.float32)),
    )
    yield (
        "scan_last_counter",
        "the counter before it wraps to 0; the largest clock; flag bits without a name",
        Scan(
            Channel.STRUCTURE,
            2**32 - 1,
            MAX_DEVICE_US,
            ScanFlag(255),
            np.array([258], dtype=np.int16),
        ),
    )
    yield (
        "scan_first_counter",
        "every field zero that may be",
        Scan(Channel.MAGNITUDE, 0, 0, ScanFlag(0), np.zeros(1, dtype=np.int16)),
    )
    yield (
        "scan_zeros",
        "COBS of many zeros",
        _scan(Channel.MAGNITUDE, 4, np.zeros(208, dtype=np.int32)),
    )
    yield (
        "scan_largest",
        "the most samples of the widest format and hardly a zero: the largest frame",
        _scan(Channel.STRUCTURE, 5, np.full(MAX_SAMPLES, -2, dtype=np.int32)),
    )
    load_cell = CompanionReading(0, ScanFlag.SIMULATED, 1_000_000, -8_388_607.0)
    yield "companion", "24 bits of a load cell's converter are exact in a float32", load_cell
    largest = CompanionReading(255, ScanFlag(255), MAX_DEVICE_US, float(np.finfo(np.float32).max))
    yield "companion_largest", "every field at its end", largest
    yield "companion_zero", "every field zero", CompanionReading(0, ScanFlag(0), 0, 0.0)
    for size in (253, 254, 255):
        name = f"cobs_run_of_{size}"
        yield name, f"a payload of {size} bytes without a zero", _without_zeros(size)
    yield "unknown_empty", "a type of the future, without a body", UnknownPacket(0x7F, b"")


def _without_zeros(payload_size: int) -> UnknownPacket:
    """A packet whose whole payload, checksum included, has `payload_size` bytes and no zero."""
    for first in range(1, 256):
        packet = UnknownPacket(0x42, bytes([first]) + b"\x11" * (payload_size - 7))
        if 0 not in cobs.decode(encode(packet)[1:-1]):
            return packet
    raise AssertionError("no such payload")


class _Stream(NamedTuple):
    name: str
    about: str
    stream: bytes
    packets: Sequence[Packet]
    counts: JsonMap = {}  # noqa: RUF012  (never written to; zeros and `packets` left out)


def _raw_frame(content: bytes) -> bytes:
    """A frame with a right checksum around any content, valid or not."""
    payload = content + crc32(content).to_bytes(4, "little")
    return b"\0" + bytes(cobs.encode(payload)) + b"\0"


def _changed(frame: bytes, at: int, value: int) -> bytes:
    return frame[:at] + bytes([value]) + frame[at + 1 :]


def _streams() -> Iterator[_Stream]:
    """Streams of bytes and what a decoder that starts with them gives."""
    first, second, third = (_short_scan(counter) for counter in (1, 2, 3))
    a, b, c = encode(first), encode(second), encode(third)
    yield from _whole_streams(first, second, a, b)
    yield from _damaged_streams(first, second, third, a, b, c)
    yield from _refused_frames(first, second, a, b)


def _whole_streams(first: Scan, second: Scan, a: bytes, b: bytes) -> Iterator[_Stream]:
    both = [first, second]
    yield _Stream("nothing", "no bytes, no packets, no errors", b"", [])
    yield _Stream("two_packets", "with both delimiters each", a + b, both)
    yield _Stream("shared_delimiter", "a receiver needs one between frames", a[:-1] + b, both)
    yield _Stream("empty_frames", "mean nothing", bytes(9) + a + bytes(9) + b + bytes(9), both)
    yield _Stream(
        "attached_mid_frame",
        "what comes before the first delimiter is not counted",
        a[10:] + b,
        [second],
    )
    yield _Stream("unfinished", "the last frame's end has not come yet", a + b[:-1], [first])
    one_port: list[Packet] = [
        ONE_PORT_HELLO,
        Acknowledge(7, CommandCode.START, AckStatus.OK),
        *(_full_scan(channel, n) for n in (2**32 - 1, 0, 1) for channel in Channel),
    ]
    yield _Stream(
        "one_port_session",
        "both channels on one port; the counter wraps",
        b"".join(map(encode, one_port)),
        one_port,
    )
    run = _without_zeros(254)
    yield _Stream(
        "cobs_final_block",
        "some encoders end a full last block with one more code 01; accept it",
        encode(run)[:-1] + b"\x01\0",
        [run],
        {"unknown_type": 1},
    )


def _damaged_streams(
    first: Scan, second: Scan, third: Scan, a: bytes, b: bytes, c: bytes
) -> Iterator[_Stream]:
    around = [first, third]
    yield _Stream(
        "flipped_bit",
        "in the clock: refused by the checksum",
        a + _changed(b, 8, b[8] ^ 0x10) + c,
        around,
        {"crc_errors": 1},
    )
    yield _Stream(
        "flipped_code",
        "a COBS code that points past the frame's end",
        a + _changed(b, 1, 0xF0) + c,
        around,
        {"cobs_errors": 1},
    )
    yield _Stream(
        "both_delimiters_lost",
        "joins two frames: both are lost, as one error, and the third is not",
        a[:-1] + b[1:] + c,
        [third],
        {"crc_errors": 1},
    )
    yield _Stream(
        "cut_short",
        "the second frame's last five bytes are missing",
        a + b[:-5] + c,
        around,
        {"cobs_errors": 1},
    )
    yield _Stream("all_zeroed", "leaves no trace but the gap", a + bytes(len(b)) + c, around)
    yield _Stream(
        "garbage_between",
        "two runs of bytes: too short for a checksum, and no COBS",
        a + b"\x03\x55\x55\0\x99\x55" + c,
        around,
        {"crc_errors": 1, "cobs_errors": 1},
    )
    yield _Stream(
        "split_by_a_zero",
        "a zero written into a frame makes two of it: one packet lost, two errors",
        a + _raw_frame(b"\x01\x42" + b"\x11" * 20)[:12] + b"\0\x7f\x11\0" + c,
        around,
        {"cobs_errors": 2},
    )
    yield _Stream(
        "endless_garbage",
        "more than any frame holds: dropped up to the next delimiter, counted once",
        a + b"\x01" * (2 * MAX_FRAME_BYTES) + c,
        around,
        {"oversize": 1},
    )
    longest = MAX_FRAME_BYTES - 2
    yield _Stream(
        "longest_garbage",
        "as long as the largest frame: still decoded, then refused by its checksum",
        a + b"\x01" * longest + c,
        around,
        {"crc_errors": 1},
    )
    yield _Stream(
        "too_long_garbage",
        "one byte more",
        a + b"\x01" * (longest + 1) + c,
        around,
        {"oversize": 1},
    )


def _refused_frames(first: Scan, second: Scan, a: bytes, b: bytes) -> Iterator[_Stream]:
    """Frames with a right checksum, between two good ones."""
    both = [first, second]

    def between(name: str, about: str, content: bytes, count: str = "malformed") -> _Stream:
        return _Stream(name, about, a + _raw_frame(content) + b, both, {count: 1})

    scan = _content(first)
    hello = _content(ONE_PORT_HELLO)
    start = _content(START)
    yield between(
        "version_2", "intact, but of another version", b"\x02" + scan[1:], "wrong_version"
    )
    yield between("no_content", "a checksum of nothing", b"", "crc_errors")
    yield between("only_a_version", "no type", b"\x01", "crc_errors")
    yield between("scan_without_body", "no header", scan[:2])
    yield between("scan_channel_2", "no such channel", _changed(scan, 2, 2))
    yield between("scan_format_0", "no such sample format", _changed(scan, 16, 0))
    yield between("scan_count_0", "no samples", _changed(scan, 18, 0)[:20])
    yield between("scan_count_wrong", "five samples stated, four there", _changed(scan, 18, 5))
    yield between("scan_trailing_byte", "longer than its header and samples", scan + b"\x01")
    yield between("scan_clock_beyond", "2^53 µs", scan[:8] + bytes(6) + b"\x20\0" + scan[16:])
    yield between(
        "scan_clock_largest", "2^64 - 1 µs: a clock of 64 bits", scan[:8] + b"\xff" * 8 + scan[16:]
    )
    yield between("hello_no_channels", "", _changed(hello, 2, 0))
    yield between("hello_channel_2", "a bit that names no channel", _changed(hello, 2, 5))
    yield between("hello_offset_16", "beyond its 16 electrodes", _changed(hello, 7, 16))
    yield between(
        "hello_volts_nan", "a scale that is no number", hello[:8] + b"\xff" * 8 + hello[16:]
    )
    for name, rate_hz in (
        ("nan", math.nan),
        ("negative", -20.0),
        ("too_fast", 1e308),
        ("too_slow", 5e-324),
    ):
        changed = hello[:16] + struct.pack("<d", rate_hz) + hello[24:]
        yield between(f"hello_rate_{name}", f"a rate of {rate_hz:g} Hz", changed)
    yield between("hello_not_utf8", "a byte that no UTF-8 holds", _changed(hello, 26, 0xFF))
    yield between("hello_escape", "a control character in a name", _changed(hello, 26, 0x1B))
    yield between("hello_string_beyond", "a length past the end", _changed(hello, 25, 60))
    yield between("hello_firmware_beyond", "as above, in the last string", _changed(hello, 35, 6))
    yield between("hello_firmware_empty", "a string of no bytes", _changed(hello, 35, 0)[:36])
    yield between("hello_trailing_byte", "longer than its strings", hello + b"\x01")
    reading = _content(CompanionReading(1, ScanFlag(0), 5, 2.5))
    yield between("companion_nan", "a value that is no number", reading[:12] + b"\0\0\xc0\x7f")
    yield between("companion_short", "its last byte is missing", reading[:-1])
    yield between("companion_clock_beyond", "2^53 µs", reading[:10] + b"\x20\0" + reading[12:])
    yield between("command_short", "its last byte is missing", start[:-1])
    yield between("acknowledge_status_4", "no such status", b"\x01\x03\x07\x02\x04")
    yield _Stream(
        "reserved_bytes_ignored",
        "a scan's byte 17, and the rate of a command that takes none",
        _raw_frame(_changed(scan, 17, 9)) + _raw_frame(_changed(start, 11, 9)),
        [first, START],
    )
    nan_rate = _content(Command(CommandCode.SET_RATE, 3, 1.0))[:4] + b"\0\0\0\0\0\0\xf8\x7f"
    yield _Stream(
        "set_rate_nan",
        "reaches the device, which answers BAD_ARGUMENT",
        _raw_frame(nan_rate),
        [Command(CommandCode.SET_RATE, 3, math.nan)],
    )
    future = UnknownPacket(0x55, b"\x01\0\x02")
    yield _Stream(
        "unknown_type",
        "handed on, to be ignored",
        a + encode(future) + b,
        [first, future, second],
        {"unknown_type": 1},
    )


def _content(packet: Packet) -> bytes:
    """Version, type and body: what the checksum covers."""
    return bytes(cobs.decode(encode(packet)[1:-1])[:-4])


def packet_vectors() -> list[JsonMap]:
    """The content of `packets.json`: name, purpose, fields, payload and frame of each packet."""
    return [
        {
            "name": name,
            "about": about,
            "fields": fields(packet),
            "payload": cobs.decode(encode(packet)[1:-1]).hex(),
            "frame": encode(packet).hex(),
        }
        for name, about, packet in _packets()
    ]


def stream_vectors() -> list[JsonMap]:
    """The content of `streams.json`: name, purpose, bytes, packets and counts of each stream."""
    return [
        {
            "name": stream.name,
            "about": stream.about,
            "stream": stream.stream.hex(),
            "packets": [fields(packet) for packet in stream.packets],
            "counts": asdict(DecoderCounts(packets=len(stream.packets), **stream.counts)),
        }
        for stream in _streams()
    ]


def render(vectors: list[JsonMap]) -> str:
    """The text of a vector file: JSON, one vector a line, so that changes can be read."""
    lines = ",\n".join(json.dumps(vector, ensure_ascii=False) for vector in vectors)
    return f'{{"protocol_version": {PROTOCOL_VERSION}, "vectors": [\n{lines}\n]}}\n'


def _main() -> None:
    parser = argparse.ArgumentParser(
        prog="python tests/support/protocol_vectors.py",
        description="Write the protocol's test vectors.",
    )
    parser.add_argument("folder", type=Path, help="where packets.json and streams.json are written")
    folder: Path = parser.parse_args().folder
    if not folder.is_dir():
        parser.error(f"{folder} is not a folder; name the one that holds the vectors")
    for name, vectors in (("packets", packet_vectors()), ("streams", stream_vectors())):
        path = folder / f"{name}.json"
        path.write_text(render(vectors), encoding="utf-8")
        print(f"{path}: {len(vectors)} vectors")


if __name__ == "__main__":
    _main()
