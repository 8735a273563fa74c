"""From the magnitude channel's conductivity change to pressure and force, with uncertainty.

A sensor's curve answers within a range. Below its onset a contact is felt by the structure channel
alone: that it is touched is known, how hard is not. Where the pressure may lie beyond its last
reading, nothing bounds it from above, and what is told is a lower bound. Neither is given a number
that looks measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum, auto
from functools import cached_property
from typing import Protocol

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.scene.parameters import FALLING_SHARE
from tactomo_models.sensor.description import SensorDescription

CLEARLY = 2.0  # standard uncertainties above zero from which a magnitude is one
# Standard uncertainties by which a contact's last range is favoured. Noise then changes the range
# of a magnitude right on the border in 4 % of the frames, of one of zero in none of a thousand;
# without it in half of them, and in 2 %. Less than CLEARLY: a contact that lightens is let go.
HYSTERESIS = 1.75
ONE_SIDED_95 = 1.645  # standard uncertainties below which 95 % of a normal distribution lie
ONE_SIDED_99 = 2.326  # likewise: only if this bound is on the curve is a pressure `within` again


class PressureRange(StrEnum):
    """Where a contact's pressure lies, seen from what the magnitude channel answers to."""

    WITHIN = auto()
    BELOW = auto()  # touched, but too lightly to be measured
    ABOVE = auto()  # its upper bound, 95 %, lies beyond the range's top: a lower bound is told
    UNKNOWN = auto()  # no magnitude channel, no curve, or too uncertain to tell


@dataclass(frozen=True)
class Pressures:
    """Pressures of K contacts; NaN where unknown."""

    kpa: FloatArray  # (K,) a lower bound, 95 %, where it is `above`; at most the range's top
    sigma_kpa: FloatArray  # (K,) standard uncertainties; known `within` alone
    # (K,) pressures times areas; a lower bound where one is `above`
    force_n: FloatArray
    # (K,) standard uncertainties; NaN where `above`, and where the force or the area's is
    force_sigma_n: FloatArray
    ranges: tuple[PressureRange, ...]  # K of them
    peak_kpa: FloatArray  # (K,) highest pressures; lower bounds, as `kpa`, where `above`
    peak_sigma_kpa: FloatArray  # (K,) standard uncertainties; known `within` alone
    max_kpa: FloatArray  # (K,) upper bounds, 95 %, in every range; +inf where the curve ends below


@dataclass(frozen=True)
class FieldContacts:
    """What a fitted pressure field says of K contacts, by the sensor description's table."""

    peak_magnitude: FloatArray  # (K,) |relative conductivity change| under the highest pressure
    peak_magnitude_sigma: FloatArray  # (K,) standard uncertainties
    # (2, K) the same downwards and upwards: `ONE_SIDED_95` times as far are the bounds of 95 %,
    # where the accounts that are likely have peaks of their own
    peak_magnitude_sides: FloatArray
    # (K,) the same by the likely account in which the pressure falls least towards the edge: it
    # tells best whether anything is felt at all
    felt: FloatArray
    felt_sigma: FloatArray  # (K,) its standard uncertainty by noise
    peak_kpa: FloatArray  # (K,) highest pressures
    mean_kpa: FloatArray  # (K,) mean pressures
    # (K,) their standard uncertainties: how a pressure falls matters less there
    mean_sigma_kpa: FloatArray
    force_n: FloatArray  # (K,) forces
    force_sigma_n: FloatArray  # (K,) standard uncertainties
    edge: FloatArray  # (K,) gamma; 0 flat, 1/2 Hertz; NaN where nobody has told
    total_force_n: float  # of all contacts together
    # its standard uncertainty: less than that of its parts where they touch
    total_force_sigma_n: float


class Response(Protocol):
    """A table of pressures and changes, of a sensor description or of a running daemon."""

    @property
    def pressure_kpa(self) -> tuple[float, ...]:
        """Pressures (n,), rising."""

    @property
    def relative_change(self) -> tuple[float, ...]:
        """Relative changes of conductivity (n,) under them."""


