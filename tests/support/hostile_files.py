"""A corpus of files that nobody means well with, made anew for each run.

Each is small on the disk. What it asks for when read is not: memory, time, another file, a pipe
that never ends, or that a terminal does as it says.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import numpy as np
import zstandard
from ezdxf.filemanagement import new
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import Entry, RecordingWriter
from tactomo_models import SkinSimulator, load_description
from tactomo_models.sensor.description_file import shipped_text
from tactomo_protocol import Channel, Hello, SampleFormat, Scan, ScanFlag, encode

MEGABYTE: Final = 1 << 20
ESCAPES: Final = "\x1b]0;owned\x07\x1b[2J[/b][red][link=file:///etc/passwd]a[/]\u202e\x9b31m"
BAD_DEVICE: Final = "x[/b]y"
BAD_SENSOR: Final = "a[/]b"
NAME: Final = "x[/b]y\x1b[2J\u202e"  # of a file, in a folder


def zeros_npz(path: Path, megabytes: int = 1024) -> None:
    """One array of zeros: a thousandth of what it unpacks to."""
    header = io.BytesIO()
    shape = (megabytes * MEGABYTE // 1664, 208)
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("magnitude.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(megabytes):
            member.write(bytes(MEGABYTE))


def boastful_npz(path: Path) -> None:
    """A header of a terabyte, and nothing behind it."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("magnitude.npy", "w") as member:
        shape = (1 << 29, 208)
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": shape}
        )


def many_members_npz(path: Path) -> None:
    """Arrays without number, of nothing."""
    array = io.BytesIO()
    np.save(array, np.zeros(0))
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(20_000):
            archive.writestr(f"a{number}.npy", array.getvalue())


def markup_npz(path: Path) -> None:
    """Names that steer a terminal, or what draws tables on it."""
    np.savez(
        path,
        allow_pickle=False,
        **{ESCAPES.replace("/", "|"): np.zeros(3), "skin[left]": np.zeros((2, 208))},
    )


def _tanks(path: Path, injection: int, weights: int, side: int) -> None:
    """A tank of the challenge's, by as many injections, weights and pixels a side."""
    rows = {"injection": (1, 32, injection), "measurement": (32, weights)}
    readings = dict.fromkeys(("reference", "voltages"), (1, injection * weights))
    arrays = {name: np.ones(shape, np.int8) for name, shape in {**rows, **readings}.items()}
    truth = np.zeros((1, side, side), np.int8)
    np.savez_compressed(path, allow_pickle=False, truth=truth, **arrays)


def large_pictures_npz(path: Path) -> None:
    """A tank in a picture of 36 million pixels, whose score would take 4 GB."""
    _tanks(path, 76, 31, 6000)


def many_readings_npz(path: Path) -> None:
    """A tank of a million readings, of which each has 64 numbers of electrodes."""
    _tanks(path, 1000, 1000, 4)


def beyond_npz(path: Path) -> None:
    """Voltages whose squares no computer holds, among honest ones."""
    [volts] = SkinSimulator(load_description("tank_disc")).voltages([]).values()
    scans = volts * (1 + 1e-4 * np.random.default_rng(0).normal(size=(6, len(volts))))
    rest = scans.copy()
    scans[::2], rest[0, 3] = 1e308, -1e308
    np.savez(path, structure=scans, structure_reference=rest)


def beyond_recording(path: Path) -> None:
    """Scans of the largest numbers on the wire, each of the largest scale."""
    largest = float(np.finfo(np.float32).max)
    both = (Channel.MAGNITUDE, Channel.STRUCTURE)
    kind = SampleFormat.FLOAT32
    hello = Hello("device", "firmware", both, 16, 1, 1, 208, kind, largest, 20.0)
    writer = RecordingWriter(path, Origin("skin", "paper_square", "", ("a",), "0"))
    writer.add(Entry("port/0", encode(hello), 10**10, 10**10))
    for counter in range(1, 60):
        at_ns = 10**10 + 50_000_000 * counter
        for channel in both:
            samples = np.full(208, largest * (-1) ** counter, np.float32)
            scan = Scan(channel, counter, 50_000 * counter, ScanFlag(0), samples)
            writer.add(Entry("port/0", encode(scan), at_ns, at_ns))
    writer.close()


