"""Recordings read back as frames: the same as live, by time, from folders, cut and damaged."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_fields import frame_fields
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import Entry, RecordingWriter
from tactomo_client import Contact, Frame, MessageError, RecordingError, subscribe
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import clock_id, encode_message
from tactomo_client.recording import RecordingWarning, open_recording

ORIGIN = Origin("left", "paper_square", "ab" * 32, ("/dev/ttyACM0",), "0.1.0")
PERIOD_S = 0.05
RAMP = np.tile(np.linspace(0, 1, 51, dtype=np.float32), (51, 1))
CONTACT = Contact(3, 10.0, -20.0, 700.0, 0.15, 0.01, 170.0)


def entries(number: int, at_s: float) -> list[Entry]:
    """Return what a daemon writes for one dual scan: bytes, its map and its contacts."""
    at_ns = round(at_s * 1e9)
    contact = dataclasses.replace(CONTACT, id=number)
    # The clock is this computer's, and yet the age does not go by it.
    fields = frame_fields(number, at_ns, [contact], clock_id=clock_id())
    images = {"map": RAMP * number, "pressure_kpa": None, "structure": RAMP}
    extent = {"x_mm": [-75.0, 75.0], "y_mm": [-75.0, 75.0]}
    as_map = encode_message("left", "map", fields | images | extent)
    as_contacts = encode_message("left", "contacts", fields)
    return [
        Entry("port/0", b"\0bytes\0", at_ns, at_ns),
        Entry("map", as_map, at_ns, at_ns),
        Entry("contacts", as_contacts, at_ns, at_ns),
    ]


def record(
    path: Path, numbers: Sequence[int] = range(1, 41), *, maps: bool = True, finish: bool = True
) -> Path:
    """Write a recording of a chunk for each two dual scans."""
    writer = RecordingWriter(path, ORIGIN)
    for number in numbers:
        for entry in entries(number, number * PERIOD_S):
            if maps or entry.topic.startswith("port"):
                writer.add(entry)
        if number % 2 == 0:
            writer.flush()
    writer.flush()
    if finish:
        writer.close()
    else:
        writer.abandon()
    return path


def spoil_a_chunk(path: Path, in_file: float) -> None:
    """Flip a byte in the first chunk that begins so far into the file, a share of it."""
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd", int(len(data) * in_file)) + 100] ^= 0xFF
    path.write_bytes(data)


def numbers_of(frames: Any) -> list[int]:
    return [frame.sequence for frame in frames]


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    return record(tmp_path / "whole.mcap")


def test_a_recorded_frame_is_the_live_one(sensor: FakeSensor, tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with subscribe("left", address=sensor.address, timeout_s=10) as live:
        sensor.wait_for_subscriber()
        data = entries(1, 1.0)[1].data
        sensor.send(data)
        alive = next(live)
    writer = RecordingWriter(path, ORIGIN)
    writer.add(Entry("map", data, 1, 1))
    writer.close()
    (frame,) = open_recording(path)
    for field in dataclasses.fields(Frame):
        if not field.name.startswith("_"):
            one, other = getattr(alive, field.name), getattr(frame, field.name)
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def test_what_it_is_of_how_long_and_every_frame_of_a_kind(whole: Path) -> None:
    recording = open_recording(str(whole))
    assert (recording.sensor, recording.description) == ("left", "paper_square")
    assert (recording.description_sha256, recording.version) == ("ab" * 32, "0.1.0")
    assert recording.files == (whole,)
    assert recording.duration_s == pytest.approx(39 * PERIOD_S, abs=1e-3)
    assert recording.has_frames
    assert recording.damage == ""
    assert numbers_of(recording) == list(range(1, 41))
    contacts = list(recording.frames("contacts"))
    assert numbers_of(contacts) == list(range(1, 41))
    assert all(frame.map is None for frame in contacts)
    assert contacts[4].contacts == (dataclasses.replace(CONTACT, id=5),)
    frame = next(recording.frames())
    assert frame.age_s == pytest.approx(0.007)  # as when it was published
    assert not frame.is_stale
    assert next(recording.frames(stale_after_s=0.001)).is_stale


def test_a_time_range_reads_no_more_than_it_needs(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tactomo_client import recording_file
    from tactomo_client.recording_file import unpack_chunk

    unpacked = []

    def note(chunk: Any) -> Any:
        unpacked.append(chunk)
        return unpack_chunk(chunk)

    monkeypatch.setattr(recording_file, "unpack_chunk", note)
    recording = open_recording(whole)
    frames = recording.frames(start_s=9.5 * PERIOD_S, end_s=12 * PERIOD_S)
    assert numbers_of(frames) == [11, 12]  # the first one is at 0 s
    assert len(unpacked) <= 1 + 1 + 2  # for its metadata, for the topics, and for these


def test_a_folder_is_read_in_the_order_in_which_it_was_made(tmp_path: Path) -> None:
    for number, begin in ((999_998, 1), (999_999, 11), (1_000_000, 21)):
        name = f"left-{number:06d}-20260131T120000Z.mcap"
        record(tmp_path / name, range(begin, begin + 10))
    record(tmp_path / "right-000001-20260131T120000Z.mcap", [99])
    record(tmp_path / "mine.mcap", [98])
    with pytest.raises(RecordingError, match="several sensors: left, right; say which"):
        open_recording(tmp_path)
    recording = open_recording(tmp_path, sensor="left")
    assert numbers_of(recording) == list(range(1, 31))
    assert recording.duration_s == pytest.approx(29 * PERIOD_S, abs=1e-3)
    assert numbers_of(recording.frames(start_s=0.975)) == list(range(21, 31))


def test_a_file_of_bytes_alone_beside_others_is_told(tmp_path: Path) -> None:
    """One `record start` with --maps, and one without, in the daemon's folder."""
    record(tmp_path / "left-000001-20260131T120000Z.mcap", range(1, 11))
    record(tmp_path / "left-000002-20260131T120000Z.mcap", range(11, 21), maps=False)
    recording = open_recording(tmp_path)
    says = r"there are no maps and no contacts in .*left-000002-.*tactomo replay .*left-000002-"
    with pytest.warns(RecordingWarning, match=says):
        assert numbers_of(recording) == list(range(1, 11))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert numbers_of(recording.frames(end_s=0.3)) == list(range(1, 7))


