"""Contacts as a table: a row for each contact in each frame, units in the columns' names."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import IO, Final

from tactomo_client import Contact
from tactomo_client.schema import table_row

from tactomo.cli.files.recorded_frames import Moment

FRAME_COLUMNS: Final = (
    "time_s",
    "acquired_realtime_ns",
    "session",
    "sequence",
    "scan_counter",
    "tier",
    "misfit",
    "confidence",
    "total_force_n",
    "total_force_sigma_n",
    "flags",
    "age_s",
)
CONTACT_COLUMNS: Final = tuple(table_row(Contact(0, 0.0, 0.0, 0.0)))
ARRAY_COLUMNS: Final = {"magnitude_sigma": "contact_sigma", "frame": "contact_mount_frame"}
"""Columns whose array in the .npz of `tactomo reconstruct` is not named `contact_` and theirs."""


def write_contacts(moments: Iterable[Moment], output: IO[bytes]) -> int:
    """Write the contacts of frames; return how many frames there were."""
    count = 0
    text = io.TextIOWrapper(output, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow([*FRAME_COLUMNS, *CONTACT_COLUMNS])
    for time_s, frame, age_s in moments:
        count += 1
        start = [
            f"{time_s:.9f}",
            *(getattr(frame, name.removeprefix("total_")) for name in FRAME_COLUMNS[1:-2]),
            " ".join(sorted(frame.flags)),
            age_s,
        ]
        for contact in frame.contacts or (None,):
            cells = dict.fromkeys(CONTACT_COLUMNS, "") if contact is None else table_row(contact)
            writer.writerow([*start, *cells.values()])
    text.detach()  # flushes it; the file stays open
    return count
