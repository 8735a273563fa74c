"""Maps and contacts as arrays, named as those of `tactomo reconstruct` where they are the same.

A recording may be larger than the memory, and its length shows at its end only: numbers and images
grow in files, and go from there into the archive.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib import format as npy
from tactomo_client import Contact, Frame
from tactomo_models import Flag
from tactomo_models.arrays import FloatArray

from tactomo.cli.files.csv import ARRAY_COLUMNS
from tactomo.cli.files.recorded_frames import Moment

IMAGES: Final = ("map", "pressure_kpa", "structure")
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
CONTACT_TYPES: Final[Mapping[str, str]] = {
    "contact_frame": "<i8",
    **{
        ARRAY_COLUMNS.get(field.name, f"contact_{field.name}"): {
            "int": "<i8",
            "str": "<U8",
            "bool": "?",
        }.get(str(field.type), "<f8")
        for field in fields(Contact)
    },
}


def write_maps(
    moments: Iterable[Moment],  # the frames
    output: IO[bytes],  # the file
    scratch: Path,  # a folder with room for all of it, uncompressed
) -> int:
    """Write frames as an .npz file; return how many there were.

    An image that a frame does not have, and a number that is not known, is NaN.
    """
    with (
        tempfile.TemporaryDirectory(prefix=".tactomo-", dir=scratch) as folder,
        contextlib.ExitStack() as undo,
    ):
        files = {
            name: undo.enter_context((Path(folder) / name).open("w+b"))
            for name in ("frames", "contacts", *IMAGES)
        }
        images = {name: _Images(files[name]) for name in IMAGES}
        axes: dict[str, FloatArray] = {}
        count = 0
        for moment in moments:
            files["frames"].write(_row(FRAME_TYPES, _frame_values(moment)))
            for contact in moment.frame.contacts:
                files["contacts"].write(_row(CONTACT_TYPES, _contact_values(count, contact)))
            for name, growing in images.items():
                growing.put(count, getattr(moment.frame, name))
            axes = axes or _axes(moment.frame)
            count += 1
        arrays: dict[str, Any] = {
            **_columns(files["frames"], FRAME_TYPES),
            **_columns(files["contacts"], CONTACT_TYPES),
            **axes,
        }
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, growing in images.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    growing.write(entry, count, axes)
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    npy.write_array(entry, array)
        return count


class _Images:
    """Images of one kind and shape that grow in a file; NaN for a frame that has none."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._rows = 0

    def put(self, row: int, image: FloatArray | None) -> None:
        if image is not None:
            self._fill(row, image.shape)
            self._file.write(image.astype("<f4").tobytes())
            self._rows += 1

    def write(self, entry: IO[bytes], rows: int, axes: Mapping[str, FloatArray]) -> None:
        """Write all images into an .npy file; none where no frame had any.

        They pass by: a memory map would count all that is read as this program's memory.
        """
        shape: tuple[int, ...] = (0,)
        if axes:
            shape = (rows, len(axes["y_mm"]), len(axes["x_mm"]))
            self._fill(rows, shape[1:])
        npy.write_array_header_1_0(entry, {"descr": "<f4", "fortran_order": False, "shape": shape})
        self._file.seek(0)
        shutil.copyfileobj(self._file, entry)

    def _fill(self, rows: int, shape: tuple[int, ...]) -> None:
        for _ in range(self._rows, rows):
            self._file.write(np.full(shape, np.nan, "<f4").tobytes())
        self._rows = max(self._rows, rows)


def _row(types: Mapping[str, str], values: Mapping[str, Any]) -> bytes:
    return np.array(tuple(values[name] for name in types), list(types.items())).tobytes()


def _columns(file: IO[bytes], types: Mapping[str, str]) -> dict[str, Any]:
    """Return each column of the rows in a file."""
    file.seek(0)
    table = np.fromfile(file, list(types.items()))
    return {name: table[name] for name in types}


def _frame_values(moment: Moment) -> dict[str, Any]:
    time_s, frame, age_s = moment
    known = {name: _known(getattr(frame, name, None)) for name in FRAME_TYPES}
    bits = sum(Flag[name] for flag in frame.flags if (name := flag.upper()) in Flag.__members__)
    return {
        **known,
        "time_s": time_s,
        "age_s": _known(age_s),
        "tier": frame.tier or "",
        "flags": bits,
    }


def _contact_values(row: int, contact: Contact) -> dict[str, Any]:
    values = {
        ARRAY_COLUMNS.get(field.name, f"contact_{field.name}"): _known(getattr(contact, field.name))
        for field in fields(Contact)
    }
    return {"contact_frame": row, **values}


def _known(value: Any) -> Any:
    return np.nan if value is None else value


def _axes(frame: Frame) -> dict[str, FloatArray]:
    """Return the positions of the images' columns and rows, mm; nothing for a frame without one."""
    image = next((i for name in IMAGES if (i := getattr(frame, name)) is not None), None)
    if image is None or frame.x_mm is None or frame.y_mm is None:
        return {}
    rows, columns = image.shape
    return {"x_mm": np.linspace(*frame.x_mm, columns), "y_mm": np.linspace(*frame.y_mm, rows)}
