"""Teaching a sheet that is no rectangle: a place beside it is no press."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import CalibrationError, Press, SkinSimulator, load_description
from tactomo_models.calibration.calibration_file import Subject
from tactomo_models.commissioning.teach import KnownPresses, teach


def test_a_place_in_the_notch_of_an_l_is_off_the_skin() -> None:
    sensor = load_description("palm_l")
    skin = Skin(SkinSimulator(sensor, 0.008))
    x_m, y_m = (each.ravel() for each in np.meshgrid(np.arange(-0.05, 0.06, 0.02), (-0.045, -0.02)))
    xy_m = np.r_[np.c_[x_m, y_m], [(-0.045, y) for y in np.arange(0.0, 0.05, 0.005)]]
    scans = [skin.scan(Press(x, y, 150.0, 0.01))["magnitude"] for x, y in xy_m]
    xy_m[3] = 0.004, 0.004  # within the bounding box, beside the sheet
    presses = KnownPresses(
        {"magnitude": np.array(scans)}, skin.reference(), 1e3 * xy_m, np.full(len(xy_m), np.nan)
    )
    subject = Subject(sensor="palm", description=sensor.name, sha256=sensor.sha256)
    with pytest.raises(CalibrationError, match=r"1 presses are off the skin.*\(4.0, 4.0\) mm"):
        teach(presses, sensor, subject)
