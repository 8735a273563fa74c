"""What the first scans of a start are, beside a reference of before."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from tactomo_models import Press, Reconstructor, Reference, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.commissioning.known_skin import SkinAtStart, skin_at_start
from tactomo_protocol import Channel

LIGHT, HARD = 40.0, 180.0
HOUR_S = 3600.0
KINDS = ("paper_square", "graded_square")


@cache
def skin(kind: str, seed: int, uneven: float = 0.05) -> SkinSimulator:
    description = load_description(kind)
    return SkinSimulator(description, 0.006, unevenness=uneven, impedance_spread=0.2, seed=seed)


@cache
def reconstructor(kind: str) -> Reconstructor:
    return Reconstructor(load_description(kind), method="tikhonov")


def taken(volts: dict[Channel, FloatArray], gain: float = 1.0, seed: int = 0) -> Reference:
    """The mean of twenty scans with noise 60 dB below the voltages' rms."""
    rng = np.random.default_rng(seed)
    scans = {
        name: gain * each + rng.normal(0, 1e-3 * np.sqrt(np.mean(each**2)), (20, each.size))
        for name, each in volts.items()
    }
    return Reference.from_scans(scans.get(Channel.MAGNITUDE), scans.get(Channel.STRUCTURE))


def found(kind: str, now: Reference, elapsed_s: float = 60.0, uneven: float = 0.05) -> SkinAtStart:
    known = taken(skin(kind, 0, uneven).voltages([]), seed=1)
    return skin_at_start(reconstructor(kind), known, now, elapsed_s)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gain", [1.0, 0.95, 2.0])
def test_a_skin_at_rest_is_known_whatever_its_gain(kind: str, gain: float) -> None:
    assert found(kind, taken(skin(kind, 0).voltages([]), gain)) is SkinAtStart.KNOWN


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gain", [1.0, 1.04])
@pytest.mark.parametrize(
    "presses",
    [
        [Press(0.02, -0.03, LIGHT, 0.012)],
        [Press(-0.04, 0.01, HARD, 0.012)],
        [Press(x, y, HARD, 0.012) for x in (-0.03, 0.03) for y in (-0.03, 0.03)],
        [Press(0.0, 0.0, HARD, 0.04)],
    ],
    ids=["light", "hard", "four", "hand"],
)
def test_what_lies_on_it_is_no_other_skin(kind: str, presses: list[Press], gain: float) -> None:
    assert found(kind, taken(skin(kind, 0).voltages(presses), gain), HOUR_S) is SkinAtStart.LOADED


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("uneven", [0.03, 0.05])  # the first a drift would nearly explain
def test_another_skin_is_no_load(kind: str, seed: int, uneven: float) -> None:
    now = taken(skin(kind, seed, uneven).voltages([]))
    assert found(kind, now, uneven=uneven) is SkinAtStart.OTHER


def test_what_cannot_be_compared_is_as_good_as_known() -> None:
    volts = taken(skin("paper_square", 0).voltages([]))
    known = Reference(np.zeros(208), None)
    only = Reference(None, volts.structure)
    assert skin_at_start(reconstructor("paper_square"), known, only, 1.0) is SkinAtStart.KNOWN
