"""What a fitted pressure field says: images, and each contact with its numbers and uncertainties.

Everything follows from the field and from the covariance of its parameters. Where the data leave
another account of the same contacts possible, images and numbers are the mean of all, and the
uncertainties know how far they are apart. Where they leave outlines open, images are the mean over
these, too: of all images the one of the least expected square error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.scans.changes import WRONG_WAY
from tactomo_models.scans.companion_forces import SheetsAndCompanions
from tactomo_models.scene.areas import AreaFinder, Areas
from tactomo_models.scene.drawing import Drawing
from tactomo_models.scene.evidence import Likelihood
from tactomo_models.scene.field_fit import Family, FieldFit, FittedField, Measured
from tactomo_models.scene.parameters import (
    E1,
    E2,
    EDGE,
    HOLE,
    PEAK,
    PEAK_LIMITS,
    SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.pressure import ONE_SIDED_95, FieldContacts
from tactomo_models.scene.pressure_field import PressureField
from tactomo_models.scene.sheet_response import GradedResponse, SaturatingResponse
from tactomo_models.scene.size_and_peak import ReflectionTable, SizeAndPeak, along_bend

# Of an outline's radius, over the nodes' distance, that no noise accounts for where a pressure is
# even: with 0.05, 59 % of rectangles' and rings' areas are within one sigma, with 0.07, 67 %.
OUTLINE_ERROR = 0.07
# Of a place, likewise: what is left of electrodes' places once the sheet is found. With half, 48 %
# of the places on hand-made skins are within one sigma, with twice 75 %.
PLACE_ERROR = 0.03
# Standard deviations of what is likely of the log ratio: of contrasts from a tenth of saturation
# to all of it, which ordinary skins have, none comes to two.
FAR_RATIO = 3.0
NEGLIGIBLE = 0.02  # share of an alternative that need not be drawn
TABLED_PEAKS = 200  # between a peak's limits, whose reflection is looked up
# Fields whose images are averaged where outlines are open. With 8 or 64 the maps of ordinary scenes
# at 10 dB have the same correlation to 0.001, those of crowds 0.001 less and more.
DRAWS = 16
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


@dataclass(frozen=True)
class Alternative:
    """What else one contact may be."""

    # how likely, over what it is taken for, if the others are what they are taken for
    odds: float
    marginal: float  # the same, whatever the others are
    contact: FloatArray  # (COLUMNS,) its parameters
    sigmas: FloatArray  # (COLUMNS,) their standard uncertainties


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
        if isinstance(self._graded, GradedResponse):
            peaks = np.geomspace(*PEAK_LIMITS, TABLED_PEAKS)
            size, _ = self._graded.relative_change(self._graded.end_kpa * peaks)
            self._reflection = ReflectionTable.of(peaks, size)
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
        # of each contact; where they are likely, images and numbers are the mean of all
        alternatives: Sequence[Sequence[Alternative]] = (),
        # (sum M, N + 1) of its weighted residual; None where it is not known yet
        jacobian: FloatArray | None = None,
    ) -> FieldAccount:
        """Account for a field."""
        shown = self._drawn(fitted, measured, jacobian)
        family = fitted.family
        if not isinstance(family, PressureField) or not len(shown.areas):
            return shown
        each = family.split(fitted.parameters)
        owner = self._owners_of(shown, each)
        for k, others in enumerate(alternatives):
            odds = [max(one.odds, one.marginal) for one in others]
            least = NEGLIGIBLE * (1 + sum(odds))
            likely = [one for one, of_it in zip(others, odds, strict=True) if of_it > least]
            if likely:
                shown = self._mixed(shown, family, each[k], likely, np.flatnonzero(owner == k))
        return shown

    def _sensed(self, fitted: FittedField, measured: Measured, J: FloatArray | None) -> FloatArray:
        """Derivative (sum M, N + 1) of the weighted residual by the parameters and the log ratio.

        Below its onset a graded sheet answers to nothing. What it would answer to is what bounds a
        light contact's pressure, so that there it is differentiated at its onset.
        """
        family = fitted.family
        if J is None:
            J = self._fit.jacobian(fitted, measured)
        if not isinstance(family, PressureField) or Channel.MAGNITUDE not in measured:
            return J
        if family.light(fitted.parameters).any():
            sensed, J = self._fit.jacobian_at_onset(fitted, measured), J.copy()
            start = [*measured].index(Channel.MAGNITUDE) * len(sensed)
            J[start : start + len(sensed)] = sensed
        return J

    def _covariance(self, fitted: FittedField, measured: Measured, J: FloatArray) -> FloatArray:
        """Covariance (N + 1, N + 1) of a field's parameters and the log ratio."""
        likelihood = Likelihood.of(measured)
        information = likelihood.information(J, likelihood.chi_squared(fitted.residual))
        information[np.diag_indices(len(information))] += fitted.prior[0]
        return np.asarray(np.linalg.inv(information), np.float64)

    def _drawn(self, fitted: FittedField, measured: Measured, J: FloatArray | None) -> FieldAccount:
        near, samples = self._sampled(fitted.family, fitted.parameters, fitted.drawing)
        whole, covered = (self._image(near, each) for each in samples[:2])
        drawing, images = fitted.drawing, self._images(near, samples)
        there = np.zeros(len(self._fit.forward.bare.pressable))
        there[drawing.nodes] = 1.0
        areas = self._areas.find(whole, there)
        mine = areas.on_nodes[:, drawing.nodes] > 0
        areas = self._areas.less(areas, covered / np.maximum(whole, 1e-12))
        known = _unknown(areas)
        if len(areas):
            J = self._sensed(fitted, measured, J)
            covariance = self._covariance(fitted, measured, J)
            known = self._contacts(fitted, measured, J, covariance, areas, mine)
            if isinstance(fitted.family, PressureField):
                images = self._mean(images, fitted.family, fitted.parameters, covariance[:-1, :-1])
        return FieldAccount(map=images[0], structure=images[1], pressure_kpa=images[2], **known)

    def _mean(
        self,
        images: FloatArray,  # (3, nodes_y, nodes_x) of the parameters
        family: PressureField,
        parameters: FloatArray,  # (N,)
        covariance: FloatArray,  # (N, N) of them
    ) -> FloatArray:
        """Images (3, nodes_y, nodes_x), mean over the parameters that are possible.

        Where outlines are known to the distance of samples, the mean shows the same.
        """
        sigmas = np.zeros(family.free.shape)
        sigmas[family.free] = np.sqrt(np.diag(covariance))
        scale = np.exp(family.split(parameters)[:, [SIZE]])
        scale = np.where(np.arange(PEAK) < SIZE, UNIT_M, scale)
        if np.linalg.norm(scale * sigmas[:, :PEAK], axis=1).max() < self._step_m:
            return images
        variances, axes = np.linalg.eigh(covariance)
        half = np.random.default_rng(0).standard_normal((DRAWS // 2, len(parameters)))
        # The symmetric root: it goes with the covariance evenly, so that images do not flicker.
        off = half @ (axes * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
        light, mean = family.light(parameters), np.zeros_like(images)
        for each in parameters + np.vstack([off, -off]):
            possible = family.as_light(family.bounded(each), light)
            mean += self._images(*self._sampled(family, possible, family.draw(possible))) / DRAWS
        return mean

    def _images(self, near: IntArray, samples: FloatArray) -> FloatArray:
        """Map, structure and pressure (3, nodes_y, nodes_x), see `FieldAccount`, of samples."""
        _, share, pressure = samples
        of_share = (*self._responses(pressure), pressure)
        return np.stack([self._image(near, share * each) for each in of_share])

    def _responses(self, pressure: FloatArray) -> tuple[FloatArray, FloatArray]:
        """|Relative change| of the graded sheet, and share of the saturating one's full change."""
        magnitude, saturation = np.zeros(pressure.shape), np.ones(pressure.shape)
        if isinstance(self._graded, GradedResponse):
            magnitude = np.abs(self._graded.relative_change(pressure)[0])
        if isinstance(self._saturating, SaturatingResponse):
            saturation = self._saturating.saturation(pressure)[0]
        return magnitude, saturation

    def _image(self, near: IntArray, values: FloatArray) -> FloatArray:
        """Image (nodes_y, nodes_x) of samples in the cells near what is pressed."""
        image = np.zeros(self._x.shape[0])
        image[near] = values.sum(axis=1) / values.shape[1]
        return image.reshape(self._shape)

    def _alone(self, family: PressureField, kinds: FloatArray) -> _Alone:
        """What one contact is by itself, of each kind (n, COLUMNS) that it may be."""
        reach = np.exp(kinds[:, SIZE] + np.hypot(kinds[:, E1], kinds[:, E2])) * 1.3 + self._cell_m
        of_kinds = (self._x[:, 0], X), (self._y[:, 0], Y)
        is_near = [abs(at[:, None] - UNIT_M * kinds[:, axis]) < reach for at, axis in of_kinds]
        near = np.flatnonzero((is_near[0] & is_near[1]).any(axis=1))
        x, y = self._x[near], self._y[near]
        drawn = [family.sampled(one[None], x.ravel(), y.ravel(), self._step_m) for one in kinds]
        _, share, pressure = np.reshape(drawn, (len(kinds), 3, *x.shape)).swapaxes(0, 1)
        magnitude, saturation = self._responses(pressure)
        values = np.stack([share * magnitude, share * saturation, share * pressure])
        sample_m2 = self._areas.cells_m2.flat[near] / SAMPLES**2
        total = np.maximum(share.sum(axis=2) @ sample_m2, 1e-18)
        by_magnitude, _, by_pressure = values.sum(axis=3) @ sample_m2
        peak = family.unit_kpa * kinds[:, PEAK]
        size = slope = np.zeros(len(kinds))
        if isinstance(self._graded, GradedResponse):
            size, slope = np.abs(self._graded.relative_change(peak))
        return _Alone(
            near,
            images=values.mean(axis=3),
            area_m2=total,
            magnitude=by_magnitude / total,
            mean_kpa=by_pressure / total,
            force_n=1e3 * by_pressure,
            peak_kpa=peak,
            peak_magnitude=size,
            slope=slope,
        )

    def _mixed(
        self,
        shown: FieldAccount,
        family: PressureField,
        contact: FloatArray,
        likely: Sequence[Alternative],
        own: IntArray,  # the areas that are this contact's
    ) -> FieldAccount:
        """The mean over what a contact may be; uncertainties know how far that is apart."""
        odds = np.array([1.0, *(one.odds for one in likely)])
        marginal = np.array([1.0, *(one.marginal for one in likely)])
        share, marginal = odds / odds.sum(), marginal / marginal.sum()
        kinds = np.stack([contact, *(each.contact for each in likely)])
        alone = self._alone(family, kinds)

        def mean(of: FloatArray, share: FloatArray = share) -> Any:
            return share @ (of - of[0])

        def spread(of: FloatArray) -> float:
            return float(np.sqrt(marginal @ (of - share @ of) ** 2))

        # The mean of a disc and a ring is a dent, which neither of them has.
        is_alike = (kinds[:, HOLE] > 0) == (contact[HOLE] > 0)
        alike = odds * is_alike / (odds @ is_alike)
        images = [shown.map.copy(), shown.structure.copy(), shown.pressure_kpa.copy()]
        for image, of, shares in zip(images, alone.images, (share, share, alike), strict=True):
            image.flat[alone.near] = np.maximum(image.flat[alone.near] + mean(of, shares), 0.0)
        shown = replace(shown, map=images[0], structure=images[1], pressure_kpa=images[2])
        if len(own) != 1:
            return shown
        at = own[0]

        def moved(values: FloatArray, of: FloatArray) -> FloatArray:
            changed = np.array(values, float)
            changed[at] = max(changed[at] + mean(of), 0.0)
            return changed

        def wider(sigmas: FloatArray, of: FloatArray, more: float = 0.0) -> FloatArray:
            changed = np.array(sigmas, float)
            changed[at] = np.sqrt(changed[at] ** 2 + spread(of) ** 2 + more)
            return changed

        areas = shown.areas
        sigmas = areas.sigmas.copy()
        sigmas[:, 2] = wider(sigmas[:, 2], alone.area_m2)
        areas = replace(areas, areas_m2=moved(areas.areas_m2, alone.area_m2), sigmas=sigmas)
        contacts = shown.contacts
        if contacts is not None:
            of_peaks = family.unit_kpa * np.array([0.0, *(one.sigmas[PEAK] for one in likely)])
            # Whatever else it may be has a peak of its own uncertainty.
            by_peak = alone.slope * of_peaks
            more = float(marginal @ by_peak**2)
            own_sigmas = np.hypot(contacts.peak_magnitude_sigma[at], by_peak)
            sides = contacts.peak_magnitude_sides.copy()
            skew = sides[:, at, None] / max(contacts.peak_magnitude_sigma[at], 1e-12)
            sides[:, at] = _sides(
                marginal, alone.peak_magnitude, skew * own_sigmas, share @ alone.peak_magnitude
            )
            felt = np.array(contacts.felt, float)
            felt[at] = alone.peak_magnitude[kinds[:, EDGE].argmin()]
            contacts = replace(
                contacts,
                peak_magnitude=moved(contacts.peak_magnitude, alone.peak_magnitude),
                peak_magnitude_sigma=wider(
                    contacts.peak_magnitude_sigma, alone.peak_magnitude, more
                ),
                peak_magnitude_sides=sides,
                felt=felt,
                peak_kpa=moved(contacts.peak_kpa, alone.peak_kpa),
                mean_kpa=moved(contacts.mean_kpa, alone.mean_kpa),
                mean_sigma_kpa=wider(contacts.mean_sigma_kpa, alone.mean_kpa),
                force_n=moved(contacts.force_n, alone.force_n),
                force_sigma_n=wider(contacts.force_sigma_n, alone.force_n),
                total_force_n=contacts.total_force_n + mean(alone.force_n),
                total_force_sigma_n=float(
                    np.hypot(contacts.total_force_sigma_n, spread(alone.force_n))
                ),
            )
        return replace(
            shown,
            areas=areas,
            magnitudes=moved(shown.magnitudes, alone.magnitude),
            magnitude_sigmas=wider(shown.magnitude_sigmas, alone.magnitude),
            contacts=contacts,
        )

    def _owners_of(self, shown: FieldAccount, each: FloatArray) -> IntArray:
        """The contact (A,) that is nearest to the centre of each area."""
        x, y = shown.areas.centres_m.T
        apart = np.hypot(UNIT_M * each[:, X] - x[:, None], UNIT_M * each[:, Y] - y[:, None])
        return np.asarray((apart / np.exp(each[:, SIZE])).argmin(axis=1))

    def _sampled(
        self, family: Family, parameters: FloatArray, drawing: Drawing
    ) -> tuple[IntArray, FloatArray]:
        """Cells near what is pressed, and what is enclosed, share and pressure (3, cells, samples).

        Elsewhere nothing is pressed.
        """
        if not isinstance(family, PressureField):
            on_nodes = np.zeros((2, len(self._fit.forward.bare.pressable)))
            on_nodes[:, drawing.nodes] = drawing.share, drawing.share * drawing.pressure_kpa
            share, pressed = (self._areas.on_map(each).reshape(-1, 1) for each in on_nodes)
            pressure = pressed / np.maximum(share, 1e-12)
            return np.arange(len(share)), np.stack([share, share, pressure])
        near = self._near(drawing)
        x, y = self._x[near], self._y[near]
        found = family.sampled(family.split(parameters), x.ravel(), y.ravel(), self._step_m)
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
        J: FloatArray,  # (sum M, N + 1) as sensed
        with_ratio: FloatArray,  # (N + 1, N + 1) covariance of parameters and the log ratio
        areas: Areas,  # one at least
        mine: BoolArray,
    ) -> dict[str, Any]:
        """Numbers of each area's contact, and what they do not know of themselves."""
        known, count = _unknown(areas), len(areas)
        family, drawing = fitted.family, fitted.drawing
        covariance = with_ratio[:-1, :-1]
        by_share, by_pressure = drawing.slopes()[2:]
        cell = self._areas.node_areas_m2[drawing.nodes]
        share, pressure = drawing.share, drawing.pressure_kpa

        def sigma(gradients: FloatArray) -> FloatArray:
            return np.asarray(np.sqrt((gradients @ covariance * gradients).sum(axis=1)))

        weight = mine * cell
        area = np.maximum(weight @ share, 1e-12)
        places = self._areas.places[:, drawing.nodes]
        off = [
            mine * cell * (axis - centre[:, None])
            for axis, centre in zip(places, areas.centres_m.T, strict=True)
        ]
        highest = np.where(mine, share * pressure, -1.0).argmax(axis=1)  # a node of each area
        each, owner, edges = np.zeros((0, 0)), np.zeros(0, int), np.full(count, np.nan)
        if isinstance(family, PressureField):
            each = family.split(fitted.parameters)
            owner = self._owners(each, places[:, highest])
            edges = each[owner, EDGE]
            if Channel.STRUCTURE in measured:
                known["goes_wrong_way"] = self._answers_strangely(fitted, each, with_ratio)
        # What a mesh cannot tell of an outline; magnitudes go against it. A pressure that falls
        # leaves no step there.
        of_mesh = 2 * self._cell_m / np.sqrt(areas.areas_m2 / np.pi)
        by_outline = np.where(edges > 0, 0.0, OUTLINE_ERROR * of_mesh)
        by_area = weight @ by_share
        sigmas = np.column_stack(
            [
                *(
                    np.hypot(sigma(each_off @ by_share / area[:, None]), PLACE_ERROR * self._cell_m)
                    for each_off in off
                ),
                np.hypot(sigma(by_area), OUTLINE_ERROR * of_mesh * areas.areas_m2),
            ]
        )
        if Channel.MAGNITUDE not in measured or not isinstance(self._graded, GradedResponse):
            known["areas"] = replace(areas, sigmas=sigmas)
            return known
        size, slope = self._felt(pressure)
        known["magnitudes"] = (weight @ (share * size)) / area
        by_magnitude = by_share * size[:, None] + (share * slope)[:, None] * by_pressure
        by_mean = (weight @ by_magnitude - known["magnitudes"][:, None] * by_area) / area[:, None]
        known["magnitude_sigmas"] = np.hypot(sigma(by_mean), by_outline * known["magnitudes"])
        peaks, by_peak = pressure[highest], by_pressure[highest]
        if isinstance(family, PressureField):
            peaks = family.unit_kpa * each[owner, PEAK]
            index = family.index[owner, PEAK]
            by_peak = family.unit_kpa * np.eye(by_share.shape[1])[index]
            rests = peaks <= max(self._graded.onset_kpa, family.unit_kpa * family.limits[0, PEAK])
            less = self._goes_wrong_way(J[:, index], fitted.residual, rests)
            known["goes_wrong_way"] = known["goes_wrong_way"] or less
        peak_size, peak_slope = self._felt(peaks)
        scale = areas.areas_m2 / area  # the map's, over the mesh's
        by_force = by_share * pressure[:, None] + share[:, None] * by_pressure
        total = weight @ (share * pressure)
        means = total / area
        by_mean_kpa = (weight @ by_force - means[:, None] * by_area) / area[:, None]
        by_outline_kpa = by_outline * peak_size / np.maximum(peak_slope, 1e-12)
        # What magnitude and area undo of it is the pressure beyond the table's onset alone.
        by_edge = np.abs(by_outline - by_outline_kpa / peaks)
        peak_sigma = np.hypot(peak_slope * sigma(by_peak), by_outline * peak_size)
        sides = np.stack([peak_sigma, peak_sigma])
        total_sigma, by_bend = np.hypot(sigma(weight @ by_force), total * by_edge), np.zeros(count)
        mean_sigma = np.hypot(sigma(by_mean_kpa), by_outline_kpa * means / peaks)
        if isinstance(family, PressureField):
            of_peaks, spreads = self._along_bends(family, each, covariance)
            of_mean, of_area, of_force = spreads[:, owner]
            sides = np.maximum(sides, of_peaks[:, owner])
            mean_sigma = np.maximum(mean_sigma, means * of_mean)
            sigmas[:, 2] = np.maximum(sigmas[:, 2], areas.areas_m2 * of_area)
            if not isinstance(measured, SheetsAndCompanions):  # else the force itself is told
                more = (total * of_force) ** 2 - total_sigma**2
                by_bend = np.sqrt(np.maximum(more, 0.0))
        known["areas"] = replace(areas, sigmas=sigmas)
        known["contacts"] = FieldContacts(
            peak_magnitude=peak_size,
            peak_magnitude_sigma=peak_sigma,
            peak_magnitude_sides=sides,
            felt=peak_size,
            felt_sigma=peak_slope * sigma(by_peak),
            peak_kpa=peaks,
            mean_kpa=means,
            mean_sigma_kpa=mean_sigma,
            force_n=1e3 * total * scale,
            force_sigma_n=1e3 * scale * np.hypot(total_sigma, by_bend),
            edge=edges,
            total_force_n=float(1e3 * total @ scale),
            # Errors of contacts that touch go against each other; those of their outlines do not.
            total_force_sigma_n=1e3
            * float(
                np.hypot(
                    sigma((scale @ (weight @ by_force))[None])[0],
                    np.linalg.norm([scale * total * by_edge, scale * by_bend]),
                )
            ),
        )
        return known

    def _along_bends(
        self, family: PressureField, each: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """How far peaks and sizes, and what follows of them, may be off along their bends.

        Returns:
            sides: (2, K) magnitudes under peaks, downwards and upwards, in `ONE_SIDED_95`.
            spreads: (3, K) mean pressures, areas and forces, root mean squares over these.
        """
        table, sides, spreads = self._reflection, np.zeros((2, len(each))), np.zeros((3, len(each)))
        for k, contact in enumerate(each):
            index = family.index[k, [SIZE, PEAK]]
            if index.min() < 0 or contact[PEAK] <= family.onset:
                continue
            known = SizeAndPeak(
                contact[[SIZE, PEAK]],
                covariance[np.ix_(index, index)],
                family.prior_mean[index],
                family.prior_precision[index],
                family.limits[:, SIZE],
            )
            bend = at_edge = along_bend(known, table)
            at, least, most = self._felt(family.unit_kpa * np.append(contact[PEAK], bend.peaks))[0]
            sides[:, k] = np.array([at - least, most - at]) / ONE_SIDED_95
            edge = family.index[k, EDGE]
            if edge >= 0:  # a peak and an edge that rise together leave mean and force as they are
                along = covariance[index, edge]
                fixed = known.covariance - np.outer(along, along) / covariance[edge, edge]
                at_edge = along_bend(replace(known, covariance=fixed), table)
            spreads[:, k] = at_edge.peak_spread, bend.area_spread, at_edge.force_spread
        return sides, spreads

    def _felt(self, pressure_kpa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """|Relative change| of the graded sheet and its slope; below its onset, the slope there."""
        assert isinstance(self._graded, GradedResponse)
        size, _ = self._graded.relative_change(pressure_kpa)
        _, slope = self._graded.relative_change(np.maximum(pressure_kpa, self._graded.onset_kpa))
        return np.abs(size), np.abs(slope)

    def _answers_strangely(
        self,
        fitted: FittedField,
        each: FloatArray,  # (K, COLUMNS) its contacts
        covariance: FloatArray,  # (N + 1, N + 1) of its parameters and the log ratio
    ) -> bool:
        """Tell whether the structure sheet would have to answer as no such sheet does.

        What the mesh does not tell of outlines it does not tell of the ratio: far from 1, twice
        the contrast is as good as an outline larger by a hundredth.
        """
        assert isinstance(fitted.family, PressureField)
        size = fitted.family.index[:, SIZE]
        by_size = covariance[-1, size] / covariance[size, size]
        of_mesh = by_size * OUTLINE_ERROR * self._cell_m / np.exp(each[:, SIZE])
        precision, offset = fitted.prior
        sigma = np.sqrt(1 / precision[-1] + of_mesh @ of_mesh)
        return bool(abs(offset[-1]) > FAR_RATIO * sigma)

    @staticmethod
    def _goes_wrong_way(
        # (sum M, K) derivative of the weighted residual by each contact's peak
        by_peak: FloatArray,
        residual: FloatArray,  # (sum M,) weighted
        rests: BoolArray,  # (K,) whether the graded sheet answers to none of it
    ) -> bool:
        """Tell whether a contact that hardly presses would have to press less than nothing."""
        power = np.maximum((by_peak**2).sum(axis=0), 1e-12)
        return bool((rests & (by_peak.T @ residual > WRONG_WAY * np.sqrt(power))).any())

    @staticmethod
    def _owners(each: FloatArray, highest_m: FloatArray) -> IntArray:
        """Contact (K,) of the field that presses hardest in each area."""
        apart = np.hypot(
            UNIT_M * each[:, X] - highest_m[0][:, None], UNIT_M * each[:, Y] - highest_m[1][:, None]
        )
        return np.asarray((apart / np.exp(each[:, SIZE])).argmin(axis=1))


def _unknown(areas: Areas) -> dict[str, Any]:
    """What an account has of areas of which no sheet tells how hard they are pressed."""
    nothing = np.full(len(areas), np.nan)
    return {
        "areas": areas,
        "magnitudes": nothing,
        "magnitude_sigmas": nothing,
        "contacts": None,
        "goes_wrong_way": False,
    }


def _sides(share: FloatArray, means: FloatArray, sigmas: FloatArray, told: float) -> FloatArray:
    """How far (2,) below and above a value the bounds of 95 % of normal distributions are.

    In `ONE_SIDED_95`; shares and means are of each distribution, (n,), and standard deviations
    (2, n) below and above its mean.
    """
    below, above = (means - 6 * sigmas[0]).min(), (means + 6 * sigmas[1]).max()
    least, most = np.full((2, 2), [[below], [above]])
    for _ in range(24):  # bisection of both, to a millionth of a sigma
        middle = (least + most) / 2
        off = middle[:, None] - means
        by = np.maximum(np.where(off < 0, *sigmas), 1e-12)
        is_less = ndtr(off / by) @ share < (0.05, 0.95)
        least, most = np.where(is_less, middle, least), np.where(is_less, most, middle)
    bounds = (least + most) / 2
    return np.asarray(np.maximum([told - bounds[0], bounds[1] - told], 0.0) / ONE_SIDED_95)


@dataclass(frozen=True)
class _Alone:
    """One contact by itself, of each kind that it may be."""

    near: IntArray  # (c,) map cells that it may touch
    images: FloatArray  # (3, n, c) of the map, the structure and the pressure in kPa
    area_m2: FloatArray  # (n,), as all below
    magnitude: FloatArray  # |relative conductivity change|, mean over the area
    mean_kpa: FloatArray
    force_n: FloatArray
    peak_kpa: FloatArray
    peak_magnitude: FloatArray  # |relative conductivity change| under the peak
    slope: FloatArray  # of that by the pressure
