"""Packets to bytes and back: COBS framing, CRC-32, and a decoder that survives any input.

A frame is `0x00 COBS(version type body crc32) 0x00`. Both delimiters are sent, so that damage to
the end of one frame cannot swallow the start of the next; two in a row enclose an empty frame,
which means nothing. PROTOCOL.md is the specification; this module follows it field by field.
"""

from __future__ import annotations

import contextlib
import math
import operator
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np

from . import cobs
from .packets import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    Samples,
    Scan,
    ScanFlag,
    UnknownPacket,
)

PROTOCOL_VERSION = 1
MAX_SAMPLES = 1024
MAX_STRING_BYTES = 64
MAX_DEVICE_US = 2**53 - 1
"""285 years: exact as a double, and as nanoseconds still a signed 64-bit number."""
MIN_RATE_HZ, MAX_RATE_HZ = 1e-3, 1e6
"""A scan in 1000 s, which C's 32-bit timer still spans; one a microsecond, the clock's unit."""

_SCAN, _HELLO, _ACKNOWLEDGE, _COMPANION, _COMMAND = 0x01, 0x02, 0x03, 0x04, 0x81
# Each layout starts with the version and the type, as the payload does.
_PREFIX = struct.Struct("<BB")
_SCAN_HEAD = struct.Struct("<BBBBIQBBH")
_HELLO_HEAD = struct.Struct("<BBBBHBBddB")
_ACKNOWLEDGE_BODY = struct.Struct("<BBBBB")
_COMPANION_BODY = struct.Struct("<BBBBQf")
_COMMAND_BODY = struct.Struct("<BBBBd")
_CRC_BYTES = 4

_MAX_PAYLOAD = _SCAN_HEAD.size + 4 * MAX_SAMPLES + _CRC_BYTES
_MAX_BODY = _MAX_PAYLOAD - _PREFIX.size - _CRC_BYTES
_MAX_ENCODED = cobs.max_encoded_length(_MAX_PAYLOAD)
MAX_FRAME_BYTES = _MAX_ENCODED + 2

_U8, _U32 = 2**8 - 1, 2**32 - 1


class FieldError(ValueError):
    """A packet field that the wire cannot carry: says which, what it is and what is allowed."""

    def __init__(self, field: str, value: object, allowed: str) -> None:
        super().__init__(f"{field} is {value!r}; it must be {allowed}")
        self.field = field
        self.value = value


def encode(packet: Packet) -> bytes:
    """One whole frame, both delimiters included, at most `MAX_FRAME_BYTES` long.

    Raises `FieldError` (a `ValueError`) for a field that the wire cannot carry.
    """
    payload = _pack(packet)
    payload += crc32(payload).to_bytes(_CRC_BYTES, "little")
    return b"\0" + cobs.encode(payload) + b"\0"


@dataclass(slots=True)
class DecoderCounts:
    """What a decoder has met since it was made.

    The error counts are of frames, not of packets: damage that writes a zero into a frame splits
    it in two, and damage that removes delimiters joins several. Lost scans show as gaps in their
    counter.
    """

    packets: int = 0  # returned by `feed`, those of unknown type included
    crc_errors: int = 0  # the checksum does not match, or the frame is too short to hold one
    cobs_errors: int = 0  # not a COBS encoding of anything
    malformed: int = 0  # intact, but its body breaks the specification: a sender's mistake
    oversize: int = 0  # longer than any frame may be; dropped up to the next delimiter
    wrong_version: int = 0  # intact, of a protocol version that is not spoken here
    unknown_type: int = 0  # returned as `UnknownPacket`; not an error

    @property
    def damaged(self) -> int:
        """Frames that the line spoilt."""
        return self.crc_errors + self.cobs_errors + self.oversize

    @property
    def faulty(self) -> int:
        """Intact frames that break the specification: the line is good, and the sender is not."""
        return self.malformed + self.wrong_version

    @property
    def corrupt(self) -> int:
        """Frames that arrived and yielded no packet."""
        return self.damaged + self.faulty