@dataclass(frozen=True)
class PressureCurve:
    """Pressure against |relative conductivity change|, straight between knots."""

    magnitude: FloatArray  #: (n,) rising; the first is the onset
    pressure_kpa: FloatArray  #: (n,) rising
    sigma_kpa: FloatArray  #: (n,) standard uncertainty of the curve itself; 0 where nobody has said

    @classmethod
    def of_response(cls, response: Response) -> PressureCurve:
        """The curve of a table; a calibration's may begin above a change of 0."""
        size = np.abs(np.asarray(response.relative_change))
        onset = max(int(np.flatnonzero(size > 0)[0]) - 1, 0)
        rising = np.append(True, np.diff(size[onset:]) > 0)  # of one change, the least pressure
        kpa = np.asarray(response.pressure_kpa)[onset:][rising]
        return cls(size[onset:][rising], kpa, np.zeros(len(kpa)))

    @cached_property
    def falling(self) -> PressureCurve:
        """Peaks of presses that fall as Hertz's do, over the mean magnitude of their area.

        K. L. Johnson, "Contact Mechanics" (1985), eq. 3.39: a peak times the root of 1 - ρ².
        """
        inside = (np.arange(64) + 0.5) / 64  # 1 - ρ², of parts of equal area
        peaks = np.linspace(*self.range_kpa, 64)
        pressure = peaks[:, None] * np.sqrt(inside)
        size = np.interp(pressure, self.pressure_kpa, self.magnitude, left=0.0)
        return PressureCurve(
            size.mean(axis=1), peaks, np.interp(peaks, self.pressure_kpa, self.sigma_kpa)
        )

    @property
    def range_kpa(self) -> tuple[float, float]:
        """Pressures between which it answers."""
        return float(self.pressure_kpa[0]), float(self.pressure_kpa[-1])

    def pressure(self, magnitude: FloatArray) -> FloatArray:
        """Pressure in kPa, any shape; the ends' beyond them."""
        return np.asarray(np.interp(magnitude, self.magnitude, self.pressure_kpa))

    def spread(self, magnitude: FloatArray, sigma: FloatArray) -> FloatArray:
        """Standard uncertainty in kPa that a magnitude's own one makes, same shape."""
        low, high = self._beyond(magnitude + np.array([-sigma, sigma]))
        return np.asarray(high - low) / 2

    def skewed_spread(self, magnitude: FloatArray, down: FloatArray, up: FloatArray) -> FloatArray:
        """The same of one that differs downwards and upwards: from the mode of a split normal.

        Source: Wallis, "The two-piece normal", Statistical Science 29 (2014), section 2.
        """
        low, at, high = self._beyond(magnitude + np.array([-down, np.zeros_like(up), up]))
        less, more = at - low, high - at
        return np.asarray(np.sqrt(less**2 - less * more + more**2))

    def sigma(self, magnitude: FloatArray) -> FloatArray:
        """Standard uncertainty of the curve in kPa, any shape."""
        return np.asarray(np.interp(magnitude, self.magnitude, self.sigma_kpa))

    def bound(self, magnitude: FloatArray, sigma: FloatArray) -> FloatArray:
        """Pressure in kPa, same shape, that the true one stays below with 95 %.

        +inf where the bound of the magnitude lies beyond the curve's top, NaN where it is unknown.
        """
        most = magnitude + ONE_SIDED_95 * sigma
        reported, highest = self.pressure(np.array([magnitude, most]))
        kpa = reported + np.hypot(highest - reported, ONE_SIDED_95 * self.sigma(most))
        return np.where(most > self.magnitude[-1], np.inf, kpa)

    def least(self, magnitude: FloatArray, sigma: FloatArray) -> FloatArray:
        """Pressure in kPa, same shape, that the true one exceeds with 95 %; at most the top."""
        least = np.maximum(magnitude - ONE_SIDED_95 * sigma, 0.0)
        reported, lowest = self.pressure(np.array([magnitude, least]))
        by_both = np.hypot(reported - lowest, ONE_SIDED_95 * self.sigma(least))
        return np.asarray(np.maximum(reported - by_both, 0.0))

    def range_of(
        self,
        magnitude: float,
        sigma: float,
        last: PressureRange = PressureRange.UNKNOWN,
        *,
        highest: tuple[float, float] | None = None,
    ) -> PressureRange:
        """Where a magnitude with its standard uncertainty lies, of a contact that was in `last`.

        Args:
            magnitude: tells whether anything is felt.
            sigma: its standard uncertainty.
            last: the range a frame ago.
            highest: magnitude under the highest pressure and its standard uncertainty, which tell
                whether it may lie beyond the curve; the same ones if None.
        """
        # Of the curve's top: a magnitude that is clearly below that, and may be 0, is below.
        little = 0.25
        peak, peak_sigma = highest or (magnitude, sigma)
        if not np.isfinite(magnitude + sigma + peak + peak_sigma):
            return PressureRange.UNKNOWN
        was_measured = last in (PressureRange.WITHIN, PressureRange.ABOVE)
        was_below = last is PressureRange.BELOW
        favour = HYSTERESIS * sigma * (was_below - was_measured)
        if magnitude > CLEARLY * sigma + favour and magnitude >= self.magnitude[0] + favour:
            sure = ONE_SIDED_99 if last is PressureRange.ABOVE else ONE_SIDED_95
            above = peak + sure * peak_sigma > self.magnitude[-1]
            return PressureRange.ABOVE if above else PressureRange.WITHIN
        most = max(little * self.magnitude[-1], self.magnitude[0])
        light = magnitude + CLEARLY * sigma - HYSTERESIS * sigma * was_below < most
        return PressureRange.BELOW if light else PressureRange.UNKNOWN

    def covers(self, magnitude: FloatArray, sigma: FloatArray) -> BoolArray:
        """Whether magnitudes (any shape) are between the curve's ends, as far as is known.

        A curve that begins at no pressure covers all that is light.
        """
        from_onset = magnitude - ONE_SIDED_95 * sigma >= self.magnitude[0]
        is_bounded = magnitude + ONE_SIDED_95 * sigma <= self.magnitude[-1]
        return np.asarray(is_bounded & (from_onset | (self.pressure_kpa[0] <= 0)))

    def excess(self, magnitude: FloatArray) -> FloatArray:
        """Pressure in kPa, any shape, by which a peak that falls exceeds an even pressure."""
        return np.asarray(self.falling._beyond(magnitude) - self.pressure(magnitude))

    @cached_property
    def _end_slopes(self) -> FloatArray:
        """Pressure per magnitude of the first piece and the last, kPa."""
        return np.asarray((np.diff(self.pressure_kpa) / np.diff(self.magnitude))[[0, -1]])

    def _beyond(self, magnitude: FloatArray) -> FloatArray:
        """Pressure with the end pieces prolonged, so that a spread does not shrink at the ends."""
        m, (first, last) = self.magnitude, self._end_slopes
        outside = first * np.minimum(magnitude - m[0], 0) + last * np.maximum(magnitude - m[-1], 0)
        return np.asarray(self.pressure(magnitude) + outside)


