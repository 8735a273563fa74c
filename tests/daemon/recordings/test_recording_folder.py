"""Recordings in a folder: cut into files that each replay alone, the oldest deleted."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from daemon_bench import maps_of, scan_counters
from fixture_types import Start
from tactomo.config import RecordingConfig
from tactomo.recordings import recorder
from tactomo.recordings.recording import Origin, open_recording
from tactomo.recordings.recording_writer import RecordingWriter
from tactomo.recordings.rotation import KeptRecording, list_recordings, to_delete
from tactomo_client import ControlError
from tactomo_protocol import Channel

DAY_S = 86_400.0


@pytest.mark.slow
@pytest.mark.parametrize("ports", [1, 2])
def test_each_file_replays_alone_and_together_they_have_every_frame_once(
    bench: Start, replay: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ports: int
) -> None:
    monkeypatch.setattr(recorder, "LOOK_S", 0.3)
    folder = tmp_path / "set"
    b = bench(
        ports=ports, recording={"folder": folder, "at_start": True, "rotate_mb": 0.01, "maps": True}
    ).tare()
    load = 0.0
    while b.ask("status")["recorder"]["files"] < 4:
        load = (load + 0.01) % 0.4
        b.step(load=load)
    for _ in range(5):
        b.step(load=load)
    last = b.skin.counter
    b.daemon.stop()
    rotated = b.daemon.status()["events"]["counts"]["recording_rotated"]  # the last one unheard
    live = maps_of(b.listener.of("map"))
    files = sorted(folder.iterdir())
    numbers = [path.name.split("-")[1] for path in files]
    assert numbers == [f"{number:06d}" for number in range(1, len(files) + 1)]
    again: list[int] = []
    for path in files:
        summary = open_recording(path).summary
        assert summary.is_complete
        assert summary.corrupt == 0
        assert summary.hellos or not summary.port_bytes  # begun just before the end
        replayed = maps_of(replay(path).of("map"))
        assert len(replayed) == summary.frames
        for counter, image in replayed.items():
            np.testing.assert_array_equal(image, live[counter], err_msg=f"{path} {counter}")
        again += replayed
    assert again == list(live) == list(range(1, last + 1))
    for channel in Channel:
        assert {c for path in files for c in scan_counters(path, channel)} == set(again)
    assert rotated == len(files) - 1 >= 3


def test_numbers_go_on_whatever_the_clock_and_strangers_do(bench: Start, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    strangers = {
        "left-000007-20400101T000000Z.mcap",
        "left-000003-20990101T000000Z.mcap",
        "left-000099-notes.txt",
        "left-000098-20269999T999999Z.mcap",
        "leftover-000500-20260101T000000Z.mcap",
        "right-000900-20260101T000000Z.mcap",
    }
    for name in strangers:
        (folder / name).write_text("precious")
    b = bench(recording={"folder": folder, "keep_days": 1e-6, "rotate_mb": 0.01})
    b.ask("record_start")
    path = Path(b.ask("record_stop")["path"])
    assert path.name.startswith("left-000008-")
    assert strangers <= {each.name for each in folder.iterdir()}
    assert all((folder / name).read_text() == "precious" for name in strangers)


def test_a_named_recording_is_never_deleted_for_its_age(bench: Start, tmp_path: Path) -> None:
    b = bench(recording={"folder": tmp_path, "keep_days": 1e-9, "rotate_mb": 0.01}).tare()
    with pytest.raises(ControlError, match="the oldest are deleted") as refused:
        b.ask("record_start", path="left-999999-20260101T000000Z.mcap")
    assert refused.value.name == "cannot_write"
    b.ask("record_start", path="left-999999-x.mcap")
    b.step()
    b.ask("record_stop")
    b.ask("record_start")  # deletes what is too much
    names = sorted(path.name for path in tmp_path.glob("*.mcap"))
    assert [name[:12] for name in names] == ["left-000001-", "left-999999-"]


@pytest.mark.slow
def test_the_oldest_files_of_this_sensor_go_when_there_are_too_many(
    bench: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    rules = {"folder": folder, "rotate_mb": 0.01, "keep_gb": 0.00006}
    b = bench(recording=rules).tare()
    made = []
    for _ in range(6):
        b.ask("record_start")
        for _ in range(8):  # some 14 kB
            b.step()
        made.append(Path(b.ask("record_stop")["path"]))
    b.ask("record_start")
    left = sorted(folder.iterdir())
    assert left[-1] not in made
    assert left[-2] == made[-1]
    assert made[0] not in left
    assert sum(path.stat().st_size for path in left) <= 60_000
    recorder = b.ask("status")["recorder"]
    deleted = recorder["deleted"]
    assert deleted == recorder["files"] - len(left) > 0

    def told() -> list[str]:
        return [e["detail"] for e in b.listener.of("event") if e["name"] == "recording_deleted"]

    b.until(lambda: len(told()) >= deleted)
    assert len(told()) == deleted
    assert str(made[0]) in told()[0]


def kept(number: int, begin_s: float, end_s: float, size: int = 1) -> KeptRecording:
    return KeptRecording(number, Path(f"{number}"), size, begin_s, end_s)


RULES = RecordingConfig(keep_days=7, keep_gb=0)


def gone(recordings: list[KeptRecording], rules: RecordingConfig = RULES) -> list[int]:
    return [int(path.name) for path, _ in to_delete(recordings, rules)]


def days(first: int, end: int, offset_s: float = 0.0) -> list[KeptRecording]:
    """One recording of a whole day each."""
    return [kept(n, n * DAY_S + offset_s, (n + 1) * DAY_S + offset_s) for n in range(first, end)]


def test_files_go_by_age_and_a_clock_that_jumps_costs_a_day_at_most() -> None:
    assert gone(days(0, 20)) == list(range(12))
    for jump_s in (DAY_S, 365 * DAY_S, 50 * 365 * DAY_S):
        assert gone([*days(0, 5), kept(5, 5 * DAY_S + jump_s, 5 * DAY_S + jump_s + 1)]) == []
        # And it costs it once, and none when it is set right again.
        assert gone([*days(0, 3), *days(3, 4, jump_s), *days(4, 6)]) == []
    assert gone([*days(100, 105), *days(0, 1)]) == []  # one that goes back deletes nothing
    claims = [kept(n, n * DAY_S, 5000 * DAY_S) for n in range(3)]  # a day is believed
    assert gone([*claims, kept(3, 5000 * DAY_S, 5000 * DAY_S)]) == []
    written = [kept(0, 0, 1, size=10**12)]  # at present: it stays
    assert gone(written, RecordingConfig(keep_gb=2, keep_days=1)) == []


def test_files_copied_without_their_times_are_as_old_as_what_is_in_them(
    bench: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    now_ns = time.time_ns()
    for hours in range(40, 0, -1):  # an hour each
        begin_ns = now_ns - hours * 3600 * 10**9
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(begin_ns // 10**9))
        origin = Origin("left", "paper_square", "", ("a",), "0")
        writer = RecordingWriter(folder / f"left-{41 - hours:06d}-{stamp}.mcap", origin)
        for at_ns in (begin_ns, begin_ns + 3590 * 10**9):
            writer.write("port/0", b"\0", at_ns, at_ns)
        writer.close()
    b = bench(recording={"folder": folder, "keep_days": 7, "keep_gb": 0, "at_start": True})
    b.until(lambda: len(list(folder.iterdir())) > 40)
    assert b.ask("status")["recorder"]["deleted"] == 0


@pytest.mark.slow
def test_a_file_is_as_old_as_what_is_in_it(
    bench: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "LOOK_S", 0.1)
    folder = tmp_path / "set"
    b = bench(recording={"folder": folder, "at_start": True, "rotate_minutes": 0.01})
    b.until(lambda: b.ask("status")["uptime_s"] > 1.0)  # longer than that, but nothing came
    b.tare()
    while len(list(folder.iterdir())) == 1:
        b.step()
    b.step()
    b.daemon.stop()
    first, second = (open_recording(path).summary for path in sorted(folder.iterdir())[:2])
    assert second.start_ns - first.start_ns > 0.3e9  # and not from when it was begun


def test_links_and_folders_are_not_recordings(tmp_path: Path) -> None:
    name = "left-000001-20260101T000000Z.mcap"
    (tmp_path / name).mkdir()
    (tmp_path / name.replace("1-", "2-")).symlink_to("/etc/hostname")
    assert list_recordings(tmp_path, "left") == []
