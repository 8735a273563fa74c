"""What is fuzzed: every parser of ours that reads what others wrote, with examples to start from.

A target takes any bytes and raises nothing: what its parser documents, it takes in itself. It tells
whether the bytes were what the parser reads. The default suite mutates the examples for a moment
(`test_fuzz`); `make fuzz` has libFuzzer do so for long, led by the coverage of our code (`run`).
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sciospec_stream
from frame_fields import frame_fields
from pydantic import ValidationError
from tactomo.config import load_config
from tactomo.errors import ConfigError, RecordingError, TactomoError
from tactomo.protocols import protocol_named
from tactomo.protocols.sciospec import Sciospec
from tactomo.recordings.imported_scans import read_scans
from tactomo.recordings.recording import Origin, open_recording
from tactomo.recordings.recording_writer import (
    Entry,
    RecordingWriter,
    pack_frame,
    reference_entry,
)
from tactomo.scans import FrameRecord, ScanKey
from tactomo.stream.control import COMMANDS
from tactomo.twin import control as twin_control
from tactomo.twin.scene import SHIPPED, load_scene
from tactomo_client import ClientError, ControlError, MessageError
from tactomo_client.messages import (
    CONTACTS,
    EVENT,
    MAP,
    STATUS,
    decode_message,
    decode_reply,
    decode_request,
    encode_error,
    encode_message,
    encode_reply,
    encode_request,
    frame_from_message,
)
from tactomo_client.recording import RecordingWarning
from tactomo_client.recording import open_recording as open_frames
from tactomo_client.schema import Event, Status
from tactomo_models import Reference, load_description, shipped_descriptions
from tactomo_models.calibration.calibration_file import (
    PressureCalibration,
    parse_calibration,
    subject_of,
)
from tactomo_models.calibration.curve import Reading
from tactomo_models.calibration.load_cell import (
    Seen,
    direct_readings,
    joined_readings,
    read_load_cell,
)
from tactomo_models.errors import CalibrationError, DataError, DescriptionError
from tactomo_models.scene.pressure import pressures_of
from tactomo_models.sensor.description_file import shipped_text
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    Decoder,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    encode,
)

DEPLOY = Path(__file__).parents[2] / "deploy"
BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)
HELLO = Hello("fuzz-1", "1.0", BOTH, 16, 1, 1, 208, SampleFormat.INT32, 1e-6, 20.0)
SCAN = Scan(Channel.STRUCTURE, 7, 350_000, ScanFlag(0), np.arange(208, dtype=np.int32))
PACKETS: tuple[Packet, ...] = (
    HELLO,
    SCAN,
    Scan(Channel.MAGNITUDE, 2**32 - 1, 2**53 - 1, ScanFlag(1), np.zeros(3, np.float32)),
    Acknowledge(1, CommandCode.START, AckStatus.OK),
    Command(CommandCode.SET_RATE, request=1, rate_hz=20.0),
)
HEADER = frame_fields(
    7, 1_700_000_000_000_000_000, tier_reason="two contacts", flags=["misfit_high"]
)
ENVELOPE = {k: v for k, v in HEADER.items() if k not in ("scan_counter", "contacts")}
PRESS = {"at_s": 0.0, "duration_s": 1.0, "x_mm": 1.0, "y_mm": 2.0}
CONTACT = {"id": 1, "x_mm": 1.0, "y_mm": -2.0, "area_mm2": 700.0, "magnitude": None}


@dataclass(frozen=True)
class Target:
    """One parser: valid input, and what to do with any other."""

    examples: Callable[[], list[bytes]] = field(repr=False)
    parse: Callable[[bytes], bool]


def _fed_alike(whole: Any, pieces: Any, data: bytes, step: int) -> list[Any]:
    """Return what comes of bytes; cut into reads of some length, the outcome is the same."""
    expected = whole.feed(data)
    found = [p for at in range(0, len(data), step) for p in pieces.feed(data[at : at + step])]
    for one, other in zip(found, expected, strict=True):
        assert one == other or repr(one) == repr(other)  # a rate may be NaN
    assert whole.counts == pieces.counts
    return list(expected)


def _wire_examples() -> list[bytes]:
    packets = [encode(packet) for packet in PACKETS]
    return [*packets, b"".join(packets)]


def _parse_wire(data: bytes) -> bool:
    packets = _fed_alike(Decoder(), Decoder(), data, 1 + len(data) % 7)
    return any(isinstance(packet, Hello | Scan | Acknowledge | Command) for packet in packets)


def _line_examples() -> list[bytes]:
    values = [f"{n / 16:.4f}" for n in range(256)]
    fields = "".join(f"{value:>13}," for value in values[:192])
    frame = f"OpenEIT\nmagnitudes: {fields}\r\n".encode()
    table = ("\n" + ", ".join(values) + ", \n").encode()
    rows = "".join(",".join(values[n : n + 16]) + "\r\n" for n in range(0, 256, 16))
    return [b"\n" + frame * 2, table * 2, b"\nA\n" + rows.encode() * 2]


def _parse_lines(data: bytes) -> bool:
    """Also told to a new object."""
    taken = False
    for name in ("openeit_disc", "matrix_disc"):
        whole, pieces, again = (protocol_named("matrix", load_description(name)) for _ in range(3))
        taken |= bool(_fed_alike(whole, pieces, data, 1 + len(data) % 7))
        again.feed(pieces.preamble())
    return taken


def _message_examples() -> list[bytes]:
    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    images = {"map": image, "pressure_kpa": None, "structure": image}
    extent = {"x_mm": [-75.0, 75.0], "y_mm": [-75.0, 75.0]}
    contacts = {**HEADER, "contacts": [CONTACT]}
    return [
        encode_message("left", MAP, {**contacts, **images, **extent}),
        encode_message("left", CONTACTS, contacts),
        encode_message("left", STATUS, {**ENVELOPE, "ports": [{"url": "a"}], "rates": {}}),
        encode_message("left", EVENT, {**ENVELOPE, "name": "tared", "detail": "a reference"}),
        encode_reply({"scans": 20}),
        encode_error("tare_refused", "somebody presses", "let go"),
    ]


def _parse_message(data: bytes) -> bool:
    taken = False
    with suppress(ClientError):
        frame_from_message(decode_message(data), time.monotonic_ns(), 0.5)
        taken = True
    for kind in (Status, Event):
        with suppress(ClientError):
            kind.from_fields(decode_message(data).fields, time.monotonic_ns(), 0.5)
            taken = True
    with suppress(MessageError):
        with suppress(ControlError):  # a refusal is a reply, too
            decode_reply(data)
        taken = True
    return taken


def _request_examples() -> list[bytes]:
    return [
        encode_request("set_tier", {"tier": "fit"}),
        encode_request("set_budget", {"budget_ms": 20.0}),
        encode_request("record_start", {"path": "a.mcap"}),
        encode_request("press", {"x_mm": 1.0, "y_mm": 2.0, "shape": "ring"}),
        encode_request("play", {"scene": {"press": [PRESS]}}),
    ]


def _parse_request(data: bytes) -> bool:
    """As far as the handlers, of the daemon and of the twin."""
    taken = False
    with suppress(ClientError, ValidationError):
        command, arguments = decode_request(data)
        for commands in (COMMANDS, twin_control.COMMANDS):
            if command in commands:
                commands[command].model_validate(arguments)
                taken = True
    return taken


def _description_examples() -> list[bytes]:
    return [shipped_text(name).encode() for name in shipped_descriptions()]


def _parse_description(data: bytes) -> bool:
    """Including what is worked out from it at once."""
    with suppress(DescriptionError):
        description = load_description(_scratch("description.toml", data))
        assert description.electrode_ends_m.shape == (description.electrode_count, 2, 2)
        assert np.isfinite(description.electrode_ends_m).all()
        assert 0 < description.measurements <= description.electrode_count**2
        assert len(description.map_x_m) * len(description.map_y_m) < 20_000
        assert description.sha256
        return True
    return False


def _recording_examples() -> list[bytes]:
    path = _scratch("example.mcap")
    path.unlink(missing_ok=True)
    writer = RecordingWriter(path, Origin("left", "paper_square", "0" * 64, ("a", "b"), "0.1"))
    volts = np.linspace(0.05, 0.2, 6)
    reference = Reference(volts, volts, volts * 1e-4, None, scans=3)
    writer.add(Entry("port/0/hello", encode(HELLO), 1, 1))
    writer.add(reference_entry(reference, 1, 2, 2))
    writer.add(Entry("port/0", encode(SCAN), 3, 3))
    writer.add(Entry("port/1", b"\0\1\2", 4, 4))
    contacts = encode_message("left", CONTACTS, {**HEADER, "contacts": [CONTACT]})
    writer.add(Entry(MAP, encode_message("left", MAP, HEADER), 4, 4))
    writer.add(Entry(CONTACTS, contacts, 4, 4))
    key = ScanKey(Channel.STRUCTURE, 7, 350_000)
    mark = FrameRecord((key,), "fit", 4.0, reference_number=1)
    writer.add(Entry("frame", pack_frame(mark), 5, 5))
    writer.flush()
    cut = path.read_bytes()
    writer.close()
    return [path.read_bytes(), cut]


def _parse_recording(data: bytes) -> bool:
    path = _scratch("fuzzed.mcap", data)
    taken = False
    with suppress(RecordingError):
        recording = open_recording(path)
        taken = True
        for read in (
            lambda: recording.summary.ending,
            lambda: recording.span,
            lambda: recording.start_ns,
            lambda: list(recording.chunks(0)),
            recording.marks,
            recording.first_reference,
            recording.replay_urls,
        ):
            with suppress(RecordingError):
                read()
    with suppress(ClientError), warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        frames = open_frames(path)
        assert frames.duration_s is not None
        assert frames.damage is not None
        list(frames.frames("contacts"))
    return taken


TANK = load_description("tank_disc")


def _sciospec_examples() -> list[bytes]:
    said = sciospec_stream.frames(TANK, [np.full(TANK.measurements, 0.1)] * 3)
    return [
        b"".join(b"".join(frame) for frame in said),
        b"".join(said[0][:9]) + b"\x18\x01\x83\x18",
    ]


def _parse_sciospec(data: bytes) -> bool:
    """Little of it is kept."""
    whole = Sciospec(TANK)
    _fed_alike(whole, Sciospec(TANK), data, 1 + len(data) % 701)
    assert len(whole.begun()) < 9000
    return whole.counts.packets > 0


def _eit_examples() -> list[bytes]:
    """A frame with each of the three headers."""
    date = "2024.01.31. 12:30:05.250"
    said = ["setup_00001", date, "10000", "10000", "0", "1", "0.001", "20"]
    row = "\t".join(f"{n % 5}e-2\t-1e-4" for n in range(TANK.electrode_count))
    frame = [f"{k + 1} {(k + 1) % 16 + 1}\n{row}" for k in range(TANK.electrode_count)]
    headers = [["9", *said], ["11", "2", *said, ""], ["18", "2", *said, *[""] * 8]]
    return ["\n".join([*header, *frame, ""]).encode() for header in headers]


def _parse_eit(data: bytes) -> bool:
    return import_anything(_scratch("fuzzed.eit", data))


def import_anything(path: Path) -> bool:
    """Import a file of scans: it becomes packets by its own times, or is refused."""
    with suppress(TactomoError, DataError):
        scans = read_scans(path, TANK, None)
        assert scans.count > 0
        times_s = scans.times(20.0 if scans.time_s is None else None)
        assert np.isfinite(times_s).all()
        assert (np.diff(times_s) >= 0).all()
        for time_s, packet in scans.packets(times_s, TANK):
            assert time_s >= 0
            encode(packet)
        return True
    return False


def _calibration_examples() -> list[bytes]:
    """As `tactomo calibrate` writes them."""
    readings = [
        Reading(pressure_kpa=kpa, magnitude=max(kpa - 60.0, 0.0) / 1000)
        for kpa in np.linspace(20.0, 200.0, 12).tolist()
    ]
    subject = subject_of("left", load_description("paper_square"), ("fuzz-1",))
    made = PressureCalibration.of_readings(subject, readings)
    return [made.model_dump_json(indent=1).encode()]


def _parse_calibration(data: bytes) -> bool:
    """A curve, by which any magnitude becomes a pressure that is known or said to be unknown."""
    with suppress(CalibrationError):
        calibration = parse_calibration(data, "fuzzed")
        curve = calibration.curve
        low, high = curve.range_kpa
        magnitude = np.array([0.0, 0.01, 0.1, 1.0, 5.0])
        areas_m2, unknown = np.full(5, 1e-3), np.full(5, np.nan)
        found = pressures_of(curve, magnitude, 0.1 * magnitude, areas_m2, unknown)
        known = found.kpa[~np.isnan(found.kpa)]
        assert ((low <= known) & (known <= high)).all()
        assert calibration.words
        return True
    return False


def _load_cell_examples() -> list[bytes]:
    presses = "".join(f"{n};{n / 10};{n / 1000};0.001;up\r\n" for n in range(0, 200, 9))
    held = "".join(f"{n / 10},{50 * (n // 10)},706.9\n" for n in range(60))
    return [
        b"pressure_kpa;time_s;magnitude;magnitude_sigma;direction\r\n" + presses.encode(),
        b"# by hand\ntime_s,force_n,area_mm2\n" + held.encode(),
        b'\xef\xbb\xbf"force_n"\tdiameter_mm\tmagnitude\n"100"\t30\t0.1\n\n50\t30\t.05\n',
    ]


def _parse_load_cell(data: bytes) -> bool:
    """As far as readings, from the log alone and with what a sensor showed meanwhile."""
    taken = False
    path = _scratch("fuzzed.csv", data)
    for area_mm2 in (None, 700.0):
        with suppress(CalibrationError):
            cell = read_load_cell(path, area_mm2)
            assert np.isfinite(cell.pressure_kpa).all()
            if (cell.magnitude >= 0).any():
                direct_readings(cell)
            if cell.clock:
                assert len(joined_readings(cell, SEEN).readings) <= len(cell.lines)
            taken = True
    return taken


SEEN = Seen(
    np.arange(200) / 20,
    np.linspace(0, 0.2, 200),
    np.full(200, 0.01),
    np.full(200, 300.0),
    np.ones(200, int),
)


def _config_examples() -> list[bytes]:
    with_keys = b'ports = ["/dev/ttyACM0"]\n[curve]\nsecret = "a.key_secret"\nclients = "clients"\n'
    return [(DEPLOY / "daemon.example.toml").read_bytes(), with_keys]


def _parse_config(data: bytes) -> bool:
    with suppress(ConfigError):
        load_config(_scratch("daemon.toml", data))
        return True
    return False


def _scene_examples() -> list[bytes]:
    return [path.read_bytes() for path in SHIPPED.values()]


def _parse_scene(data: bytes) -> bool:
    """Including what presses at some times of it."""
    with suppress(ConfigError):
        scene = load_scene(_scratch("scene.toml", data))
        for share in (0.0, 0.3, 0.9, 1.5):
            for indenter in scene.presses_at(share * scene.length_s).values():
                indenter.press()
        return True
    return False


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="tactomo-fuzz-")


def _scratch(name: str, data: bytes = b"") -> Path:
    """Write a file, and return its path."""
    path = Path(_folder().name) / name
    path.write_bytes(data)
    return path


TARGETS: Mapping[str, Target] = {
    "wire": Target(_wire_examples, _parse_wire),
    "lines": Target(_line_examples, _parse_lines),
    "sciospec": Target(_sciospec_examples, _parse_sciospec),
    "message": Target(_message_examples, _parse_message),
    "request": Target(_request_examples, _parse_request),
    "description": Target(_description_examples, _parse_description),
    "config": Target(_config_examples, _parse_config),
    "scene": Target(_scene_examples, _parse_scene),
    "recording": Target(_recording_examples, _parse_recording),
    "eit": Target(_eit_examples, _parse_eit),
    "calibration": Target(_calibration_examples, _parse_calibration),
    "load_cell": Target(_load_cell_examples, _parse_load_cell),
}
