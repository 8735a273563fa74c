"""Contacts as a table: a row for each contact in each frame, units in the columns' names."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from tactomo_client import Contact
from tactomo_models import Flag
from tactomo_models.archive import read_arrays
from tactomo_models.errors import DataError

from tactomo.cli.recorded import Moment

FRAME_COLUMNS: Final = (
    "time_s",
    "acquired_realtime_ns",
    "session",
    "sequence",
    "scan_counter",
    "tier",
    "misfit",
    "confidence",
    "flags",
    "age_s",
)
CONTACT_COLUMNS: Final = tuple(field.name for field in fields(Contact))
ARRAY_COLUMNS: Final = {"magnitude_sigma": "contact_sigma"}
"""Columns whose array in the .npz of `tactomo reconstruct` is not named `contact_` and theirs."""


def write_contacts(moments: Iterable[Moment], output: IO[bytes]) -> int:
    """Write the contacts of frames; return how many frames there were."""
    count = 0
    with _table(output) as writer:
        writer.writerow([*FRAME_COLUMNS, *CONTACT_COLUMNS])
        for time_s, frame, age_s in moments:
            count += 1
            start = [
                f"{time_s:.9f}",
                *(getattr(frame, name) for name in FRAME_COLUMNS[1:-2]),
                " ".join(sorted(frame.flags)),
                age_s,
            ]
            for contact in frame.contacts or (None,):
                writer.writerow([*start, *_cells(contact)])
    return count


@contextlib.contextmanager
def _table(output: IO[bytes]) -> Iterator[Any]:
    """Yield a CSV writer onto a file, which stays open."""
    text = io.TextIOWrapper(output, encoding="utf-8", newline="")
    yield csv.writer(text)
    text.detach()  # flushes it


def _cells(contact: Contact | None) -> list[Any]:
    return ["" if contact is None else getattr(contact, name) for name in CONTACT_COLUMNS]


def write_contacts_of_arrays(source: Path, output: IO[bytes]) -> int:
    """Write the contacts in the .npz file of `tactomo reconstruct`; return how many frames it has.

    Raises:
        DataError: it cannot be read, or is not such a file.

    """
    try:
        arrays = read_arrays(source)
    except OSError as error:
        raise DataError(f"cannot read {source}: {error.strerror}") from error
    missing = {"contact_frame", "contact_x_mm", "contact_y_mm", "flags"} - arrays.keys()
    if missing:
        raise DataError(
            f"{source} holds no contacts ({', '.join(sorted(missing))} missing); give the OUT.npz "
            "of `tactomo reconstruct`"
        )
    columns = {name: arrays.get(ARRAY_COLUMNS.get(name, f"contact_{name}")) for name in _KEPT}
    of_frames = {name: arrays[name] for name in ("misfit", "confidence") if name in arrays}
    contact_frames, flags = arrays["contact_frame"], arrays["flags"]
    with _table(output) as writer:
        writer.writerow(["frame", *of_frames, "flags", *columns])
        for frame, bits in enumerate(flags):
            words = " ".join(sorted(Flag(int(bits)).names()))
            start = [frame, *(_cell(values, frame) for values in of_frames.values()), words]
            first, end = np.searchsorted(contact_frames, (frame, frame + 1)).tolist()
            for row in range(first, end) or (None,):
                writer.writerow([*start, *(_cell(values, row) for values in columns.values())])
    return len(flags)


_KEPT: Final = tuple(name for name in CONTACT_COLUMNS if name != "id")


def _cell(values: Any, row: int | None) -> Any:
    """Return what goes into the table: nothing for what is not there, or is not known."""
    if values is None or row is None:
        return ""
    value = values[row].item()
    return "" if isinstance(value, float) and np.isnan(value) else value
