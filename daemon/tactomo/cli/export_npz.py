"""Maps and contacts as arrays, named as those of `tactomo reconstruct` where they are the same.

A recording may be larger than the memory, and how long it is shows at its end only: each array
grows in a file of its own, and goes from there into the archive.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
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
    count = 0
    with contextlib.ExitStack() as undo:
        folder = undo.enter_context(tempfile.TemporaryDirectory(prefix=".tactomo-", dir=scratch))

        def column(name: str, dtype: str) -> _Column:
            return undo.enter_context(_Column.opened(Path(folder) / name, np.dtype(dtype)))

        of_frames = {name: column(name, dtype) for name, dtype in FRAME_TYPES.items()}
        of_contacts = {name: column(name, dtype) for name, dtype in CONTACT_TYPES.items()}
        images = {name: column(name, "<f4") for name in IMAGES}
        axes: dict[str, NDArray[np.float64]] = {}
        for count, moment in enumerate(moments, 1):
            _append(of_frames, _frame_values(moment))
            for contact in moment.frame.contacts:
                _append(of_contacts, _contact_values(count - 1, contact))
            for name, grown in images.items():
                grown.put(count - 1, getattr(moment.frame, name))
            axes = axes or _axes(moment.frame)
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for grown in images.values():
                grown.fill(count)
            for name, grown in {**of_frames, **images, **of_contacts}.items():
                grown.store(archive, name)
            for name, positions in axes.items():
                with archive.open(f"{name}.npy", "w") as entry:
                    npy.write_array(entry, positions)
    return count


class _Column:
    """An array that grows in a file; its rows are numbers, or images of one shape."""

    def __init__(self, file: IO[bytes], dtype: np.dtype[Any]) -> None:
        self.rows = 0
        self._file = file
        self._dtype = dtype
        self._shape: tuple[int, ...] | None = None

    @classmethod
    @contextlib.contextmanager
    def opened(cls, path: Path, dtype: np.dtype[Any]) -> Iterator[_Column]:
        """Open a column in a new file."""
        with path.open("w+b") as file:
            yield cls(file, dtype)

    def put(self, row: int, value: Any) -> None:
        """Set a row at or beyond the end; NaN where it is None, and in rows that are left out."""
        if value is None:
            return
        array = np.asarray(value, self._dtype)
        self._shape = array.shape
        self.fill(row)
        self._file.write(array.tobytes())
        self.rows += 1

    def fill(self, rows: int) -> None:
        """Make it so many rows long, by NaN; by nothing, as long as its rows have no shape."""
        if self._shape is None:
            return
        while self.rows < rows:
            self._file.write(np.full(self._shape, np.nan, self._dtype).tobytes())
            self.rows += 1

    def store(self, archive: zipfile.ZipFile, name: str) -> None:
        """Copy it into an archive."""
        header = {
            "descr": npy.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (self.rows, *(self._shape or ())),
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