@pytest.mark.filterwarnings("error")
def test_a_cut_recording_gives_what_there_is_and_says_so(tmp_path: Path) -> None:
    path = record(tmp_path / "cut.mcap", finish=False)
    path.write_bytes(path.read_bytes()[:-300])
    recording = open_recording(path)
    assert recording.damage == "cut.mcap is cut off"
    assert recording.duration_s == pytest.approx(37 * PERIOD_S, abs=1e-3)
    frames: list[Frame] = []
    with pytest.warns(RecordingWarning, match=r"cut.mcap is cut off or damaged; `tactomo recover`"):
        frames += recording
    assert numbers_of(frames) == list(range(1, 39))


def test_what_lies_beyond_damage_is_read_too(whole: Path) -> None:
    spoil_a_chunk(whole, in_file=0.5)
    recording = open_recording(whole)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is read as it is asked for: this far from the damage
        assert next(recording.frames()).sequence == 1
    assert recording.damage == "whole.mcap is damaged, with intact data beyond"
    with pytest.warns(RecordingWarning):
        found = numbers_of(recording)
    assert len(found) == 38
    assert found == sorted(found)
    assert found[-1] == 40


def test_frames_are_found_where_the_names_of_the_topics_are_lost(tmp_path: Path) -> None:
    path = record(tmp_path / "headless.mcap", finish=False)
    spoil_a_chunk(path, in_file=0.0)
    with pytest.warns(RecordingWarning):
        assert numbers_of(open_recording(path)) == list(range(3, 41))


@pytest.mark.parametrize("finish", [True, False])
def test_a_recording_of_bytes_alone_says_how_to_get_frames(tmp_path: Path, finish: bool) -> None:
    path = record(tmp_path / "bytes.mcap", maps=False, finish=finish)
    recording = open_recording(path)
    assert not recording.has_frames
    with pytest.raises(RecordingError, match=r"record --maps.*tactomo replay .*bytes.mcap") as told:
        next(iter(recording))
    assert told.value.name == "no_frames"


def test_what_is_no_recording_is_named(tmp_path: Path, whole: Path) -> None:
    text = tmp_path / "notes.mcap"
    text.write_text("time,volts\n" * 100)
    with pytest.raises(RecordingError, match="is not an MCAP file; record one with"):
        open_recording(text)
    with pytest.raises(RecordingError, match=r"cannot open the recording .*No such file"):
        open_recording(tmp_path / "absent.mcap")
    with pytest.raises(RecordingError, match="no recordings in the folder"):
        open_recording(tmp_path)
    with pytest.raises(MessageError, match="no frames of 'scan'"):
        open_recording(whole).frames("scan")  # type: ignore[arg-type]


def test_a_frame_that_cannot_be_read_is_left_out_and_told(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    writer = RecordingWriter(path, ORIGIN)
    writer.add(Entry("map", b"left/map\0\xc1", 1, 1))
    writer.add(entries(2, 1.0)[1])
    writer.close()
    with pytest.warns(RecordingWarning, match="not MessagePack"):
        assert numbers_of(open_recording(path)) == [2]


def test_without_the_extra_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("tactomo_client.recording")]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("mcap", "mcap.exceptions"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"pip install 'tactomo-client\[recording\]'"):
        import tactomo_client.recording  # noqa: F401


@pytest.mark.parametrize(
    ("times", "says"),
    [
        ({"start_s": -1}, "start_s = -1: give finite seconds, 0 or more"),
        ({"start_s": math.inf}, "start_s = inf: give finite seconds, 0 or more"),
        ({"end_s": math.nan}, "end_s = nan"),
        ({"start_s": 5, "end_s": 2}, "end_s = 2.0 is before start_s = 5.0"),
        ({"end_s": "2"}, "end_s = '2' is no number"),
    ],
)
def test_times_of_a_recording(whole: Path, times: dict[str, Any], says: str) -> None:
    recording = open_recording(whole)
    with pytest.raises((TypeError, ValueError), match=re.escape(says)):
        recording.frames(**times)


def test_a_recording_that_ends_sooner_than_was_asked_for(whole: Path) -> None:
    recording = open_recording(whole)
    for end_s in (1e9, 10**400, math.inf):
        assert len(list(recording.frames("contacts", end_s=end_s))) == 40
    assert not list(recording.frames(start_s=1e300))