def described_curve(description: SensorDescription) -> PressureCurve | None:
    """The curve until there is a calibration; None where there is no magnitude channel."""
    channel = description.magnitude
    return None if channel is None else PressureCurve.of_response(channel.response)


def pressures_of(
    curve: PressureCurve | None,  # the sensor's; None where it has none
    magnitude: FloatArray,  # (K,) |relative conductivity change|; NaN where unknown
    magnitude_sigma: FloatArray,  # (K,) standard uncertainties
    areas_m2: FloatArray,  # (K,)
    area_sigmas_m2: FloatArray,  # (K,) standard uncertainties; NaN where unknown
    *,
    # what a fitted field says of them; the magnitudes are means if None
    field: FieldContacts | None = None,
    # K ranges of the same contacts a frame ago; none is known if None
    last: Sequence[PressureRange] | None = None,
) -> Pressures:
    """Pressures and forces of K contacts from their magnitudes and areas.

    Without a field a magnitude is the mean of its area.

    An area taken too large makes the magnitude too small, and the magnitude's uncertainty says so
    already: in the force the two errors partly cancel.
    """
    nothing = np.full(len(magnitude), np.nan)
    if curve is None:
        unknown = (PressureRange.UNKNOWN,) * len(magnitude)
        return Pressures(nothing, nothing, nothing, nothing, unknown, nothing, nothing, nothing)
    highest, highest_sigma = felt, felt_sigma = magnitude, magnitude_sigma
    down, up = highest_sigma, highest_sigma
    if field is not None:
        highest, highest_sigma = field.peak_magnitude, field.peak_magnitude_sigma
        down, up = field.peak_magnitude_sides
        felt, felt_sigma = field.felt, field.felt_sigma
    lasts = [PressureRange.UNKNOWN] * len(magnitude) if last is None else last
    columns = (felt, felt_sigma, highest, up)
    ranges = tuple(
        curve.range_of(size, error, was, highest=(peak_size, peak_error))
        for size, error, peak_size, peak_error, was in zip(
            *(column.tolist() for column in columns), lasts, strict=True
        )
    )
    within = np.array([r is PressureRange.WITHIN for r in ranges], bool)
    above = np.array([r is PressureRange.ABOVE for r in ranges], bool)
    peak = curve.pressure(highest)
    spread, own = curve.spread(highest, highest_sigma), curve.sigma(highest)
    peak_sigma = np.hypot(np.maximum(spread, curve.skewed_spread(highest, down, up)), own)
    least = np.where(above, curve.least(highest, down), np.nan)
    if field is not None:
        # The curve in force may be another than the description's table, as after a calibration.
        by_curve = peak / np.maximum(field.peak_kpa, 1e-12)
        force = field.force_n * by_curve
        force_sigma = np.hypot(field.force_sigma_n * by_curve, force * own / peak)
        kpa = np.minimum(field.mean_kpa * by_curve, peak)  # but for rounding it is
        sigma = np.hypot(field.mean_sigma_kpa * by_curve, own)
    else:
        kpa, sigma, force = peak, peak_sigma, 1e3 * peak * areas_m2
        by_area = magnitude * area_sigmas_m2 / areas_m2
        apart = np.sqrt(np.maximum(magnitude_sigma**2 - by_area**2, 0.0))
        slope = spread / np.maximum(magnitude_sigma, 1e-12)
        of_area = (kpa - slope * magnitude) * area_sigmas_m2
        of_pressure = np.hypot(curve.spread(magnitude, apart), own) * areas_m2
        force_sigma = 1e3 * np.hypot(of_pressure, of_area)
    most = curve.bound(highest, up)
    # Where nobody has told how the pressure falls, it may as a ball's does.
    may_fall = np.isnan(nothing if field is None else field.edge)
    if may_fall.any():
        of_fall = np.where(may_fall, FALLING_SHARE**0.5 * curve.excess(highest), 0.0)
        peak_sigma = np.hypot(peak_sigma, of_fall)
        most = np.where(may_fall, curve.falling.bound(highest, up), most)
    is_force = within | (~above & curve.covers(highest, highest_sigma))
    known_sigma = np.where(np.isnan(force_sigma), 0.0, force_sigma)
    least_force = np.maximum(force - ONE_SIDED_95 * known_sigma, 0.0)
    return Pressures(
        kpa=np.where(within, kpa, least * kpa / np.maximum(peak, 1e-12)),
        sigma_kpa=np.where(within, sigma, np.nan),
        force_n=np.where(is_force, force, np.where(above, least_force, np.nan)),
        force_sigma_n=np.where(is_force, force_sigma, np.nan),
        ranges=ranges,
        peak_kpa=np.where(within, peak, least),
        peak_sigma_kpa=np.where(within, peak_sigma, np.nan),
        max_kpa=np.where(above, np.inf, most),
    )
