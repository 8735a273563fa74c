"""What a pressure does to a sheet: conductivities, their slopes, and tables of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.sheet_response import (
    GradedResponse,
    SaturatingResponse,
    SheetResponse,
)
from tactomo_models.sensor.response import StructureChannel, StructureResponse

TABLE_KPA = np.array([0.0, 80.0, 150.0, 200.0])
RESPONSES: dict[str, SheetResponse] = {
    "rising": GradedResponse(TABLE_KPA, np.array([0.0, 0.0, 0.4, 1.5])),
    "falling": GradedResponse(TABLE_KPA, np.array([0.0, 0.0, -0.1, -0.3])),
    "saturating": SaturatingResponse(TABLE_KPA, np.array([0.0, 0.2, 0.9, 1.0]), 0.98),
    "saturated": SaturatingResponse(np.zeros(0), np.zeros(0), 0.98),
}
log_ratios = st.floats(-7, 7).filter(lambda ratio: abs(ratio) > 0.1)


def conductivity(response: SheetResponse, at: FloatArray) -> tuple[float, FloatArray]:
    """Ratio at one share, pressure and log ratio, and its slopes by them (3,)."""
    ratio, *slopes = response.conductivity(at[:1], at[1:2], float(at[2]))
    return float(ratio[0]), np.array(slopes)[:, 0]


@pytest.mark.parametrize("name", RESPONSES)
@given(
    st.floats(0.01, 1),
    st.floats(1, 220).filter(lambda p: np.abs(p - TABLE_KPA).min() > 0.1),
    log_ratios,
)
def test_conductivities_have_their_slopes(
    name: str, share: float, pressure_kpa: float, log_ratio: float
) -> None:
    step = 1e-5
    at = np.array([min(share, 1 - step), pressure_kpa, log_ratio])  # a share ends at 1
    _, slopes = conductivity(RESPONSES[name], at)
    for k in range(3):
        aside = step * np.eye(3)[k]
        there, before = (conductivity(RESPONSES[name], at + s * aside)[0] for s in (1, -1))
        assert slopes[k] == pytest.approx((there - before) / (2 * step), rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("name", ["saturating", "saturated"])
@given(st.floats(0, 1), log_ratios)
def test_what_is_pressed_in_part_conducts_in_between(
    name: str, share: float, log_ratio: float
) -> None:
    ratio, _ = conductivity(RESPONSES[name], np.array([share, 1e3, log_ratio]))
    least, most = sorted([1.0, np.exp(log_ratio)])
    assert least - 1e-9 <= ratio <= most + 1e-9
    assert (RESPONSES[name].exponent(log_ratio) < 0) == (log_ratio > 0)


@given(st.floats(0.01, 1), log_ratios)
def test_what_conducts_worse_is_one_over_what_conducts_better(
    share: float, log_ratio: float
) -> None:
    """Objects in a tank: a negative share is of the other kind."""
    saturated = RESPONSES["saturated"]
    pressure = np.full(2, 1e9)
    ratio, by_share, _, by_log_ratio = saturated.conductivity(
        np.array([share, -share]), pressure, log_ratio
    )
    assert ratio[0] * ratio[1] == pytest.approx(1)
    # The logarithm is odd in the share.
    np.testing.assert_allclose((by_share / ratio)[0], (by_share / ratio)[1])
    np.testing.assert_allclose((by_log_ratio / ratio)[0], -(by_log_ratio / ratio)[1])


def test_a_table_is_followed_and_goes_on_beyond_its_end() -> None:
    rising = RESPONSES["rising"]
    assert isinstance(rising, GradedResponse)
    change, slope = rising.relative_change(np.array([40.0, 115.0, 200.0, 210.0]))
    np.testing.assert_allclose(change, [0.0, 0.2, 1.5, 1.72])
    np.testing.assert_allclose(slope[1:], [0.4 / 70, 0.022, 0.022])
    assert slope[0] == 0
    assert (rising.onset_kpa, rising.end_kpa) == (80.0, 200.0)


@given(st.floats(0, 1e5), st.floats(0, 1))
def test_a_falling_table_never_takes_all_conductivity(pressure_kpa: float, share: float) -> None:
    ratio, slopes = conductivity(RESPONSES["falling"], np.array([share, pressure_kpa, 1.0]))
    assert 0 < ratio <= 1
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("ratio", [100.0, 0.01])
def test_a_structure_sheet_has_the_descriptions_curve(ratio: float) -> None:
    """At the saturated ratio it is the description's own."""
    table = StructureResponse(pressure_kpa=(0.0, 50.0, 100.0), conductivity_ratio=(1, 4, 100))
    if ratio < 1:
        table = StructureResponse(
            pressure_kpa=(0.0, 50.0, 100.0), conductivity_ratio=(1, 0.5, ratio)
        )
    response = SaturatingResponse.of(StructureChannel(response=table))
    pressure = np.linspace(0, 130, 14)
    found = response.conductivity(np.ones(14), pressure, float(np.log(ratio)))[0]
    np.testing.assert_allclose(found, table.ratio(pressure))
