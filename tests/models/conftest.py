"""Tests of the models find a sheet once for each reference; elsewhere each tare finds its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.actual_sheet import SheetEstimator
from tactomo_models.physics.bare_sheet import BareSheet
from tactomo_models.physics.forward import ForwardModel

_FOUND: dict[int, BareSheet | None] = {}
_MAX_FOUND = 4  # tens of megabytes each


@pytest.fixture(scope="module", autouse=True)
def sheets_once() -> Iterator[None]:
    """Find a sheet once for each reference, half a second each: most tests tare on the same."""
    estimate = SheetEstimator.estimate

    def once(
        self: SheetEstimator, voltages: FloatArray, usable: BoolArray, noise: FloatArray
    ) -> ForwardModel | None:
        taken = (voltages.tobytes(), usable.tobytes(), noise.tobytes())
        key = hash((self._description.model_dump_json(), *taken))
        if key not in _FOUND:
            model = estimate(self, voltages, usable, noise)
            _FOUND[key] = None if model is None else model.bare
            if len(_FOUND) > _MAX_FOUND:
                del _FOUND[next(iter(_FOUND))]
        bare = _FOUND[key]
        return None if bare is None else ForwardModel(self._description, bare)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SheetEstimator, "estimate", once)
        yield
