"""The C library and the Python codec, each written from PROTOCOL.md, agree on every byte."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from any_packets import PACKETS, SMALL_PACKETS
from builds import runs
from c_firmware import C_FOLDER, Speaker, answered, build, f64_bits
from cobs import cobs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from needs import lacking, need
from protocol_vectors import fields, load
from tactomo_protocol import Command, Decoder, DecoderCounts, Packet, encode

COMMAND_TYPE = 0x81
JsonMap = dict[str, Any]
# One program serves all examples.
quickly = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


# --- what a device must make of a stream, by the Python decoder -----------------------------------


def is_malformed_otherwise(encoded: bytes) -> bool:
    """Whether a frame is malformed, but of a type that a device does not know."""
    decoder = Decoder()
    decoder.feed(b"\0" + encoded + b"\0")
    return bool(decoder.counts.malformed) and cobs.decode(encoded)[1] != COMMAND_TYPE


def seen_by_device(stream: bytes) -> tuple[list[Packet], DecoderCounts]:
    """Commands and counts: to a device each other type is unknown, whatever its body."""
    decoder = Decoder()
    packets = decoder.feed(stream)
    commands: list[Packet] = [packet for packet in packets if isinstance(packet, Command)]
    others = sum(map(is_malformed_otherwise, filter(None, stream.split(b"\0")[1:-1])))
    counts = decoder.counts
    return commands, replace(
        counts,
        packets=counts.packets + others,
        malformed=counts.malformed - others,
        unknown_type=counts.packets + others - len(commands),
    )


def assert_same(speaker: Speaker, stream: bytes, run: int | None = None) -> None:
    commands, counts = speaker.parse(stream, run)
    expected, expected_counts = seen_by_device(stream)
    assert list(map(fields, commands)) == list(map(fields, expected))
    assert counts == expected_counts


# --- the shared vectors ---------------------------------------------------------------------------


def test_each_vector_is_encoded_and_decoded_where_it_is_a_command(speaker: Speaker) -> None:
    for vector in load("packets.json"):
        frame, name = bytes.fromhex(vector["frame"]), vector["name"]
        [packet] = Decoder().feed(frame)
        assert fields(packet) == vector["fields"], name
        assert speaker.encode(packet) == frame, name
        commands, counts = speaker.parse(frame)
        is_command = vector["fields"]["packet"] == "command"
        assert [fields(c) for c in commands] == [vector["fields"]] * is_command, name
        assert counts == DecoderCounts(packets=1, unknown_type=int(not is_command)), name


def test_each_stream_gives_its_commands_and_counts(speaker: Speaker) -> None:
    same = ("crc_errors", "cobs_errors", "oversize", "wrong_version")
    for vector in load("streams.json"):
        stream, name = bytes.fromhex(vector["stream"]), vector["name"]
        expected = [packet for packet in vector["packets"] if packet["packet"] == "command"]
        for run in (None, 1, 2, 7, 64):
            commands, counts = speaker.parse(stream, run)
            assert [fields(command) for command in commands] == expected, name
            assert [getattr(counts, each) for each in same] == [
                vector["counts"][each] for each in same
            ], name
        assert_same(speaker, stream)


# --- any packets, any bytes -----------------------------------------------------------------------


@quickly
@given(PACKETS)
def test_both_encode_any_packet_alike(sanitized: Speaker, packet: Packet) -> None:
    assert sanitized.encode(packet) == encode(packet)


FRAMES = SMALL_PACKETS.map(encode)
PIECES = st.one_of(
    FRAMES,
    st.builds(lambda frame, n: frame[:n], FRAMES, st.integers(0, 40)),
    st.builds(
        lambda frame, at, bit: bytes(b ^ (1 << bit) * (i == at) for i, b in enumerate(frame)),
        FRAMES,
        st.integers(0, 40),
        st.integers(0, 7),
    ),
    st.lists(st.sampled_from([0, 1, 2, 3, 0xFF]), max_size=8).map(bytes),
    st.binary(max_size=40),
    st.builds(lambda n: b"\x01" * n, st.integers(4130, 4145)),
)


@quickly
@given(st.lists(PIECES, max_size=8).map(b"".join), st.integers(1, 30))
def test_both_make_the_same_of_any_stream(sanitized: Speaker, stream: bytes, run: int) -> None:
    assert_same(sanitized, stream, run)


# --- what a sender must not send ------------------------------------------------------------------

HELLO = ("3", "2", "208", "16", "1", "1", f64_bits(1e-6), f64_bits(20.0), "6161", "31")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *((0, value) for value in (0, 4)),
        *((1, value) for value in (0, 4)),
        *((2, value) for value in (0, 1025)),
        *((3, value) for value in (0, 1)),
        *((field, value) for field in (4, 5) for value in (0, 16)),
        *((6, f64_bits(value)) for value in (0.0, -1.0, float("inf"), float("nan"))),
        *((7, f64_bits(value)) for value in (-1.0, 5e-324, 9e-4, 1.1e6, 1e308)),
        *((7, f64_bits(value)) for value in (float("inf"), float("nan"))),
        *((field, "-") for field in (8, 9)),
        *((field, "61" * 65) for field in (8, 9)),
        *((8, code) for code in ("611b62", "c3", "80")),
    ],
)
def test_a_hello_against_the_rules_is_not_encoded(
    sanitized: Speaker, field: int, value: object
) -> None:
    assert answered(sanitized.ask("hello", *HELLO))
    fields: list[object] = [*HELLO]
    fields[field] = value
    assert not answered(sanitized.ask("hello", *fields))


@pytest.mark.parametrize(
    "scan",
    [
        *("2 0 0 0 1 1", "0 0 0 0 0 1", "0 0 0 0 4 1", "0 0 0 0 1 0", "0 0 0 0 1 1025"),
        *(f"0 0 0 {2**53} 1 1", f"0 0 0 {2**64 - 1} 1 1"),
    ],
)
def test_a_scan_against_the_rules_is_not_encoded(sanitized: Speaker, scan: str) -> None:
    assert answered(sanitized.ask("scan 1 0 0 0 1 1 0000"))
    assert not answered(sanitized.ask("scan", scan, "00" * 2050))


@pytest.mark.parametrize("reading", [f"0 0 {2**53} 0", "0 0 0 2143289344", "0 0 0 4286578688"])
def test_a_companion_against_the_rules_is_not_encoded(sanitized: Speaker, reading: str) -> None:
    assert answered(sanitized.ask("companion 0 0 0 1065353216"))
    assert not answered(sanitized.ask("companion", reading))  # a clock too far, NaN, -infinity


def test_there_is_no_status_4(sanitized: Speaker) -> None:
    assert not answered(sanitized.ask("acknowledge 0 0 4"))


def test_any_text_is_judged_as_python_judges_it(sanitized: Speaker) -> None:
    """Every first byte of a character with second bytes at each edge, in full length."""
    edges = (0x7F, 0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, 0xC0)
    verdicts: Counter[bool] = Counter()
    for first in range(0x20, 0x100):
        for second in edges:
            for tail in (b"", b"\x80", b"\x80\x80"):
                text = bytes([first, second]) + tail
                is_sent = bool(answered(sanitized.ask("hello", *HELLO[:8], text.hex(), "31")))
                assert is_sent == may_be_sent(text), text.hex()
                verdicts[is_sent] += 1
    assert min(verdicts.values()) > 100


def may_be_sent(text: bytes) -> bool:
    try:
        decoded = text.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return not any(ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0 for c in decoded)


# --- compilers and fuzzers ------------------------------------------------------------------------


@pytest.mark.parametrize("compiler", ["gcc", "clang", "arm-none-eabi-gcc"])
def test_the_library_compiles_without_a_warning(tmp_path: Path, compiler: str) -> None:
    if compiler == "arm-none-eabi-gcc":
        if shutil.which(compiler) is None:
            pytest.skip(f"needs {compiler} on the PATH")
        header = subprocess.run(
            [compiler, "-E", "-xc", "-"], input=b"#include <string.h>", capture_output=True
        )
        if header.returncode != 0:
            pytest.skip("needs the newlib of arm-none-eabi-gcc")
    need(compiler)
    build("example_firmware.o", compiler)
    for source in ("tactomo_protocol.c", "tactomo_device.c"):
        options = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-Os"]
        done = subprocess.run(
            [compiler, *options, "-c", "-o", str(tmp_path / "out.o"), str(C_FOLDER / source)],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("fuzzer", ["fuzz_parser", "fuzz_encoder", "fuzz_device"])
def test_a_fuzzer_finds_nothing_in_a_moment(tmp_path: Path, fuzzer: str) -> None:
    """Always the same inputs; `make fuzz` goes on for as long as one likes."""
    need("clang")
    empty = "int LLVMFuzzerTestOneInput(void) { return 0; }\n"
    if not runs("clang", "-fsanitize=fuzzer,address", empty):
        lacking("needs a clang with libFuzzer (Debian: libclang-rt-14-dev)")
    program = build(fuzzer)
    seeds = tmp_path / "seeds"
    subprocess.run([sys.executable, C_FOLDER / "tests" / "make_seeds.py", seeds], check=True)
    options = ["-seed=1", "-runs=1500", "-max_total_time=5", f"-artifact_prefix={tmp_path}/"]
    done = subprocess.run([program, *options, seeds], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
