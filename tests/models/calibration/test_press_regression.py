"""A press's place from presses at known places: how near, how surely, and where it stops."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_skin import presses_on
from tactomo_models.calibration.press_regression import PressRegression


@pytest.fixture(scope="module")
def learnt() -> PressRegression:
    return PressRegression(*presses_on(1, 200))


def test_a_few_presses_locate_the_others_and_say_how_surely(learnt: PressRegression) -> None:
    changes, xy_mm = presses_on(2, 400)
    found = learnt.locate(changes)
    off_mm = found.xy_mm - xy_mm
    assert np.median(np.linalg.norm(off_mm, axis=1)) < 2.5  # presses are 5.7 mm apart
    assert 0.6 < (np.abs(off_mm) < found.sigma_mm[:, None]).mean() < 0.75
    assert found.is_taught.mean() > 0.97


def test_each_press_is_located_as_if_it_were_alone(learnt: PressRegression) -> None:
    changes, _ = presses_on(2, 5)
    together = learnt.locate(changes).xy_mm
    alone = [learnt.locate(changes[i : i + 1]).xy_mm[0] for i in range(5)]
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_strength_and_units_of_volts_do_not_matter() -> None:
    changes, xy_mm = presses_on(1, 100)
    new, _ = presses_on(2, 20)
    a = PressRegression(changes, xy_mm).locate(new)
    b = PressRegression(1e-6 * changes, xy_mm).locate(1e-6 * new)
    np.testing.assert_allclose(a.xy_mm, b.xy_mm, atol=1e-6)


def test_what_a_model_gets_wrong_is_learnt() -> None:
    """A model that is 4 mm off to one side, and squeezed: from 20 presses on."""
    changes, xy_mm = presses_on(1, 100)
    new, there_mm = presses_on(2, 200)
    rng = np.random.default_rng(3)

    def model_of(place_mm: np.ndarray) -> np.ndarray:
        return 0.9 * place_mm + [4.0, 0.0] + 0.3 * rng.standard_normal(place_mm.shape)

    learnt = PressRegression(changes, xy_mm, model_of(xy_mm))
    guess = model_of(there_mm)
    found = learnt.locate(new, guess)
    assert np.median(np.linalg.norm(guess - there_mm, axis=1)) > 3
    assert np.median(np.linalg.norm(found.xy_mm - there_mm, axis=1)) < 0.8