class Decoder:
    """Turns the bytes of one port into packets; not thread-safe.

    Holds at most one frame's bytes between calls. What comes before the first delimiter is the
    rest of a frame whose start was missed: it is dropped and not counted.
    """

    def __init__(self) -> None:
        self.counts = DecoderCounts()  #: of all that was fed
        #: which rule the last intact frame that gave no packet breaks, for the firmware's author;
        #: empty before there is one
        self.fault = ""
        self._pending = bytearray()
        self._dropping = True  # until the next delimiter

    def feed(self, data: bytes | bytearray | memoryview) -> list[Packet]:
        """The packets completed by `data`, in order; any bytes in any chunking, never raises."""
        data = re.sub(b"\0\0+", b"\0", data)  # millions of delimiters are one
        packets: list[Packet] = []
        start = 0
        while (end := data.find(0, start)) >= 0:
            self._collect(data, start, end)
            if self._pending:
                packet = self._decode(bytes(self._pending))
                if packet is not None:
                    packets.append(packet)
                self._pending.clear()
            self._dropping = False
            start = end + 1
        self._collect(data, start, len(data))
        self.counts.packets += len(packets)
        return packets

    def restart(self) -> None:
        """Forget the frame that had begun: what comes does not go on from it."""
        self._pending.clear()
        self._dropping = True

    def _collect(self, data: bytes, start: int, end: int) -> None:
        if self._dropping:
            return
        if len(self._pending) + end - start > _MAX_ENCODED:
            self.counts.oversize += 1
            self._pending.clear()
            self._dropping = True
        else:
            self._pending += data[start:end]

    def _decode(self, encoded: bytes) -> Packet | None:
        try:
            payload = cobs.decode(encoded)
        except ValueError:
            self.counts.cobs_errors += 1
            return None
        content, checksum = payload[:-_CRC_BYTES], payload[-_CRC_BYTES:]
        if len(content) < _PREFIX.size or crc32(content) != int.from_bytes(checksum, "little"):
            self.counts.crc_errors += 1
            return None
        version, kind = _PREFIX.unpack_from(content)
        if version != PROTOCOL_VERSION:
            self.counts.wrong_version += 1
            self.fault = f"it speaks version {version} of the protocol, not {PROTOCOL_VERSION}"
            return None
        if kind not in _KNOWN_TYPES:
            self.counts.unknown_type += 1
            return UnknownPacket(kind, content[_PREFIX.size :])
        name, unpack = _KNOWN_TYPES[kind]
        try:
            return unpack(content)
        except ValueError as error:  # a body that breaks the specification
            self.counts.malformed += 1
            self.fault = f"{name} packet: {error}"
            return None


def _pack(packet: Packet) -> bytes:
    pack: Callable[[Any], bytes] | None = _PACK.get(type(packet))
    if pack is None:
        allowed = "a Scan, Hello, Acknowledge, CompanionReading, Command or UnknownPacket"
        raise FieldError("packet", packet, allowed)
    return pack(packet)


def _pack_scan(scan: Scan) -> bytes:
    sample_format = _format_of(scan.samples)
    head = _SCAN_HEAD.pack(
        PROTOCOL_VERSION,
        _SCAN,
        _channel("Scan.channel", scan.channel).number,
        _integer("Scan.flags", scan.flags, 0, _U8),
        _integer("Scan.counter", scan.counter, 0, _U32),
        _integer("Scan.device_us", scan.device_us, 0, MAX_DEVICE_US),
        sample_format,
        0,
        len(scan.samples),
    )
    return head + scan.samples.astype(sample_format.dtype.newbyteorder("<")).tobytes()


def _unpack_scan(content: bytes) -> Scan:
    _check_size(len(content) >= _SCAN_HEAD.size)
    _, _, channel, flags, counter, device_us, code, _, count = _SCAN_HEAD.unpack_from(content)
    dtype = SampleFormat(code).dtype
    _integer("Scan.device_us", device_us, 0, MAX_DEVICE_US)
    _integer("len(Scan.samples)", count, 1, MAX_SAMPLES)
    _check_size(len(content) == _SCAN_HEAD.size + count * dtype.itemsize)
    samples = np.frombuffer(content, dtype.newbyteorder("<"), count, _SCAN_HEAD.size)
    return Scan(
        Channel.of_number(channel),
        counter,
        device_us,
        ScanFlag(flags),
        samples.astype(dtype, copy=False),
    )


def _pack_hello(hello: Hello) -> bytes:
    _check_hello(hello)
    head = _HELLO_HEAD.pack(
        PROTOCOL_VERSION,
        _HELLO,
        sum(1 << Channel(channel).number for channel in hello.channels),
        hello.sample_format,
        hello.samples_per_scan,
        hello.electrodes,
        hello.drive_offset,
        hello.volts_per_count,
        hello.scan_rate_hz,
        hello.measure_offset,
    )
    return head + _pack_string(hello.device_id) + _pack_string(hello.firmware)