def zeros_mat(path: Path, megabytes: int = 700) -> None:
    """One compressed element of zeros, of version 5."""
    rows, columns = megabytes * MEGABYTE // 1664, 208

    def tagged(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data

    size = rows * columns * 8
    head = tagged(6, struct.pack("<II", 6, 0)) + tagged(5, struct.pack("<ii", rows, columns))
    head += tagged(1, b"vv      ") + struct.pack("<II", 9, size)
    packer = zlib.compressobj(1)
    packed = packer.compress(struct.pack("<II", 14, len(head) + size) + head)
    for _ in range(size // MEGABYTE):
        packed += packer.compress(bytes(MEGABYTE))
    packed += packer.compress(bytes(size % MEGABYTE)) + packer.flush()
    title = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)
    path.write_bytes(title + struct.pack("<II", 15, len(packed)) + packed)


def wide_csv(path: Path) -> None:
    """A single line of numbers."""
    path.write_text(",".join(["1"] * MEGABYTE))


def tall_csv(path: Path) -> None:
    """A single number a line."""
    path.write_text("1\n" * MEGABYTE)


def zeros_csv(path: Path) -> None:
    """Scans of eight electrodes that measured nothing."""
    path.write_text((",".join(["0"] * 40) + "\n") * 3)


def beyond_csv(path: Path) -> None:
    """Scans of eight electrodes, whose sums are beyond numbers."""
    path.write_text((",".join(["1e308", "-1e308"] * 20) + "\n") * 3)


def headless_csv(path: Path) -> None:
    """Nothing but header."""
    path.write_text("what is no number\n" * 100_000)


def _recording(path: Path, origin: Origin, hellos: Iterable[Hello] = ()) -> None:
    writer = RecordingWriter(path, origin)
    for number, hello in enumerate(hellos):
        at_ns = 10_000_000_000 + number
        writer.add(Entry("port/0", encode(hello), at_ns, at_ns))
    writer.close()


def _hello(device: str) -> Hello:
    both = (Channel.MAGNITUDE, Channel.STRUCTURE)
    return Hello(device, "firmware", both, 16, 1, 1, 208, SampleFormat.FLOAT32, 1.0, 20.0)


def markup_recording(path: Path) -> None:
    """A device and a sensor whose names are markup."""
    origin = Origin(BAD_SENSOR, "paper_square", "", (ESCAPES,), ESCAPES)
    _recording(path, origin, [_hello(BAD_DEVICE), _hello("skin[left]")])


def timeless_recording(path: Path) -> None:
    """Scans of a computer whose clock stands still."""
    writer = RecordingWriter(path, Origin("skin", "paper_square", "", ("a",), "0"))
    at_ns, hello = 10_000_000_000, _hello("device")
    writer.add(Entry("port/0", encode(hello), at_ns, at_ns))
    for counter in (1, 2, 3):
        for channel in hello.channels:
            scan = Scan(channel, counter, 50_000 * counter, ScanFlag(0), np.ones(208, np.float32))
            writer.add(Entry("port/0", encode(scan), at_ns, at_ns))
    writer.close()


def many_devices(path: Path) -> None:
    """A board that calls itself otherwise each time."""
    _recording(
        path,
        Origin("skin", "paper_square", "", ("a",), "0"),
        (_hello(f"device {number}") for number in range(20_000)),
    )


def _described(path: Path, description: str) -> None:
    _recording(path, Origin("skin", description, "", ("a",), "0"), [_hello("device")])


def password_recording(path: Path) -> None:
    """A recording that says that its description is another's file."""
    _described(path, "/etc/passwd")


def piped_recording(path: Path) -> None:
    """A recording that says that its description is a pipe."""
    os.mkfifo(path.with_suffix(".fifo"))
    _described(path, str(path.with_suffix(".fifo")))


def _chunk(records: bytes, size: int | None = None) -> bytes:
    data = zstandard.compress(records)
    size = len(records) if size is None else size
    body = struct.pack("<QQQII", 0, 1, size, zlib.crc32(records), 4) + b"zstd"
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


def _begun(path: Path) -> bytes:
    _recording(path, Origin("skin", "paper_square", "", ("a",), "0"))
    whole = path.read_bytes()
    return whole[: whole.rindex(struct.pack("<BQ", Opcode.DATA_END, 4))]


def tiny_records(path: Path) -> None:
    """Chunks of seven million records of nothing each, a few kilobytes on the disk."""
    nothing = struct.pack("<BQ", 0x80, 0) * (7 * MEGABYTE)
    path.write_bytes(_begun(path) + 3 * _chunk(nothing))


def tiny_messages(path: Path) -> None:
    """Chunks of a million messages of a port that said nothing."""
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, 6, 0, 1, 1)
    path.write_bytes(_begun(path) + 3 * _chunk(message * (2 * MEGABYTE)))


