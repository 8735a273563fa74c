"""Recovering recordings that were cut, flipped, zeroed or overwritten; and what is none."""

from __future__ import annotations

import functools
import json
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_bench import scan_counters
from fixture_types import Run, Start
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from tactomo.errors import RecordingError
from tactomo.recordings.recording import Origin, open_recording
from tactomo.recordings.recording_writer import (
    Entry,
    RecordingWriter,
    calibration_entry,
    pack_frame,
    reference_entry,
)
from tactomo.recordings.recovery import Recovery, recover
from tactomo.scans import FrameRecord, ScanKey
from tactomo_client.messages import array_from_wire
from tactomo_client.recording_file import intact_chunks
from tactomo_models import Reference
from tactomo_protocol import Channel, Hello, SampleFormat, Scan, ScanFlag, encode

PERIOD_NS = 50_000_000
SCANS = 40
RECALIBRATED = 30
A_CHUNK = 2
"""Dual scans in each chunk."""
ORIGIN = Origin("left", "paper_square", "ab" * 32, ("/dev/ttyACM0",), "0.1.0")
HELLO = Hello("bench-1", "1.2.3", tuple(Channel), 16, 1, 1, 208, SampleFormat.INT32, 1e-6, 20.0)
TAKES_FILES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def scan(channel: Channel, counter: int) -> Scan:
    samples = np.random.default_rng([counter, channel.number]).integers(
        50_000, 200_000, 208, np.int32
    )
    return Scan(channel, counter, counter * 50_000, ScanFlag(0), samples)