def _unpack_hello(content: bytes) -> Hello:
    _check_size(len(content) >= _HELLO_HEAD.size)
    _, _, mask, code, samples, electrodes, drive, volts, rate, measure = _HELLO_HEAD.unpack_from(
        content
    )
    device_id, end = _unpack_string(content, _HELLO_HEAD.size)
    firmware, end = _unpack_string(content, end)
    _check_size(end == len(content))
    hello = Hello(
        device_id=device_id,
        firmware=firmware,
        channels=tuple(Channel.of_number(bit) for bit in range(8) if mask >> bit & 1),
        electrodes=electrodes,
        drive_offset=drive,
        measure_offset=measure,
        samples_per_scan=samples,
        sample_format=SampleFormat(code),
        volts_per_count=volts,
        scan_rate_hz=rate,
    )
    _check_hello(hello)
    return hello


def _check_hello(hello: Hello) -> None:
    _check_string("Hello.device_id", hello.device_id)
    _check_string("Hello.firmware", hello.firmware)
    for channel in hello.channels:
        _channel("Hello.channels", channel)
    ordered = [channel for channel in Channel if channel in hello.channels]
    if not hello.channels or list(hello.channels) != ordered:
        raise FieldError("Hello.channels", hello.channels, "one or more, ascending, none twice")
    _integer("Hello.electrodes", hello.electrodes, 2, _U8)
    _integer("Hello.drive_offset", hello.drive_offset, 1, hello.electrodes - 1)
    _integer("Hello.measure_offset", hello.measure_offset, 1, hello.electrodes - 1)
    _integer("Hello.samples_per_scan", hello.samples_per_scan, 1, MAX_SAMPLES)
    _member("Hello.sample_format", hello.sample_format, SampleFormat)
    if not (_is_finite(hello.volts_per_count) and hello.volts_per_count > 0):
        raise FieldError("Hello.volts_per_count", hello.volts_per_count, "finite and above 0 V")
    rate_hz = hello.scan_rate_hz
    if not (_is_finite(rate_hz) and (rate_hz == 0 or MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ)):
        allowed = f"0, or from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:.0f} Hz"
        raise FieldError("Hello.scan_rate_hz", rate_hz, allowed)


def _pack_acknowledge(acknowledge: Acknowledge) -> bytes:
    return _ACKNOWLEDGE_BODY.pack(
        PROTOCOL_VERSION,
        _ACKNOWLEDGE,
        _integer("Acknowledge.request", acknowledge.request, 0, _U8),
        _integer("Acknowledge.command", acknowledge.command, 0, _U8),
        _member("Acknowledge.status", acknowledge.status, AckStatus),
    )


def _unpack_acknowledge(content: bytes) -> Acknowledge:
    _check_size(len(content) == _ACKNOWLEDGE_BODY.size)
    _, _, request, command, status = _ACKNOWLEDGE_BODY.unpack(content)
    return Acknowledge(request, _command_code(command), AckStatus(status))


def _pack_companion(reading: CompanionReading) -> bytes:
    head = (
        _integer("CompanionReading.index", reading.index, 0, _U8),
        _integer("CompanionReading.flags", reading.flags, 0, _U8),
        _integer("CompanionReading.device_us", reading.device_us, 0, MAX_DEVICE_US),
    )
    if _is_finite(reading.value):
        with contextlib.suppress(OverflowError):  # beyond every float32
            return _COMPANION_BODY.pack(PROTOCOL_VERSION, _COMPANION, *head, reading.value)
    raise FieldError("CompanionReading.value", reading.value, "a finite float32")


def _unpack_companion(content: bytes) -> CompanionReading:
    _check_size(len(content) == _COMPANION_BODY.size)
    _, _, index, flags, device_us, value = _COMPANION_BODY.unpack(content)
    _integer("CompanionReading.device_us", device_us, 0, MAX_DEVICE_US)
    if not math.isfinite(value):
        raise FieldError("CompanionReading.value", value, "finite")
    return CompanionReading(index, ScanFlag(flags), device_us, value)


def _pack_command(command: Command) -> bytes:
    is_set_rate = command.code == CommandCode.SET_RATE
    if is_set_rate and not (_is_finite(command.rate_hz) and command.rate_hz > 0):
        raise FieldError("Command.rate_hz", command.rate_hz, "finite and above 0 Hz")
    if not is_set_rate and command.rate_hz != 0:
        raise FieldError("Command.rate_hz", command.rate_hz, "0 for commands other than SET_RATE")
    return _COMMAND_BODY.pack(
        PROTOCOL_VERSION,
        _COMMAND,
        _integer("Command.code", command.code, 0, _U8),
        _integer("Command.request", command.request, 0, _U8),
        command.rate_hz,
    )


