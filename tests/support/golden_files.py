"""Write `tests/golden` as this version writes it: ``python tests/support/golden_files.py``.

Where a format changes, its number goes up: raise it in the name here, and the file of before stays.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from handmade_skin import described, presses, write_description
from recorded_grasp import write_grasp
from tactomo_models.calibration.calibration_file import CALIBRATIONS, PressureCalibration, Subject
from tactomo_models.calibration.curve import Reading

FOLDER = Path(__file__).parents[1] / "golden"


def main() -> None:
    """A recording of 8 frames, a calibration of 8 readings, a skin taught by 40 presses."""
    write_grasp(FOLDER / "recording-1.mcap", range(18, 26))
    subject = Subject(sensor="palm", description="paper_square", sha256=described().sha256)
    readings = [
        Reading(pressure_kpa=kpa, magnitude=1e-3 * (kpa - 100)) for kpa in range(110, 270, 20)
    ]
    CALIBRATIONS.save(
        PressureCalibration.of_readings(subject, readings), FOLDER / "pressure-1.json"
    )
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "presses.npz", **presses(40, seed=1))
        sensor = write_description(Path(folder) / "skin.toml")
        command = ["teach", "fit", f"{folder}/presses.npz", "--sensor", "palm", "-d", str(sensor)]
        environment = {**os.environ, "XDG_DATA_HOME": folder}
        subprocess.run([sys.executable, "-m", "tactomo.cli", *command], env=environment, check=True)
        [taught] = Path(folder).rglob("palm.taught.npz")
        (FOLDER / "taught-1.npz").write_bytes(taught.read_bytes())


if __name__ == "__main__":
    main()
