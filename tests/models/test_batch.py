"""Batch reconstruction: the arrays of a file in, the arrays of a file out."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from noisy_skin import Skin
from tactomo_models import (
    DataError,
    MethodError,
    Press,
    Reference,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.batch import read_scans, reconstruct_file
from variants import variant

Arrays = dict[str, Any]
Run = Callable[..., Arrays]

PRESSES = [(), (Press(0.02, 0.01, 180.0),), (Press(-0.03, 0.0, 160.0), Press(0.035, 0.03, 190.0))]


@pytest.fixture
def arrays(skin: Skin) -> Arrays:
    scans = [skin.scan(*presses) for presses in PRESSES]
    rest = skin.reference(50)
    assert rest.magnitude is not None
    assert rest.structure is not None
    return {
        "magnitude": np.array([scan["magnitude"] for scan in scans]),
        "structure": np.array([scan["structure"] for scan in scans]),
        "magnitude_reference": rest.magnitude,
        "structure_reference": rest.structure,
    }


@pytest.fixture
def run(tmp_path: Path, paper: SensorDescription) -> Run:
    """Reconstruct arrays by a method, of the paper's sensor or another: the arrays of the file."""

    def reconstruct(
        arrays: Arrays, method: str = "auto", sensor: SensorDescription = paper
    ) -> Arrays:
        np.savez(tmp_path / "in.npz", **arrays)
        made = reconstruct_file(
            tmp_path / "in.npz", tmp_path / "out.npz", description=sensor, method=method
        )
        with np.load(tmp_path / "out.npz") as stored:
            out = dict(stored)
        assert made.frames == len(out["map"])
        return out

    return reconstruct


def test_contacts_of_a_mounted_sheet_have_their_place_on_the_robot(
    run: Run, paper: SensorDescription, arrays: Arrays
) -> None:
    cylinder = {"radius_m": 0.05, "position_m": (0.0, 0.0, 0.3)}
    mounted = variant(paper, mount={"frame": "left_forearm", "cylinder": cylinder})
    out = run(arrays, "tikhonov", mounted)
    assert len(out["contact_frame"])
    assert set(out["contact_mount_frame"].tolist()) == {"left_forearm"}
    angle = out["contact_x_mm"] * 1e-3 / 0.05
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    assert out["contact_normal"] == pytest.approx(normal)
    up = np.outer(0.3 + out["contact_y_mm"] * 1e-3, [0, 0, 1])
    assert out["contact_position_m"] == pytest.approx(0.05 * normal + up)
    flat = run(arrays, "tikhonov")
    assert np.isnan(flat["contact_position_m"]).all()
    assert flat["contact_position_m"].shape == (len(flat["contact_frame"]), 3)


@pytest.mark.parametrize("absent", ["missing", "all NaN"])
def test_a_single_channel_is_reconstructed_linearly(run: Run, arrays: Arrays, absent: str) -> None:
    if absent == "missing":
        del arrays["structure"]
    else:
        arrays["structure"] = np.full_like(arrays["structure"], np.nan)
    out = run(arrays)
    assert np.isfinite(out["map"]).all()
    assert out["map"][1].max() > 0.01


def test_bad_input_is_refused_with_what_is_needed(
    run: Run, tmp_path: Path, paper: SensorDescription, arrays: Arrays
) -> None:
    bad: list[tuple[Arrays, str]] = [
        ({}, "none of the channels"),
        ({each: np.nan * volts for each, volts in arrays.items()}, "NaN throughout"),
        ({**arrays, "magnitude": np.zeros((3, 192))}, "T x 208"),
        ({**arrays, "magnitude": np.zeros((2, 208))}, "differ in length"),
        ({**arrays, "magnitude": np.array(["a"] * 208)}, "real numbers"),
        ({"magnitude": arrays["magnitude"]}, "magnitude_reference"),
        ({**arrays, "structure_reference": np.ones((20, 192))}, "shape 208, or n x 208, are"),
        ({**arrays, "structure_reference": np.full((20, 208), np.nan)}, "holds no voltage"),
    ]
    for content, said in bad:
        with pytest.raises(DataError, match=said):
            run(content)
    with pytest.raises(MethodError, match="unknown method"):
        run(arrays, "magic")
    with pytest.raises(DataError, match=r"cannot write.*no folder"):
        reconstruct_file(tmp_path / "in.npz", tmp_path / "no folder" / "x", description=paper)


