"""Files that tactomo wrote when their formats were new are read for good, to the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_grasp import SENSOR, contacts_of
from tactomo.recordings.recording import open_recording
from tactomo_client.recording import open_recording as open_frames
from tactomo_models.archive import read_arrays
from tactomo_models.calibration.calibration_file import CALIBRATIONS
from tactomo_models.calibration.taught_skin import TAUGHT

HERE = Path(__file__).parent


def test_a_recording(tactomo: Callable[..., Any]) -> None:
    path = HERE / "recording-1.mcap"
    assert open_recording(path).summary.is_complete
    told = tactomo("info", path)
    assert (told.returncode, SENSOR in told.stdout) == (0, True), told.stderr
    frames = list(open_frames(path).frames())
    assert [list(frame.contacts) for frame in frames] == [contacts_of(k) for k in range(18, 26)]


def test_a_calibration() -> None:
    curve = CALIBRATIONS.read(HERE / "pressure-1.json").curve
    np.testing.assert_allclose(np.interp(0.07, curve.magnitude, curve.pressure_kpa), 170, atol=1)


@pytest.mark.parametrize("forces", [True, False])
def test_a_taught_skin(tmp_path: Path, forces: bool) -> None:
    """Files were without forces once, of the same format."""
    arrays = dict(read_arrays(HERE / "taught-1.npz"))
    for name in () if forces else ("loads", "force_n", "force_error"):
        del arrays[name]
    np.savez(tmp_path / "taught.npz", **arrays)  # type: ignore[arg-type]
    taught = TAUGHT.read(tmp_path / "taught.npz")
    assert len(taught.xy_mm) == 40
    assert taught.with_mm == pytest.approx(0.36, abs=0.01)
    assert (taught.forces is not None) == forces
