"""The test vectors are current, mean what they say, and agree with a second reading of the spec.

The first half of this file is that second reading: a decoder written from the tables of
PROTOCOL.md with nothing but arithmetic, which shares no line with the package it judges.
"""

import ctypes
import json
import struct
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import protocol_vectors as vectors
import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import need
from tactomo_protocol import Decoder, Packet, encode

FOLDER = Path(__file__).parents[2] / "firmware_protocol"
JsonMap = dict[str, Any]


def load(name: str) -> list[JsonMap]:
    vectors: list[JsonMap] = json.loads((FOLDER / "vectors" / name).read_text("utf-8"))["vectors"]
    return vectors


# --- a second reading of PROTOCOL.md ------------------------------------------------------------


class RefusedError(Exception):
    """A frame yields no packet; the message is the counter that it adds to."""


def unstuff(encoded: bytes) -> bytes:
    out = bytearray()
    at = 0
    while at < len(encoded):
        code = encoded[at]
        if at + code > len(encoded):
            raise RefusedError("cobs_errors")
        out += encoded[at + 1 : at + code]
        at += code
        if code != 0xFF and at < len(encoded):
            out.append(0)
    return bytes(out)


def checksum(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def u(data: bytes, offset: int, size: int) -> int:
    assert offset + size <= len(data)
    return sum(byte << 8 * i for i, byte in enumerate(data[offset : offset + size]))


def read_scan(p: bytes) -> JsonMap:
    kind, count = u(p, 16, 1), u(p, 18, 2)
    size = {1: 2, 2: 4, 3: 4}[kind]
    assert u(p, 2, 1) <= 1
    assert 1 <= count <= 1024
    assert len(p) == 20 + count * size
    assert u(p, 8, 8) < 2**53
    raw = [u(p, 20 + i * size, size) for i in range(count)]
    signed = [value - (value >> (8 * size - 1) << 8 * size) for value in raw]
    return {
        "packet": "scan",
        "channel": u(p, 2, 1),
        "flags": u(p, 3, 1),
        "counter": u(p, 4, 4),
        "device_us": str(u(p, 8, 8)),
        "sample_format": kind,
        "samples": [f"0x{value:08x}" for value in raw] if kind == 3 else signed,
    }


def read_hello(p: bytes) -> JsonMap:
    size = u(p, 25, 1)
    texts = [p[26 : 26 + size], p[27 + size :]]
    assert len(p) == 27 + size + u(p, 26 + size, 1)
    for text in texts:
        assert 1 <= len(text) <= 64
        assert not any(ord(c) < 32 or 127 <= ord(c) < 160 for c in text.decode())
    volts, rate = (struct.unpack_from("<d", p, at)[0] for at in (8, 16))
    assert 0 < volts < float("inf")
    assert rate == 0 or 0.001 <= rate <= 1_000_000
    electrodes, drive, measure = u(p, 6, 1), u(p, 7, 1), u(p, 24, 1)
    assert electrodes >= 2
    assert 1 <= drive < electrodes
    assert 1 <= measure < electrodes
    assert 1 <= u(p, 2, 1) <= 3
    assert 1 <= u(p, 3, 1) <= 3
    assert 1 <= u(p, 4, 2) <= 1024
    return {
        "packet": "hello",
        "device_id": texts[0].decode(),
        "firmware": texts[1].decode(),
        "channels": [bit for bit in (0, 1) if u(p, 2, 1) & 1 << bit],
        "electrodes": electrodes,
        "drive_offset": drive,
        "measure_offset": measure,
        "samples_per_scan": u(p, 4, 2),
        "sample_format": u(p, 3, 1),
        "volts_per_count": volts,
        "scan_rate_hz": rate,
    }


def read_acknowledge(p: bytes) -> JsonMap:
    assert len(p) == 5
    assert p[4] <= 3
    return {"packet": "acknowledge", "request": p[2], "command": p[3], "status": p[4]}


def read_command(p: bytes) -> JsonMap:
    assert len(p) == 12
    rate = struct.unpack_from("<d", p, 4)[0] if p[2] == 4 else 0.0
    return {
        "packet": "command",
        "code": p[2],
        "request": p[3],
        "rate_hz": "nan" if rate != rate else rate,
    }


READERS = {0x01: read_scan, 0x02: read_hello, 0x03: read_acknowledge, 0x81: read_command}


def read_frame(encoded: bytes) -> JsonMap:
    if len(encoded) > 4137:
        raise RefusedError("oversize")
    payload = unstuff(encoded)
    p = payload[:-4]
    if len(payload) < 6 or checksum(p) != u(payload, len(p), 4):
        raise RefusedError("crc_errors")
    if p[0] != 1:
        raise RefusedError("wrong_version")
    if p[1] not in READERS:
        return {"packet": "unknown", "type": p[1], "body": p[2:].hex()}
    try:
        return READERS[p[1]](p)
    except (AssertionError, KeyError, UnicodeDecodeError):
        raise RefusedError("malformed") from None


def read_stream(stream: bytes) -> tuple[list[JsonMap], dict[str, int]]:
    counts = dict.fromkeys(asdict(Decoder().counts), 0)
    packets = []
    _, *frames = stream.split(b"\0")  # what comes before the first delimiter is dropped
    unfinished = frames.pop() if frames else b""
    counts["oversize"] += len(unfinished) > 4137
    for encoded in filter(None, frames):
        try:
            packets.append(read_frame(encoded))
        except RefusedError as refused:
            counts[str(refused)] += 1
    counts["packets"] = len(packets)
    counts["unknown_type"] = sum(packet["packet"] == "unknown" for packet in packets)
    return packets, counts


# --- the vectors ----------------------------------------------------------------------------------


def test_the_documented_command_writes_the_files_that_are_there(tmp_path: Path) -> None:
    command = [sys.executable, vectors.__file__, str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    written = {path.name: path.read_text("utf-8") for path in tmp_path.iterdir()}
    present = {path.name: path.read_text("utf-8") for path in (FOLDER / "vectors").iterdir()}
    assert written == present, (
        "run: python tests/support/protocol_vectors.py firmware_protocol/vectors"
    )


def test_the_command_says_when_there_is_no_such_folder(tmp_path: Path) -> None:
    command = [sys.executable, vectors.__file__, str(tmp_path / "missing")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "missing is not a folder" in done.stderr


def test_packet_vectors() -> None:
    for vector in load("packets.json"):
        frame, payload = bytes.fromhex(vector["frame"]), bytes.fromhex(vector["payload"])
        name = vector["name"]
        assert frame[0] == frame[-1] == 0, name
        assert unstuff(frame[1:-1]) == payload, name
        assert read_frame(frame[1:-1]) == vector["fields"], f"{name}: the specification differs"
        [packet] = Decoder().feed(frame)
        assert vectors.fields(packet) == vector["fields"], name
        assert encode(packet) == frame, name


def test_stream_vectors() -> None:
    for vector in load("streams.json"):
        stream, name = bytes.fromhex(vector["stream"]), vector["name"]
        expected = vector["packets"], vector["counts"]
        assert read_stream(stream) == expected, f"{name}: the specification differs"
        for size in (1, 7, 64, len(stream) + 1):
            decoder = Decoder()
            chunks = (stream[i : i + size] for i in range(0, len(stream), size))
            packets = [packet for chunk in chunks for packet in decoder.feed(chunk)]
            assert [vectors.fields(packet) for packet in packets] == vector["packets"], (name, size)
            assert asdict(decoder.counts) == vector["counts"], (name, size)


def test_every_kind_of_packet_and_of_error_has_a_vector() -> None:
    kinds = {vector["fields"]["packet"] for vector in load("packets.json")}
    assert kinds == {"scan", "hello", "acknowledge", "command", "unknown"}
    counted = {name for vector in load("streams.json") for name, n in vector["counts"].items() if n}
    assert counted == set(asdict(Decoder().counts))


def fields_and_counts(stream: bytes) -> tuple[list[JsonMap], dict[str, int]]:
    decoder = Decoder()
    packets: list[Packet] = decoder.feed(stream)
    return [vectors.fields(packet) for packet in packets], asdict(decoder.counts)


FRAMES = [bytes.fromhex(v["frame"]) for v in load("packets.json") if len(v["frame"]) < 400]
PIECES = st.one_of(
    st.sampled_from(FRAMES),
    st.lists(st.sampled_from([0, 1, 2, 3, 0xFF]), max_size=8).map(bytes),  # much COBS, few bytes
    st.builds(lambda n: b"\x01" * n, st.integers(4130, 4145)),
    st.builds(lambda frame, n: frame[:n], st.sampled_from(FRAMES), st.integers(0, 40)),
)


@given(st.lists(PIECES, max_size=6).map(b"".join))
def test_both_readings_of_the_specification_agree_on_any_stream(stream: bytes) -> None:
    assert fields_and_counts(stream) == read_stream(stream)


# --- PROTOCOL.md ----------------------------------------------------------------------------------


def test_the_worked_example_is_the_vector() -> None:
    [start] = [vector for vector in load("packets.json") if vector["name"] == "start"]
    text = (FOLDER / "PROTOCOL.md").read_text("utf-8")
    for part in ("payload", "frame"):
        assert bytes.fromhex(start[part]).hex(" ") in text, part


@pytest.fixture(scope="module")
def c_code(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The C of PROTOCOL.md, compiled."""
    need("cc")
    folder = tmp_path_factory.mktemp("c")
    _, after = (FOLDER / "PROTOCOL.md").read_text("utf-8").split("```c\n")
    code, _ = after.split("```", 1)
    source, library = folder / "cobs.c", folder / "cobs.so"
    source.write_text("#include <stddef.h>\n#include <stdint.h>\n" + code)
    options = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run(["cc", *options, "-o", library, source], check=True, timeout=60)
    return ctypes.CDLL(str(library))


def test_the_c_of_the_specification_gives_the_vectors(c_code: ctypes.CDLL) -> None:
    for vector in load("packets.json"):
        encoded, payload = bytes.fromhex(vector["frame"])[1:-1], bytes.fromhex(vector["payload"])
        name, out = vector["name"], ctypes.create_string_buffer(b"\xee" * 8192)
        size = c_code.cobs_encode(payload, len(payload), out)
        assert out.raw[:size] == encoded, name
        assert size <= len(payload) + len(payload) // 254 + 1, name
        assert c_code.cobs_decode(encoded, len(encoded), out) == len(payload), name
        assert out.raw[: len(payload)] == payload, name
        longer = encoded + b"\x02"
        assert c_code.cobs_decode(longer, len(longer), out) == 0, f"{name}: a code beyond the end"


def test_the_checksum_has_the_stated_check_value() -> None:
    assert checksum(b"123456789") == 0xCBF43926
