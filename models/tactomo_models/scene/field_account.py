"""What a fitted pressure field says: images, and each contact with its numbers and uncertainties.

Everything follows from the field and from the covariance of its parameters. Where the data leave
another account of the same contacts possible, images and numbers are the mean of all, and the
uncertainties know how far they are apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.scans.changes import WRONG_WAY
from tactomo_models.scene.areas import AreaFinder, Areas
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.field_fit import FieldFit, FittedField, Measured, covariance_of
from tactomo_models.scene.parameters import EDGE, HOLE, PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.pressure import FieldContacts
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse, SaturatingResponse

# Shares within one sigma are of tuning scenes of every kind.
# Of an outline's radius, over the nodes' distance, that no noise accounts for where a pressure is
# even: with 0.05, 59 % of rectangles' and rings' areas are within one sigma, with 0.07, 67 %.
OUTLINE_ERROR = 0.07
# Sigmas of size and pressure over the fit's own: a form that is not fitted is no surer for that.
# With 1, 63 % of the magnitudes at 10 dB are within one sigma, with this 69 %.
UNFITTED = 1.25
MAP_OUTLINE = 0.05  # `OUTLINE_ERROR` of a map beside a network's, tuned with `auto.NETWORK_ERROR`
SAMPLES = 3  # per side of a map cell: what an outline covers of it is right to 3 %


@dataclass(frozen=True)
class FieldAccount:
    """What a fitted field says."""

    areas: Areas  # K pressed areas
    map: FloatArray  # (nodes_y, nodes_x) |relative conductivity change| of the magnitude sheet
    structure: FloatArray  # (nodes_y, nodes_x) share of the structure sheet's full change
    pressure_kpa: FloatArray  # (nodes_y, nodes_x) by the description's table
    magnitudes: FloatArray  # (K,) |relative conductivity change|, mean over each area
    magnitude_sigmas: FloatArray  # (K,) their standard uncertainties
    contacts: FieldContacts | None  # what it says of each area's pressure
    goes_wrong_way: bool  # whether a conductivity goes where no pressure takes it
    # of areas and magnitudes together, as a share of them, by noise alone and not by other
    # accounts; NaN where they are not known
    uncertainty: float = float("nan")


@dataclass(frozen=True)
class Doubt:
    """Another account of the same contacts that the data leave possible."""

    odds: float  # how likely it is, over the likelier account, 0 to 1
    # (K, COLUMNS) of its contacts' parameters from those of the likelier account
    difference: FloatArray


class FieldAccountant:
    """Makes accounts of one sensor's fields."""

    def __init__(
        self,
        fit: FieldFit,  # what fits them
        areas: AreaFinder,  # finds areas on the map
    ) -> None:
        self._fit, self._areas = fit, areas
        self._graded = fit.responses.get(Channel.MAGNITUDE)
        self._saturating = fit.responses.get(Channel.STRUCTURE)
        x, y = areas.map_places
        self._cell_m = float(x[0, 1] - x[0, 0])
        self._step_m = self._cell_m / SAMPLES
        offset = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * self._step_m
        dx, dy = (each.ravel() for each in np.meshgrid(offset, offset))
        self._x = x.ravel()[:, None] + dx  # (cells, samples)
        self._y = y.ravel()[:, None] + dy
        self._shape = x.shape

    def account(
        self,
        fitted: FittedField,  # the field
        measured: Measured,  # the data that it explains
        # other accounts; where they are likely, images are the mean of all
        doubts: Sequence[Doubt] = (),
    ) -> FieldAccount:
        """Account for a field."""
        negligible = 0.02  # odds of what need not be drawn
        shown, family, weight = self._drawn(fitted, measured, None), fitted.family, 1.0
        if not isinstance(family, PressureField):
            return shown
        each = family.split(fitted.parameters)
        for doubt in doubts:
            if doubt.odds < negligible or doubt.difference.shape != each.shape:
                continue
            changed = each.copy()
            columns = [SIZE, PEAK, EDGE, HOLE]
            changed[:, columns] += doubt.difference[:, columns]
            changed[:, PEAK] = np.clip(changed[:, PEAK], *family.peak_limits)
            changed[:, [EDGE, HOLE]] = np.clip(changed[:, [EDGE, HOLE]], 0.0, 1.0)
            weight += doubt.odds
            shown = _mean(shown, self._drawn(fitted, measured, changed), doubt.odds / weight)
        return shown

    def _drawn(
        self, fitted: FittedField, measured: Measured, changed: FloatArray | None
    ) -> FieldAccount:
        """Account for a field, or for the same with its contacts (K, COLUMNS) changed."""
        family, needs_sigmas = fitted.family, True
        if changed is not None:
            assert isinstance(family, PressureField)
            # Of another account only what is felt of evener pressures is shown with its own sigma.
            before = family.split(fitted.parameters)
            needs_sigmas = bool((changed[:, EDGE] < before[:, EDGE]).any())
            family = family.of(changed, family.order)
            parameters = family.join(changed)
            fitted = replace(
                fitted, family=family, parameters=parameters, drawing=family.draw(parameters)
            )
        near, (solid, share, pressure) = self._images(fitted)
        magnitude, saturation = np.zeros(share.shape), np.ones(share.shape)
        if isinstance(self._graded, GradedResponse):
            magnitude = np.abs(self._graded.relative_change(pressure)[0])
        if isinstance(self._saturating, SaturatingResponse):
            saturation = self._saturating.saturation(pressure)[0]

        def seen(values: FloatArray) -> FloatArray:
            image = np.zeros(self._x.shape[0])
            image[near] = values.sum(axis=1) / values.shape[1]
            return image.reshape(self._shape)

        covered, whole = seen(share), seen(solid)
        drawing = fitted.drawing
        there = np.zeros(len(self._fit.forward.bare.pressable))
        there[drawing.nodes] = 1.0
        areas = self._areas.find(whole, there)
        mine = areas.on_nodes[:, drawing.nodes] > 0
        areas = self._areas.less(areas, covered / np.maximum(whole, 1e-12))
        known = self._contacts(fitted, measured, areas, mine, needs_sigmas)
        return FieldAccount(
            map=seen(share * magnitude),
            structure=seen(share * saturation),
            pressure_kpa=seen(share * pressure),
            **known,
        )

    def _images(self, fitted: FittedField) -> tuple[IntArray, FloatArray]:
        """Cells near what is pressed, and what is enclosed, share and pressure (3, cells, samples).

        Elsewhere nothing is pressed.
        """
        family, drawing = fitted.family, fitted.drawing
        if not isinstance(family, PressureField):
            on_nodes = np.zeros((2, len(self._fit.forward.bare.pressable)))
            on_nodes[:, drawing.nodes] = drawing.share, drawing.share * drawing.pressure_kpa
            share, pressed = (self._areas.on_map(each).reshape(-1, 1) for each in on_nodes)
            pressure = pressed / np.maximum(share, 1e-12)
            return np.arange(len(share)), np.stack([share, share, pressure])
        near = self._near(drawing)
        x, y = self._x[near], self._y[near]
        each = family.split(fitted.parameters)
        found = family.sampled(each, x.ravel(), y.ravel(), self._step_m)
        return near, np.reshape(found, (3, *x.shape))

    def _near(self, drawing: Drawing) -> IntArray:
        """Map cells next to a node that is pressed."""
        pressed = np.zeros(self._shape, bool)
        rows, columns = self._areas.nearest
        pressed[rows[drawing.nodes], columns[drawing.nodes]] = True
        grown = pressed.copy()
        grown[1:] |= pressed[:-1]
        grown[:-1] |= pressed[1:]
        pressed = grown.copy()
        grown[:, 1:] |= pressed[:, :-1]
        grown[:, :-1] |= pressed[:, 1:]
        return np.flatnonzero(grown)

    def _contacts(
        self,
        fitted: FittedField,
        measured: Measured,
        areas: Areas,
        mine: BoolArray,
        needs_sigmas: bool,
    ) -> dict[str, Any]:
        """Numbers of each area's contact, and what they do not know of themselves."""
        count = len(areas)
        nothing = np.full(count, np.nan)
        known: dict[str, Any] = {
            "areas": areas,
            "magnitudes": nothing,
            "magnitude_sigmas": nothing,
            "contacts": None,
            "goes_wrong_way": False,
        }
        if count == 0:
            return known
        family, drawing = fitted.family, fitted.drawing
        by_share = by_pressure = np.zeros((len(drawing.nodes), 0))
        own = together = displaced = np.zeros((0, 0))  # what is known for sure
        if needs_sigmas:
            J = self._fit.jacobian(fitted, measured, drawing)
            precision, data = self._fit.prior(fitted)[0], measured.values()
            own, together, displaced = (
                covariance_of(J, precision, inflation, fitted.misfit)[:-1, :-1]
                for inflation in (
                    np.full(len(J), UNFITTED**2),
                    np.concatenate([each.variance_inflation for each in data]),
                    np.concatenate([each.centre_inflation for each in data]),
                )
            )
            by_share, by_pressure = drawing.slopes()[2:]
        cell = self._areas.node_areas_m2[drawing.nodes]
        share, pressure = drawing.share, drawing.pressure_kpa

        def sigma(gradients: FloatArray, covariance: FloatArray = own) -> FloatArray:
            return np.asarray(np.sqrt(np.einsum("ki,ij,kj->k", gradients, covariance, gradients)))

        weight = mine * cell
        area = np.maximum(weight @ share, 1e-12)
        places = self._areas.places[:, drawing.nodes]
        off = [
            mine * cell * (axis - centre[:, None])
            for axis, centre in zip(places, areas.centres_m.T, strict=True)
        ]
        highest = np.where(mine, share * pressure, -1.0).argmax(axis=1)  # a node of each area
        each, owner, edges = np.zeros((0, 0)), np.zeros(0, int), nothing
        if isinstance(family, PressureField):
            each = family.split(fitted.parameters)
            owner = self._owners(each, places[:, highest])
            edges = each[owner, EDGE]
        # What a mesh cannot tell of an outline; magnitudes go against it. A pressure that falls
        # leaves no step there.
        of_mesh = 2 * self._cell_m / np.sqrt(areas.areas_m2 / np.pi)
        by_outline = np.where(edges > 0, 0.0, OUTLINE_ERROR * of_mesh)
        by_area = weight @ by_share
        sigmas = np.column_stack(
            [
                *(sigma(each_off @ by_share / area[:, None], displaced) for each_off in off),
                np.hypot(sigma(by_area), by_outline * areas.areas_m2),
            ]
        )
        known["areas"] = replace(areas, sigmas=sigmas)
        if Channel.MAGNITUDE not in measured or not isinstance(self._graded, GradedResponse):
            return known
        size, slope = (np.abs(v) for v in self._graded.relative_change(pressure))
        known["magnitudes"] = (weight @ (share * size)) / area
        by_magnitude = by_share * size[:, None] + (share * slope)[:, None] * by_pressure
        by_mean = (weight @ by_magnitude - known["magnitudes"][:, None] * by_area) / area[:, None]
        known["magnitude_sigmas"] = np.hypot(sigma(by_mean), by_outline * known["magnitudes"])
        of_area = sigma(by_area, together) / areas.areas_m2
        of_size = sigma(by_mean, together) / np.maximum(known["magnitudes"], 1e-12)
        of_map = (MAP_OUTLINE * of_mesh) ** 2
        unsure = of_area**2 + of_map + np.minimum(of_size**2 + of_map, 1.0)
        known["uncertainty"] = float(np.sqrt(np.mean(unsure)))
        peaks, by_peak = pressure[highest], by_pressure[highest]
        if isinstance(family, PressureField):
            peaks = family.unit_kpa * each[owner, PEAK]
            if needs_sigmas:
                index = family.index[owner, PEAK]
                by_peak = family.unit_kpa * np.eye(by_share.shape[1])[index]
                is_least = each[owner, PEAK] <= family.peak_limits[0]
                known["goes_wrong_way"] = self._goes_wrong_way(
                    J[:, index], fitted.residual, is_least
                )
        peak_size, peak_slope = (np.abs(v) for v in self._graded.relative_change(peaks))
        scale = areas.areas_m2 / area  # the map's, over the mesh's
        by_force = by_share * pressure[:, None] + share[:, None] * by_pressure
        total = weight @ (share * pressure)
        means = total / area
        by_mean_kpa = (weight @ by_force - means[:, None] * by_area) / area[:, None]
        by_outline_kpa = by_outline * peak_size / np.maximum(peak_slope, 1e-12)
        # What magnitude and area undo of it is the pressure beyond the table's onset alone.
        by_edge = np.abs(by_outline - by_outline_kpa / peaks)
        known["contacts"] = FieldContacts(
            peak_magnitude=peak_size,
            peak_magnitude_sigma=np.hypot(peak_slope * sigma(by_peak), by_outline * peak_size),
            felt=peak_size,
            felt_sigma=peak_slope * sigma(by_peak, together),
            peak_kpa=peaks,
            mean_kpa=means,
            mean_sigma_kpa=np.hypot(sigma(by_mean_kpa), by_outline_kpa * means / peaks),
            force_n=1e3 * total * scale,
            force_sigma_n=1e3 * scale * np.hypot(sigma(weight @ by_force), total * by_edge),
            edge=edges,
        )
        return known

    @staticmethod
    def _goes_wrong_way(
        # (sum M, K) derivative of the weighted residual by each contact's peak
        by_peak: FloatArray,
        residual: FloatArray,  # (sum M,) weighted
        is_least: BoolArray,  # (K,) whether a peak is as small as it may be
    ) -> bool:
        """Tell whether a contact that hardly presses would have to press less than nothing."""
        power = np.maximum((by_peak**2).sum(axis=0), 1e-12)
        return bool((is_least & (by_peak.T @ residual > WRONG_WAY * np.sqrt(power))).any())

    @staticmethod
    def _owners(each: FloatArray, highest_m: FloatArray) -> IntArray:
        """Contact (K,) of the field that presses hardest in each area."""
        apart = np.hypot(
            UNIT_M * each[:, X] - highest_m[0][:, None], UNIT_M * each[:, Y] - highest_m[1][:, None]
        )
        return np.asarray((apart / np.exp(each[:, SIZE])).argmin(axis=1))


