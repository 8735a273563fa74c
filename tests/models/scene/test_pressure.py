"""From a conductivity change to pressure and force: what is known, how well, and what is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import PressureCurve, PressureRange
from tactomo_models.scene.pressure import Pressures, pressures_of
from tactomo_models.sensor.response import MagnitudeResponse

CURVE = PressureCurve(np.array([0.02, 0.2]), np.array([140.0, 200.0]), np.array([2.0, 4.0]))
AREA_M2 = 7e-4


@given(st.floats(0.001, 0.999), st.sampled_from([1.0, -1.0]))
def test_pressure_inverts_the_response(share: float, sign: float) -> None:
    response = MagnitudeResponse(
        pressure_kpa=(0, 130, 140, 200), relative_change=(0, 0, 0.03 * sign, 0.25 * sign)
    )
    pressure = 130 + 70 * share
    change = response.change(np.array([pressure]))
    curve = PressureCurve.of_response(response)
    assert curve.pressure(np.abs(change)) == pytest.approx(pressure, rel=1e-9)
    assert curve.range_kpa == (130, 200)
    assert response.sign == sign


def test_a_response_that_flattens_answers_up_to_where_it_does() -> None:
    flat = MagnitudeResponse(pressure_kpa=(0, 100, 200, 300), relative_change=(0, 0, 0.3, 0.3))
    assert PressureCurve.of_response(flat).range_kpa == (100, 200)


def one(
    magnitude: float, sigma: float, area_sigma_m2: float = np.nan, curve: PressureCurve = CURVE
) -> Pressures:
    parts = (magnitude, sigma, AREA_M2, area_sigma_m2)
    return pressures_of(curve, *(np.array([part]) for part in parts))


@pytest.mark.parametrize(
    ("magnitude", "sigma", "expected"),
    [
        (0.1, 0.01, "within"),
        (0.0, 0.005, "below"),
        (0.019, 0.001, "below"),  # clearly there, and less than the least that was calibrated
        (0.21, 0.01, "above"),
        (0.0, 0.2, "unknown"),  # may be anything
        (0.15, 0.1, "unknown"),
        (np.nan, np.nan, "unknown"),
    ],
)
def test_each_contact_is_told_where_its_pressure_lies(
    magnitude: float, sigma: float, expected: str
) -> None:
    pressures = one(magnitude, sigma, 1e-5)
    (found,) = pressures.ranges
    assert found == expected
    assert np.isfinite(pressures.kpa[0]) == (found in ("within", "above"))
    assert np.isfinite(pressures.force_n[0]) == (found in ("within", "above"))
    assert np.isfinite(pressures.sigma_kpa[0]) == (found == "within")
    assert np.isfinite(pressures.force_sigma_n[0]) == (found == "within")


@pytest.mark.parametrize(
    ("magnitude", "from_below", "from_within"),
    [
        (0.01, "below", "below"),
        (0.028, "below", "within"),  # within noise of the onset at 0.02: as it was
        (0.013, "below", "within"),
        (0.05, "within", "within"),
        (0.21, "above", "above"),
    ],
)
def test_near_the_onset_a_contact_stays_in_its_range(
    magnitude: float, from_below: str, from_within: str
) -> None:
    found = [
        CURVE.range_of(magnitude, 0.005, last)
        for last in (PressureRange.BELOW, PressureRange.WITHIN)
    ]
    assert found == [from_below, from_within]


@pytest.mark.parametrize(
    ("magnitude", "sigma", "at_least", "at_most"),
    [
        (0.0, 0.005, 140, 144),  # too light to be measured: at most the onset
        (0.05, 0.04, 172, 173),  # too uncertain for a pressure, and bounded all the same
        (0.1, 0.0, 171, 172.1),  # the curve's own uncertainty counts
        (0.19, 0.01, np.inf, np.inf),  # may lie beyond the curve's top
        (0.21, 0.0, np.inf, np.inf),
    ],
)
def test_every_magnitude_bounds_its_pressure(
    magnitude: float, sigma: float, at_least: float, at_most: float
) -> None:
    """Of a press that is known to be even; of one that may fall as a ball's, further up."""
    bound = float(CURVE.bound(np.array(magnitude), np.array(sigma)))
    assert at_least <= bound <= at_most
    pressures = one(magnitude, sigma)
    assert pressures.max_kpa[0] >= bound - 1e-9
    assert not pressures.max_kpa[0] < pressures.kpa[0]


@given(st.floats(145.0, 190.0))
def test_a_balls_peak_is_not_far_for_its_mean_magnitude(peak_kpa: float) -> None:
    """Without a field nobody has told how the pressure falls."""
    inside = np.linspace(0.0, 1.0, 2001)  # of equal areas
    pressure = peak_kpa * np.sqrt(1 - inside)
    mean = float(np.interp(pressure, CURVE.pressure_kpa, CURVE.magnitude, left=0.0).mean())
    pressures = one(mean, 0.002)
    assert pressures.max_kpa[0] > peak_kpa
    if pressures.ranges[0] is PressureRange.WITHIN:
        assert abs(pressures.peak_kpa[0] - peak_kpa) < 3 * pressures.peak_sigma_kpa[0]


@pytest.mark.parametrize(("magnitude", "sigma"), [(np.nan, np.nan), (0.1, np.nan)])
def test_a_magnitude_that_is_unknown_bounds_nothing(magnitude: float, sigma: float) -> None:
    assert np.isnan(one(magnitude, sigma).max_kpa[0])


