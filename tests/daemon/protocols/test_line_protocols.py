"""Boards that print their readings: what becomes of their lines, whole, damaged or of another."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tactomo.errors import ConfigError
from tactomo.protocols import ForeignProtocol, protocol_named, recognised
from tactomo.protocols.lines import MAX_LINE_BYTES
from tactomo.protocols.matrix import Matrix
from tactomo_models import SensorDescription, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DescriptionError
from tactomo_protocol import Hello, Packet, Scan
from variants import variant

BANNER = b"\n*******************\nOpenEIT:\nPress:\n a for Time-Series,\n c for Imaging\nmode 3\r\n"
OPENEIT = load_description("openeit_disc")
MATRIX = load_description("matrix_disc")
SQUARE = load_description("matrix_square")
VALUES = np.arange(1, 257) / 16.0


def openeit_line(values: FloatArray) -> bytes:
    """As the firmware prints it."""
    fields = "".join(f"{int(v):8d}.{int(v % 1 * 16) * 625:04d}," for v in values)
    return b"magnitudes: " + fields.encode() + b"\r\n"


def teensy_line(values: FloatArray) -> bytes:
    return "".join(f"{v:.4f}, " for v in values).encode() + b"\n"


def table_of(description: SensorDescription, volts: FloatArray) -> FloatArray:
    """Every drive by every measuring pair, zeros where they touch."""
    count = description.electrode_count
    table = np.zeros((count, count))
    table[description.pairs.drive[:, 0], description.pairs.measure[:, 0]] = volts
    return table


def scans(packets: list[Packet]) -> list[list[float]]:
    return [packet.samples.tolist() for packet in packets if isinstance(packet, Scan)]


def begun(protocol: ForeignProtocol) -> ForeignProtocol:
    """Past the line that it was in when we came."""
    assert protocol.feed(b"rest\n") == []
    return protocol


def fed(data: bytes, **changes: Any) -> ForeignProtocol:
    protocol = begun(Matrix(variant(MATRIX, **changes)))
    protocol.feed(data)
    return protocol


@given(st.lists(st.integers(1, 400), max_size=30))
@settings(max_examples=30)
def test_an_openeit_frame_comes_whole_in_any_chunking(cuts: list[int]) -> None:
    stream = BANNER + openeit_line(VALUES[:192]) + b"Imaging\n" + openeit_line(VALUES[1:193])
    protocol, packets = Matrix(OPENEIT), []
    for cut in [*cuts, len(stream)]:
        packets += protocol.feed(stream[:cut])
        stream = stream[cut:]
    hello, *_ = packets
    assert isinstance(hello, Hello)
    assert (hello.electrodes, hello.drive_offset, hello.samples_per_scan) == (16, 8, 192)
    assert scans(packets) == [VALUES[:192].tolist(), VALUES[1:193].tolist()]
    assert [packet.counter for packet in packets if isinstance(packet, Scan)] == [0, 1]
    assert protocol.counts.corrupt == 0
    assert protocol.trouble is None


def test_a_build_with_a_menu_is_told_what_the_description_says() -> None:
    assert Matrix(OPENEIT).introduction() == [b"d\n"]
    assert Matrix(variant(OPENEIT, instrument={"start": "c\r"})).introduction() == [b"c\r"]
    assert Matrix(variant(MATRIX, instrument={"start": "y"})).introduction() == [b"y"]
    assert Matrix(MATRIX).introduction() == []


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"    1250.0625 \r\n", "1 numbers a line; the description openeit_disc"),  # mode a
        (b"magnitudes:200;    1250.0625 \r\n", "2 numbers a line"),  # mode b
        (openeit_line(np.ones(896)), "896 numbers a line, as of 32 electrodes (opposite drive)"),
    ],
)
def test_openeit_in_another_mode_is_refused(line: bytes, said: str) -> None:
    protocol = begun(Matrix(OPENEIT))
    protocol.feed(line * 2)
    assert protocol.trouble is None  # it may be damage
    protocol.feed(line)
    assert protocol.trouble is not None
    assert said in protocol.trouble.cause
    assert protocol.counts.malformed == 3
    protocol.feed(openeit_line(np.ones(192)))
    assert protocol.trouble is None


FORMATS: dict[str, Callable[[FloatArray], bytes]] = {
    "commas, one behind": teensy_line,
    "prefixed": lambda v: b"magnitudes: " + teensy_line(v),
    "spaces": lambda v: b" ".join(b"%g" % x for x in v) + b"\r\n",
    "tabs": lambda v: b"\t".join(b"%.17g" % x for x in v) + b"\n",
    "semicolons": lambda v: b";".join(b"%e" % x for x in v) + b"\n",
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("whole", [True, False], ids=["all pairs", "those that do not touch"])
def test_a_table_comes_in_many_forms(name: str, whole: bool) -> None:
    volts = VALUES[:208]
    sent = table_of(MATRIX, volts).ravel() if whole else volts
    protocol = begun(Matrix(MATRIX))
    assert scans(protocol.feed(FORMATS[name](sent) * 2)) == [volts.tolist()] * 2
    assert protocol.counts.corrupt == 0


def test_what_stands_where_pairs_touch_is_of_no_consequence() -> None:
    table = table_of(MATRIX, VALUES[:208])
    table[table == 0] = 2000.0
    assert scans(begun(Matrix(MATRIX)).feed(teensy_line(table.ravel()))) == [VALUES[:208].tolist()]


@pytest.mark.parametrize("beginning", [b"A\n", b"\n", b"A\r\n", b"\r\n"])
def test_a_line_for_each_drive_after_one_that_begins(beginning: bytes) -> None:
    rows = (table_of(MATRIX, VALUES[:208]) * 16).astype(int)
    frame = beginning + b"".join(b",".join(b"%d" % x for x in row) + b"\r\n" for row in rows)
    protocol = begun(Matrix(variant(MATRIX, instrument={"volts_per_unit": 1 / 16})))
    assert scans(protocol.feed(frame + frame)) == [VALUES[:208].tolist()] * 2
    cut = frame.splitlines(keepends=True)
    del cut[5]
    assert scans(protocol.feed(b"".join(cut) + frame)) == [VALUES[:208].tolist()]
    assert protocol.counts.malformed == 1


def test_readings_against_ground_become_differences() -> None:
    potentials = np.random.default_rng(1).uniform(0, 1, (16, 16)).round(4)
    instrument = {"voltages": "signed", "referenced": "single_ended"}
    protocol = begun(Matrix(variant(MATRIX, instrument=instrument)))
    [[*volts]] = scans(protocol.feed(teensy_line(potentials.ravel())))
    k, m = MATRIX.pairs.drive[:, 0], MATRIX.pairs.measure
    expected = potentials[k, m[:, 0]] - potentials[k, m[:, 1]]
    assert volts == pytest.approx(expected, abs=1e-6)


def test_listed_pairs_have_a_table_of_their_own() -> None:
    pattern = {"drive": [[0, 8], [4, 12], [2, 9]], "measure": [[1, 2], [5, 7], [13, 15], [9, 10]]}
    sensor = variant(MATRIX, pattern=pattern)
    line = teensy_line(np.arange(12.0))
    assert scans(begun(Matrix(sensor)).feed(line)) == [
        [float(n) for n in range(12) if n not in (8, 11)]  # (2, 9) touches (1, 2) and (9, 10)
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (teensy_line(np.ones(1024)), "1024 numbers a line, as of 32 electrodes (every drive by"),
        (teensy_line(np.ones(40)), "as of 8 electrodes (adjacent drive)"),
        (teensy_line(np.ones(16)), "no line, empty or of an A, that says where a frame begins"),
        (b"A\n" + teensy_line(np.ones(16)) * 8, "frames of 8 lines of 16 numbers"),
    ],
)
def test_another_boards_table_is_named(line: bytes, said: str) -> None:
    protocol = fed(line * 4)
    assert protocol.trouble is not None
    assert said in protocol.trouble.cause
    assert protocol.counts.packets == 0
    protocol.feed(teensy_line(np.ones(208)))
    assert protocol.trouble is None


@pytest.mark.parametrize(
    "line",
    [
        openeit_line(VALUES[:192])[:1500] + b"\x00\xff garbage\n",
        openeit_line(VALUES[:192]).replace(b"5", b"\xb5", 1),
        b"\x1b[2J" + b"x" * 300 + b"\n",
    ],
)
def test_a_damaged_line_costs_itself(line: bytes) -> None:
    whole = openeit_line(VALUES[:192])
    protocol = begun(Matrix(OPENEIT))
    assert len(scans(protocol.feed(whole + line + whole))) == 2
    assert (protocol.counts.damaged, protocol.counts.faulty) == (1, 0)
    assert protocol.trouble is None


def test_a_line_that_never_ends_takes_no_memory() -> None:
    protocol = begun(Matrix(MATRIX))
    tracemalloc.start()
    for _ in range(2000):
        protocol.feed(b"1.0, " * 200)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * MAX_LINE_BYTES
    assert protocol.counts.oversize == 1
    assert scans(protocol.feed(b"\n" + teensy_line(np.ones(208)))) == [[1.0] * 208]


@given(st.data())
def test_a_recording_may_begin_anywhere(data: st.DataObject) -> None:
    """What a new object is told at the cut makes it say what the old one goes on to say."""
    rows = b"A\n" + b"".join(teensy_line(VALUES[k : k + 16]) for k in range(16))
    stream = b"x\n" + rows + teensy_line(VALUES[:208]) + rows + b"hello\n" + rows
    old, new = Matrix(MATRIX), Matrix(MATRIX)
    cut = data.draw(st.integers(0, len(stream)))
    before = old.feed(stream[:cut])
    after = new.feed(old.preamble() + stream[cut:])
    expected = [p for p in old.feed(stream[cut:]) if isinstance(p, Scan)]
    found = [p for p in after if isinstance(p, Scan)]
    if before:
        assert found == expected
    else:  # nothing was recorded yet but the bytes; a line that had begun is lost
        assert scans(after) == scans(expected)[len(expected) - len(found) :]  # type: ignore[arg-type]


def test_a_new_cable_does_not_finish_the_old_line() -> None:
    line = teensy_line(VALUES[:208])
    protocol = begun(Matrix(MATRIX))
    protocol.feed(line + line[:500])
    protocol.restart()
    assert protocol.begun() == b""
    hello, scan = protocol.feed(line[500:] + line)
    assert hello == protocol.hello()  # for the port: who is there now is the same
    assert scans([scan]) == [VALUES[:208].tolist()]
    assert isinstance(scan, Scan)
    assert scan.counter == 1
    assert protocol.counts.corrupt == 0


def test_ports_are_recognised_by_what_they_print() -> None:
    assert recognised(openeit_line(VALUES[:192])[300:] + openeit_line(VALUES[:192]) * 2) == "matrix"
    assert recognised(teensy_line(np.ones(256)) * 4) == "matrix"
    assert recognised(b"x" + teensy_line(np.ones(16)) * 4) == "matrix"
    assert recognised(b"temperature 1\ntemperature 2\n") is None
    assert recognised(bytes(range(256)) * 8) is None


@pytest.mark.parametrize(
    ("protocol", "sensor", "said"),
    [
        ("matrix", load_description("paper_square"), "two channels"),
        ("matrix", variant(SQUARE, electrodes={"per_side": 9}), "1188 voltages, and a scan at"),
    ],
)
def test_a_description_of_another_board_is_refused(
    protocol: str, sensor: SensorDescription, said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        protocol_named(protocol, sensor)


def test_readings_against_the_sink_have_their_sign() -> None:
    with pytest.raises((DescriptionError, ValueError), match="positive by themselves"):
        variant(MATRIX, instrument={"referenced": "single_ended"})
