"""What a small contact's peak may be: bounds against the same posterior on a dense grid."""

import numpy as np
import pytest
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.pressure import ONE_SIDED_95
from tactomo_models.scene.size_and_peak import ReflectionTable, SizeAndPeak, along_bend

PRIOR_SIGMA = np.array([0.6, 0.5])
LIMITS = np.array([[np.log(0.003), 0.01], [np.log(0.1), 3.0]])


def relative_change(peak: FloatArray) -> FloatArray:
    return 3.0 * peak / (1 + peak)


PEAKS = np.geomspace(LIMITS[0, 1], LIMITS[1, 1], 200)
TABLE = ReflectionTable.of(PEAKS, relative_change(PEAKS))


def reflection(peak: FloatArray) -> FloatArray:
    change = relative_change(peak)
    return np.asarray(change / (2 + change))


def known(size: float, peak: float, sigma: FloatArray) -> SizeAndPeak:
    """A contact whose dipole and whose next term data tell to these relative uncertainties."""
    step = 1e-6
    slope = float(np.log(reflection(np.array(peak + step)) / reflection(np.array(peak)))) / step
    by_dipole, by_next = np.array([2.0, slope]), np.array([4.0, slope])
    certain = np.outer(by_dipole, by_dipole) / sigma[0] ** 2
    certain += np.outer(by_next, by_next) / sigma[1] ** 2
    precision = PRIOR_SIGMA**-2
    covariance = np.linalg.inv(certain + np.diag(precision))
    found = np.array([size, peak])
    return SizeAndPeak(found, covariance, found, precision, LIMITS[:, 0])


def test_what_data_tell_well_is_normal() -> None:
    each = known(np.log(0.012), 0.5, np.array([1e-3, 5e-3]))
    bend = along_bend(each, TABLE)
    sigma = np.sqrt(each.covariance[1, 1])
    expected = 0.5 + np.array([-1, 1]) * ONE_SIDED_95 * sigma
    assert bend.peaks == pytest.approx(expected, abs=0.1 * sigma)


@pytest.mark.parametrize("size_mm", [5.0, 8.0])
def test_a_size_that_data_hardly_tell_leaves_high_peaks_possible(size_mm: float) -> None:
    """The dipole is exact, the next term is a disc's of that size, to half of itself."""
    size, peak = np.log(size_mm / 1e3), 0.15
    each = known(size, peak, np.array([0.01, 0.5]))
    bend = along_bend(each, TABLE)
    # The same without any coordinates along a bend: all sizes and peaks, each by its own voltages.
    sizes = np.linspace(LIMITS[0, 0], LIMITS[1, 0], 1500)[:, None]
    peaks = np.geomspace(LIMITS[0, 1], LIMITS[1, 1], 1500)
    dipole = np.exp(2 * (sizes - size)) * reflection(peaks) / reflection(np.array(peak))
    following = np.exp(2 * (sizes - size)) - 1
    cost = (np.log(dipole) / 0.01) ** 2 + ((np.log(dipole) + following) / 0.5) ** 2
    cost += ((sizes - size) / 0.6) ** 2 + ((peaks - peak) / 0.5) ** 2
    share = np.exp(-cost / 2).sum(axis=0) * np.gradient(peaks)
    expected = np.interp([0.05, 0.95], share.cumsum() / share.sum(), peaks)
    assert bend.peaks == pytest.approx(expected, rel=0.05)
    normal = peak + ONE_SIDED_95 * np.sqrt(each.covariance[1, 1])
    assert bend.peaks[1] > 1.2 * normal
    assert bend.force_spread > 0.03