def write(path: Path) -> None:
    """Write a recording of many chunks: a hello, references at 1 and in the middle, marks.

    After three quarters another pressure calibration is put in force.
    """
    rest = np.linspace(0.05, 0.2, 208)
    reference = Reference.from_scans(np.stack([rest, rest * 1.0001]), None)
    writer = RecordingWriter(path, ORIGIN)
    writer.add(Entry("port/0/hello", encode(HELLO), 0, 0))
    references = 0
    for counter in range(SCANS):
        time_ns = counter * PERIOD_NS
        if counter in (0, SCANS // 2):
            references += 1
            writer.add(reference_entry(reference, references, time_ns, time_ns))
        if counter == RECALIBRATED:
            writer.add(calibration_entry("another", 1, time_ns, time_ns))
        packets = [scan(channel, counter) for channel in Channel]
        data = b"".join(encode(packet) for packet in packets)
        writer.add(Entry("port/0", data, time_ns, time_ns))
        keys = tuple(ScanKey(p.channel, p.counter, p.device_us) for p in packets)
        calibrations = int(counter >= RECALIBRATED)
        mark = FrameRecord(
            keys, "auto", None, reference_number=references, calibration_number=calibrations
        )
        writer.add(Entry("frame", pack_frame(mark), time_ns, time_ns))
        if counter % A_CHUNK == A_CHUNK - 1:
            writer.flush()
    writer.close()


@functools.cache
def whole() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "whole.mcap"
        write(path)
        return path.read_bytes()


@functools.cache
def chunks() -> list[tuple[int, int]]:
    """Where each chunk begins and ends in the whole file."""
    import io

    return [(chunk.start, chunk.end) for chunk in intact_chunks(io.BytesIO(whole()))]


def messages(path: Path) -> list[tuple[str, bytes, int, int]]:
    with path.open("rb") as file:
        return [
            (channel.topic, message.data, message.log_time, message.publish_time)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


def expected(damaged: bytes) -> list[int]:
    """Counters of the scans in the chunks that are byte for byte what they were."""
    found: list[int] = []
    for index, (start, end) in enumerate(chunks()):
        if damaged[start:end] == whole()[start:end]:
            found += range(index * A_CHUNK, (index + 1) * A_CHUNK)
    return found


def recovered(folder: Path, data: bytes) -> tuple[Recovery, Path]:
    damaged, output = folder / "damaged.mcap", folder / "out.mcap"
    damaged.write_bytes(data)
    output.unlink(missing_ok=True)
    recovery = recover(damaged, output)
    assert damaged.read_bytes() == data, "the damaged file stays as it is"
    assert {path.name for path in folder.iterdir()} == {"damaged.mcap", "out.mcap"}
    return recovery, output


def assert_honest(folder: Path, data: bytes) -> None:
    """Every intact chunk is in the new file, which any MCAP reader takes; the rest is told."""
    want = expected(data)
    if not want:
        with pytest.raises(RecordingError):
            recovered(folder, data)
        return
    recovery, output = recovered(folder, data)
    kept = scan_counters(output)
    assert set(want) <= set(kept)  # more where the damage is to a chunk's times alone
    assert kept == sorted(set(kept))
    want = kept
    recording = open_recording(output)
    assert recording.summary.is_complete
    assert recording.summary.corrupt == 0
    with output.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary() is not None
        assert sum(1 for _ in reader.iter_messages(topics=["port/0"])) == len(want)
    lost = SCANS - len(want)
    known = sum(gap.scans.get(Channel.MAGNITUDE, 0) for gap in recovery.gaps)
    at_ends = want[0] + SCANS - 1 - want[-1]
    assert known + at_ends == lost
    assert recovery.is_cut or want[-1] == SCANS - 1
    assert not (recovery.is_intact and lost)
    # A mark is there only with its scans and after its own reference and calibration.
    number: int | None = None
    calibration = ""
    for mark in recording.marks():
        calibration = calibration if mark.calibration is None else mark.calibration
        assert calibration == ("another" if mark.scans[0].counter >= RECALIBRATED else "")
        assert all(key.counter in want for key in mark.scans)
        number = 1 if mark.scans[0].counter < SCANS // 2 else 2
        assert mark.reference_number == number


def test_a_whole_recording_is_copied(tmp_path: Path) -> None:
    recovery, output = recovered(tmp_path, whole())
    assert recovery.is_intact
    assert recovery.lost_bytes == 0
    assert scan_counters(output) == list(range(SCANS))
    assert open_recording(output).origin == ORIGIN
    assert messages(output) == messages(tmp_path / "damaged.mcap")


def test_a_name_that_is_no_text_is_as_good_as_another(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xe9")
    folder.mkdir()
    damaged = folder / os.fsdecode(b"\xe9.mcap")
    damaged.write_bytes(whole())
    assert recover(damaged, tmp_path / "out.mcap").is_intact


def test_frames_whose_calibration_is_lost_are_absent(tmp_path: Path) -> None:
    start, end = chunks()[RECALIBRATED // A_CHUNK]
    data = bytearray(whole())
    data[(start + end) // 2] ^= 1
    assert_honest(tmp_path, bytes(data))
    marks = open_recording(tmp_path / "out.mcap").marks()
    assert [mark.scans[0].counter for mark in marks] == list(range(RECALIBRATED))


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "step", [pytest.param(397, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.long)]
)
def test_cut_anywhere(tmp_path: Path, step: int) -> None:
    end = len(whole())
    for length in (*range(0, end - 30, step), *range(end - 30, end)):
        assert_honest(tmp_path, whole()[:length])


@TAKES_FILES
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 7)), min_size=1, max_size=12))
@example([(6202, 0)])  # a chunk whose length reaches into the next one
def test_bits_flipped_anywhere(tmp_path: Path, flips: list[tuple[int, int]]) -> None:
    data = bytearray(whole())
    for position, bit in flips:
        data[400 + position % (len(data) - 400)] ^= 1 << bit
    assert_honest(tmp_path, bytes(data))


@TAKES_FILES
@given(
    flips=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 7)), min_size=1, max_size=12),
    length=st.integers(0, 10**6),
)
def test_reading_what_is_damaged_gives_what_is_before_the_damage_or_an_error(
    tmp_path: Path, flips: list[tuple[int, int]], length: int
) -> None:
    data = bytearray(whole())
    for position, bit in flips:
        data[position % len(data)] ^= 1 << bit
    (tmp_path / "a.mcap").write_bytes(data[: length % (2 * len(data))])
    try:
        recording = open_recording(tmp_path / "a.mcap")
        summary, marks, found = recording.summary, recording.marks(), scan_counters(recording.path)
        span = recording.span
    except RecordingError:
        return
    assert found == list(range(len(found)))
    assert len(marks) == summary.frames == len(found) == summary.scans.get(Channel.MAGNITUDE, 0)
    assert summary.corrupt == 0
    assert span.end_ns >= span.start_ns or not span.is_complete


