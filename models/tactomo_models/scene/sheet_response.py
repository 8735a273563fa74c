"""What a pressure does to each sheet: its conductivity, and how that changes with the pressure.

One pressure field presses on all sheets. A node that is pressed in part conducts in between, and so
does a triangle whose corners differ: by the power mean with which an outline that is drawn over
some width answers as a sharp one (`reflection`); with that of a typical press, everywhere alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.compiled_sheet import CompiledResponse, reflection
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.response import MagnitudeResponse, StructureChannel

LEAST = 0.01  # conductivity ratio: a falling table must not fall through zero
ROUNDING = 1e-12  # of a change: at the onset it is 0


class SheetResponse(Protocol):
    """How one sheet's conductivity, over its own at rest, follows from the pressure."""

    def conductivity(
        self,
        # (n,) share of each that is pressed; where it is negative (`objects`), pressing goes the
        # other way
        share: FloatArray,
        pressure_kpa: FloatArray,  # (n,) pressure on that share
        log_ratio: float,  # logarithm of the structure sheet's ratio where it is saturated
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Conductivity ratio (n,) of nodes, and its slopes.

        Returns:
            The ratio, its derivatives by share, by pressure and by the log ratio, each (n,).
        """

    def exponent(self, log_ratio: float) -> float:
        """Of the power mean by which triangles mix what their corners conduct."""

    @property
    def compiled(self) -> CompiledResponse:
        """The same for C."""


@dataclass(frozen=True)
class GradedResponse:
    """A magnitude sheet: the relative change of conductivity grows with the pressure."""

    pressure_kpa: FloatArray  # (n,) of the description's table
    change: FloatArray  # (n,) relative conductivity changes, signed

    @classmethod
    def of(cls, response: MagnitudeResponse) -> GradedResponse:
        """The response that a description's table gives."""
        return cls(np.asarray(response.pressure_kpa), np.asarray(response.relative_change))

    @property
    def onset_kpa(self) -> float:
        """Pressure from which the sheet answers."""
        first = int(np.flatnonzero(self.change)[0])
        return float(self.pressure_kpa[first - 1])

    @property
    def end_kpa(self) -> float:
        """Pressure at which the table ends."""
        return float(self.pressure_kpa[-1])

    @cached_property
    def _slopes(self) -> FloatArray:
        """(n - 1,) of the table's pieces."""
        return np.asarray(np.diff(self.change) / np.diff(self.pressure_kpa))

    def relative_change(self, pressure_kpa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Relative conductivity change, and its slope by the pressure, each of the same shape.

        Beyond the table its last piece goes on: there a pressure is a lower bound.
        """
        piece = np.searchsorted(self.pressure_kpa[1:-1], pressure_kpa, side="right")
        slope = self._slopes[piece]
        change = self.change[piece] + slope * (pressure_kpa - self.pressure_kpa[piece])
        change = np.where(np.abs(change) < ROUNDING, 0.0, change)
        return np.maximum(change, LEAST - 1), np.where(change > LEAST - 1, slope, 0.0)

    def conductivity(
        self, share: FloatArray, pressure_kpa: FloatArray, log_ratio: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """See `SheetResponse`."""
        ratio, slopes = self.compiled.conductivity(share, pressure_kpa, log_ratio)
        return ratio, *slopes

    @cached_property
    def compiled(self) -> CompiledResponse:
        """See `SheetResponse`."""
        given = self.pressure_kpa, self.change
        return CompiledResponse(*given, saturates=False, reflected=self.reflected)

    @cached_property
    def reflected(self) -> float:
        """By the outline of a press in the middle of what the table answers to, from 0 to 1."""
        change, _ = self.relative_change(np.array([(self.onset_kpa + self.end_kpa) / 2]))
        return abs(float(reflection(1 + change)[0]))

    def exponent(self, log_ratio: float) -> float:
        """See `SheetResponse`."""
        return float(-np.copysign(self.reflected, self.change[-1]))


@dataclass(frozen=True)
class SaturatingResponse:
    """A structure sheet: a share of its full change, in logarithm, by a table.

    The table gives the shares alone: how far the sheet changes where it is saturated is fitted.
    """

    pressure_kpa: FloatArray  # (n,) of the description's table; empty where any pressure saturates
    share: FloatArray  # (n,) of the logarithm of the saturated ratio, from 0 to 1
    reflected: float  # by an outline where the sheet is saturated, from 0 to 1

    @classmethod
    def of(cls, channel: StructureChannel) -> SaturatingResponse:
        """The response that a description gives."""
        reflected = abs(float(reflection(channel.saturated_ratio)))
        if channel.response is None:
            return cls(np.zeros(0), np.zeros(0), reflected)
        logs = np.log(channel.response.conductivity_ratio)
        return cls(np.asarray(channel.response.pressure_kpa), logs / logs[-1], reflected)

    @cached_property
    def _slopes(self) -> FloatArray:
        """(n,) of the table's pieces, and beyond it."""
        return np.append(np.diff(self.share) / np.diff(self.pressure_kpa), 0.0)

    def saturation(self, pressure_kpa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Share of the full change, in logarithm, and its slope, each of the pressure's shape."""
        if len(self.share) == 0:
            return np.ones_like(pressure_kpa), np.zeros_like(pressure_kpa)
        share = np.interp(pressure_kpa, self.pressure_kpa, self.share)
        piece = np.searchsorted(self.pressure_kpa[1:], pressure_kpa, side="right")
        return share, self._slopes[piece]

    def pressure_at(self, saturation: FloatArray) -> FloatArray:
        """Least pressure, kPa, at which a share of the full change is reached; of its shape."""
        if len(self.share) == 0:
            return np.zeros_like(saturation)
        return np.interp(saturation, self.share, self.pressure_kpa)

    def conductivity(
        self, share: FloatArray, pressure_kpa: FloatArray, log_ratio: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """See `SheetResponse`."""
        ratio, slopes = self.compiled.conductivity(share, pressure_kpa, log_ratio)
        return ratio, *slopes

    @cached_property
    def compiled(self) -> CompiledResponse:
        """See `SheetResponse`."""
        given = self.pressure_kpa, self.share
        return CompiledResponse(*given, saturates=True, reflected=self.reflected)

    def exponent(self, log_ratio: float) -> float:
        """See `SheetResponse`."""
        return float(-np.copysign(self.reflected, log_ratio))


def responses_of(description: SensorDescription) -> dict[Channel, SheetResponse]:
    """The response of each of a sensor's sheets."""
    sheets: dict[Channel, SheetResponse] = {}
    if description.magnitude is not None:
        sheets[Channel.MAGNITUDE] = GradedResponse.of(description.magnitude.response)
    if description.structure is not None:
        sheets[Channel.STRUCTURE] = SaturatingResponse.of(description.structure)
    return sheets
