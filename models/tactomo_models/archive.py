"""Files that are whole or not there, and archives of arrays (.npz), which disks damage."""

from __future__ import annotations

import errno
import glob
import math
import os
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from tactomo_models.array_files import READERS, check_unpacked
from tactomo_models.errors import DataError
from tactomo_models.foreign_file import open_regular

_HEADERS: Final = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name, or of another program's, see `array_files`.

    Raises:
        OSError: the file cannot be read.
        DataError: it is damaged, or no file of plain arrays.
    """
    if read := READERS.get(path.suffix.lower()):
        return read(path)
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as stored:
            members = stored.infolist()
            check_unpacked(path, sum(member.file_size for member in members), len(members))
            return {m.filename.removesuffix(".npy"): _array(stored, m) for m in members}
    except (OSError, DataError):
        raise
    except Exception as error:  # a flipped bit makes zip and header parsers raise almost anything
        raise DataError(
            f"cannot read {path}: damaged, or no .npz file of numbers; read are .npz, "
            f"{', '.join(READERS)}, and what they hold is told by that ending"
        ) from error


def _array(stored: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """One array: read to its end, where the checksum is compared, unlike by numpy."""
    with stored.open(info) as member:  # numpy makes room for as much as the header says
        version = np.lib.format.read_magic(member)
        shape, _, dtype = _HEADERS[version](member)
        if info.file_size - member.tell() != dtype.itemsize * math.prod(shape):
            raise ValueError("not as much as its header says")
    with stored.open(info) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        member.read(1)
    return array


def map_array(path: Path, name: str) -> NDArray[Any]:
    """One array of an uncompressed .npz file, in the file: what nobody reads of it takes no memory.

    For files that `read_arrays` has read. An array at an odd place is copied. Raises ValueError for
    a compressed one.
    """
    with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as member:
        np.lib.format.read_magic(member)
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
        info, header = archive.getinfo(f"{name}.npy"), member.tell()
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
    start = info.header_offset
    with path.open("rb") as file:
        file.seek(start + 26)  # lengths of the name and of the field that end the 30 bytes' header
        start += 30 + sum(struct.unpack("<HH", file.read(4))) + header
    return np.require(np.asarray(np.memmap(path, dtype, "r", start, shape)), requirements="A")


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write an .npz file as a whole, see `write_whole`.

    Raises OSError where the file cannot be written.
    """
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def write_whole(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file and make its folder; a half-written one is never left under that name.

    A link is followed. What is no file, such as /dev/null, is written to and not replaced.

    Raises OSError where the file cannot be written.
    """
    if path.is_dir():  # "." has no name that another could be made of
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path = path.resolve()
    if path.exists() and not path.is_file():
        with path.open("wb") as device:
            write(device)
        return
    part = part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave an empty file under that name
        part.replace(path)
    except BaseException:  # Ctrl-C included
        with suppress(OSError):
            part.unlink()
        raise


def check_replaceable(path: Path) -> None:
    """Raise OSError where no file, but a pipe or a device, has a place of ours.

    For use before `write_whole`, which waits for a pipe, where nobody has named the place.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))


def part_of(path: Path) -> Path:
    """Return the hidden file to write until it is whole; remove those that killed writers left."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        pid = left.name.split(".")[-2]
        if pid.isdecimal() and not _is_running(int(pid)):
            with suppress(OSError):
                left.unlink()
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        return True
    return True
