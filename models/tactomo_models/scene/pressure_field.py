"""The pressure field: contacts that press on all sheets alike, each of few parameters.

A contact is a closed outline and the pressure inside it. The outline is an ellipse (5 parameters),
whose radius may be modulated around its edge, which makes it an egg or a rounded rectangle (9). The
pressure is even, or falls towards the edge; a ring presses with its rim alone.

    u = B (x - x0),  B = exp(-s) expm(-E),  E = [[e1, e2], [e2, -e1]]     the unit circle of u
    log q = log |u| - sum_k (a_k cos k psi + b_k sin k psi),  psi = angle of u,  k = 3, 4
    phi = -log q |u|^2 / |B u|          distance inside the outline, to first order of it;
                                        held at its maximum where q < 1 / e
    h = H(phi / w)                      share pressed; H of compact support, 2 w wide
    p = P (1 - q^2)^gamma               pressure; gamma 0 is flat, 1/2 is Hertz

Where contacts overlap, what is pressed is pressed once, with the mean of their pressures.

A mesh blurs what is drawn on its nodes. Of a blurred disc of radius r voltages see the area, and
along each axis a second moment of r^2 / 4 + b, b the variance of the blur: it looks larger and
fainter. On a graded sheet a contact is drawn smaller and stronger, of radius k r and with a share
of h / k^2, so that both are those of the contact:

    k^2 = 1 - 2 (gamma + 2) b / r^2     r^2 / (2 gamma + 4) is the moment of a pressure that falls
"""

from __future__ import annotations