def _mean(one: FieldAccount, other: FieldAccount, share: float) -> FieldAccount:
    """Mean of two accounts of the same areas, of which the other has a share.

    How far they are apart is part of the uncertainties.
    """
    if len(one.areas) != len(other.areas):
        return one

    def mean(first: FloatArray, second: FloatArray) -> FloatArray:
        return first + share * (second - first)

    def spread(sigma: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(np.hypot(sigma, np.sqrt(share * (1 - share)) * (second - first)))

    contacts = one.contacts
    if one.contacts is not None and other.contacts is not None:
        a, b = one.contacts, other.contacts
        is_evener = b.edge < a.edge
        contacts = FieldContacts(
            peak_magnitude=mean(a.peak_magnitude, b.peak_magnitude),
            peak_magnitude_sigma=spread(a.peak_magnitude_sigma, a.peak_magnitude, b.peak_magnitude),
            felt=np.where(is_evener, b.felt, a.felt),
            felt_sigma=np.where(is_evener, b.felt_sigma, a.felt_sigma),
            peak_kpa=mean(a.peak_kpa, b.peak_kpa),
            mean_kpa=mean(a.mean_kpa, b.mean_kpa),
            mean_sigma_kpa=spread(a.mean_sigma_kpa, a.mean_kpa, b.mean_kpa),
            force_n=mean(a.force_n, b.force_n),
            force_sigma_n=spread(a.force_sigma_n, a.force_n, b.force_n),
            edge=a.edge,
        )
    areas = replace(
        one.areas,
        areas_m2=mean(one.areas.areas_m2, other.areas.areas_m2),
        sigmas=np.column_stack(
            [
                one.areas.sigmas[:, :2],
                spread(one.areas.sigmas[:, 2], one.areas.areas_m2, other.areas.areas_m2),
            ]
        ),
    )
    return replace(
        one,
        areas=areas,
        map=mean(one.map, other.map),
        structure=mean(one.structure, other.structure),
        pressure_kpa=mean(one.pressure_kpa, other.pressure_kpa),
        magnitudes=mean(one.magnitudes, other.magnitudes),
        magnitude_sigmas=spread(one.magnitude_sigmas, one.magnitudes, other.magnitudes),
        contacts=contacts,
    )
