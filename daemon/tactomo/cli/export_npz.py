"""Maps and contacts as arrays, named as those of `tactomo reconstruct` where they are the same.

A recording may be larger than the memory, and how long it is shows at its end only: each array
grows in a file of its own, and goes from there into the archive.
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
from numpy.typing import NDArray
from tactomo_client import Contact, Frame
from tactomo_models import Flag

from tactomo.cli.export_csv import ARRAY_COLUMNS
from tactomo.cli.recorded import Moment

IMAGES: Final = ("map", "pressure_kpa", "structure")
FRAME_TYPES: Final[Mapping[str, str]] = {
    "time_s": "<f8",
    "acquired_realtime_ns": "<i8",
    "scan_counter": "<i8",
    "age_s": "<f8",
    "tier": "<U16",
    "misfit": "<f8",
    "confidence": "<f8",
    "flags": "<u4",
}
CONTACT_TYPES: Final[Mapping[str, str]] = {
    "contact_frame": "<i8",
    **{
        ARRAY_COLUMNS.get(field.name, f"contact_{field.name}"): {"int": "<i8", "str": "<U8"}.get(
            str(field.type), "<f8"
        )
        for field in fields(Contact)
    },
}


def write_maps(moments: Iterable[Moment], output: IO[bytes], scratch: Path) -> int:
    """Write frames as an .npz file; return how many there were.

    An image that a frame does not have, and a number that is not known, is NaN.

    Args:
        moments: the frames.
        output: the file.
        scratch: a folder with room for all of it, uncompressed.

    """
    with (
        tempfile.TemporaryDirectory(prefix=".tactomo-", dir=scratch) as folder,
        contextlib.ExitStack() as undo,
    ):
        arrays = _Arrays(Path(folder), undo)
        for moment in moments:
            arrays.append(moment)
        arrays.store(output)
        return arrays.count


class _Arrays:
    """All arrays of a file while they grow; `undo` closes theirs.

    Attributes:
        count: how many frames are in them.

    """

    def __init__(self, folder: Path, undo: contextlib.ExitStack) -> None:
        def columns(types: Mapping[str, str]) -> dict[str, _Column]:
            files = {name: undo.enter_context((folder / name).open("w+b")) for name in types}
            return {name: _Column(files[name], np.dtype(dtype)) for name, dtype in types.items()}

        self.count = 0
        self._frames = columns(FRAME_TYPES)
        self._contacts = columns(CONTACT_TYPES)
        self._images = columns(dict.fromkeys(IMAGES, "<f4"))
        self._axes: dict[str, NDArray[np.float64]] = {}

    def append(self, moment: Moment) -> None:
        """Append a frame."""
        _append(self._frames, _frame_values(moment))
        for contact in moment.frame.contacts:
            _append(self._contacts, _contact_values(self.count, contact))
        for name, column in self._images.items():
            column.put(self.count, getattr(moment.frame, name))
        self._axes = self._axes or _axes(moment.frame)
        self.count += 1

    def store(self, output: IO[bytes]) -> None:
        """Write all of them as an archive."""
        if self._axes:
            shape = (len(self._axes["y_mm"]), len(self._axes["x_mm"]))
            for column in self._images.values():
                column.fill(self.count, shape)
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, column in {**self._frames, **self._images, **self._contacts}.items():
                column.store(archive, name)
            for name, positions in self._axes.items():
                with archive.open(f"{name}.npy", "w") as entry:
                    npy.write_array(entry, positions)


class _Column:
    """An array that grows in a file; its rows are numbers, or images of one shape."""

    def __init__(self, file: IO[bytes], dtype: np.dtype[Any]) -> None:
        self.rows = 0
        self._file = file
        self._dtype = dtype
        self._shape: tuple[int, ...] = ()

    def put(self, row: int, value: Any) -> None:
        """Set a row at or beyond the end; NaN in those that are left out. None leaves it out."""
        if value is None:
            return
        array = np.asarray(value, self._dtype)
        self.fill(row, array.shape)
        self._file.write(array.tobytes())
        self.rows += 1

    def fill(self, rows: int, shape: tuple[int, ...]) -> None:
        """Make it so many rows of this shape long, by NaN."""
        self._shape = shape
        while self.rows < rows:
            self._file.write(np.full(shape, np.nan, self._dtype).tobytes())
            self.rows += 1

    def store(self, archive: zipfile.ZipFile, name: str) -> None:
        """Copy it into an archive."""
        header = {
            "descr": npy.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (self.rows, *self._shape),
        }
        self._file.seek(0)
        with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
            npy.write_array_header_1_0(entry, header)
            shutil.copyfileobj(self._file, entry)


def _append(columns: Mapping[str, _Column], values: Mapping[str, Any]) -> None:
    for name, column in columns.items():
        column.put(column.rows, values[name])


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


def _axes(frame: Frame) -> dict[str, NDArray[np.float64]]:
    """Return the positions of the images' columns and rows, mm; nothing for a frame without one."""
    image = next((i for name in IMAGES if (i := getattr(frame, name)) is not None), None)
    if image is None or frame.x_mm is None or frame.y_mm is None:
        return {}
    rows, columns = image.shape
    return {"x_mm": np.linspace(*frame.x_mm, columns), "y_mm": np.linspace(*frame.y_mm, rows)}