@pytest.mark.parametrize(
    ("magnitude", "sigma", "kpa"),
    [
        (0.4, 0.01, 200 - 1.645 * 4),  # the curve's own uncertainty is all there is
        (0.195, 0.01, 198.3 - 1.645 * np.hypot(3.33, 3.8)),  # may be beyond, and need not be
    ],
)
def test_what_may_lie_beyond_the_range_has_a_lower_bound(
    magnitude: float, sigma: float, kpa: float
) -> None:
    pressures = one(magnitude, sigma, 1e-5)
    assert pressures.ranges == (PressureRange.ABOVE,)
    assert pressures.kpa[0] <= pressures.peak_kpa[0] == pytest.approx(kpa, abs=0.5)
    assert pressures.max_kpa[0] == np.inf
    assert np.isnan([pressures.sigma_kpa, pressures.peak_sigma_kpa, pressures.force_sigma_n]).all()
    assert 0.9 * kpa * 1e3 * AREA_M2 < pressures.force_n[0] < kpa * 1e3 * AREA_M2


@pytest.mark.parametrize(("truth", "is_upper"), [(0.1, True), (0.19, False)])
def test_a_bound_holds_in_95_of_100(truth: float, *, is_upper: bool) -> None:
    rng, count = np.random.default_rng(5), 100_000
    magnitude = truth + 0.01 * rng.standard_normal(count)
    true_kpa = CURVE.pressure(np.array([truth])) + rng.standard_normal(count) * CURVE.sigma(
        np.array([truth])
    )
    sigma = np.full(count, 0.01)
    held = (
        true_kpa <= CURVE.bound(magnitude, sigma)
        if is_upper
        else true_kpa >= CURVE.least(magnitude, sigma)
    )
    assert held.mean() == pytest.approx(0.95, abs=0.01)


def test_a_peak_that_may_be_far_higher_is_as_uncertain() -> None:
    """Against the second moment of a split normal from its mode, by its density."""
    at, down, up = np.array([0.1]), np.array([0.005]), np.array([0.02])
    off = np.linspace(-6 * down[0], 6 * up[0], 100_001)
    density = np.exp(-0.5 * (off / np.where(off < 0, down, up)) ** 2)
    expected = np.sqrt((density * off**2).sum() / density.sum()) * 60 / 0.18  # kPa of each change
    assert CURVE.skewed_spread(at, down, up) == pytest.approx(expected, rel=1e-3)
    assert CURVE.skewed_spread(at, down, down) == pytest.approx(CURVE.spread(at, down))


def test_near_the_top_a_contact_stays_above_until_it_is_clearly_not() -> None:
    ranges = [
        [CURVE.range_of(magnitude, 0.01, last) for magnitude in (0.176, 0.18, 0.185)]
        for last in (PressureRange.WITHIN, PressureRange.ABOVE)
    ]
    assert ranges == [["within", "within", "above"], ["within", "above", "above"]]


FROM_ZERO = PressureCurve(np.array([0.0, 2.0]), np.array([0.0, 300.0]), np.zeros(2))


@pytest.mark.parametrize(
    ("curve", "magnitude", "sigma", "found", "is_known"),
    [
        (FROM_ZERO, 0.1, 0.15, "below", True),  # the sheet answers from the lightest touch on
        (FROM_ZERO, 0.5, 0.4, "unknown", True),
        (FROM_ZERO, 1.4, 1.0, "unknown", False),  # may be beyond the curve
        (CURVE, 0.02, 0.012, "below", False),  # may be less than what it answers to
        (CURVE, 0.07, 0.036, "unknown", False),
    ],
)
def test_a_force_is_known_where_the_curve_covers_the_contact(
    curve: PressureCurve, magnitude: float, sigma: float, found: str, is_known: bool
) -> None:
    pressures = one(magnitude, sigma, 1e-5, curve)
    assert pressures.ranges == (PressureRange(found),)
    assert np.isnan(pressures.kpa[0])
    assert np.isfinite(pressures.force_n[0]) == is_known
    assert np.isfinite(pressures.force_sigma_n[0]) == is_known


def test_without_a_curve_nothing_is_known() -> None:
    pressures = pressures_of(None, *np.full((4, 2), 0.1))
    assert pressures.ranges == (PressureRange.UNKNOWN,) * 2
    assert np.isnan([pressures.kpa, pressures.max_kpa, pressures.force_n]).all()


@pytest.mark.parametrize("area_share", [0.0, 0.02, 0.1])
def test_uncertainties_are_what_happens(area_share: float) -> None:
    """The area's error is in the magnitude, too: an area too large makes it too small."""
    # Goes on far enough for none to be `above`, where lower bounds are told.
    curve = PressureCurve(np.array([0.02, 0.38]), np.array([140.0, 260.0]), np.array([2.0, 6.0]))
    rng = np.random.default_rng(5)
    truth, noise, count = 0.1, 0.004, 100_000
    areas = AREA_M2 * (1 + area_share * rng.standard_normal(count))
    magnitude = truth * AREA_M2 / areas + noise * rng.standard_normal(count)
    off = rng.standard_normal(count)  # of the curve, in its own uncertainties
    true_kpa = curve.pressure(np.array([truth])) + off * curve.sigma(np.array([truth]))
    sigma = np.full(count, np.hypot(noise, truth * area_share))
    found = pressures_of(curve, magnitude, sigma, areas, np.full(count, area_share * AREA_M2))
    pressure_error = (found.kpa - true_kpa).std()
    assert pressure_error == pytest.approx(found.sigma_kpa.mean(), rel=0.03)
    force_error = (found.force_n - 1e3 * true_kpa * AREA_M2).std()
    assert force_error == pytest.approx(found.force_sigma_n.mean(), rel=0.03)
