"""Batch reconstruction: the arrays of a file in, the arrays of a file out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import DataError, Press, SensorDescription
from tactomo_models.batch import reconstruct_file

PRESSES = [(), (Press(0.02, 0.01, 180.0),), (Press(-0.03, 0.0, 160.0), Press(0.035, 0.03, 190.0))]


@pytest.fixture
def arrays(skin: Skin) -> dict[str, Any]:
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


@pytest.fixture(autouse=True)
def _artifact_at_hand(
    paper: SensorDescription, artifact: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactomo_models.reconstruct.load_or_build_artifact", lambda _: artifact)


def run(
    tmp_path: Path, paper: SensorDescription, arrays: dict[str, Any], method: str = "auto"
) -> dict[str, Any]:
    np.savez(tmp_path / "in.npz", **arrays)
    count = reconstruct_file(
        tmp_path / "in.npz", tmp_path / "out.npz", description=paper, method=method
    )
    with np.load(tmp_path / "out.npz") as stored:
        out = dict(stored)
    assert count == len(out["map"])
    return out


def test_the_arrays_are_those_of_the_contract(
    tmp_path: Path, paper: SensorDescription, arrays: dict[str, Any]
) -> None:
    out = run(tmp_path, paper, arrays)
    assert out["map"].shape == out["structure"].shape == (3, 51, 51)
    assert out["map"].dtype == out["structure"].dtype == np.float32
    assert out["flags"].dtype == np.uint32
    assert out["misfit"].shape == out["flags"].shape == out["seconds"].shape == (3,)
    assert out["contact_frame"].tolist() == [1, 2, 2]
    for name in ("x_mm", "y_mm", "area_mm2", "magnitude", "sigma"):
        assert out[f"contact_{name}"].shape == (3,)
    assert (out["contact_x_mm"][0], out["contact_y_mm"][0]) == pytest.approx((20, 10), abs=2)
    assert out["contact_magnitude"][0] == pytest.approx(0.177, abs=0.03)
    assert not out["map"][0].any()
    assert 0.1 < out["map"][1].max() < 0.25
    assert 0 <= out["structure"].min() < out["structure"].max() <= 1


@pytest.mark.parametrize("absent", ["missing", "all NaN"])
def test_a_single_channel_is_reconstructed_linearly(
    tmp_path: Path, paper: SensorDescription, arrays: dict[str, Any], absent: str
) -> None:
    if absent == "missing":
        del arrays["structure"]
    else:
        arrays["structure"] = np.full_like(arrays["structure"], np.nan)
    out = run(tmp_path, paper, arrays)
    assert np.isfinite(out["map"]).all()
    assert out["map"][1].max() > 0.01


def test_tikhonov_can_be_asked_for(
    tmp_path: Path, paper: SensorDescription, arrays: dict[str, Any]
) -> None:
    linear, nonlinear = (run(tmp_path, paper, arrays, m)["map"] for m in ("tikhonov", "levelset"))
    assert linear[1].std() < nonlinear[1].std()


def test_bad_input_is_refused_with_what_is_needed(
    tmp_path: Path, paper: SensorDescription, arrays: dict[str, Any]
) -> None:
    bad: list[tuple[dict[str, Any], str]] = [
        ({}, "none of the channels"),
        ({**arrays, "magnitude": np.zeros((3, 192))}, "T x 208"),
        ({**arrays, "magnitude": np.zeros((2, 208))}, "differ in length"),
        ({**arrays, "magnitude": np.array(["a"] * 208)}, "real numbers"),
        ({"magnitude": arrays["magnitude"]}, "magnitude_reference"),
    ]
    for content, said in bad:
        with pytest.raises(DataError, match=said):
            run(tmp_path, paper, content)
    with pytest.raises(DataError, match="unknown method"):
        run(tmp_path, paper, arrays, "magic")
    (tmp_path / "text.npz").write_text("not numpy")
    with pytest.raises(DataError, match="cannot read"):
        reconstruct_file(tmp_path / "text.npz", tmp_path / "out.npz", description=paper)
