"""Statistics that a few outliers do not move."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_models.robust import median


@pytest.mark.parametrize("count", [1, 2, 3, 8, 207, 208])
def test_the_median_is_numpys_to_the_last_bit(count: int) -> None:
    for seed in range(20):
        values = np.random.default_rng(seed).normal(size=count)
        assert median(values) == np.median(values)