@pytest.mark.parametrize("content", ["missing", "text", "one array", "pickle", "other files"])
def test_a_file_that_is_no_archive_of_numbers_is_refused(
    tmp_path: Path, paper: SensorDescription, content: str
) -> None:
    file = tmp_path / "in.npz"
    if content == "text":
        file.write_text("not numpy")
    elif content == "one array":
        with file.open("wb") as opened:
            np.save(opened, np.zeros((3, 208)))
    elif content == "pickle":
        np.savez(file, magnitude=np.array([{}, None], dtype=object))
    elif content == "other files":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("magnitude", "1, 2, 3")
    with pytest.raises(DataError, match=r"cannot read .*in\.npz"):
        reconstruct_file(file, tmp_path / "out.npz", description=paper)


@given(st.data())
def test_a_damaged_archive_is_refused_or_read_as_it_was(
    paper: SensorDescription, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    volts = np.linspace(1, 2, 208)
    written = io.BytesIO()
    np.savez_compressed(written, structure=volts[None], structure_reference=volts)
    content = bytearray(written.getvalue())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file = tmp_path_factory.mktemp("flip") / "in.npz"
    file.write_bytes(content)
    try:
        scans, reference, _ = read_scans(file, paper)
    except DataError:
        return
    np.testing.assert_array_equal(scans["structure"], volts[None])
    np.testing.assert_array_equal(reference.structure, volts)


def test_scans_at_rest_tell_their_noise(
    run: Run, tmp_path: Path, paper: SensorDescription, skin: Skin, arrays: Arrays
) -> None:
    taken = [skin.scan() for _ in range(21)]
    rest = {name: np.array([scan[name] for scan in taken]) for name in taken[0]}
    for volts in rest.values():
        volts[7] = np.nan  # a scan that was not taken
    arrays |= {f"{name}_reference": volts for name, volts in rest.items()}
    np.savez(tmp_path / "in.npz", **arrays)
    _, reference, _ = read_scans(tmp_path / "in.npz", paper)
    known = {name: np.delete(volts, 7, axis=0) for name, volts in rest.items()}
    expected = Reference.from_scans(known["magnitude"], known["structure"])
    assert reference.scans == 20
    assert reference.is_noise_measured
    for name in ("magnitude", "structure", "magnitude_noise", "structure_noise"):
        np.testing.assert_array_equal(getattr(reference, name), getattr(expected, name))
    out = run(arrays)
    assert out["contact_frame"].tolist() == [1, 2, 2]


def test_a_voltage_that_no_scan_at_rest_has_is_left_out(
    tmp_path: Path, paper: SensorDescription, skin: Skin, arrays: Arrays
) -> None:
    rest = np.array([skin.scan()["magnitude"] for _ in range(5)])
    rest[:, 3] = np.nan
    np.savez(tmp_path / "in.npz", **{**arrays, "magnitude_reference": rest})
    _, reference, _ = read_scans(tmp_path / "in.npz", paper)
    assert reference.magnitude is not None
    assert np.flatnonzero(np.isnan(reference.magnitude)).tolist() == [3]


@pytest.mark.slow
@pytest.mark.parametrize("averaged", [1, 20, "without noise"])
def test_the_noise_is_that_of_the_scans_however_good_the_reference(
    run: Run, simulator: SkinSimulator, averaged: int | str
) -> None:
    """A file does not say how its reference was made; noise must not look like pressing."""
    skin = Skin(simulator, noise_share=0.01)
    rest = Skin(simulator, noise_share=0.0).reference(1)
    if isinstance(averaged, int):
        rest = skin.reference(averaged)
    scans = [skin.scan(*presses) for presses in [(), (), PRESSES[1], PRESSES[2], (), ()]]
    out = run(
        {name: np.array([scan[name] for scan in scans]) for name in scans[0]}
        | {"magnitude_reference": rest.magnitude, "structure_reference": rest.structure}
    )
    assert np.bincount(out["contact_frame"], minlength=6).tolist() == [0, 0, 1, 2, 0, 0]
    assert not out["flags"].any()
    assert out["misfit"].max() < 1.3
    assert out["misfit"][[0, 1, 4, 5]].mean() == pytest.approx(1, abs=0.15)
