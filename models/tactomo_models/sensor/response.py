"""What pressing does to a channel's conductivity: the contact responses of a sensor description."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Final, Self

import numpy as np
from pydantic import Field, model_validator

from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.section import Section

# TOML has lists where a frozen model has tuples; what is in them is as strict as the rest.
ROWS = Field(min_length=2, max_length=64, strict=False)
Table = Annotated[tuple[float, ...], ROWS]
LARGEST_KPA: Final = 1e4  # 100 bar: beyond what presses on any skin


class MagnitudeResponse(Section):
    """Relative conductivity change (sigma - sigma_0) / sigma_0 against pressure in kPa."""

    pressure_kpa: Table
    relative_change: Annotated[tuple[Annotated[float, Field(gt=-1)], ...], ROWS]

    @model_validator(mode="after")
    def _is_a_monotone_table(self) -> Self:
        _check_table(self.pressure_kpa, self.relative_change, "relative_change", start=0.0)
        return self

    @property
    def sign(self) -> float:
        """+1 where pressure raises conductivity, -1 where it lowers it."""
        return 1.0 if self.relative_change[-1] > 0 else -1.0

    def change(self, pressure_kpa: FloatArray) -> FloatArray:
        """Relative conductivity change at a pressure, any shape."""
        return np.asarray(np.interp(pressure_kpa, self.pressure_kpa, self.relative_change))


class StructureResponse(Section):
    """Ratio of the pressed to the unpressed conductivity against pressure in kPa."""

    pressure_kpa: Table
    conductivity_ratio: Annotated[tuple[Annotated[float, Field(gt=0)], ...], ROWS]

    @model_validator(mode="after")
    def _is_a_monotone_table(self) -> Self:
        _check_table(self.pressure_kpa, self.conductivity_ratio, "conductivity_ratio", start=1.0)
        return self

    def ratio(self, pressure_kpa: FloatArray) -> FloatArray:
        """Conductivity ratio at a pressure, any shape; the logarithm is interpolated."""
        logs = np.log(self.conductivity_ratio)
        return np.asarray(np.exp(np.interp(pressure_kpa, self.pressure_kpa, logs)))


def _check_table(x: Table, y: Table, name: str, start: float) -> None:
    if len(x) != len(y):
        raise ValueError(f"{name} = {list(y)}: must have as many entries as pressure_kpa, {len(x)}")
    if x[0] != 0 or any(b <= a for a, b in pairwise(x)):
        raise ValueError(f"pressure_kpa = {list(x)}: must start at 0 and rise")
    if x[-1] > LARGEST_KPA:
        raise ValueError(
            f"pressure_kpa = {list(x)}: must not exceed {LARGEST_KPA:g}; in pascals? {x[-1]:g} Pa "
            f"are {1e-3 * x[-1]:g} kPa"
        )
    steps = np.diff(y)
    if y[0] != start or not (np.all(steps >= 0) or np.all(steps <= 0)) or y[-1] == y[0]:
        raise ValueError(f"{name} = {list(y)}: must start at {start:g} and only rise or only fall")


class MagnitudeChannel(Section):
    """The channel that answers with the pressure's size."""

    response: MagnitudeResponse


class StructureChannel(Section):
    """The saturating channel: pressed or not. Give a response, or the saturated ratio alone.

    With `either_way`, as in a tank that holds metal and plastic, objects of both kinds may be in
    one scene: of this ratio, or of one over it.
    """

    response: StructureResponse | None = None
    conductivity_ratio: Annotated[float, Field(gt=0, le=1e6)] | None = None
    either_way: bool = False

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.response is None) == (self.conductivity_ratio is None):
            raise ValueError("response or conductivity_ratio: give one of the two")
        if self.saturated_ratio == 1:
            raise ValueError("conductivity_ratio = 1: must differ from 1")
        if self.either_way and self.saturated_ratio < 1:
            raise ValueError(
                f"conductivity_ratio = {self.saturated_ratio:g}: must be above 1 with either_way, "
                "objects of one over it are the other kind"
            )
        return self

    @property
    def saturated_ratio(self) -> float:
        """Conductivity of a fully pressed area over that of the bare sheet."""
        return (
            self.response.conductivity_ratio[-1]
            if self.response
            else self.conductivity_ratio or 1.0
        )
