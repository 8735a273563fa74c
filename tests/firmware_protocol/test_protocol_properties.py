"""Properties of the codec: round trip, survival of any bytes, and damage that stays local."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np
import pytest
from any_packets import PACKETS, SMALL_PACKETS
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st
from tactomo_protocol import (
    MAX_FRAME_BYTES,
    Channel,
    Command,
    CommandCode,
    Decoder,
    Packet,
    Scan,
    ScanFlag,
    UnknownPacket,
    encode,
)
from tactomo_protocol import cobs as our_cobs


def chunked(data: st.DataObject, stream: bytes) -> Iterable[bytes]:
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    return [stream[i:j] for i, j in zip([0, *cuts], [*cuts, len(stream)], strict=True)]


def feed_all(decoder: Decoder, chunks: Iterable[bytes]) -> list[Packet]:
    return [packet for chunk in chunks for packet in decoder.feed(chunk)]


@given(st.data(), st.lists(PACKETS, max_size=8))
def test_any_packets_round_trip_in_any_chunks(data: st.DataObject, packets: list[Packet]) -> None:
    frames = [encode(packet) for packet in packets]
    assert all(0 not in frame[1:-1] for frame in frames)
    assert all(len(frame) <= MAX_FRAME_BYTES for frame in frames)
    decoder = Decoder()
    assert feed_all(decoder, chunked(data, b"".join(frames))) == packets
    assert decoder.counts.packets == len(packets)
    assert decoder.counts.corrupt == 0
    assert decoder.counts.unknown_type == sum(isinstance(p, UnknownPacket) for p in packets)


def runs() -> st.SearchStrategy[bytes]:
    """Bytes with runs without a zero about as long as a block holds."""
    run = st.sampled_from([0, 1, 253, 254, 255, 508, 509]).map(lambda size: b"\x07" * size)
    return st.lists(st.one_of(run, st.binary())).map(b"\0".join)


@given(runs())
def test_our_framing_is_cobs_as_others_write_it(data: bytes) -> None:
    encoded = our_cobs.encode(data)
    assert encoded == bytes(cobs.encode(data))
    assert our_cobs.decode(encoded) == data
    assert len(encoded) <= our_cobs.max_encoded_length(len(data))


@given(st.lists(st.integers(1, 255), min_size=1).map(bytes))
def test_what_is_no_cobs_is_refused_as_others_refuse_it(encoded: bytes) -> None:
    try:
        decoded = bytes(cobs.decode(encoded))
    except cobs.DecodeError:
        with pytest.raises(ValueError, match="beyond the end"):
            our_cobs.decode(encoded)
    else:
        assert our_cobs.decode(encoded) == decoded


def framed(content: bytes) -> bytes:
    """A frame whose checksum is right, around content that need not be."""
    return b"\0" + bytes(cobs.encode(content + crc32(content).to_bytes(4, "little"))) + b"\0"


def contents() -> st.SearchStrategy[bytes]:
    """Plausible to implausible contents: random ones of each type, and true ones with a change."""
    random = st.builds(
        lambda kind, body: bytes([1, kind]) + body, st.sampled_from([1, 2, 3, 0x81, 9]), st.binary()
    )
    true = PACKETS.map(lambda packet: bytes(cobs.decode(encode(packet)[1:-1])[:-4]))
    altered = st.builds(
        lambda content, at, with_, cut: (
            content[: at % len(content)] + with_ + content[at % len(content) + cut :]
        ),
        true,
        st.integers(0, 60),
        st.binary(max_size=4),
        st.integers(0, 4),
    )
    return st.one_of(random, altered)


ANY_STREAM = st.lists(
    st.one_of(
        st.binary(),
        contents().map(framed),
        st.integers(1, 2 * MAX_FRAME_BYTES).map(lambda n: b"\x01" * n),
        st.integers(1, 9).map(bytes),
    ),
    max_size=6,
).map(b"".join)


@given(st.data(), ANY_STREAM)
def test_any_bytes_decode_without_an_exception_and_alike_in_any_chunks(
    data: st.DataObject, stream: bytes
) -> None:
    whole, parts = Decoder(), Decoder()
    packets = whole.feed(stream)
    again = feed_all(parts, chunked(data, stream))
    assert [repr(p) for p in packets] == [repr(p) for p in again]  # repr: a rate may be NaN
    assert whole.counts == parts.counts
    assert whole.counts.packets == len(packets)
    frames = sum(bool(part) for part in stream.split(b"\0"))
    assert whole.counts.packets + whole.counts.corrupt <= frames


def is_for_the_device_to_refuse(packet: Packet) -> bool:
    """A bad rate must reach the device, which says so; a host cannot send one."""
    return (
        isinstance(packet, Command)
        and packet.code == CommandCode.SET_RATE
        and not 0 < packet.rate_hz < math.inf
    )


@given(contents())
def test_whatever_decodes_is_a_packet_that_can_be_sent(content: bytes) -> None:
    decoder = Decoder()
    for packet in decoder.feed(framed(content)):
        assert is_for_the_device_to_refuse(packet) or Decoder().feed(encode(packet)) == [packet]
    assert decoder.counts.packets + decoder.counts.corrupt == 1


# --- damage -----------------------------------------------------------------------------------
#
# A stream is a list of cells, each a byte that remembers the frame it belongs to and its place in
# it. Damage replaces, inserts and removes cells. A frame is untouched if its cells, both its
# delimiters among them, still stand side by side.


@dataclass(frozen=True, slots=True)
class Cell:
    byte: int
    frame: int | None = None  # None: put there by the damage
    place: int = 0


def cells_of(frames: Sequence[bytes]) -> list[Cell]:
    return [Cell(b, f, i) for f, frame in enumerate(frames) for i, b in enumerate(frame)]


def untouched(cells: Sequence[Cell], frames: Sequence[bytes]) -> list[int]:
    """The frames that stand whole in `cells`."""
    starts = {cell.frame: i for i, cell in enumerate(cells) if cell.place == 0}
    return [
        f
        for f, frame in enumerate(frames)
        if f in starts and list(cells[starts[f] : starts[f] + len(frame)]) == cells_of_one(f, frame)
    ]


def cells_of_one(index: int, frame: bytes) -> list[Cell]:
    return [Cell(byte, index, place) for place, byte in enumerate(frame)]


def garbage() -> st.SearchStrategy[bytes]:
    long_run = st.integers(1, 2 * MAX_FRAME_BYTES).map(lambda n: b"\x01" * n)
    return st.one_of(st.binary(min_size=1, max_size=30), st.just(b"\0"), long_run)


@st.composite
def damaged(draw: st.DrawFn, cells: list[Cell]) -> list[Cell]:
    """One flip, insertion, deletion, zeroing or truncation, often at the edge of a frame."""
    edges = [i for i, cell in enumerate(cells) if cell.place == 0 and cell.frame is not None]
    anywhere = st.integers(0, len(cells))
    near_edge = st.builds(
        lambda edge, by: min(max(edge + by, 0), len(cells)),
        st.sampled_from(edges or [0]),
        st.integers(-3, 3),
    )
    at = draw(st.one_of(anywhere, near_edge))
    count = draw(st.one_of(st.integers(1, 4), st.integers(1, 80)))
    before, hit, after = cells[:at], cells[at : at + count], cells[at + count :]
    kind = draw(st.sampled_from(["flip", "insert", "delete", "zero", "truncate"]))
    if kind == "flip":
        mask = draw(st.integers(1, 255))
        return before + [Cell(cell.byte ^ mask) for cell in hit] + after
    if kind == "insert":
        return before + [Cell(byte) for byte in draw(garbage())] + hit + after
    if kind == "delete":
        return before + after
    if kind == "zero":
        return before + [cell if cell.byte == 0 else Cell(0) for cell in hit] + after
    return before


def is_subsequence(part: Iterable[Packet], whole: Iterable[Packet]) -> bool:
    rest = iter(whole)
    return all(any(candidate == packet for candidate in rest) for packet in part)


@given(st.data(), st.lists(SMALL_PACKETS, min_size=1, max_size=6), st.integers(1, 4))
def test_damage_loses_only_what_it_touches_and_invents_nothing(
    data: st.DataObject, sent: list[Packet], times: int
) -> None:
    frames = [encode(packet) for packet in sent]
    cells = cells_of(frames)
    for _ in range(times):
        cells = data.draw(damaged(cells))
    stream = bytes(cell.byte for cell in cells)
    decoded = feed_all(Decoder(), chunked(data, stream))
    whole = [sent[f] for f in untouched(cells, frames)]
    assert is_subsequence(decoded, sent), "a packet was invented or reordered"
    assert is_subsequence(whole, decoded), "a packet that was not touched is lost"


A, B, C = (
    Scan(Channel.MAGNITUDE, n, 50_000 * n, ScanFlag(0), np.array([n, -n], dtype=np.int16))
    for n in (1, 2, 3)
)


def test_every_single_byte_error_costs_that_packet_alone() -> None:
    before, hit, after = encode(A), encode(B), encode(C)
    for at, right in enumerate(hit):
        for wrong in set(range(256)) - {right}:
            damaged = hit[:at] + bytes([wrong]) + hit[at + 1 :]
            assert Decoder().feed(before + damaged + after) == [A, C], (at, wrong)
