"""Two scans of one scene are told from two scenes, whatever the tare takes for noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from noisy_skin import Skin
from shared_data import measured
from tactomo_models import (
    Artifact,
    Channel,
    Press,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.stillness import is_still

HELD = Press(0.02, -0.01, 170.0, 0.012)

Seen = Callable[..., Changes]


@pytest.fixture(params=["20 scans", "1 scan", "1 scan, asymmetric"])
def seen(
    request: pytest.FixtureRequest,
    paper: SensorDescription,
    artifact: Artifact,
    simulator: SkinSimulator,
) -> Seen:
    """Changes of the structure channel at 60 dB; a reciprocity error of 4 % where asymmetric."""
    skin = Skin(simulator)
    rng = np.random.default_rng(3)
    gain = 1 + 0.04 * ("asymmetric" in request.param) * rng.standard_normal(paper.measurements)

    def volts(*presses: Press) -> FloatArray:
        return np.asarray(gain * skin.scan(*presses)[Channel.STRUCTURE])

    reconstructor = Reconstructor(paper, artifact, method="noser")
    if request.param == "20 scans":
        taken = np.array([volts() for _ in range(20)])
        reconstructor.set_reference(Reference.from_scans(None, taken))
    else:
        reconstructor.set_reference(Reference(None, volts()))

    def seen(*presses: Press) -> Changes:
        return reconstructor.compare(None, volts(*presses)).changes[Channel.STRUCTURE]

    return seen


def moved(press: Press, x_mm: float) -> Press:
    return replace(press, x_m=press.x_m + 1e-3 * x_mm)


def test_noise_is_not_taken_for_movement(seen: Seen) -> None:
    settled = seen(HELD)
    assert np.mean([is_still(seen(HELD), seen(HELD)) for _ in range(200)]) >= 0.99
    assert is_still(settled, settled)


def test_a_contact_that_moves_or_lands_is_not_still(seen: Seen) -> None:
    lands = Press(-0.03, 0.03, 170.0, 0.005)  # small, beside a large one
    held = [seen(HELD) for _ in range(20)]
    for then in (*([moved(HELD, x_mm)] for x_mm in (3, 10, 40)), [HELD, lands]):
        assert not any(is_still(settled, seen(*then)) for settled in held)


def test_a_contact_that_creeps_is_noticed_before_it_is_far(seen: Seen) -> None:
    settled = seen(HELD)
    steps_mm = np.arange(0.0, 5.0, 0.2)
    held = [x_mm for x_mm in steps_mm if is_still(settled, seen(moved(HELD, x_mm)))]
    assert max(held) < 2.5


def test_the_same_scan_without_noise_is_still(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    skin = Skin(simulator, noise_share=0.0)
    reconstructor = Reconstructor(paper, artifact, method="noser")
    reconstructor.set_reference(skin.reference(1))
    settled, same, crept, other = (
        reconstructor.compare(**skin.scan(moved(HELD, x_mm))).changes[Channel.STRUCTURE]
        for x_mm in (0.0, 0.0, 0.005, 1.0)
    )
    assert is_still(settled, same)
    assert is_still(settled, crept)
    assert not is_still(settled, other)


@pytest.mark.slow
@pytest.mark.parametrize("scans", [1, 20])
def test_a_cup_that_moves_through_a_tank_is_never_still(scans: int) -> None:
    """Its reciprocity error is 75 times its noise; from frame 90 on the cup is on its way."""
    tank = load_description("sciospec_disc")
    with np.load(measured("tank_sciospec_20fps.npz")) as file:
        single = file["volts"].real
    drive, measure = tank.pairs.drive[:, 0], tank.pairs.measure
    volts = single[:, drive, measure[:, 0]] - single[:, drive, measure[:, 1]]
    reconstructor = Reconstructor(tank, method="noser")
    rest = Reference.from_scans(None, volts[:20]) if scans == 20 else Reference(None, volts[0])
    reconstructor.set_reference(rest)
    seen = [reconstructor.compare(None, scan).changes[Channel.STRUCTURE] for scan in volts[20:]]
    assert not any(is_still(one, other) for one, other in pairwise(seen[70:]))


@pytest.mark.slow
def test_a_change_below_a_frames_noise_is_followed(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    skin = Skin(simulator)
    reconstructor = Reconstructor(paper, artifact, method="auto", budget_s=1.0)
    reconstructor.set_reference(skin.reference())
    first, then = (Press(0.005, -0.008, kpa, radius_m=0.015) for kpa in (208.0, 196.0))

    def seen(press: Press) -> float:
        (contact,) = reconstructor.reconstruct(**skin.scan(press)).contacts
        return contact.magnitude

    held = {seen(first) for _ in range(20)}
    assert len(held) == 1, "still frames are not solved again"
    assert [seen(then) for _ in range(40)][-1] < held.pop() - 0.015