@TAKES_FILES
@given(cut=st.integers(400, 10**6), length=st.integers(1, 5000))
def test_a_part_missing(tmp_path: Path, cut: int, length: int) -> None:
    data = whole()
    cut = cut % (len(data) - 400) + 400
    damaged = data[:cut] + data[cut + length :]
    kept = [
        index for index, (start, end) in enumerate(chunks()) if end <= cut or start >= cut + length
    ]
    want = [index * A_CHUNK + k for index in kept for k in range(A_CHUNK)]
    _, output = recovered(tmp_path, damaged)
    found = scan_counters(output)
    assert set(want) <= set(found)  # more where only a chunk's times went
    assert found == sorted(set(found))


@pytest.mark.parametrize("zeros", [9, 300_000])
def test_a_tail_of_zeros_as_after_a_loss_of_power(tmp_path: Path, zeros: int) -> None:
    end = chunks()[7][1]
    data = whole()[: end + 20] + bytes(zeros)
    (tmp_path / "zeros.mcap").write_bytes(data)
    summary = open_recording(tmp_path / "zeros.mcap").summary
    assert not summary.is_complete
    assert not summary.has_more
    (tmp_path / "zeros.mcap").unlink()
    recovery, output = recovered(tmp_path, data)
    assert scan_counters(output) == list(range(8 * A_CHUNK))
    assert recovery.is_cut
    assert not recovery.gaps


def test_after_a_gap_marks_begin_cold_and_wait_for_their_reference(tmp_path: Path) -> None:
    data = bytearray(whole())
    middle = SCANS // 2 // A_CHUNK  # the chunk with the second reference
    for index in (3, middle):
        data[chunks()[index][0] + 80] ^= 1
    recovery, output = recovered(tmp_path, bytes(data))
    marks = open_recording(output).marks()
    assert [mark.scans[0].counter for mark in marks] == [*range(6), *range(8, 20)]
    assert [mark.scans[0].counter for mark in marks if mark.is_cold] == [8]
    assert recovery.frames_lost == SCANS // 2 - A_CHUNK
    assert [gap.scans for gap in recovery.gaps] == [dict.fromkeys(Channel, A_CHUNK)] * 2
    assert recovery.gaps[0].seconds == pytest.approx(0.15)


@pytest.mark.parametrize("length", [1, 100, 400])
def test_a_recording_that_has_lost_its_beginning(tmp_path: Path, length: int) -> None:
    data = bytes(length) + whole()[length:]
    recovery, output = recovered(tmp_path, data)
    assert scan_counters(output) == expected(data)
    assert open_recording(output).origin.ports
    if length == 400:
        assert not recovery.knows_origin


def test_any_byte_of_the_beginning_may_be_another(tmp_path: Path) -> None:
    for position in range(0, chunks()[0][0], 5):
        data = bytearray(whole())
        data[position] ^= 0xFF
        _, output = recovered(tmp_path, bytes(data))
        assert scan_counters(output) == list(range(SCANS)), position


