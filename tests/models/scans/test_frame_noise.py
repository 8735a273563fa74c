"""Each scan tells its own noise: reciprocal voltages differ by no more than that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from model_fixtures import Tared
from noisy_skin import Skin, rms
from tactomo_models import (
    Artifact,
    Channel,
    Flag,
    Press,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes

NOISE = 1e-3  # of the voltages' root mean square
PRESS = Press(0.02, -0.01, 170.0, 0.012)


class Bench:
    """A structure sheet whose converter's noise changes from scan to scan."""

    def __init__(
        self,
        description: SensorDescription,
        artifact: Artifact,
        simulator: SkinSimulator,
        *,
        scans: int = 20,
        gain_spread: float = 0.0,
    ) -> None:
        self._simulator = simulator
        self._rng = np.random.default_rng(5)
        self._gain = 1 + gain_spread * self._rng.standard_normal(description.measurements)
        rest = np.array([self.scan(NOISE) for _ in range(scans)])
        reference = Reference.from_scans(None, rest) if scans > 1 else Reference(None, rest[0])
        self.reconstructor = Reconstructor(description, artifact)
        self.reconstructor.set_reference(reference)

    def scan(self, noise_share: float, *presses: Press) -> FloatArray:
        clean = self._simulator.voltages(presses)[Channel.STRUCTURE]
        noise = noise_share * rms(clean) * self._rng.standard_normal(len(clean))
        return np.asarray(self._gain * clean + noise)

    def changes(self, noise_share: float, *presses: Press) -> Changes:
        measurement = self.reconstructor.compare(None, self.scan(noise_share, *presses))
        assert not measurement.flags & ~Flag.MAGNITUDE_MISSING
        return measurement.changes[Channel.STRUCTURE]

    def ratios(self, noise_share: float, *presses: Press, of: FloatArray) -> FloatArray:
        """Stated noise of 200 scans over that of a scan whose variances (M,) these are."""
        each = [self.changes(noise_share, *presses).noise_variance for _ in range(200)]
        return np.array([np.sqrt(np.median(one / of)) for one in each])


@pytest.fixture
def converter(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> Callable[..., Bench]:
    return partial(Bench, paper, artifact, simulator)


def test_a_scan_as_noisy_as_the_tare_has_the_tares_noise(converter: Callable[..., Bench]) -> None:
    bench = converter()
    tare = bench.changes(NOISE).noise_variance
    assert (bench.ratios(NOISE, PRESS, of=tare) == 1).mean() >= 0.99
    assert (bench.ratios(NOISE / 4, PRESS, of=tare) == 1).all()


@pytest.mark.parametrize(("times", "gain_spread"), [(2.0, 0.03), (6.0, 0.0)])
def test_a_noisier_scan_has_its_own_noise_and_no_flag(
    converter: Callable[..., Bench], times: float, gain_spread: float
) -> None:
    bench = converter(gain_spread=gain_spread)
    tare = bench.changes(NOISE).noise_variance
    ratios = bench.ratios(times * NOISE, of=tare)
    assert ratios.mean() == pytest.approx(times, rel=0.1)
    assert ratios.std() < 0.12 * times
    assert all(bench.changes(times * NOISE).quiet for _ in range(200))


@pytest.mark.parametrize("times", [0.1, pytest.param(10.0, marks=pytest.mark.slow)])
def test_against_a_tare_of_one_scan_each_scan_tells_its_own(
    converter: Callable[..., Bench], simulator: SkinSimulator, times: float
) -> None:
    """The reference's own noise is in every change; 104 pairs tell that of one scan to 8 %."""
    bench = converter(scans=1)
    bench.changes(NOISE)  # the first frame, which tells the noise of a reference that has none
    clean = simulator.voltages(())[Channel.STRUCTURE]
    expected = (NOISE * rms(clean) / clean) ** 2 * (1 + times**2)
    ratios = bench.ratios(times * NOISE, of=expected)
    assert ratios.mean() == pytest.approx(1, abs=0.25)


def test_pressing_is_no_noise(converter: Callable[..., Bench]) -> None:
    """Unequal gains break reciprocity by a share, of a voltage that pressing has changed, too."""
    bench = converter(gain_spread=0.03)
    tare = bench.changes(NOISE).noise_variance
    assert (bench.ratios(NOISE, PRESS, of=tare) == 1).mean() >= 0.99


@pytest.mark.slow
def test_noise_that_grows_with_the_change_is_explained(
    tared: Tared, simulator: SkinSimulator
) -> None:
    """A reference of one scan without noise, and noise 40 dB under each frame's change."""
    rng = np.random.default_rng(3)
    rest = simulator.voltages(())
    reconstructor = tared(Reference(rest[Channel.MAGNITUDE], rest[Channel.STRUCTURE]))
    misfits = []
    for number in range(8):
        presses = [PRESS, Press(-0.04, 0.035, 190.0, 0.015)][: 1 + number // 4]
        volts = {
            str(name): clean + 0.01 * rms(clean - rest[name]) * rng.standard_normal(len(clean))
            for name, clean in simulator.voltages(presses).items()
        }
        frame = reconstructor.reconstruct(**volts)
        assert frame.tier == "fit"
        assert len(frame.contacts) == len(presses)
        misfits.append(frame.misfit)
    assert min(misfits) > 0.7
    assert max(misfits) < 1.3


def test_channels_of_one_frame_differ_in_noise(reconstructor: Reconstructor, skin: Skin) -> None:
    rng = np.random.default_rng(2)
    scan, quiet = skin.scan(PRESS), skin.scan(PRESS)
    volts = scan["magnitude"]
    noisy = volts + 5e-3 * rms(volts) * rng.standard_normal(len(volts))
    before = reconstructor.compare(quiet["magnitude"], quiet["structure"]).changes
    after = reconstructor.compare(noisy, scan["structure"]).changes
    grown = {
        name: float(np.median(after[name].noise_variance / before[name].noise_variance))
        for name in after
    }
    assert grown[Channel.STRUCTURE] == 1
    assert grown[Channel.MAGNITUDE] == pytest.approx(26, rel=0.3)


def test_a_stable_instrument_feels_less(
    paper: SensorDescription, artifact: Artifact, simulator: SkinSimulator
) -> None:
    """What voltages do by themselves is no press, and the description says how much that is."""
    skin = Skin(simulator, 1e-4)
    reference, light = skin.reference(), Press(0.02, -0.01, 170.0, 0.008)
    pressed = {}
    for stability in (0.003, 3e-4):
        instrument = paper.instrument.model_copy(update={"stability": stability})
        sensor = paper.model_copy(update={"instrument": instrument})
        reconstructor = Reconstructor(sensor, artifact, method="noser")
        reconstructor.set_reference(replace(reference, structure=None))

        def is_pressed(volts: FloatArray, by: Reconstructor = reconstructor) -> bool:
            return not by.compare(volts, None).is_quiet

        rest = [skin.scan()["magnitude"] for _ in range(50)]
        pressed[stability] = (
            any(is_pressed(volts) for volts in rest),
            any(is_pressed(1.001 * volts) for volts in rest),
            is_pressed(skin.scan(light)["magnitude"]),
        )
    assert pressed == {0.003: (False, False, False), 3e-4: (False, True, True)}