def _unpack_command(content: bytes) -> Command:
    _check_size(len(content) == _COMMAND_BODY.size)
    _, _, code, request, rate_hz = _COMMAND_BODY.unpack(content)
    # A bad rate is the device's to refuse, with an acknowledgement; elsewhere it means nothing.
    return Command(_command_code(code), request, rate_hz if code == CommandCode.SET_RATE else 0.0)


def _pack_unknown(packet: UnknownPacket) -> bytes:
    kind = _integer("UnknownPacket.type", packet.type, 0, _U8)
    if kind in _KNOWN_TYPES:
        raise FieldError("UnknownPacket.type", kind, "a type that this version does not define")
    if len(packet.body) > _MAX_BODY:
        raise FieldError("UnknownPacket.body", packet.body, f"at most {_MAX_BODY} bytes")
    return _PREFIX.pack(PROTOCOL_VERSION, kind) + packet.body


_PACK: dict[type, Callable[[Any], bytes]] = {
    Scan: _pack_scan,
    Hello: _pack_hello,
    Acknowledge: _pack_acknowledge,
    CompanionReading: _pack_companion,
    Command: _pack_command,
    UnknownPacket: _pack_unknown,
}
_KNOWN_TYPES: dict[int, tuple[str, Callable[[bytes], Packet]]] = {
    _SCAN: ("scan", _unpack_scan),
    _HELLO: ("hello", _unpack_hello),
    _ACKNOWLEDGE: ("acknowledge", _unpack_acknowledge),
    _COMPANION: ("companion", _unpack_companion),
    _COMMAND: ("command", _unpack_command),
}


def _format_of(samples: Samples) -> SampleFormat:
    if not isinstance(samples, np.ndarray) or samples.ndim != 1:
        raise FieldError("Scan.samples", samples, "a 1-D NumPy array")
    if not 1 <= len(samples) <= MAX_SAMPLES:
        raise FieldError("len(Scan.samples)", len(samples), f"from 1 to {MAX_SAMPLES}")
    for sample_format in SampleFormat:
        if samples.dtype == sample_format.dtype:
            return sample_format
    raise FieldError("Scan.samples.dtype", samples.dtype, "int16, int32 or float32")


def _command_code(code: int) -> int:
    try:
        return CommandCode(code)
    except ValueError:
        return code


def _pack_string(text: str) -> bytes:
    data = text.encode()
    return bytes([len(data)]) + data


def _unpack_string(content: bytes, start: int) -> tuple[str, int]:
    _check_size(start < len(content))
    end = start + 1 + content[start]  # beyond the content: the caller's check of the end fails
    return content[start + 1 : end].decode(), end


def _check_string(field: str, text: str) -> None:
    allowed = f"1 to {MAX_STRING_BYTES} bytes of UTF-8 without control characters"
    try:
        size = len(text.encode())
    except (UnicodeEncodeError, AttributeError):  # a lone surrogate, or no string at all
        raise FieldError(field, text, allowed) from None
    # Device names go to terminals and logs: no escape sequences in them (C0, DEL and C1).
    has_control = any(ord(c) < 0x20 or 0x7F <= ord(c) <= 0x9F for c in text)
    if not 1 <= size <= MAX_STRING_BYTES or has_control:
        raise FieldError(field, text, allowed)


def _integer(field: str, value: int, low: int, high: int) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = low - 1
    if not low <= number <= high:
        raise FieldError(field, value, f"an integer from {low} to {high}")
    return number


def _channel(field: str, value: Channel) -> Channel:
    try:
        return Channel(value)
    except ValueError:
        raise FieldError(field, value, f"one of {', '.join(Channel)}") from None


def _member(field: str, value: int, kind: type[SampleFormat] | type[AckStatus]) -> int:
    try:
        return int(kind(value))
    except ValueError:
        allowed = ", ".join(f"{member.value} ({member.name})" for member in kind)
        raise FieldError(field, value, f"one of {allowed}") from None


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except (TypeError, OverflowError):  # not a number, or an int beyond every float
        return False


def _check_size(is_right: bool) -> None:
    if not is_right:
        raise ValueError("the body has the wrong length")