def endless_message(path: Path) -> None:
    """Chunks of one message of 30 MB of a port each."""
    data = bytes(30 * MEGABYTE)
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(data), 6, 0, 1, 1) + data
    path.write_bytes(_begun(path) + 4 * _chunk(message))


def false_marks(path: Path) -> None:
    """What looks like the beginning of a chunk, every few bytes."""
    head = struct.pack("<BQQQQI", 6, 0, 0, 0, MEGABYTE, 1) + b"\x04\0\0\0zstd"
    path.write_bytes(_begun(path) + (head + struct.pack("<Q", MEGABYTE)) * 20_000)


def nested_chunks(path: Path) -> None:
    """Chunks that unpack, one inside the other, each with a wrong checksum."""
    data = b""
    for _ in range(8_000):
        head = struct.pack("<BQQQQI", 6, 0, 0, 0, 30 * MEGABYTE, 1) + b"\x04\0\0\0zstd"
        frame = b"\x28\xb5\x2f\xfd\xa0" + struct.pack("<I", 30 * MEGABYTE)
        frame += struct.pack("<I", (MEGABYTE << 3) | 2)[:3] + b"\0"
        data += head + struct.pack("<Q", 4 * MEGABYTE) + frame
    path.write_bytes(_begun(path) + data)


def deep_metadata(path: Path) -> None:
    """A recording of another program, all of whose records are nothing."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("other", "other")
        for _ in range(50_000):
            writer.add_metadata("", {})
        writer.finish()  # type: ignore[no-untyped-call]


def _write_paper_square(path: Path, key: str, value: str) -> None:
    """The paper's sensor with another value of a key."""
    text, count = re.subn(
        f"(?m)^{key} = .*", lambda _: f"{key} = {value}", shipped_text("paper_square")
    )
    assert count == 1
    path.write_text(text)


def wide_description(path: Path) -> None:
    """A sheet 3 m wide: the largest mesh that its map's nodes seem to allow."""
    _write_paper_square(path, "width_m", "3.0")


def deep_toml(path: Path) -> None:
    """Lists in lists."""
    path.write_text("a = " + "[" * 100_000)


def dotted_toml(path: Path) -> None:
    """A key of twenty thousand parts, whose every beginning is a key, too."""
    path.write_text("a" + ".a" * 20_000 + " = 1")


def titled_description(path: Path) -> None:
    """A description whose title is markup and whose name is none."""
    _write_paper_square(path, "title", f'"{BAD_DEVICE} \\u001b[2J"')


def deep_json(path: Path) -> None:
    """Lists in lists, where a calibration is to be."""
    path.write_text("[" * 1_000_000)


