"""docs/files.md against what is read and written: every array, topic and field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from mcap.reader import make_reader
from small_sensor import SMALL
from tables import table
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import (
    RecordingWriter,
    calibration_entry,
    pack_frame,
    reference_entry,
)
from tactomo.scans import FrameRecord
from tactomo_client.recording_file import CHANNELS, PROFILE
from tactomo_models import Flag, Press, Reference, SkinSimulator, load_description
from tactomo_models.batch import reconstruct_file
from tactomo_models.calibration.calibration_file import PressureCalibration

PAGE = "docs/files.md"


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with in.npz, out.npz of two frames, and the sensor's description."""
    folder = tmp_path_factory.mktemp("batch")
    (folder / "small.toml").write_text(SMALL)
    description = load_description(folder / "small.toml")
    skin = SkinSimulator(description)
    rest = skin.voltages([])
    pressed = skin.voltages([Press(0.005, 0.0, 150.0, 0.006)])
    arrays: dict[str, Any] = {f"{name}_reference": volts for name, volts in rest.items()}
    arrays |= {name: np.stack([rest[name], pressed[name]]) for name in rest}
    np.savez(folder / "in.npz", **arrays)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        reconstruct_file(folder / "in.npz", folder / "out.npz", description=description)
    return folder


def test_the_arrays_that_are_read_have_their_rows(batch: Path) -> None:
    """All of them were needed, or taken, for what is in out.npz."""
    assert table(PAGE, "## Scans to reconstruct").keys() == np.load(batch / "in.npz").keys()


def test_the_arrays_that_are_written_have_their_rows(batch: Path) -> None:
    told, made = table(PAGE, "## Maps and contacts"), np.load(batch / "out.npz")
    assert told.keys() == made.keys()
    sizes = {"T": 2, "ny": 21, "nx": 21, "3": 3, "C": len(made["contact_frame"])}
    assert sizes["C"] == 1
    for name, row in told.items():
        dtype, _, shape = row["Type"].partition(" ")
        assert made[name].dtype == np.dtype(dtype), name
        wanted = [sizes[axis] for axis in shape.strip("(),").replace(",", " ").split()]
        assert list(made[name].shape) == wanted, name


def test_every_field_of_a_calibration_has_its_row() -> None:
    assert (
        table(PAGE, "## A pressure calibration").keys() == PressureCalibration.model_fields.keys()
    )


def test_every_flag_has_its_bit() -> None:
    told = {
        int(bit): row["Flag"].strip("`") for bit, row in table(PAGE, "## Flags in numbers").items()
    }
    assert told == {int(flag): flag.name.lower() for flag in Flag if flag.name}


def test_every_topic_of_a_recording_has_its_row() -> None:
    told = {name: row["Encoding"] for name, row in table(PAGE, "## A recording's channels").items()}
    assert told == CHANNELS


def test_every_word_of_a_recordings_origin_has_its_row(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", Origin("skin", "small", "", ("a",), "0"))
    writer.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        (metadata,) = [m for m in make_reader(file).iter_metadata() if m.name == PROFILE]
    assert table(PAGE, "## A recording's origin").keys() == metadata.metadata.keys()


def test_every_field_of_what_is_recorded_has_its_row() -> None:
    frame = msgpack.unpackb(pack_frame(FrameRecord((), "auto", None)))
    assert table(PAGE, "## A frame").keys() == frame.keys()
    scan = np.ones(3)
    whole = Reference(scan, scan, scan, scan, 1, scan, scan, scan, scan)
    reference = msgpack.unpackb(reference_entry(whole, 1, 0, 0).data)
    assert table(PAGE, "## A reference").keys() == reference.keys()
    calibration = msgpack.unpackb(calibration_entry("", 1, 0, 0).data)
    assert table(PAGE, "## A calibration put in force").keys() == calibration.keys()
