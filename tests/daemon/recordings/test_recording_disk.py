"""Disks that are full, stuck, dead or taken away: the stream goes on, and so does recording.

The disks are real: a tmpfs of 5 MB, and an ext4 on a loop device that is frozen as a disk that
hangs, or shut down as one that is pulled out. Mounting takes root.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_bench import scan_counters
from fixture_types import Start
from tactomo.recordings import recorder, recording_writer
from tactomo.recordings.recording import open_recording
from tactomo.recordings.recovery import recover
from tactomo_client import ControlError, request
from waiting import wait_until

EXT4_SHUTDOWN = 0x8004587D
NO_LOG_FLUSH = struct.pack("<I", 2)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "RETRY_S", 0.5)
    monkeypatch.setattr(recorder, "LOOK_S", 0.2)
    monkeypatch.setattr(recorder, "STALL_S", 0.6)


def mounted(folder: Path, *options: str) -> Iterator[Path]:
    folder.mkdir()
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, check=False)
    if done.returncode:
        pytest.skip(f"cannot mount: {done.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    yield from mounted(tmp_path / "small", "-t", "tmpfs", "-o", "size=5m", "tmpfs")


@pytest.fixture
def ext4_disk(tmp_path: Path) -> Iterator[Path]:
    if shutil.which("mkfs.ext4") is None or shutil.which("fsfreeze") is None:
        pytest.skip("needs mkfs.ext4 and fsfreeze")
    image = tmp_path / "image"
    with image.open("wb") as file:
        file.truncate(32 << 20)
    subprocess.run(["mkfs.ext4", "-q", str(image)], check=True)
    yield from mounted(tmp_path / "ext4", "-o", "loop", str(image))


@pytest.fixture
def stuck_disk(ext4_disk: Path) -> Iterator[tuple[Path, Callable[[str], None]]]:
    """A disk that hangs from ``turn("-f")`` to ``turn("-u")``."""

    def turn(how: str) -> None:
        subprocess.run(["fsfreeze", how, str(ext4_disk)], check=True, capture_output=True)

    yield ext4_disk, turn
    subprocess.run(["fsfreeze", "-u", str(ext4_disk)], check=False, capture_output=True)


def fill(disk: Path, leave_bytes: int) -> Path:
    free = shutil.disk_usage(disk).free
    filler = disk / "filler"
    filler.write_bytes(bytes(max(0, free - leave_bytes)))
    return filler


def step_until(b: Any, condition: Callable[[], Any]) -> Any:
    """Go on scanning until the condition holds, with frames that come all the while."""
    return wait_until(condition, meanwhile=b.step, step_s=0.0)


def told(b: Any, name: str) -> list[dict[str, Any]]:
    return [event for event in b.listener.of("event") if event["name"] == name]


@pytest.mark.slow
@pytest.mark.parametrize("reserve_mb", [0, 2])
def test_a_full_disk_is_recorded_to_again_once_it_has_room(
    bench: Start, small_disk: Path, monkeypatch: pytest.MonkeyPatch, reserve_mb: float
) -> None:
    tries: list[None] = []
    create = recorder.Recorder._create

    def counted(*arguments: Any, **options: Any) -> Any:
        tries.append(None)
        return create(*arguments, **options)

    monkeypatch.setattr(recorder.Recorder, "_create", counted)
    folder = small_disk / "set"
    b = bench(
        recording={"folder": folder, "at_start": True, "reserve_mb": reserve_mb, "maps": True}
    ).tare()
    filler = fill(small_disk, 600_000)
    step_until(b, lambda: told(b, "recording_failed"))
    failed = told(b, "recording_failed")[0]
    assert failed["severity"] == "error"
    assert "tries again" in failed["next_step"]
    status = b.ask("status")
    assert status["recording"] is None
    assert status["recorder"]["failures"] == 1
    assert "free" in status["recorder"]["waits_for"] or "space" in status["recorder"]["waits_for"]
    (first,) = folder.iterdir()
    assert open_recording(first).summary.frames >= 3
    assert open_recording(first).summary.is_complete == (reserve_mb > 0)
    tries.clear()
    b.until(lambda: len(tries) >= 2)  # it tries, in vain, and says no more about it
    assert len(told(b, "recording_failed")) == 1
    filler.unlink()
    resumed = step_until(b, lambda: told(b, "recording_resumed"))[0]
    b.step()
    assert b.ask("status")["recorder"]["waits_for"] is None
    end = b.ask("record_stop")
    assert resumed["detail"] == end["path"]
    assert open_recording(end["path"]).summary.frames > 0


@pytest.mark.slow
def test_a_recording_to_one_file_ends_with_the_room_and_can_be_recovered(
    bench: Start, small_disk: Path, tmp_path: Path
) -> None:
    b = bench(recording={"reserve_mb": 0, "maps": True, "folder": small_disk}).tare()
    path = small_disk / "one.mcap"
    b.ask("record_start", path=path.name)
    first = b.skin.counter + 1
    (small_disk / "filler").write_bytes(bytes(shutil.disk_usage(small_disk).free - 300_000))
    step_until(b, lambda: told(b, "recording_failed"))
    assert "No space" in told(b, "recording_failed")[0]["detail"]
    told_by_status = b.ask("status")
    assert told_by_status["recorder"]["waits_for"] is None
    assert any("No space" in issue["what"] for issue in told_by_status["issues"])
    found = scan_counters(path)
    assert found == list(range(first, first + len(found)))
    assert len(found) > 5
    again = recover(path, tmp_path / "again.mcap").path
    assert scan_counters(again) == found
    with pytest.raises(Exception, match="MB are free"):
        b.ask("record_start", path="two.mcap")


@pytest.mark.slow
def test_a_stuck_disk_holds_up_nothing_and_costs_nothing(
    bench: Start, stuck_disk: tuple[Path, Callable[[str], None]]
) -> None:
    disk, turn = stuck_disk
    path = disk / "a.mcap"
    b = bench(recording={"file": path}).tare()
    b.until(lambda: b.ask("status")["recording"]["bytes"] > 3000)
    turn("-f")
    begin = b.skin.counter
    step_until(b, lambda: told(b, "recording_stalled"))
    while b.skin.counter < begin + 100:
        b.step()
    status = b.ask("status")
    assert status["recording"]["queued_bytes"] > 50_000
    ages_ns = sorted(f["age_ns"] for f in b.listener.of("map") if f["scan_counter"] > begin)
    # Milliseconds, on an idle machine; one that stops for seconds holds up a frame or two.
    assert ages_ns[-len(ages_ns) // 10] < 2e9
    turn("-u")
    step_until(b, lambda: told(b, "recording_resumed"))
    b.ask("record_stop")
    assert scan_counters(path) == list(range(1, b.skin.counter + 1))


@pytest.mark.slow
def test_a_disk_that_stays_stuck_ends_the_recording_when_enough_waits(
    bench: Start, stuck_disk: tuple[Path, Callable[[str], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_writer, "MAX_QUEUED_BYTES", 200_000)
    disk, turn = stuck_disk
    b = bench(recording={"folder": disk / "set", "at_start": True}).tare()
    turn("-f")
    step_until(b, lambda: told(b, "recording_failed"))
    assert "too slow" in told(b, "recording_failed")[0]["detail"]
    assert b.ask("status")["recording"]["queued_bytes"] <= 200_000
    for _ in range(50):
        b.step()
    turn("-u")
    step_until(b, lambda: any(disk.as_posix() in e["detail"] for e in told(b, "recording_resumed")))
    b.step()
    b.ask("record_stop")
    first, second = sorted((disk / "set").iterdir())
    assert scan_counters(first) == list(range(1, 1 + len(scan_counters(first))))
    assert len(scan_counters(first)) > 60  # 200 kB of them
    assert open_recording(first).summary.is_complete
    assert open_recording(second).summary.frames > 0
    assert len(told(b, "recording_failed")) == 1


@pytest.mark.slow
def test_the_daemon_stops_although_the_disk_does_not_answer(
    bench: Start, stuck_disk: tuple[Path, Callable[[str], None]]
) -> None:
    disk, turn = stuck_disk
    b = bench(recording={"file": disk / "a.mcap"}).tare()
    turn("-f")
    b.step()
    with pytest.raises(ControlError):
        request("record_stop", b.daemon.control_address, 0.5)
    b.ask("status")  # and others are answered
    begin_s = time.monotonic()
    b.daemon.stop()
    # Beyond what is waited for the disk, what a stop takes on a busy computer.
    assert time.monotonic() - begin_s < recorder.STOP_S + 10
    turn("-u")
    b.until(lambda: all(thread.name != "recorder" for thread in threading.enumerate()))
    assert scan_counters(disk / "a.mcap") == [1, 2, 3, 4]


def test_a_disk_that_dies(bench: Start, ext4_disk: Path, tmp_path: Path) -> None:
    path = ext4_disk / "a.mcap"
    b = bench(recording={"file": path}).tare()
    with path.open("rb") as file:
        fcntl.ioctl(file, EXT4_SHUTDOWN, NO_LOG_FLUSH)
    step_until(b, lambda: told(b, "recording_failed"))
    b.until(lambda: b.step() and b.ask("status")["state"] == "running")
    b.ask("record_start", path="elsewhere.mcap")
    b.step()
    b.ask("record_stop")
    assert open_recording(tmp_path / "elsewhere.mcap").summary.frames == 1


def test_what_comes_while_the_disk_is_asked_to_keep_it_is_written(
    bench: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed process loses nothing of it, however long that takes."""
    asked, answered = threading.Event(), threading.Event()
    keep = os.fdatasync

    def slow(descriptor: int) -> None:
        asked.set()
        assert answered.wait(60)
        keep(descriptor)

    monkeypatch.setattr(os, "fdatasync", slow)
    b = bench(recording={"sync_s": 0.05}).tare()
    path = tmp_path / "kept.mcap"
    b.ask("record_start", path=path.name)
    b.step()
    assert asked.wait(60)
    b.step()
    b.until(lambda: b.skin.counter in scan_counters(path))
    answered.set()
    b.ask("record_stop")
    assert open_recording(path).summary.is_complete


