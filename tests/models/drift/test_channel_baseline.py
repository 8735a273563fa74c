"""One channel's baseline: it follows what skins drift by, and learns little of anything else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from measured import measured
from tactomo_models import Press, Reconstructor, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_models.drift.channel_baseline import BLOCK_S, MAX_RESIDUAL, ChannelBaseline
from tactomo_models.drift.drift_model import DriftSubspace
from tactomo_protocol import Channel

NOISE = 1e-3  # of each voltage, relative
TIME_CONSTANT_S = 60.0


class Followed:
    """A baseline that is shown one scan after another, a block each."""

    def __init__(self, subspace: DriftSubspace, tare: FloatArray) -> None:
        self.baseline = ChannelBaseline(subspace, tare, np.ones(len(tare), bool))
        self.baseline.begin(0.0)
        self.tare = tare
        self._no_creep = np.zeros(subspace.modes.shape[1])
        self._now_s = 0.0

    def show(self, *logarithms: FloatArray) -> list[bool]:
        """Follow scans (M,), as logarithms over the tare; returns whether each is like drift."""
        return list(self._following(logarithms))

    def _following(self, logarithms: tuple[FloatArray, ...]) -> Iterator[bool]:
        taken = measured(np.zeros(len(self.tare)), 1 / NOISE)
        for logarithm in logarithms:
            for _ in range(2):  # the first and the last scan of a block
                is_full = self.baseline.add(self._now_s, self.tare * np.exp(logarithm), taken)
                self._now_s += BLOCK_S
            assert is_full
            yield self.baseline.follow(self._now_s, self._no_creep, TIME_CONSTANT_S)

    def learned(self) -> FloatArray:
        """What is taken for the baseline, in standard deviations of one scan."""
        return self.baseline.put_in_force()[0] / NOISE


@pytest.fixture(scope="module")
def subspace(small: SensorDescription) -> DriftSubspace:
    return DriftSubspace(Reconstructor(small).sensor)


@pytest.fixture(scope="module")
def skin(small: SensorDescription) -> SkinSimulator:
    return SkinSimulator(small, spacing_m=0.001)


@pytest.fixture
def followed(subspace: DriftSubspace, skin: SkinSimulator) -> Followed:
    return Followed(subspace, skin.voltages(())[Channel.STRUCTURE])


@pytest.fixture(scope="module")
def touch(skin: SkinSimulator, subspace: DriftSubspace) -> FloatArray:
    """What only a touch does, in logarithms of the voltages, of one standard deviation's size."""
    rest, touched = (
        skin.voltages(presses)[Channel.STRUCTURE]
        for presses in ((), (Press(0.01, 0.005, 5.0, 0.006),))
    )
    change = np.log(touched / rest)
    drift = subspace.modes[:, : subspace.smooth.stop]  # the gain and the smooth modes
    change -= drift @ np.linalg.lstsq(drift, change)[0]
    return NOISE * change / rms(change)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_gain_is_followed_and_nothing_else_is_learned(followed: Followed) -> None:
    size = len(followed.tare)
    warming = [np.full(size, -1e-4 * block) for block in range(1, 121)]
    assert all(followed.show(*warming))
    assert followed.learned() * NOISE == pytest.approx(-0.012, rel=0.05)
    drift = followed.baseline.drift()
    assert drift.gain == pytest.approx(np.expm1(-0.012), rel=0.05)
    assert drift.uneven < 1e-4


def test_of_a_touch_that_comes_slowly_no_more_is_learned_than_the_noise_of_a_scan(
    followed: Followed, touch: FloatArray
) -> None:
    """However slowly: each block changes by a fifth of the noise, up to forty times of it."""
    is_drift = followed.show(*(block / 5 * touch for block in range(1, 201)))
    assert not is_drift[-1]
    assert rms(followed.learned()) < 3 * MAX_RESIDUAL
    stays = followed.show(*[40 * touch] * 100)
    assert not any(stays)
    assert rms(followed.learned()) < 3 * MAX_RESIDUAL


def test_what_noise_could_be_is_learned(followed: Followed, touch: FloatArray) -> None:
    assert all(followed.show(*[0.5 * touch] * 60))
    assert followed.learned() * NOISE == pytest.approx(0.5 * touch, abs=0.1 * NOISE)
