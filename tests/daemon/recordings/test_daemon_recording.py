"""Recording what the ports said, and having it said again."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_bench import maps_of
from fixture_types import Start
from recorded_grasp import write_grasp
from tactomo.config import load_config
from tactomo.errors import ConfigError, PortError, RecordingError
from tactomo.imaging import frame_log
from tactomo.recordings.recording import open_recording
from tactomo.recordings.recording_writer import pack_frame, write_recording
from tactomo.recordings.records import read_frame
from tactomo.scans import FrameRecord, ScanKey
from tactomo.service import daemon
from tactomo.service.daemon import Daemon
from tactomo_client import ControlError
from tactomo_client.messages import frame_from_message
from tactomo_client.recording import open_recording as open_frames
from tactomo_client.recording_file import intact_chunks
from tactomo_models import Reference
from tactomo_protocol import Channel, Decoder, Hello, SampleFormat, Scan, ScanFlag, encode


def assert_same(live: dict[int, Any], again: dict[int, Any]) -> None:
    assert list(live) == list(again)
    for counter, image in live.items():
        np.testing.assert_array_equal(image, again[counter], err_msg=f"counter {counter}")


@pytest.mark.slow
def test_a_recording_that_begins_in_the_middle_of_a_packet_has_it_whole(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "skin.mcap"
    b = bench().tare()
    samples = np.full(208, 100_000, np.int32)
    frames = b"".join(encode(Scan(c, 500, 0, ScanFlag(0), samples)) for c in Channel)
    (port,) = b.ask("status")["ports"]
    b.skin.lines[0].say(frames[:400])
    b.until(lambda: b.ask("status")["ports"][0]["bytes"] == port["bytes"] + 400)
    b.ask("record_start", path=path.name)
    b.skin.lines[0].say(frames[400:])
    live = b.listener.frame(500)
    b.ask("record_stop")
    assert open_recording(path).summary.corrupt == 0
    assert_same(maps_of([live]), maps_of(replay(path).of("map")))


@pytest.mark.slow
def test_a_replay_leaves_out_what_the_live_run_dropped(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "slow.mcap"
    b = bench(seconds=0.03).tare()
    b.ask("record_start", path=path.name)
    start = b.skin.counter
    for index in range(40):
        b.skin.scan(load=0.01 * index)
    b.listener.frame(b.skin.counter)
    b.ask("record_stop")
    live = maps_of([f for f in b.listener.of("map") if f["scan_counter"] > start])
    assert len(live) < 40
    assert_same(live, maps_of(replay(path).of("map")))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "name"), [(frame_log, "Entry"), (daemon, "Entry")], ids=["mark", "map"]
)
def test_a_frame_that_was_seen_is_in_the_recording(
    bench: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, name: str
) -> None:
    """However slowly it gets there."""
    entry = getattr(module, name)

    def slowly(*arguments: Any) -> Any:
        time.sleep(0.3)
        return entry(*arguments)

    monkeypatch.setattr(module, name, slowly)
    path = tmp_path / "seen.mcap"
    b = bench().tare()
    b.ask("record_start", path=path.name, maps=True)
    seen = b.step(load=0.1)
    b.ask("record_stop")
    assert open_recording(path).summary.frames == 1
    assert [frame.scan_counter for frame in open_frames(path)] == [seen["scan_counter"]]


@pytest.mark.slow
def test_the_method_and_time_of_each_frame_are_again(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "budget.mcap"
    b = bench(recording={"file": path}).tare()
    for tier, budget_ms in (("auto", 12), ("auto", 3), ("noser", None)):
        b.ask("set_tier", tier=tier)
        b.ask("set_budget", budget_ms=budget_ms)
        b.until(lambda now=tier: b.ask("status")["plan"]["tier"] == now)
        status = b.ask("status")
        assert (status["tier_requested"], status["budget_ms"]) == (tier, budget_ms)
        b.step(load=0.1)
    b.daemon.stop()
    marks = [(mark.tier, mark.budget_ms) for mark in open_recording(path).marks()]
    assert [tier for tier, _ in marks[:3]] == ["auto"] * 3
    assert marks[3:] == [("auto", 12), ("auto", 3), ("noser", None)]
    again = replay(path, budget_ms=1)
    assert [(mark.tier, mark.budget_ms) for mark in open_recording(again.path).marks()] == marks


def test_a_recording_whose_frames_were_made_by_the_hybrid_opens(tmp_path: Path) -> None:
    """Earlier versions wrote that name for `auto` and what it did."""
    path = write_grasp(tmp_path / "old.mcap", range(3), lambda _: {"tier": "hybrid"})
    assert {frame.tier for frame in open_frames(path).frames()} == {"hybrid"}
    mark = pack_frame(FrameRecord((ScanKey(Channel.STRUCTURE, 7, 350_000),), "hybrid", None))
    assert read_frame(mark).tier == "auto"


def test_a_recording_knows_what_is_in_it(bench: Start, tmp_path: Path) -> None:
    path = tmp_path / "skin.mcap"
    b = bench(ports=2, recording={"file": path}).tare()
    b.skin.lines[0].say(b"\x00noise\x00")
    b.step()
    b.until(lambda: b.ask("status")["recording"]["bytes"] > 0)
    said = [port["bytes"] for port in b.ask("status")["ports"]]
    b.daemon.stop()
    recording = open_recording(path)
    summary = recording.summary
    assert summary.is_complete
    assert (recording.origin.sensor, recording.origin.description) == ("left", "paper_square")
    assert [summary.port_bytes[port] for port in range(2)] == said
    assert summary.scans == {Channel.MAGNITUDE: 4, Channel.STRUCTURE: 4}
    assert (summary.frames, summary.references, summary.corrupt) == (4, 1, 1)
    assert {hello.device_id for hello in summary.hellos} == {"bench-1"}
    assert summary.duration_s > 0


def test_a_recording_has_the_frames_that_were_published(bench: Start, tmp_path: Path) -> None:
    path = tmp_path / "frames.mcap"
    b = bench().tare()
    b.ask("record_start", path=path.name, maps=True)
    first = b.skin.counter + 1
    for load in (0.1, 0.2):
        b.step(load=load)
    b.ask("record_stop")
    live = [m for m in b.listener.messages if m.kind == "map" and m.fields["scan_counter"] >= first]
    recording = open_frames(path)
    assert (recording.sensor, recording.description) == ("left", "paper_square")
    for message, frame in zip(live, recording, strict=True):
        alive = frame_from_message(message, None, 0.5)
        assert (frame.sequence, frame.contacts) == (alive.sequence, alive.contacts)
        np.testing.assert_array_equal(frame.map, alive.map)
        assert frame.age_s == alive.age_s
    b.ask("record_start", path="bytes.mcap")
    b.step(load=0.3)
    b.ask("record_stop")
    assert not open_frames(tmp_path / "bytes.mcap").has_frames


def test_recordings_go_below_the_configured_folder_alone(bench: Start, tmp_path: Path) -> None:
    b = bench(recording={"folder": tmp_path / "kept"})
    (tmp_path / "kept" / "own").mkdir(parents=True)
    (tmp_path / "kept" / "out").symlink_to(tmp_path)
    (tmp_path / "kept" / "over.mcap").symlink_to(tmp_path / "elsewhere.mcap")
    before = sorted(tmp_path.rglob("*"))
    for name in (str(tmp_path / "skin.mcap"), "../skin.mcap", "own/../../skin.mcap"):
        with pytest.raises(ControlError, match=r"recording\.folder") as refused:
            b.ask("record_start", path=name)
        assert refused.value.name == "bad_argument"
    with pytest.raises(ControlError, match="link that leads out") as led_out:
        b.ask("record_start", path="out/skin.mcap")
    assert "recording.folder" in led_out.value.next_step
    with pytest.raises(ControlError, match="exists already"):
        b.ask("record_start", path="over.mcap")
    with pytest.raises(ControlError, match="no folder") as caught:
        b.ask("record_start", path="new/folder/skin.mcap")
    assert f"mkdir -p {tmp_path}/kept/new/folder" in caught.value.next_step
    assert sorted(tmp_path.rglob("*")) == before
    assert b.ask("record_start", path="own/a.mcap") == {"path": f"{tmp_path}/kept/own/a.mcap"}
    b.ask("record_stop")


def test_one_recording_at_a_time_and_as_many_as_wanted(bench: Start, tmp_path: Path) -> None:
    b = bench().tare()
    for number in range(3):
        path = tmp_path / f"{number}.mcap"
        b.ask("record_start", path=path.name)
        with pytest.raises(Exception, match="runs already"):
            b.ask("record_start", path="other.mcap")
        b.step()
        b.ask("record_stop")
        assert open_recording(path).summary.frames == 1


def imported(path: Path, reference: Reference | None = None, **hello: Any) -> list[Scan]:
    """Write a recording of 60 scans at 20 Hz that a daemon never saw; return its scans."""
    greeting = Hello(
        "import", "1", (Channel.MAGNITUDE,), 16, 1, 1, 208, SampleFormat.FLOAT32, 1.0, 20.0
    )
    rest = np.linspace(0.05, 0.2, 208).astype(np.float32)
    scans = [
        Scan(Channel.MAGNITUDE, n, n * 50_000, ScanFlag(0), rest * np.float32(1 + (n > 5) * 0.1))
        for n in range(60)
    ]
    write_recording(
        path,
        replace(greeting, **hello),
        [(scan.device_us * 1e-6, scan) for scan in scans],
        sensor="tank",
        description="paper_square",
        description_sha256="",
        reference=reference,
    )
    return scans


def test_an_imported_reference_is_used_from_the_first_scan(replay: Start, tmp_path: Path) -> None:
    path = tmp_path / "tank.mcap"
    volts = np.linspace(0.05, 0.2, 208)
    imported(path, Reference.from_scans(np.stack([volts, volts * 1.0001]), None))
    frames = replay(path).of("map")
    assert frames[0]["flags"] == ["structure_missing"]


def test_a_recording_of_another_sensor_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tank.mcap"
    imported(path, Reference.from_scans(np.ones((2, 192)), None))
    memory: Any = object()
    with pytest.raises(ConfigError, match="192 voltages a scan, paper_square has 208"):
        Daemon(load_config(ports=[f"replay://{path}"]), reconstructor=memory)


@pytest.mark.slow
def test_a_replay_without_pauses_writes_chunks_as_small_as_a_live_one(
    replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "tank.mcap"
    imported(path)
    again = replay(path, lossless=True)
    for written in (path, again.path):
        with written.open("rb") as file:
            chunks = [chunk.messages for chunk in intact_chunks(file)]
        times_us = [
            [packet.device_us for packet in scans_in(chunk)] for chunk in chunks if scans_in(chunk)
        ]
        assert len(times_us) > 5
        assert max(max(times) - min(times) for times in times_us) <= 500_000


def scans_in(chunk: list[Any]) -> list[Scan]:
    """Return the scans of a chunk whose every message of a port holds whole packets."""
    decoder = Decoder()
    packets = [p for m in chunk if len(m.data) > 500 for p in decoder.feed(m.data)]
    return [packet for packet in packets if isinstance(packet, Scan)]


@pytest.mark.parametrize(
    ("urls", "error"),
    [
        (["{0}?port=1"], PortError),
        (["{0}?port=0&speed=-1"], PortError),
        (["{0}?pace=1"], PortError),
        (["{0}", "/dev/null"], ConfigError),
        (["{0}?speed=1", "{0}?speed=2"], ConfigError),
        (["{0}.none"], RecordingError),
    ],
)
def test_replay_urls_that_cannot_be_are_refused(
    tmp_path: Path, urls: list[str], error: type[Exception]
) -> None:
    path = tmp_path / "tank.mcap"
    imported(path)
    memory: Any = object()
    ports = [url.format(f"replay://{path}") for url in urls]
    with pytest.raises(error):
        Daemon(load_config(ports=ports), reconstructor=memory)
