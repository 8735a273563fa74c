"""The level set that starts from the network's objects."""

from __future__ import annotations

import numpy as np
import pytest
from challenge_tanks import challenge_pattern
from tactomo_lab.evaluation.ktc import score
from tactomo_lab.tanks import fit as fitting
from tactomo_lab.tanks.fit import TankFit
from tactomo_lab.tanks.model import Readings, TankModel, pixel_grid
from tactomo_models import load_description


@pytest.mark.slow
def test_refining_explains_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A square and a disc, solved on another mesh; without a step it is the network's image."""
    tank = load_description("tank_ktc2023")
    model, fine = TankModel(tank), TankModel(tank, rings=37)
    x, y = fine.points[fine.triangles].mean(axis=1).T
    u, v, _ = pixel_grid(256)
    kinds = [
        np.where(np.hypot(x - 0.4, y) < 0.25, -1, 0) + (np.maximum(abs(x + 0.3), abs(y)) < 0.22)
        for x, y in ((x, y), (u, v))
    ]
    currents, weights = challenge_pattern()
    fit = TankFit(
        model, Readings(model, currents, weights, model.readings_of_empty(currents, weights))
    )
    transfer = np.zeros((32, 32))
    change = fine.solve(100.0 ** kinds[0])[0] - fine.empty
    transfer[tuple(fine.pairs)] = transfer[tuple(fine.pairs[::-1])] = change
    changes = ((currents @ transfer) * weights).sum(axis=1)
    misfits, scores = [], []
    for steps in (0, fitting.STEPS):
        monkeypatch.setattr(fitting, "STEPS", steps)
        found = fit.find(changes, 0.05)
        image = fit.image(found, 256, 256)
        misfits.append(found.misfit)
        scores.append(score(kinds[1] % 3, np.where(image > 0.5, 1, np.where(image < -0.5, 2, 0))))
    assert misfits[1] < 0.35 * misfits[0]
    assert min(scores) > 0.85
