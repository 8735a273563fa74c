"""Recording while the daemon runs: into one file, or into a folder of files that come and go.

One thread touches the files; the others only put entries into a recording's queue, so a disk that
is slow, full or stuck delays nobody. The queue is bounded in bytes. A recording that cannot go on
ends with an event, and the daemon goes on; one into a folder begins again by itself once the disk
has room.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import structlog

from tactomo.config import RecordingConfig
from tactomo.errors import CommandError, RecordingError, TactomoError
from tactomo.events import OnEvent
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import MAX_QUEUED_BYTES, ActiveRecording, create
from tactomo.recordings.rotation import dated, is_numbered, list_recordings, next_path, to_delete
from tactomo.timing import wall_clock_ns
from tactomo.worker import Worker

FLUSH_S: Final = 0.2
LOOK_S: Final = 1.0
RETRY_S: Final = 10.0
OVERLAP_S: Final = 10.0  # how long, at most, a file goes on when the next one has begun
STALL_S: Final = 5.0
START_S: Final = 10.0
STOP_S: Final = 3.0
MAX_RESERVED: Final = 0.1  # of a disk; what is left of a small one is for recordings
RESUME_RESERVES: Final = 2
MIN_ROOM: Final = 1 << 20

log = structlog.get_logger()


class Recorder(Worker):
    """Starts, cuts and stops recordings, one at a time.

    Its thread does everything that touches a file; `begin` and `end` ask it to. Every thread reads
    `active` once and uses what it got, which stays harmless after the recording has ended.
    """

    def __init__(self, origin: Origin, rules: RecordingConfig, on_event: OnEvent) -> None:
        super().__init__("recorder", STOP_S)
        # the recording that runs; None while there is none
        self.active: ActiveRecording | None = None
        self.files = 0  # how many files were begun since the start
        self.deleted = 0  # how many were deleted to keep to the rules
        self.failures = 0  # how often a recording could not go on
        self.failure = ""  # why the last recording did not go on; empty once there is another
        self.waits_for = ""  # why a recording that is wanted does not run; empty while none does
        self._origin = origin  # replaced by the pipeline's thread, see `set_calibration`
        self._rules = rules
        self._on_event = on_event
        self._folder: Path | None = None  # where a set of files is recorded, or is to be
        self._with_maps = rules.maps  # as was asked for, for all files of a set
        self._ending: ActiveRecording | None = None  # the file before, while that goes on
        # the newest file that was closed since the start of what is recorded, and its bytes
        self._last: tuple[Path, int] | None = None
        self._next_try_s = self._next_look_s = 0.0
        self._woken = threading.Event()
        self._busy_since_s: float | None = None  # None while the thread rests
        self._is_stalled = self._is_dead = False  # as far as the control thread has told

    def start(self) -> None:
        """Start the thread, and what is to be recorded from the start.

        Raises RecordingError where the file cannot be created. A folder that cannot be used, or a
        disk without room, is told as an event and tried again.
        """
        super().start()
        if self._rules.file is not None:
            file = self._rules.file.absolute()
            _wait_for(self.ask(lambda: self._begin(file, self._rules.maps)))
        elif self._rules.at_start:
            _wait_for(self.ask(self._keep_recording))

    def begin(self, name: str | None, maps: bool | None = None) -> Future[Mapping[str, Any]]:
        """Ask for a recording into the folder: to a file of that name, or with None cut into files.

        With or without `maps` and contacts; None leaves that to the rules. The future gets its
        absolute `path`, or CommandError where one runs already, or RecordingError where the file
        exists, is not in the folder or cannot be created, or the disk has no room.
        """
        with_maps = self._rules.maps if maps is None else maps
        return self.ask(lambda: self._begin(None if name is None else self._below(name), with_maps))

    def end(self) -> Future[Mapping[str, Any]]:
        """Ask for the recording's end.

        The future gets `path` and length in `bytes` of the file, the last one of a set; or
        CommandError where none runs, or RecordingError where it could not be written to its end.
        """
        return self.ask(self._end)

    def set_calibration(self, text: str) -> None:
        """Have the files to come tell this pressure calibration; for the pipeline's thread."""
        self._origin = replace(self._origin, calibration=text)

    def _close(self) -> None:
        if self.is_alive and self.active is not None:
            self._tell_failure(self.active, "the disk does not answer, and the daemon stops")

    def check(self) -> None:
        """Tell what the thread cannot tell itself; called now and then by the control thread."""
        active, busy_since_s = self.active, self._busy_since_s
        if active is not None and active.is_overflowed:
            self._tell_failure(active, _TOO_SLOW)
        if not self.is_alive and not self._is_dead:
            self._is_dead, self.active = True, None
            self.failures += 1
            self.failure = _DIED
            self._on_event("recording_failed", _DIED, _REPORT)
        waits_s = 0.0 if busy_since_s is None else time.monotonic() - busy_since_s
        if (waits_s > STALL_S) != self._is_stalled:
            self._is_stalled = not self._is_stalled
            self._tell_stall(waits_s)

    def _tell_stall(self, waits_s: float) -> None:
        if self._is_stalled:
            self._on_event(
                "recording_stalled",
                f"the disk has not answered for {waits_s:.0f} s; up to "
                f"{MAX_QUEUED_BYTES >> 20} MB wait in memory",
                "look at the disk (dmesg), or record to another one",
            )
        else:
            self._on_event("recording_resumed", "the disk answers again")

    def ask(self, work: Callable[[], Any]) -> Future[Any]:
        """See `Worker`: work with files, for which this thread may wait.

        Raises RecordingError where the thread has died.
        """
        if self._is_dead:
            raise RecordingError(_DIED, _REPORT, "cannot_write")
        return super().ask(lambda: _answered(work))

    def _wake(self) -> None:
        self._woken.set()

    # From here on: the recorder's thread.

    def _run(self) -> None:
        while not self._stopping.is_set():
            is_idle = self.active is None and self._folder is None
            self._woken.wait(None if is_idle else FLUSH_S)
            self._woken.clear()
            self._busy_since_s = time.monotonic()
            self._do_asked()
            self._guard(self._write)
            if self._busy_since_s >= self._next_look_s:
                self._next_look_s = self._busy_since_s + LOOK_S
                self._guard(self._look_after)
            self._busy_since_s = None
        self._busy_since_s = time.monotonic()
        with contextlib.suppress(TactomoError):  # nothing runs; or it failed and that was told
            self._end()
        self._do_asked()
        self._busy_since_s = None

    def _guard(self, work: Callable[[], None]) -> None:
        """Do a part of the work; where it fails the recording ends, and not the thread."""
        try:
            work()
        except Exception as error:  # of any kind: a recording may fail, but never without a word
            self._give_up(_reason(error))

    def _begin(self, path: Path | None, with_maps: bool) -> Mapping[str, Any]:
        if self.active is not None:
            raise CommandError(
                f"a recording runs already: {self.active.path}",
                "stop it first: `tactomo record stop`",
                "already_recording",
            )
        folder = self._rules.folder_path if path is None else None
        self._with_maps = with_maps
        self.active = self._create(path)
        self._folder, self.waits_for, self.failure, self._last = folder, "", "", None
        self._on_event("recording_started", str(self.active.path))
        self._delete_old()
        return {"path": str(self.active.path)}

    def _below(self, name: str) -> Path:
        """Return the path of a file below the folder, which is made; no link leads out of it."""
        folder = self._rules.folder_path
        with contextlib.suppress(OSError):  # `create` says what is the matter
            folder.mkdir(parents=True, exist_ok=True)
        path = folder / name
        if not Path(os.path.realpath(path.parent)).is_relative_to(os.path.realpath(folder)):
            raise RecordingError(
                f"{path.parent} is a link that leads out of {folder}, the folder of recordings",
                "give a name in that folder, or configure another one: recording.folder",
                "cannot_write",
            )
        if is_numbered(path):
            raise RecordingError(
                f"{path.name} is a name of a numbered recording, of which the oldest are deleted",
                "give another name, without number and date",
                "cannot_write",
            )
        return path

    def _keep_recording(self) -> None:
        """Record to the folder, now or as soon as that can be done."""
        try:
            self._begin(None, self._rules.maps)
        except (OSError, RecordingError) as error:
            self._folder = self._rules.folder_path
            self.failures += 1
            self._on_event("recording_failed", str(error), self._wait(str(error)))

    def _create(
        self, path: Path | None, previous: ActiveRecording | None = None, reserves: int = 1
    ) -> ActiveRecording:
        """Begin a file, the next one of the folder if none is named.

        Raises RecordingError where it cannot be created or the disk lacks room, OSError where the
        folder cannot be read.
        """
        folder = self._rules.folder_path if path is None else path.parent
        free, reserve = self._room(folder)
        if free < max(reserve * reserves, MIN_ROOM):
            raise RecordingError(_no_room(free, reserve), "make room on the disk", "cannot_write")
        if path is None:
            with contextlib.suppress(OSError):  # `create` says what is the matter
                folder.mkdir(parents=True, exist_ok=True)  # the daemon's own
            path = next_path(folder, self._origin.sensor, wall_clock_ns() * 1e-9)
        origin = self._origin  # read once: a calibration may be put in force meanwhile
        writer = create(path, origin)
        self.files += 1
        return ActiveRecording(
            self.files, path, writer, self._with_maps, origin.calibration, previous
        )

    def _end(self) -> Mapping[str, Any]:
        active, is_wanted, why = self.active, self._folder is not None, self.waits_for
        self.active, self._folder, self.waits_for = None, None, ""
        if active is not None:
            self._finish(active)
            detail = f"{active.path}: {active.bytes_written} bytes"
            self._on_event("recording_stopped", detail)
        elif not is_wanted and not self.failure:
            step = "start with `tactomo record start`"
            raise CommandError("nothing is being recorded", step, "not_recording")
        if self._last is None or (active is None and self.failure):
            raise RecordingError(
                f"the recording ended early: {self.failure or why}", _REST, "cannot_write"
            )
        path, length = self._last
        return {"path": str(path), "bytes": length}

    def _finish(self, recording: ActiveRecording) -> None:
        """Close a file that nobody adds to any more, with its index."""
        self._finish_previous()
        try:
            recording.finish(self._rules.sync_s > 0)
        except OSError as error:
            recording.abandon()
            reason = error.strerror or str(error)
            self._tell_failure(recording, reason)
            raise RecordingError(f"{recording.path}: {reason}", _REST, "cannot_write") from error
        self._last = (recording.path, recording.bytes_written)

    def _finish_previous(self) -> None:
        previous, self._ending = self._ending, None
        if previous is not None:
            if self.active is not None:
                self.active.previous = None
            with contextlib.suppress(RecordingError):  # told; the newer file may go on
                self._finish(previous)

    def _write(self) -> None:
        active, ending = self.active, self._ending
        if active is None:
            return
        if ending is not None:
            ending.write()
            # The pipeline has come over, or nothing comes that it could come over with.
            if active.come_over.is_set() or active.age_s > OVERLAP_S:
                self._finish_previous()
        active.write()
        if active.is_overflowed:
            self._stop_early(active, _TOO_SLOW)
        else:
            active.sync(self._rules.sync_s)

    def _look_after(self) -> None:
        """Is the file still there, is there room, is it time for the next file, or to try again?"""
        active = self.active
        if active is None:
            self._try_again()
            return
        if active.is_deleted:
            raise RecordingError("the file was deleted")
        free, reserve = self._room(active.path.parent)
        if free < reserve:
            self._stop_early(active, _no_room(free, reserve))
        elif self._folder is not None and self._is_due(active):
            self._rotate(active)

    def _is_due(self, active: ActiveRecording) -> bool:
        is_full = active.bytes_written >= self._rules.rotate_mb * 1e6
        is_old = active.age_s >= self._rules.rotate_minutes * 60 and not active.is_empty
        may = self._ending is None and time.monotonic() >= self._next_try_s
        return may and (is_full or is_old)

    def _rotate(self, active: ActiveRecording) -> None:
        """Go on in the next file; both get the ports' bytes until the pipeline has come over."""
        try:
            following = self._create(None, previous=active)
        except (OSError, RecordingError) as error:
            self._next_try_s = time.monotonic() + RETRY_S
            self._on_event("rotation_failed", f"{error}; going on in {active.path}", _TRIED_AGAIN)
            return
        self._ending, self.active = active, following
        self._on_event("recording_rotated", f"{following.path}, after {active.path}")
        self._delete_old()

    def _try_again(self) -> None:
        """Record to the folder again, once there is room and a little to spare."""
        if self._folder is None or time.monotonic() < self._next_try_s:
            return
        try:
            self.active = self._create(None, reserves=RESUME_RESERVES)
        except (OSError, RecordingError) as error:
            self._wait(str(error))
            return
        self.waits_for = self.failure = ""
        self._on_event("recording_resumed", str(self.active.path))
        self._delete_old()

    def _stop_early(self, active: ActiveRecording, reason: str) -> None:
        """End a recording in good order before it has to."""
        self.active = None
        with contextlib.suppress(RecordingError):  # told
            self._finish(active)
        self._tell_failure(active, reason)

    def _give_up(self, reason: str) -> None:
        """Leave what is being written as it is."""
        active, ending = self.active, self._ending
        self.active = self._ending = None
        for recording in (ending, active):
            if recording is not None:
                recording.abandon()
                self._tell_failure(recording, reason)

    def _delete_old(self) -> None:
        if self._folder is None or self.active is None:
            return
        sensor, path = self._origin.sensor, self.active.path
        try:
            kept = list_recordings(self._folder, sensor)
            found = (one if one.path == path else dated(one, sensor) for one in kept)
            ours = [one for one in found if one is not None]
            for old, reason in to_delete(ours, self._rules):
                old.unlink()
                self.deleted += 1
                self._on_event("recording_deleted", f"{old}: {reason}")
        except OSError as error:  # the next file's beginning tries again
            log.warning("recording_not_deleted", detail=str(error))

    def _room(self, folder: Path) -> tuple[int, int]:
        """Return the bytes that are free where a folder is or will be, and those to be left so."""
        while not folder.is_dir() and folder != folder.parent:
            folder = folder.parent
        disk = os.statvfs(folder)
        if not disk.f_blocks:  # no disk: whatever stands in the way there will say so
            return MIN_ROOM, 0
        reserve = min(self._rules.reserve_mb * 1e6, MAX_RESERVED * disk.f_blocks * disk.f_frsize)
        return disk.f_bavail * disk.f_frsize, round(reserve)

    def _wait(self, reason: str) -> str:
        """Try again later what is to go on; returns the next step for people."""
        self._next_try_s = time.monotonic() + RETRY_S
        if self._folder is None:
            return _REST
        self.waits_for = reason
        return _TRIED_AGAIN

    def _tell_failure(self, recording: ActiveRecording, reason: str) -> None:
        """Tell once that a recording could not go on; for any thread."""
        if recording.tell_once():
            self.failures += 1
            detail = f"{recording.path}: {reason}, after {recording.bytes_written} bytes"
            self.failure = detail
            self._on_event("recording_failed", detail, self._wait(reason))


