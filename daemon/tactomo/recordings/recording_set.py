"""Recordings that were cut into the files of a folder, played as the one that they were.

At a cut both files get the ports' bytes for a while (see `recording`): what the next file repeats
is left out, so that each port says again exactly what it said. A pause between two files, as of a
night without the daemon, is shortened.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from tactomo_client.recording_file import ROTATED_NAME
from tactomo_models import Reference

from tactomo.errors import RecordingError
from tactomo.recordings.recording import Chunk, Recording, open_recording
from tactomo.recordings.rotation import list_recordings
from tactomo.scans import Mark

LONGEST_PAUSE_NS: Final = 1_000_000_000
LONGEST_OVERLAP_NS: Final = 30_000_000_000
"""Beyond these two the clock was set between two files, or nothing ran."""
REMEMBERED_READS: Final = 50_000  # of the end of a file; more than an overlap has


class RecordingSet(Recording):
    """The files of a folder, one after another; for playing them.

    Raises RecordingError where it holds no recordings that a daemon has cut, those of several
    sensors, or such as do not belong together.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder
        found = [open_recording(path) for path in _files(folder)]
        # A file that was begun just before the end has nothing in it.
        self.parts = [part for part in found if part.span.start_ns] or found[:1]
        self.origin = self.parts[0].origin
        for part in self.parts:
            _check_belongs(part, self.parts[0])

    @cached_property
    def start_ns(self) -> int:
        """When the first bytes were read from any port, on the first file's steady clock."""
        return self.parts[0].start_ns

    @property
    def end_ns(self) -> int:
        """When the last thing in it was written, on the first file's steady clock."""
        return self.parts[-1].span.end_ns + self._shifts_ns[-1]

    def chunks(self, port: int, from_ns: int = 0) -> Iterator[Chunk]:
        """Yield what port `port` said from a time on, as `Recording.chunks` does."""
        before: frozenset[int] = frozenset()
        for part, shift_ns in zip(self.parts, self._shifts_ns, strict=True):
            if part.span.end_ns + shift_ns >= from_ns or part is self.parts[-1]:
                before = yield from _chunks(part, port, shift_ns, before, from_ns - shift_ns)

    def marks(self) -> list[Mark]:
        """Return the dual scans that were reconstructed, each with what was new just before it."""
        marks: list[Mark] = []
        in_force: Reference | None = None
        calibration = self.origin.calibration
        for part, shift_ns in zip(self.parts, self._shifts_ns, strict=True):
            of_part = [replace(m, clock_ns=m.clock_ns + shift_ns) for m in part.marks()]
            if of_part and marks:
                first = of_part[0]
                again = _is_same(first.reference, in_force)
                reference = None if again else first.reference
                of_part[0] = replace(first, reference=reference, is_cut=True)
            begun_with = part.origin.calibration
            if of_part and of_part[0].calibration is None and begun_with != calibration:
                of_part[0] = replace(of_part[0], calibration=begun_with)
            for mark in of_part:
                in_force = mark.reference or in_force
                calibration = calibration if mark.calibration is None else mark.calibration
            marks += of_part
        return marks

    def first_reference(self) -> Reference | None:
        """Return the first reference; None where none was taken."""
        return next((found for part in self.parts if (found := part.first_reference())), None)

    @cached_property
    def _shifts_ns(self) -> list[int]:
        """What is added to each file's clock, so that it goes on where the file before ended."""
        shifts = [0]
        for before, part in pairwise(self.parts):
            pause_ns = part.span.start_ns - before.span.end_ns
            too_much = max(pause_ns - LONGEST_PAUSE_NS, 0)
            if pause_ns < -LONGEST_OVERLAP_NS:  # the clock was set back
                too_much = pause_ns
            shifts.append(shifts[-1] - too_much)
        return shifts


def open_replayable(path: str | Path) -> Recording:
    """Open a recording or a folder of cut ones; raise RecordingError where it is neither."""
    return RecordingSet(Path(path)) if Path(path).is_dir() else open_recording(path)


def _files(folder: Path) -> list[Path]:
    names = (re.fullmatch(ROTATED_NAME, path.name, re.ASCII) for path in folder.iterdir())
    sensors = sorted({name["sensor"] for name in names if name})
    if len(sensors) != 1:
        held = f"recordings of {', '.join(sensors)}" if sensors else "no recordings"
        raise RecordingError(
            f"{folder} holds {held}, and not those of one sensor that a daemon has cut",
            "give a single file, or move one sensor's into a folder of their own",
        )
    return [kept.path for kept in list_recordings(folder, sensors[0])]


def _check_belongs(part: Recording, first: Recording) -> None:
    for what, one, other in (
        ("description", part.origin.description_sha256, first.origin.description_sha256),
        ("protocol", part.origin.protocol, first.origin.protocol),
        ("number of ports", len(part.origin.ports), len(first.origin.ports)),
    ):
        if one != other:
            raise RecordingError(
                f"{part.path.name} is of another {what} than {first.path.name}",
                "replay them one by one, or move what belongs together into a folder of its own",
            )


def _chunks(
    part: Recording, port: int, shift_ns: int, before: frozenset[int], from_ns: int
) -> Generator[Chunk, None, frozenset[int]]:
    """Yield what a file adds to what was read `before`; return when its last reads were."""
    times: deque[int] = deque(maxlen=REMEMBERED_READS)
    for message in part.port_messages(port, from_ns):
        times.append(message.publish_time)
        if message.publish_time in before:
            continue
        before = frozenset()
        yield Chunk(max(message.log_time, from_ns) + shift_ns, message.data)
    return frozenset(times)


def _is_same(one: Reference | None, other: Reference | None) -> bool:
    if one is None or other is None:
        return one is other
    values = ((getattr(one, each.name), getattr(other, each.name)) for each in fields(Reference))
    return all(
        a is b if a is None or b is None else np.array_equal(a, b, equal_nan=True)
        for a, b in values
    )
