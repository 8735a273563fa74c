"""The test vectors mean what they say; `test_c_codec` is the second reading."""

import ctypes
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest
from cobs import cobs
from needs import need
from protocol_vectors import fields, load
from tactomo_protocol import Decoder, encode

FOLDER = Path(__file__).parents[2] / "firmware_protocol"


def test_packet_vectors() -> None:
    for vector in load("packets.json"):
        frame, payload = bytes.fromhex(vector["frame"]), bytes.fromhex(vector["payload"])
        name = vector["name"]
        assert frame[0] == frame[-1] == 0, name
        assert cobs.decode(frame[1:-1]) == payload, name
        [packet] = Decoder().feed(frame)
        assert fields(packet) == vector["fields"], name
        assert encode(packet) == frame, name


def test_stream_vectors() -> None:
    for vector in load("streams.json"):
        stream, name = bytes.fromhex(vector["stream"]), vector["name"]
        for size in (1, 7, 64, len(stream) + 1):
            decoder = Decoder()
            chunks = (stream[i : i + size] for i in range(0, len(stream), size))
            packets = [packet for chunk in chunks for packet in decoder.feed(chunk)]
            assert [fields(packet) for packet in packets] == vector["packets"], (name, size)
            assert asdict(decoder.counts) == vector["counts"], (name, size)


def test_every_kind_of_packet_and_of_error_has_a_vector() -> None:
    kinds = {vector["fields"]["packet"] for vector in load("packets.json")}
    assert kinds == {"scan", "hello", "acknowledge", "companion", "command", "unknown"}
    counted = {name for vector in load("streams.json") for name, n in vector["counts"].items() if n}
    assert counted == set(asdict(Decoder().counts))


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