def long_eit(path: Path) -> None:
    """A frame without end."""
    head = ["18", "3", "name", "2024.01.31. 12:30:05.250", "1", "1", "0", "1", "1", "1"]
    lines = head + ["x"] * 8 + ["1 2", " ".join(["1"] * 64)] * 20_000
    path.write_text("\n".join(lines))


def crowded_eit(path: Path) -> None:
    """As many injections as fit."""
    head = ["9", "name", "2024.01.31. 12:30:05.250", "1", "1", "0", "1", "1", "1"]
    path.write_text("\n".join(head) + "\n1 2\n1 1" * (2 * MEGABYTE - 20))


def beyond_svg(path: Path) -> None:
    """An electrode beyond numbers: GEOS ends the process on it."""
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="9mm" height="9mm">'
        '<rect width="9" height="9"/><g id="electrodes"><circle r="1e308"/><circle r="1"/></g>'
        "</svg>"
    )


def beyond_dxf(path: Path) -> None:
    """The same by another program."""
    document = new(units=4)
    document.modelspace().add_lwpolyline([(0, 0), (9, 0), (9, 9), (0, 9)], close=True)
    for radius in (1.0, 1e308):
        document.modelspace().add_circle((0, 0), radius, dxfattribs={"layer": "electrodes"})
    document.saveas(path)


def pipe(path: Path) -> None:
    """A pipe that nobody writes to."""
    os.mkfifo(path)


def endless(path: Path) -> None:
    """A device that never ends."""
    path.symlink_to("/dev/zero")


def kernel(path: Path) -> None:
    """What the kernel calls a regular file, and whose end root waits for in vain."""
    path.symlink_to("/proc/kmsg")


def honest_npz(path: Path) -> None:
    """Nothing is the matter with it but its name."""
    np.savez(
        path, allow_pickle=False, structure=np.ones((3, 208)), structure_reference=np.ones(208)
    )


def folder(path: Path) -> None:
    """A folder under the name of a file."""
    path.mkdir()


CORPUS: Final[dict[str, Callable[[Path], None]]] = {
    "zeros.npz": zeros_npz,
    "boastful.npz": boastful_npz,
    "members.npz": many_members_npz,
    "markup.npz": markup_npz,
    "pictures.npz": large_pictures_npz,
    "readings.npz": many_readings_npz,
    "beyond.npz": beyond_npz,
    "zeros.mat": zeros_mat,
    "wide.csv": wide_csv,
    "tall.csv": tall_csv,
    "zeros.csv": zeros_csv,
    "beyond.csv": beyond_csv,
    "headless.csv": headless_csv,
    "markup.mcap": markup_recording,
    "devices.mcap": many_devices,
    "beyond.mcap": beyond_recording,
    "timeless.mcap": timeless_recording,
    "password.mcap": password_recording,
    "piped.mcap": piped_recording,
    "records.mcap": tiny_records,
    "messages.mcap": tiny_messages,
    "endless.mcap": endless_message,
    "marks.mcap": false_marks,
    "nested.mcap": nested_chunks,
    "other.mcap": deep_metadata,
    "wide.toml": wide_description,
    "deep.toml": deep_toml,
    "dots.toml": dotted_toml,
    "title.toml": titled_description,
    "deep.json": deep_json,
    "long.eit": long_eit,
    "crowd.eit": crowded_eit,
    "beyond.svg": beyond_svg,
    "beyond.dxf": beyond_dxf,
    **{f"pipe{suffix}": pipe for suffix in (".npz", ".mat", ".csv", ".eit", ".mcap", ".toml")},
    **{f"device{suffix}": endless for suffix in (".npz", ".mat", ".csv", ".eit", ".mcap", ".toml")},
    **{f"kernel{suffix}": kernel for suffix in (".csv", ".mcap", ".json", ".svg")},
    "folder.mcap": folder,
    "folder.npz": folder,
    f"{NAME}.npz": honest_npz,
    f"{NAME}.csv": tall_csv,
    f"{NAME}.mcap": markup_recording,
    f"{NAME}.toml": titled_description,
    f"{NAME}.json": deep_json,
}
