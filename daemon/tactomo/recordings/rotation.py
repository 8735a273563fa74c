"""A folder of recordings: what their files are called, and which of them are to be deleted.

Names such as ``left_forearm-000042-20260131T120000Z.mcap`` sort by their number, which rises by one
with each file, whatever the wall clock does.
"""

from __future__ import annotations

import re
import stat
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from tactomo_client.recording_file import ROTATED_NAME

from tactomo.config import RecordingConfig
from tactomo.errors import RecordingError
from tactomo.recordings.recording import open_recording

_DAY_S: Final = 86_400.0
_STAMP: Final = "%Y%m%dT%H%M%SZ"


class KeptRecording(NamedTuple):
    """A file in the folder."""

    number: int
    path: Path
    size: int
    begin_s: float  # when it began, seconds since 1970 by the wall clock of that time, by its name
    end_s: float  # when the last thing in it was written, likewise; see `dated`


def next_path(folder: Path, sensor: str, now_s: float) -> Path:
    """Return the path of the next recording; raise OSError where the folder cannot be read."""
    numbers = [kept.number for kept in list_recordings(folder, sensor)]
    stamp = datetime.fromtimestamp(now_s, UTC).strftime(_STAMP)
    return folder / f"{sensor}-{max(numbers, default=0) + 1:06d}-{stamp}.mcap"


def is_numbered(path: Path) -> bool:
    """Whether a file is called as those of `next_path` are."""
    return re.fullmatch(ROTATED_NAME, path.name, re.ASCII) is not None


def list_recordings(folder: Path, sensor: str) -> list[KeptRecording]:
    """Return a sensor's recordings, the oldest first; raise OSError as folders do."""
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        name = re.fullmatch(ROTATED_NAME, path.name, re.ASCII)
        if name is None or name["sensor"] != sensor:
            continue
        try:
            begin = datetime.strptime(name["begin"], _STAMP).replace(tzinfo=UTC)
            facts = path.lstat()
        except (ValueError, FileNotFoundError):  # no such date; deleted by somebody meanwhile
            continue
        if stat.S_ISREG(facts.st_mode):
            begin_s = begin.timestamp()
            found.append(KeptRecording(int(name["number"]), path, facts.st_size, begin_s, begin_s))
    return sorted(found)


def to_delete(
    recordings: list[KeptRecording],  # all there are; the last one, which is being written, stays
    rules: RecordingConfig,  # what is to be kept
) -> list[tuple[Path, str]]:
    """Return what has to go and why, oldest first, so that the newest may grow to its full size."""
    *closed, newest = recordings
    ages_s = _ages_s(recordings)
    room = rules.keep_gb * 1e9 - max(newest.size, rules.rotate_mb * 1e6)
    total = sum(kept.size for kept in closed)
    deletions = []
    for kept, age_s in zip(closed, ages_s, strict=False):
        if rules.keep_gb and total > room:
            reason = f"more than {rules.keep_gb:g} GB"
        elif rules.keep_days and age_s > rules.keep_days * _DAY_S:
            reason = f"older than {rules.keep_days:g} days"
        else:
            continue
        deletions.append((kept.path, reason))
        total -= kept.size
    return deletions


def _ages_s(recordings: list[KeptRecording]) -> list[float]:
    """Return how long ago each recording ended, as far as the recordings themselves can tell.

    The wall clock may jump by years. So age is summed up over the recordings and the pauses
    between them, none of which counts for more than a day or less than nothing: a jump makes
    recordings at most a day older. Pauses longer than that are not counted in full.
    """
    times_s = [time_s for kept in recordings for time_s in (kept.begin_s, kept.end_s)]
    steps_s = [min(max(after - before, 0.0), _DAY_S) for before, after in pairwise(times_s)]
    return [sum(steps_s[2 * index + 1 :]) for index in range(len(recordings))]


def dated(kept: KeptRecording, sensor: str) -> KeptRecording | None:
    """Return a file with the times of what is in it; None where that is not this sensor's.

    The file system's times do not count: a copy has those of the copying.
    """
    try:
        recording = open_recording(kept.path)
        if recording.origin.sensor != sensor:
            return None
        span = recording.span
    except RecordingError:
        return None
    if not span.start_ns:
        return kept
    return kept._replace(begin_s=span.start_ns * 1e-9, end_s=span.end_ns * 1e-9)