from ctypes import Structure, byref, c_double, c_int64
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, address, at
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.drawing import GRADED_WIDTH, Drawing, Slopes
from tactomo_models.scene.parameters import (
    COLUMNS,
    E1,
    E2,
    EDGE,
    EDGE_LIMITS,
    HARMONIC,
    HERTZ,
    HOLE,
    MAX_BULGE,
    PEAK,
    PEAK_LIMITS,
    PRIOR_SIGMA,
    SIZE,
    SMALLEST_SIZE,
    TYPICAL_SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.sheet_response import GradedResponse, SaturatingResponse

BELOW = 1 - 1e-9  # of the onset: a peak there leaves no trace, and the table has no slope


class _Field(Structure):
    """What C knows of a field: see `inner_loop.c`."""

    _fields_ = (
        *((name, c_double) for name in ("half_width_m", "grown_m2", "unit_kpa", "blur_m2")),
        *((name, c_int64) for name in ("forms", "is_sharp")),
    )


@dataclass(frozen=True)
class PressureField:
    """Contacts on a sheet, and which of their parameters are fitted."""

    x_m: FloatArray = field(repr=False)  # (P,) nodes
    y_m: FloatArray = field(repr=False)  # (P,) nodes
    half_width_m: float  # half the width over which the share falls from 1 to 0
    # how far outwards of its parameters an outline is drawn for a saturated sheet, times its radius
    grown_m2: float
    blur_m2: float  # variance of each axis by which the mesh blurs what is drawn; see above
    unit_kpa: float  # pressure that peaks are counted in: the end of the table
    onset: float  # pressure from which the graded sheet answers, in that unit
    # peak that a contact starts with, in that unit: the middle of what the table answers to
    typical_peak: float
    limits: FloatArray = field(repr=False)  # (2, COLUMNS) least and largest that a contact may have
    fills_box: bool = True  # whether the nodes lie all over their bounding box
    # (K, COLUMNS) parameters of each contact, as far as they are not fitted
    fixed: FloatArray = field(default_factory=lambda: np.zeros((0, COLUMNS)))
    # (K, COLUMNS) which are fitted
    free: BoolArray = field(default_factory=lambda: np.zeros((0, COLUMNS), bool))

    @classmethod
    def on(cls, forward: ForwardModel, graded: GradedResponse | None) -> PressureField:
        """A field without contacts on the nodes of a forward model.

        On a saturated sheet a mesh of linear triangles shows less than what is drawn on it, as if
        an area were missing of 0.53 of the square of the nodes' distance, times what the outline
        reflects to the power of 1.5, whatever the contact's size; so an outline is drawn that much
        larger there. Discs of 4 to 9 nodes' distances across (3 mm each) on saturated sheets of a
        contrast of 0.05 to 100 are then told with radii that err by -0.04 to 0.07 mm, without by
        0.05 to 0.42. A graded sheet's outlines stand where they are drawn, but for the blur.

        Args:
            forward: the model of the sheet.
            graded: the magnitude sheet's response; None where there is none.
        """
        structure, grown = forward.description.structure, 0.53 / 2  # see above
        reflected = SaturatingResponse.of(structure).reflected if structure else 0.0
        # A triangle has the mean of its corners, which spreads what is on a node over its hexagon;
        # and then there is the step from 1 to 0. ICC of tuning scenes without and with it: 0.989,
        # 0.991 at 40 dB, 0.954, 0.960 at 20 dB, 0.979, 0.981 of one graded sheet.
        of_triangles, of_step = 5 / 18, 1 / 3 - 2 / np.pi**2
        x, y = np.ascontiguousarray(forward.bare.points[:, forward.bare.pressable])
        description = forward.description
        spacing = description.spacing_m
        end_kpa = graded.end_kpa if graded else 300.0
        onset = graded.onset_kpa / end_kpa if graded else 0.0
        # Two triangles to a node: half of the sheet is in larger ones, whatever is along its rim.
        areas_m2 = np.sort(forward.triangle_areas_m2)
        node_m2 = 2 * float(areas_m2[areas_m2.cumsum().searchsorted(areas_m2.sum() / 2)])
        blur_m2 = of_triangles * node_m2 + of_step * (GRADED_WIDTH * spacing) ** 2
        limits = np.array([[-np.inf], [np.inf]]) * np.ones(COLUMNS)
        limits[:, X] = x.min() / UNIT_M, x.max() / UNIT_M
        limits[:, Y] = y.min() / UNIT_M, y.max() / UNIT_M
        longest_m = np.hypot(description.width_m, description.height_m) / 2
        limits[:, SIZE] = SMALLEST_SIZE, np.log(longest_m)
        limits[:, HARMONIC:PEAK] = [[-MAX_BULGE], [MAX_BULGE]]
        limits[:, PEAK] = PEAK_LIMITS
        limits[:, EDGE] = EDGE_LIMITS  # where it is fitted: what is even is another kind
        return cls(
            x,
            y,
            half_width_m=spacing,
            grown_m2=grown * reflected**1.5 * spacing**2,
            blur_m2=blur_m2,
            unit_kpa=end_kpa,
            onset=onset,
            typical_peak=(onset + 1) / 2,
            limits=limits,
            fills_box=description.sheet.shape == "rectangle",
        )

    @property
    def count(self) -> int:
        """Number of contacts, K."""
        return len(self.fixed)

    def of(self, each: FloatArray, *, fits_peaks: bool = True) -> PressureField:
        """A field of contacts (K, COLUMNS).

        A contact whose outline is modulated has that fitted, one whose edge is above 0 its edge.
        """
        free = np.zeros(each.shape, bool)
        free[:, :HARMONIC] = True
        free[:, PEAK] = fits_peaks
        free[:, EDGE] = fits_peaks & (each[:, EDGE] > 0)
        fixed = each.copy()
        modulated = np.asarray(fixed[:, HARMONIC:PEAK].any(axis=1))
        free[:, HARMONIC:PEAK] = modulated[:, None]
        return replace(self, fixed=fixed, free=free)

    def with_peaks_alone(self, parameters: FloatArray) -> PressureField:
        """Contacts of these parameters, of which nothing but the peaks is fitted any more."""
        free = np.zeros_like(self.free)
        free[:, PEAK] = True
        return replace(self, fixed=self.split(parameters), free=free)

    @cached_property
    def index(self) -> IntArray:
        """(K, COLUMNS) where each parameter stands in the vector of all; -1 where it is fixed."""
        index = np.full(self.free.shape, -1)
        index[self.free] = np.arange(self.free.sum())
        return index

    @cached_property
    def forms(self) -> int:
        """Columns of the form that any contact has."""
        waves = slice(HARMONIC, PEAK)
        modulated = bool(self.free[:, waves].any() or self.fixed[:, waves].any())
        return PEAK if modulated else HARMONIC

    def split(self, parameters: FloatArray) -> FloatArray:
        """(K, COLUMNS) parameters of each contact."""
        each = self.fixed.copy()
        each[self.free] = parameters
        return each

    def join(self, each: FloatArray) -> FloatArray:
        """Parameters (N,) that are fitted, of all contacts in one vector."""
        return each[self.free]

    def light(self, parameters: FloatArray) -> BoolArray:
        """Which contacts (K,) press too lightly for the graded sheet to answer."""
        return np.asarray(self.free[:, PEAK] & (self.split(parameters)[:, PEAK] < self.onset))

    @cached_property
    def prior_mean(self) -> FloatArray:
        """Contacts are circles of a fingertip's size, anywhere."""
        mean = np.zeros((self.count, COLUMNS))
        mean[:, SIZE], mean[:, PEAK] = TYPICAL_SIZE, self.typical_peak
        mean[:, EDGE] = np.where(self.fixed[:, EDGE] > 0, HERTZ, 0.0)
        mean[:, HOLE] = self.fixed[:, HOLE]
        return self.join(mean)

    @cached_property
    def prior_precision(self) -> FloatArray:
        """Inverse variances (N,) of that."""
        return self.join(np.broadcast_to(PRIOR_SIGMA**-2.0, self.free.shape))

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Keep centres on the sheet, and sizes, forms and pressures to those of contacts."""
        max_elongated = 0.9  # half the logarithm of the ratio of an ellipse's axes
        least, most = self.limits
        each = np.minimum(np.maximum(self.split(parameters), least), most)
        if not self.fills_box:
            for contact in each:
                off = (self.x_m - UNIT_M * contact[X]) ** 2 + (self.y_m - UNIT_M * contact[Y]) ** 2
                nearest = off.argmin()
                if off[nearest] > self.half_width_m**2:  # on the sheet, a node is nearer
                    contact[[X, Y]] = self.x_m[nearest] / UNIT_M, self.y_m[nearest] / UNIT_M
        elongation = np.maximum(np.hypot(each[:, E1], each[:, E2]), 1e-12)
        each[:, E1:HARMONIC] *= np.minimum(1, max_elongated / elongation)[:, None]
        return self.join(each)

    def as_light(self, parameters: FloatArray, light: BoolArray) -> FloatArray:
        """Parameters (N,) with the peaks of some contacts (K,) below the graded sheet's onset.

        Down there no slope tells how far to go.
        """
        if not light.any():
            return parameters
        kept, peaks = parameters.copy(), self.index[light, PEAK]
        kept[peaks] = np.minimum(kept[peaks], BELOW * self.onset)
        return kept

    def draw(self, parameters: FloatArray) -> Drawing:
        """Draw the field on the nodes."""
        each = self.split(parameters)
        of = byref(self._for_c())
        points = len(self.x_m)
        nodes, found = np.empty(points, np.intp), np.empty((4, points))
        places = at(self.x_m), at(self.y_m)
        count = LIBRARY.draw(of, len(each), at(each), points, *places, at(nodes), *_rows(found))
        nodes = nodes[:count].copy()

        @cache
        def slopes() -> Slopes:
            x_m, y_m = self.x_m[nodes], self.y_m[nodes]
            by = np.empty((4, count, self.index.max(initial=-1) + 1))
            points = count, at(x_m), at(y_m)
            LIBRARY.draw_slopes(
                of, len(each), at(each), *points, at(self.index), by.shape[2], *_rows(by)
            )
            return by[0], by[1], by[2], by[3]

        enclosed, enclosed_kpa, share, pressure = found[:, :count].copy()
        return Drawing(nodes, enclosed, enclosed_kpa, share, pressure, slopes)

    def _for_c(self, step_m: float | None = None) -> _Field:
        """For C; as sharp as points a step apart can show it, where there is one."""
        width, blur = (self.half_width_m, self.blur_m2) if step_m is None else (step_m, 0.0)
        return _Field(width, self.grown_m2, self.unit_kpa, blur, self.forms, step_m is not None)

    def sampled(
        self, each: FloatArray, x_m: FloatArray, y_m: FloatArray, step_m: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What is enclosed, share pressed and pressure in kPa at n points a step apart, (n,) each.

        Outlines are as sharp as the points can show them.
        """
        found = np.empty((4, len(x_m)))
        places = len(x_m), at(x_m), at(y_m)
        of = byref(self._for_c(step_m))
        LIBRARY.draw(of, len(each), at(each), *places, None, *_rows(found))
        return found[0], found[2], found[3]


def _rows(array: FloatArray) -> list[int]:
    """Where each row (of one or more dimensions) of an array that outlives its use begins."""
    return [address(array) + array.strides[0] * row for row in range(len(array))]


def ellipses_of(
    images: FloatArray,  # (K, rows, columns) share pressed by each contact, nowhere all 0
    x_m: FloatArray,  # (rows, columns) places, evenly spaced
    y_m: FloatArray,  # (rows, columns) places
    typical_peak: float,  # peak that each starts with, in the field's unit
) -> FloatArray:
    """Parameters (K, COLUMNS) of ellipses of the same centre, area and second moments."""
    cell_m2 = float((x_m[0, 1] - x_m[0, 0]) * (y_m[1, 0] - y_m[0, 0]))
    each = np.zeros((len(images), COLUMNS))
    each[:, PEAK] = typical_peak
    for contact, image in zip(each, images, strict=True):
        share = image / image.sum()
        x, y = float((share * x_m).sum()), float((share * y_m).sum())
        dx, dy = x_m - x, y_m - y
        # A cell is no point: it has moments of its own.
        xx, yy = ((share * d**2).sum() + cell_m2 / 12 for d in (dx, dy))
        xy = (share * dx * dy).sum()
        apart = np.hypot(xx - yy, 2 * xy) / 2
        long, short = (xx + yy) / 2 + apart, max((xx + yy) / 2 - apart, cell_m2 / 12)
        elongation, angle = np.log(long / short) / 4, np.arctan2(2 * xy, xx - yy)
        contact[[X, Y, SIZE]] = (x / UNIT_M, y / UNIT_M, np.log(image.sum() * cell_m2 / np.pi) / 2)
        contact[[E1, E2]] = elongation * np.cos(angle), elongation * np.sin(angle)
    return each
