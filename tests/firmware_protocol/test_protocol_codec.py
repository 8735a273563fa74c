"""What a user of the codec meets: equality, errors that name the field, counts, bounds."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from protocol_vectors import load
from tactomo_protocol import (
    MAX_FRAME_BYTES,
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Decoder,
    FieldError,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    UnknownPacket,
    encode,
)

HELLO = Hello(
    device_id="skin-0001",
    firmware="1.4.0",
    channels=(Channel.MAGNITUDE, Channel.STRUCTURE),
    electrodes=16,
    drive_offset=1,
    measure_offset=1,
    samples_per_scan=208,
    sample_format=SampleFormat.INT32,
    volts_per_count=1e-7,
    scan_rate_hz=20.0,
)
SCAN = Scan(Channel.STRUCTURE, 5, 250_000, ScanFlag.LATE, np.arange(4, dtype=np.int32))


def test_decoded_scan_keeps_its_type_and_cannot_be_overwritten() -> None:
    [scan] = Decoder().feed(encode(SCAN))
    assert isinstance(scan, Scan)
    assert isinstance(scan.channel, Channel)
    assert isinstance(scan.flags, ScanFlag)
    with pytest.raises(ValueError, match="read-only"):
        scan.samples[0] = 1


def test_known_codes_come_back_as_enumeration_members_and_others_as_numbers() -> None:
    packets: list[Packet] = [Command(CommandCode.START, 1), Command(77, 2)]
    start, unknown = Decoder().feed(b"".join(map(encode, packets)))
    assert isinstance(start, Command)
    assert start.code is CommandCode.START
    assert isinstance(unknown, Command)
    assert unknown.code == 77
    assert not isinstance(unknown.code, CommandCode)


BAD_FIELDS = [
    (replace(SCAN, channel=2), "Scan.channel", "one of magnitude, structure"),  # type: ignore[arg-type]
    (replace(SCAN, counter=-1), "Scan.counter", "from 0 to 4294967295"),
    (replace(SCAN, counter=2**32), "Scan.counter", "from 0 to 4294967295"),
    (replace(SCAN, counter=1.5), "Scan.counter", "an integer"),  # type: ignore[arg-type]
    (replace(SCAN, device_us=2**53), "Scan.device_us", "from 0 to 9007199254740991"),
    (replace(SCAN, flags=ScanFlag(256)), "Scan.flags", "from 0 to 255"),
    (replace(SCAN, samples=np.zeros(4)), "Scan.samples.dtype", "int16, int32 or float32"),  # type: ignore[arg-type]
    (replace(SCAN, samples=np.zeros(4, ">i4")), "Scan.samples.dtype", "int16, int32 or float32"),
    (replace(SCAN, samples=np.zeros((2, 2), np.int16)), "Scan.samples", "1-D"),
    (replace(SCAN, samples=[1, 2]), "Scan.samples", "1-D NumPy array"),  # type: ignore[arg-type]
    (replace(SCAN, samples=np.zeros(0, np.int16)), "len(Scan.samples)", "from 1 to 1024"),
    (replace(SCAN, samples=np.zeros(1025, np.int16)), "len(Scan.samples)", "from 1 to 1024"),
    (replace(HELLO, device_id=""), "Hello.device_id", "1 to 64 bytes"),
    (replace(HELLO, device_id="µ" * 33), "Hello.device_id", "1 to 64 bytes"),
    (replace(HELLO, device_id="\ud800"), "Hello.device_id", "UTF-8"),
    (replace(HELLO, firmware="1.0\x1b[31m"), "Hello.firmware", "control characters"),
    (replace(HELLO, firmware="1.0\x9b"), "Hello.firmware", "control characters"),
    (replace(HELLO, channels=()), "Hello.channels", "one or more"),
    (replace(HELLO, channels=tuple(reversed(Channel))), "Hello.channels", "ascending"),
    (replace(HELLO, channels=(Channel.STRUCTURE,) * 2), "Hello.channels", "none twice"),
    (replace(HELLO, channels=(3,)), "Hello.channels", "one of magnitude, structure"),  # type: ignore[arg-type]
    (replace(HELLO, electrodes=256), "Hello.electrodes", "from 2 to 255"),
    (replace(HELLO, drive_offset=16), "Hello.drive_offset", "from 1 to 15"),
    (replace(HELLO, measure_offset=0), "Hello.measure_offset", "from 1 to 15"),
    (replace(HELLO, samples_per_scan=1025), "Hello.samples_per_scan", "from 1 to 1024"),
    (replace(HELLO, sample_format=4), "Hello.sample_format", "3 (FLOAT32)"),  # type: ignore[arg-type]
    (replace(HELLO, volts_per_count=0.0), "Hello.volts_per_count", "above 0 V"),
    (replace(HELLO, volts_per_count=math.nan), "Hello.volts_per_count", "finite"),
    (replace(HELLO, scan_rate_hz=-1.0), "Hello.scan_rate_hz", "0, or from 0.001"),
    (replace(HELLO, scan_rate_hz=5e-324), "Hello.scan_rate_hz", "0, or from 0.001"),
    (replace(HELLO, scan_rate_hz=1e308), "Hello.scan_rate_hz", "to 1000000 Hz"),
    (replace(HELLO, scan_rate_hz=math.inf), "Hello.scan_rate_hz", "to 1000000 Hz"),
    (Command(256, 0), "Command.code", "from 0 to 255"),
    (Command(CommandCode.START, -1), "Command.request", "from 0 to 255"),
    (Command(CommandCode.SET_RATE, 0), "Command.rate_hz", "above 0 Hz"),
    (Command(CommandCode.SET_RATE, 0, math.nan), "Command.rate_hz", "finite"),
    (Command(CommandCode.START, 0, 20.0), "Command.rate_hz", "0 for commands other than SET_RATE"),
    (Acknowledge(256, 1, AckStatus.OK), "Acknowledge.request", "from 0 to 255"),
    (Acknowledge(0, 256, AckStatus.OK), "Acknowledge.command", "from 0 to 255"),
    (Acknowledge(0, 1, 4), "Acknowledge.status", "3 (BUSY)"),  # type: ignore[arg-type]
    (CompanionReading(0, ScanFlag(0), 0, math.inf), "CompanionReading.value", "finite"),
    (CompanionReading(0, ScanFlag(0), 0, 1e39), "CompanionReading.value", "float32"),
    (UnknownPacket(1, b""), "UnknownPacket.type", "does not define"),
    (UnknownPacket(300, b""), "UnknownPacket.type", "from 0 to 255"),
    (UnknownPacket(9, bytes(4115)), "UnknownPacket.body", "at most 4114 bytes"),
    ("scan", "packet", "a Scan, Hello, Acknowledge, CompanionReading, Command or"),
]


@pytest.mark.parametrize(("packet", "field", "allowed"), BAD_FIELDS)
def test_a_field_that_the_wire_cannot_carry_is_named(
    packet: Packet, field: str, allowed: str
) -> None:
    with pytest.raises(FieldError) as raised:
        encode(packet)
    assert raised.value.field == field
    assert allowed in str(raised.value)
    assert repr(raised.value.value) in str(raised.value)
    assert isinstance(raised.value, ValueError)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("version_2", ["version 2", "not 1"]),
        ("scan_clock_largest", ["scan", "device_us", "18446744073709551615", "9007199254740991"]),
        ("scan_count_wrong", ["scan", "length"]),
        ("scan_channel_2", ["scan", "channel", "2"]),
        ("hello_rate_nan", ["hello", "scan_rate_hz", "nan", "0.001"]),
        ("hello_offset_16", ["hello", "drive_offset", "16"]),
    ],
)
def test_the_rule_that_an_intact_frame_breaks_is_named(name: str, told: list[str]) -> None:
    streams = {stream["name"]: stream["stream"] for stream in load("streams.json")}
    decoder = Decoder()
    decoder.feed(bytes.fromhex(streams[name]))
    for part in told:
        assert part in decoder.fault
    assert Decoder().fault == ""


def test_damage_breaks_no_rule() -> None:
    decoder = Decoder()
    frame = bytearray(encode(SCAN))
    frame[9] ^= 1
    decoder.feed(frame)
    assert decoder.counts.crc_errors == 1
    assert decoder.fault == ""


def test_the_largest_packet_fits_the_stated_frame_size() -> None:
    largest = UnknownPacket(9, b"\xff" * 4114)
    assert len(encode(largest)) == MAX_FRAME_BYTES
    assert Decoder().feed(encode(largest)) == [largest]


@pytest.mark.parametrize("filler", [b"\x01", b"\0", b"\x05\x05\0", b"\xff"])
def test_memory_stays_bounded_whatever_is_fed(filler: bytes) -> None:
    decoder = Decoder()
    decoder.feed(b"\0" + filler)
    chunk = filler * (1 << 15)
    tracemalloc.start()
    try:
        for _ in range(3):
            assert decoder.feed(chunk) == []
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 6 * MAX_FRAME_BYTES
    assert decoder.feed(encode(SCAN)) == [SCAN]


def test_unending_bytes_without_a_delimiter_are_one_error_at_once() -> None:
    decoder = Decoder()
    decoder.feed(b"\0" + b"\x01" * MAX_FRAME_BYTES)
    assert decoder.counts.oversize == 1, "known before the next delimiter comes"
    decoder.feed(b"\x01" * 3 * MAX_FRAME_BYTES)
    assert decoder.counts.oversize == 1
