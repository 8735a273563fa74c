"""Companions: scalars that feel the pressure field as the sheets do, such as a load cell below."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from tactomo_models.sensor.outline import uncrossed
from tactomo_models.sensor.section import Section
from tactomo_models.sensor.sheet import Ring


class Companion(Section):
    """A scalar that tells the force on the whole sheet, or on the part inside `region_m`.

    The packets of a device name it by `index`; None stands for its place among the companions.

    The force in newtons is gain_n_per_unit * (reading - offset). The offset counts where the tare
    has no readings of its own. A reading outside `limits` says that the device has clipped. A
    reading is of the force `dead_time_s` before it, behind a first-order lag of the time constant
    `lag_s`.
    """

    index: Annotated[int | None, Field(ge=0, le=255)] = None
    gain_n_per_unit: Annotated[float, Field(ge=-1e9, le=1e9)]
    offset: float = 0.0
    noise_n: Annotated[float, Field(gt=0, le=1e6)]
    relative_error: Annotated[float, Field(ge=0, le=1)] = 0.0
    limits: Annotated[tuple[float, float] | None, Field(strict=False)] = None
    lag_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    dead_time_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    region_m: Ring | None = None

    @model_validator(mode="after")
    def _tells_a_force(self) -> Self:
        if self.gain_n_per_unit == 0:
            raise ValueError("gain_n_per_unit = 0: give the newtons of one unit of the reading")
        if self.region_m is not None:
            uncrossed("region_m", self.region_m)
        if self.limits is not None and self.limits[0] >= self.limits[1]:
            raise ValueError(
                f"limits = {list(self.limits)}: give the least reading, then the largest"
            )
        return self

    def reading_of(self, force_n: float) -> float:
        """The reading at a force."""
        return self.offset + force_n / self.gain_n_per_unit

    def may_read(self, reading: float) -> bool:
        """Whether a reading is a number within the limits."""
        least, most = self.limits or (-np.inf, np.inf)
        return bool(np.isfinite(reading) and least <= reading <= most)