@pytest.mark.slow
def test_a_deleted_file_or_folder_is_noticed(bench: Start, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    path = folder / "one.mcap"
    b = bench(recording={"folder": folder}).tare()
    b.ask("record_start", path=path.name)
    path.unlink()
    step_until(b, lambda: told(b, "recording_failed"))
    assert "deleted" in told(b, "recording_failed")[0]["detail"]
    with pytest.raises(ControlError, match=r"the recording ended early: .*deleted"):
        b.ask("record_stop")
    b.ask("record_start")
    shutil.rmtree(folder)
    step_until(b, lambda: b.ask("status")["recorder"]["waits_for"])
    with pytest.raises(ControlError, match=r"the recording ended early: .*deleted"):
        b.ask("record_stop")
    assert b.ask("status")["recorder"]["waits_for"] is None
    b.ask("record_start")
    shutil.rmtree(folder)
    step_until(b, lambda: told(b, "recording_resumed"))
    b.step()
    end = b.ask("record_stop")
    assert open_recording(end["path"]).summary.frames > 0


def test_a_file_that_is_moved_is_written_on(bench: Start, tmp_path: Path) -> None:
    b = bench(recording={"file": tmp_path / "a.mcap"}).tare()
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    b.step()
    b.daemon.stop()
    assert open_recording(tmp_path / "b.mcap").summary.frames == 4


@pytest.mark.slow
def test_a_folder_that_takes_no_new_file_leaves_the_present_one_going(
    bench: Start, ext4_disk: Path
) -> None:
    folder = ext4_disk / "set"
    b = bench(recording={"folder": folder, "at_start": True, "rotate_mb": 0.01}).tare()
    (first,) = folder.iterdir()
    subprocess.run(["chattr", "+i", str(folder)], check=True)
    try:
        step_until(b, lambda: told(b, "rotation_failed"))
        assert b.ask("status")["recording"]["path"] == str(first)
    finally:
        subprocess.run(["chattr", "-i", str(folder)], check=True)
    step_until(b, lambda: told(b, "recording_rotated"))
    b.step()
    last = b.skin.counter
    b.daemon.stop()
    found = {counter for path in folder.iterdir() for counter in scan_counters(path)}
    assert found == set(range(1, last + 1))


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_does_not_keep_the_daemon_from_starting(
    bench: Start, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    b = bench(recording={"folder": tmp_path / "file" / "set", "at_start": True}).tare()
    assert "cannot create" in b.ask("status")["recorder"]["waits_for"]
    (tmp_path / "file").unlink()
    step_until(b, lambda: told(b, "recording_resumed"))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_mistake_of_ours_ends_the_recording_and_a_dead_recorder_is_told_of(
    bench: Start, tmp_path: Path
) -> None:
    b = bench(recording={"file": tmp_path / "a.mcap"}).tare()
    write = b.daemon._recorder._write

    def fail() -> None:
        b.daemon._recorder._write = write
        raise ZeroDivisionError("a mistake")

    def end() -> None:
        raise SystemExit  # which no guard takes for a failed recording

    b.daemon._recorder._write = fail
    assert "a mistake" in b.listener.event("recording_failed")["detail"]
    b.ask("record_start", path="b.mcap")
    b.step()
    b.ask("record_stop")
    assert open_recording(tmp_path / "b.mcap").summary.frames == 1
    b.ask("record_start", path="c.mcap")
    b.daemon._recorder._write = end
    b.until(
        lambda: b.step() and any("died" in each["detail"] for each in told(b, "recording_failed"))
    )
    b.step()
    assert b.ask("status")["recording"] is None
    with pytest.raises(ControlError, match="died"):
        b.ask("record_start")