def foreign() -> bytes:
    import io

    from mcap.writer import Writer

    file = io.BytesIO()
    writer: Any = Writer(file)
    writer.start(profile="ros2")
    channel = writer.register_channel("port/0", "x", 0)
    writer.add_message(channel, 0, b"hello", 0)
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize(
    "data", [b"", b"time,volts\n" * 1000, bytes(100_000), random.Random(1).randbytes(200_000)]
)
def test_what_is_no_recording_is_refused(tmp_path: Path, data: bytes) -> None:
    for content in (data, foreign()):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(RecordingError) as caught:
            recover(tmp_path / "a.bin", tmp_path / "b.mcap")
        assert caught.value.next_step
        assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_nothing_is_written_over(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    for output in (tmp_path / "a.mcap", tmp_path):
        with pytest.raises(RecordingError, match="exists already"):
            recover(tmp_path / "a.mcap", output)
    with pytest.raises(RecordingError, match="cannot recover"):
        recover(tmp_path / "a.mcap", tmp_path / "none" / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes()[:8] == whole()[:8]


@pytest.mark.slow
def test_a_replay_after_recovery_gives_the_live_maps(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path, damaged = tmp_path / "life.mcap", tmp_path / "damaged.mcap"
    b = bench(ports=2, recording={"file": path}).tare()
    for index in range(60):
        size = path.stat().st_size
        b.step(load=0.004 * index)
        if index % 8 == 0:  # so that the file has several chunks
            b.until(lambda size=size: path.stat().st_size > size)
    b.daemon.stop()
    live = {f["scan_counter"]: f["map"] for f in b.listener.of("map")}
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        found = list(intact_chunks(file))
    lost = found[len(found) // 2]
    data[lost.start + 60] ^= 1
    damaged.write_bytes(data)
    before = {f["scan_counter"]: f["map"] for f in replay(damaged).of("map")}
    output = recover(damaged, tmp_path / "out.mcap").path
    frames = replay(output).of("map")
    again = {f["scan_counter"]: f["map"] for f in frames}
    assert set(before) < set(again) < set(live)
    for counter in before:
        assert again[counter] == before[counter] == live[counter]
    # Half of the map before is in each map; in the first one after the gap there is none before.
    value = {c: array_from_wire(frame)[0, 0] for c, frame in live.items() if frame}
    first = min(set(again) - set(before))
    cold = array_from_wire(again[first])[0, 0]
    assert cold == pytest.approx(value[first] - 0.5 * value[first - 1], rel=1e-3)
    assert len(live) - len(again) <= 12


def test_the_command_says_what_was_kept_and_lost(tactomo: Run, tmp_path: Path) -> None:
    data = bytearray(whole())
    data[chunks()[4][0] + 70] ^= 1
    (tmp_path / "a.mcap").write_bytes(data[: chunks()[-3][0]])
    result = tactomo("recover", "a.mcap", status=0)
    assert "1.7 s, 32 magnitude, 32 structure scans" in result.stdout
    assert "a gap of 0.15 s: 2 magnitude, 2 structure scans" in result.stdout
    assert "the end" in result.stdout
    facts = json.loads(tactomo("info", "a-recovered.mcap", "--json").stdout)
    assert facts["complete"] is True
    assert facts["recovered, parts missing"] == 2
    facts = json.loads(tactomo("info", "a.mcap", "--json").stdout)
    assert facts["complete"] is False
    assert "intact data beyond; `tactomo recover`" in facts["ends"]
    again = tactomo("recover", "a.mcap", status=1)
    assert "exists already" in again.stderr
    folder = tactomo("recover", ".", status=1)
    assert folder.stderr.strip().endswith("it is no regular file; give the path of a .mcap file")


def test_a_recovered_file_has_chunks_as_small_as_a_live_one(tmp_path: Path) -> None:
    """A flipped bit in it costs 0.25 s, and not all of it."""
    live, whole = tmp_path / "live.mcap", tmp_path / "whole.mcap"
    write(live)
    recover(live, whole)
    assert recover(whole, tmp_path / "once_more.mcap").is_intact
    with whole.open("rb") as file:
        chunks = [chunk.messages for chunk in intact_chunks(file) if chunk.messages]
    times_ns = [[message.log_time for message in chunk] for chunk in chunks]
    assert max(max(times) - min(times) for times in times_ns) <= 250_000_000
    data = bytearray(whole.read_bytes())
    data[len(data) // 3] ^= 1
    flipped, again = tmp_path / "flipped.mcap", tmp_path / "again.mcap"
    flipped.write_bytes(data)
    (gap,) = recover(flipped, again).gaps
    assert gap.seconds <= 0.25 + PERIOD_NS * 1e-9
