"""Maps and contacts as arrays, named as those of `tactomo reconstruct` where they are the same."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from tactomo_client import Contact, Frame
from tactomo_models import Flag, batch
from tactomo_models.arrays import FloatArray
from tactomo_models.growing_arrays import GrowingArrays

from tactomo.cli.files.csv import ARRAY_COLUMNS
from tactomo.cli.files.recorded_frames import Moment

FRAME_TYPES: Final[Mapping[str, str]] = {
    "time_s": "<f8",
    "acquired_realtime_ns": "<i8",
    "scan_counter": "<i8",
    "age_s": "<f8",
    "tier": "<U16",
    "misfit": "<f8",
    "confidence": "<f8",
    "force_n": "<f8",
    "force_sigma_n": "<f8",
    "flags": "<u4",
}
CONTACT_TYPES: Final[Mapping[str, Any]] = {"contact_id": "<i8", **batch.CONTACT_TYPES}
ROWS: Final[Mapping[str, tuple[int, ...]]] = {**dict.fromkeys(CONTACT_TYPES, ()), **batch.VECTORS}


def write_maps(
    moments: Iterable[Moment],  # the frames
    output: IO[bytes],  # the file
    scratch: Path,  # a folder with room for all of it, uncompressed
) -> int:
    """Write frames as an .npz file; return how many there were.

    An image that a frame does not have, and a number that is not known, is NaN.
    """
    types = {**FRAME_TYPES, **CONTACT_TYPES, **dict.fromkeys(batch.IMAGES, "<f4")}
    axes: dict[str, FloatArray] = {}
    count = 0
    with GrowingArrays(types, scratch) as arrays:
        for moment in moments:
            arrays.append(_frame_values(moment))
            for contact in moment.frame.contacts:
                arrays.append(_contact_values(count, contact))
            axes = axes or _axes(moment.frame)
            count += 1
        shape = (len(axes["y_mm"]), len(axes["x_mm"])) if axes else None
        shapes = {**ROWS, **(dict.fromkeys(batch.IMAGES, shape) if shape else {})}
        arrays.write(output, shapes, **axes)
    return count


def _frame_values(moment: Moment) -> dict[str, Any]:
    time_s, frame, age_s = moment
    known = {name: _known(getattr(frame, name, None)) for name in FRAME_TYPES}
    bits = sum(Flag[name] for flag in frame.flags if (name := flag.upper()) in Flag.__members__)
    return {
        **known,
        **{name: getattr(frame, name) for name in batch.IMAGES},
        "time_s": time_s,
        "age_s": _known(age_s),
        "tier": frame.tier or "",
        "flags": bits,
    }


def _contact_values(row: int, contact: Contact) -> dict[str, Any]:
    values = {
        ARRAY_COLUMNS.get(field.name, f"contact_{field.name}"): getattr(contact, field.name)
        for field in fields(Contact)
    }
    return {"contact_frame": row, **values, "contact_mount_frame": contact.frame or ""}


def _known(value: Any) -> Any:
    return np.nan if value is None else value


def _axes(frame: Frame) -> dict[str, FloatArray]:
    """Return the positions of the images' columns and rows, mm; nothing for a frame without one."""
    image = next((i for name in batch.IMAGES if (i := getattr(frame, name)) is not None), None)
    if image is None or frame.x_mm is None or frame.y_mm is None:
        return {}
    rows, columns = image.shape
    return {"x_mm": np.linspace(*frame.x_mm, columns), "y_mm": np.linspace(*frame.y_mm, rows)}