_REST: Final = "check the disk, then record again; the part on the disk can be replayed"
_TRIED_AGAIN: Final = "make room on the disk, or make it writable; the daemon tries again"
_TRY_ELSEWHERE: Final = "allow the daemon to write to its folder of recordings"
_DIED: Final = "the recorder's thread died"
_REPORT: Final = "restart the daemon, and please report the traceback in its log"
_TOO_SLOW: Final = f"the disk is too slow: {MAX_QUEUED_BYTES >> 20} MB wait for it"


def _reason(error: Exception) -> str:
    """Return what to tell of an error; the traceback of a mistake of ours goes to the log."""
    if not isinstance(error, OSError | TactomoError):
        log.exception("recording_failed")
    return getattr(error, "strerror", None) or str(error) or repr(error)


def _answered(work: Callable[[], Any]) -> Any:
    """Do what was asked for; whatever goes wrong, who asked is told and the thread goes on."""
    try:
        return work()
    except TactomoError:
        raise
    except Exception as error:
        raise RecordingError(_reason(error), _TRY_ELSEWHERE, "cannot_write") from error


def _no_room(free: int, reserve: int) -> str:
    kept = max(reserve, MIN_ROOM)
    return f"{free / 1e6:.3g} MB are free on the disk, and {kept / 1e6:.3g} MB of it are left free"


def _wait_for(answer: Future[Any]) -> None:
    try:
        answer.result(START_S)
    except TimeoutError as error:
        raise RecordingError(
            f"the disk has not answered for {START_S:g} s", _TRY_ELSEWHERE, "cannot_write"
        ) from error
